"""The devices of a rig from ``firmware_cfg/``: a profile names a file a device, each is validated for itself."""

from __future__ import annotations

import hashlib
import tomllib
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from artemis_drivers.camera.settings import CameraSettings
from artemis_drivers.imu_serial.settings import ImuSettings
from artemis_drivers.livox_avia.settings import AviaConfig
from artemis_drivers.livox_mid360.settings import Mid360Config
from artemis_drivers.trigger.settings import TriggerSettings
from msgspec import Meta, Struct

from artemis_edge.devices.calibration import Calibration, read_calibration
from artemis_edge.errors import InputError

_LIDARS: dict[str, type[AviaConfig] | type[Mid360Config]] = {"avia": AviaConfig, "mid360": Mid360Config}
_T = TypeVar("_T")


class Profile(Struct, frozen=True, forbid_unknown_fields=True):
    """Names of device files (without .toml) in the folders of ``firmware_cfg/``; empty: the rig has none.

    ``override`` changes single fields of a device: ``[override.trigger] rate_hz = 20``, a device by its name.
    """

    lidar: tuple[str, ...] = ("avia",)
    imu: str = ""
    camera: tuple[str, ...] = ()
    trigger: str = ""
    calibration: str = ""
    override: dict[str, dict[str, Any]] = {}
    service: Annotated[dict[str, Any], Meta(description="Of ``run``: recording, control socket.")] = {}
    mapping: Annotated[dict[str, Any], Meta(description="Settings of the mapping (docs/tuning.md).")] = {}


@dataclass(frozen=True, slots=True)
class RigFile:
    """All settings of a rig. ``sources`` are the files it came from: name, text; they go into every recording."""

    lidars: tuple[AviaConfig | Mid360Config, ...]
    imu: ImuSettings | None
    cameras: tuple[CameraSettings, ...]
    trigger: TriggerSettings | None
    calibration: Calibration
    sources: dict[str, str]
    service: dict[str, Any] = field(default_factory=dict)
    mapping: dict[str, Any] = field(default_factory=dict)

    def digests(self) -> dict[str, str]:
        """SHA-256 of each source file."""
        return {name: hashlib.sha256(text.encode()).hexdigest() for name, text in self.sources.items()}


def shipped_folder() -> Path:
    """``firmware_cfg/`` as it ships: of the installed package, or of the checkout."""
    import artemis_drivers

    inside = Path(str(resources.files(artemis_drivers))) / "firmware_cfg"
    return inside if inside.is_dir() else Path(artemis_drivers.__file__).parents[2] / "firmware_cfg"


def load_rig(profile: Path | str, folder: Path | None = None) -> RigFile:
    """Read a profile (a file, or the name of one that ships) and the device files it names.

    A device file is looked for beside the profile's own tree first, then in ``folder``. Raises InputError naming
    the file and the field.
    """
    home = folder or shipped_folder()
    path = _profile_path(profile, home)
    sources: dict[str, str] = {}
    chosen: Profile = _convert(_read(path, sources), Profile, path)
    folders = [path.parent, path.parent.parent, home]
    unused = dict(chosen.override)

    def device(kind: str, name: str) -> tuple[dict[str, Any], Path]:
        file = _find(folders, kind, name)
        tree = _read(file, sources)
        for key in (kind, str(tree.get("name", name))):
            tree |= unused.pop(key, {})
        return tree, file

    rig = RigFile(
        lidars=tuple(_lidar(*device("lidar", name)) for name in chosen.lidar),
        imu=_convert(*_split(device("imu", chosen.imu), ImuSettings)) if chosen.imu else None,
        cameras=tuple(_convert(*_split(device("camera", n), CameraSettings)) for n in chosen.camera),
        trigger=_convert(*_split(device("trigger", chosen.trigger), TriggerSettings))
        if chosen.trigger
        else None,
        calibration=_calibration(folders, chosen.calibration, sources),
        sources=sources,
        service=chosen.service,
        mapping=chosen.mapping,
    )
    _require_complete(rig, unused, path)
    return rig


def _split(found: tuple[dict[str, Any], Path], kind: Any) -> tuple[dict[str, Any], Any, Path]:
    return found[0], kind, found[1]


def _require_complete(rig: RigFile, unused: dict[str, Any], path: Path) -> None:
    if unused:
        raise InputError(
            f"{path}: [override.{next(iter(unused))}] names no device of this profile; use lidar, imu, camera, "
            f"trigger or a device's own name"
        )
    names = [d.name for d in (*rig.lidars, *rig.cameras)]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"{path}: two devices are named '{twice[0]}'; give each its own name")
    missing = [c.name for c in rig.cameras if c.name not in rig.calibration.cameras]
    if missing:
        raise InputError(
            f"{path}: the calibration has nothing on camera '{missing[0]}'; calibrate it or leave it out"
        )


def _profile_path(profile: Path | str, home: Path) -> Path:
    path = Path(profile)
    if path.is_file():
        return path
    shipped = home / "profiles" / f"{profile}.toml"
    if shipped.is_file():
        return shipped
    there = ", ".join(sorted(p.stem for p in (home / "profiles").glob("*.toml"))) or "none"
    raise InputError(f"no rig profile '{profile}': give a file or one of: {there}")


def _find(folders: list[Path], kind: str, name: str) -> Path:
    for folder in folders:
        for path in (folder / kind / f"{name}.toml", folder / f"{name}.toml"):
            if path.is_file():
                return path
    raise InputError(f"no file {kind}/{name}.toml in {' or '.join(str(f) for f in folders)}")


def _calibration(folders: list[Path], name: str, sources: dict[str, str]) -> Calibration:
    if not name:
        return Calibration()
    for folder in folders:
        for path in (folder / "rig" / name / "calibration.toml", folder / name):
            if path.is_file():
                _read(path, sources)
                return read_calibration(path)
    raise InputError(f"no rig/{name}/calibration.toml in {' or '.join(str(f) for f in folders)}")


def _read(path: Path, sources: dict[str, str]) -> dict[str, Any]:
    try:
        text = path.read_text()
        tree = tomllib.loads(text)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not valid TOML: {error}") from None
    sources[f"{path.parent.name}/{path.name}"] = text
    return tree


def _lidar(tree: dict[str, Any], path: Path) -> AviaConfig | Mid360Config:
    kind = tree.pop("kind", None)
    if kind not in _LIDARS:
        raise InputError(f"{path}: kind is '{kind}'; write one of: {', '.join(_LIDARS)}")
    return _convert(tree, _LIDARS[kind], path)


def _convert(tree: dict[str, Any], kind: type[_T] | Any, path: Path) -> _T:
    try:
        made: _T = msgspec.convert(tree, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {error}; docs/hardware.md lists every field") from None
    return made
