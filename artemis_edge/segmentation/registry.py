"""Models that can be used: those that the user registered and those that ship with the program."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

import msgspec

from artemis_edge.errors import InputError, RunError, UserError
from artemis_edge.segmentation import attribute
from artemis_edge.segmentation.backend import Backend
from artemis_edge.segmentation.manifest import Kind, Manifest, Part, read_manifest, write_manifest
from artemis_edge.segmentation.network import Network
from artemis_edge.segmentation.opening import (
    ROLES,
    Smoke,
    check_signature,
    guess_kind,
    names_in,
    open_model,
    smoke_test,
)
from artemis_edge.segmentation.yolo_seg import Thresholds

STORE_VARIABLE = "ARTEMIS_MODEL_STORE"
_MANIFEST = "manifest.json"
_CHUNK = 1 << 20
_HASH_DIGITS = 64
_NAME_CHARACTERS = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789._-")
_LONGEST_NAME = 100
_NOT_STATED = "not stated"


@dataclass(frozen=True, slots=True)
class Addition:
    """What ``models add`` was told. ``sha256`` and ``parts`` by role; the network itself is role ``model``."""

    file: Path
    sha256: Mapping[str, str]
    kind: Kind | None = None
    name: str | None = None
    licence: str | None = None
    classes: tuple[str, ...] = ()
    parts: Mapping[str, Path] = field(default_factory=dict)
    input_size: tuple[int, int] | None = None
    fine_input_size: tuple[int, int] | None = None
    synthetic_only: bool = False


@dataclass(frozen=True, slots=True)
class Entry:
    """A model of the registry; ``problem`` is a sentence where its manifest or files are not there."""

    manifest: Manifest
    folder: Path
    shipped: bool
    problem: str = ""

    def open(self, thresholds: Thresholds | None = None, fine: bool = False) -> Backend:
        """The model at work, ``fine`` as of :func:`open_model`; raises InputError where its files are damaged."""
        if self.manifest.kind == "attribute":
            return open_model(self.manifest, self.folder)
        problem = self.problem or _damage(self.manifest, self.folder)
        if problem:
            raise InputError(problem)
        return open_model(self.manifest, self.folder, thresholds, fine)


def store_folder() -> Path:
    """Where the user's models are kept: $ARTEMIS_MODEL_STORE, else in the data folder of the XDG rules."""
    if os.environ.get(STORE_VARIABLE):
        return Path(os.environ[STORE_VARIABLE])
    base = os.environ.get("XDG_DATA_HOME", "")
    # relative paths there are to be ignored by the rules
    root = Path(base) if base.startswith("/") else Path.home() / ".local" / "share"
    return root / "artemis-edge" / "models"


def shipped_folder() -> Path:
    """Where the models that ship with the program are."""
    return Path(str(resources.files("artemis_edge.segmentation") / "shipped"))


def open_by_name(name: str = "", thresholds: Thresholds | None = None, fine: bool = False) -> Backend:
    """A model at work by its name, ``fine`` as of :func:`open_model`; a process can be given the function."""
    return Registry().find(name).open(thresholds, fine)


class Registry:
    """All models, by name. Names of shipped models cannot be taken."""

    def __init__(self, store: Path | None = None, shipped: Path | None = None) -> None:
        self.store = store or store_folder()
        self._shipped = shipped or shipped_folder()

    def entries(self) -> list[Entry]:
        """Every model: the user's by name, those that ship, last the one without a network; with their problems."""
        own = sorted(self.store.glob(f"*/{_MANIFEST}"), key=str) if self.store.is_dir() else []
        ours = sorted(self._shipped.glob("*.json"), key=str)
        found = [_entry(path, False) for path in own if not path.parent.name.startswith(".")]
        found += [_entry(path, True) for path in ours]
        return [*found, Entry(attribute.manifest(), self._shipped, True)]

    def find(self, name: str = "") -> Entry:
        """The model of that name; without a name the user's only one, else the one that ships, else ``attribute``."""
        entries = self.entries()
        if name:
            for entry in entries:
                if entry.manifest.name == name:
                    return entry
            known = ", ".join(entry.manifest.name for entry in entries) or "none"
            raise InputError(f"no model named '{name}'; registered are: {known}")
        own = [entry for entry in entries if not entry.shipped]
        if len(own) > 1:
            names = ", ".join(entry.manifest.name for entry in own)
            raise InputError(f"several models are registered ({names}); choose one with --model NAME")
        return entries[0]

    def add(self, wanted: Addition) -> tuple[Manifest, Smoke]:
        """Register a model after it was tried; raises InputError, with nothing registered, where it does not fit."""
        files = {"model": wanted.file, **wanted.parts}
        for role, path in files.items():
            verify(path, wanted.sha256.get(role, ""), role)
        manifest = self._describe(wanted, files)
        with self._new_folder(manifest.name) as folder:
            for role, path in files.items():
                into = manifest.file if role == "model" else manifest.parts[role].file
                shutil.copyfile(path, folder / into)
            smoke = smoke_test(open_model(manifest, folder))
            if manifest.fine_input_size is not None:  # it must go through at that size, too
                smoke_test(open_model(manifest, folder, fine=True), manifest.fine_input_size)
            write_manifest(folder / _MANIFEST, manifest)
        return manifest, smoke

    def remove(self, name: str) -> None:
        """Forget one of the user's models and delete its files."""
        entry = self.find(name) if name else None
        if entry is None:
            raise InputError("name the model to remove; 'artemis-edge models list' lists them")
        if entry.shipped:
            raise InputError(f"the model {name} ships with the program and cannot be removed")
        shutil.rmtree(entry.folder)

    def _describe(self, wanted: Addition, files: Mapping[str, Path]) -> Manifest:
        name = _fitting(wanted.name or wanted.file.stem, self.entries())
        network = Network(wanted.file)
        kind = wanted.kind or guess_kind(network)
        _check_roles(kind, wanted.parts)
        inside = names_in(network) if kind in ("yolo-seg", "semantic") else ()
        classes = wanted.classes or inside
        check_signature(network, kind, len(classes))
        _check_names(classes)
        said = Manifest(
            name=name,
            kind=kind,
            file="model.onnx",
            sha256=wanted.sha256["model"].lower(),
            licence=wanted.licence or network.metadata.get("license", _NOT_STATED),
            classes=classes,
            parts={role: _part_of(role, files[role], wanted.sha256[role]) for role in wanted.parts},
            inputs={key: tuple(side or 0 for side in shape) for key, shape in network.inputs.items()},
            outputs={key: tuple(side or 0 for side in shape) for key, shape in network.outputs.items()},
            synthetic_only=wanted.synthetic_only,
        )
        if wanted.input_size is not None:
            said = msgspec.structs.replace(said, input_size=wanted.input_size)
        return _with_fine_size(said, network, wanted.fine_input_size)

    @contextmanager
    def _new_folder(self, name: str) -> Iterator[Path]:
        """A folder that takes its place in the store only when all went well."""
        folder, part = self.store / name, self.store / f".{name}.{os.getpid()}.part"
        try:
            part.mkdir(parents=True)
            yield part
            part.rename(folder)
        except OSError as error:
            raise RunError(
                f"cannot write {folder}: {error.strerror or error}; free space or set {STORE_VARIABLE}"
            ) from None
        finally:
            shutil.rmtree(part, ignore_errors=True)


def _with_fine_size(said: Manifest, network: Network, fine: tuple[int, int] | None) -> Manifest:
    """The manifest with a second, finer size to read at, where the network can be read at several."""
    if fine is None:
        return said
    if all(next(iter(network.inputs.values()))[2:]):
        raise InputError(
            f"{network.file} takes images of one size only; leave --fine-input-size out, or export it with open sides"
        )
    try:
        return msgspec.structs.replace(said, fine_input_size=fine)
    except ValueError:
        ours, theirs = ("x".join(map(str, size)) for size in (fine, said.input_size))
        raise InputError(
            f"--fine-input-size {ours} is not finer than the input size {theirs}; give a larger one"
        ) from None


def _part_of(role: str, path: Path, sha256: str) -> Part:
    return Part(
        file=f"{role}{''.join(path.suffixes[-2:]) if role == 'vocabulary' else path.suffix}",
        sha256=sha256.lower(),
    )


def _check_roles(kind: Kind, parts: Mapping[str, Path]) -> None:
    for role in parts:
        if role not in ROLES[kind]:
            takes = ", ".join(ROLES[kind]) or "none"
            raise InputError(f"--part {role}: a model of kind {kind} has no such part (it takes: {takes})")


def _check_names(classes: Sequence[str]) -> None:
    for k, name in enumerate(classes):
        if name in classes[:k]:
            raise InputError(
                f"'{name}' names both class {classes.index(name)} and class {k} of the model; give each its own name "
                "with --classes"
            )


def _fitting(name: str, entries: list[Entry]) -> str:
    """The name, if it can be one."""
    if not name or set(name) - _NAME_CHARACTERS or not name[0].isalnum() or len(name) > _LONGEST_NAME:
        raise InputError(f"'{name[:40]}' cannot be a model's name; give letters, digits, . _ - with --name")
    if any(entry.manifest.name == name for entry in entries):
        raise InputError(f"a model named '{name}' is there already; remove it or choose another with --name")
    return name


def verify(path: Path, sha256: str, role: str) -> None:
    """Raises InputError where a file cannot be read or is not the one of that hash."""
    option = "--sha256 H" if role == "model" else f"--sha256 {role}=H"
    if not sha256:
        raise InputError(
            f"{path}: say which file you mean by its hash with {option} ('sha256sum FILE' prints it)"
        )
    if len(sha256) != _HASH_DIGITS or set(sha256.lower()) - set("0123456789abcdef"):
        raise InputError(f"{option}: '{sha256[:70]}' is not a SHA-256 of {_HASH_DIGITS} hexadecimal digits")
    found = file_hash(path)
    if found != sha256.lower():
        raise InputError(
            f"{path} has the SHA-256 {found}, not {sha256.lower()}: it is damaged or another file; "
            "nothing was registered"
        )


def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal; raises InputError where it cannot be read."""
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while chunk := file.read(_CHUNK):
                digest.update(chunk)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    return digest.hexdigest()


def _entry(path: Path, shipped: bool) -> Entry:
    """A model by its manifest; a manifest that cannot be read is an entry with a problem."""
    try:
        manifest = read_manifest(path)
    except UserError as error:
        name = path.stem if shipped else path.parent.name
        broken = Manifest(name=name, kind="yolo-seg", file="none", sha256="0" * 64, licence=_NOT_STATED)
        return Entry(broken, path.parent, shipped, str(error))
    return Entry(manifest, path.parent, shipped, _missing(manifest, path.parent))


def _files(manifest: Manifest) -> dict[str, str]:
    """Hash by file name."""
    return {manifest.file: manifest.sha256, **{part.file: part.sha256 for part in manifest.parts.values()}}


def _missing(manifest: Manifest, folder: Path) -> str:
    lost = [file for file in _files(manifest) if not (folder / file).is_file()]
    if not lost:
        return ""
    return f"the model {manifest.name} is incomplete ({lost[0]} is gone); remove it and add it again"


def _damage(manifest: Manifest, folder: Path) -> str:
    """What is wrong with the files of a model; empty when nothing is."""
    for file, expected in _files(manifest).items():
        if file_hash(folder / file) != expected:
            return f"{folder / file} is not the file that was registered; remove the model and add it again"
    return ""
