"""Photographs kept with a map, so that a later question is answered without walking back.

``map/keyframes/`` holds them still encoded, with an ``index.json`` of the form of PHOTOS.json, and beside each the
depth that the map had in its view when it was taken (depth_file.py). What is kept is what was seen from elsewhere or
towards elsewhere; where they grow beyond their budget, from farther apart.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge.config import SegmentationConfig
from artemis_edge.depth_file import decode_depth, encode_depth
from artemis_edge.errors import InputError
from artemis_edge.export.atomic import write_bytes
from artemis_edge.frames import F32, F64, U8, CameraImage, CameraModel
from artemis_edge.json_file import read_json
from artemis_edge.progress import Report, say, silent
from artemis_edge.segmentation.backend import Backend, Prompt, Segmentation
from artemis_edge.segmentation.trial import decode
from artemis_edge.session.photos import file_of, view_of
from artemis_edge.sight import Sight
from artemis_edge.trajectory import inverse

FOLDER = "keyframes"
INDEX = "index.json"
#: What other parts of the program may have kept of a map's photographs, in the same form.
_OTHER_INDEX = "images.json"
_DEPTH = "_depth.png"
# A camera that moved less than this share of what makes a view another one stands still
_STILL = 0.25
_RENEW_NS = 1_000_000_000
_THINNING = 1.4  # the distance grows by this factor, the number falls to about half
_MB = 1_000_000

#: The view of a camera from a pose T_world_cam with the reference depth that the map has now.
Look = Callable[[CameraModel, F64], Sight]


@dataclass(frozen=True, slots=True)
class Apart:
    """Two views of a camera differ when they are so far apart or turned by so much (the one makes up for the other)."""

    metres: float
    radians: float

    def scaled(self, factor: float) -> Apart:
        """Farther apart."""
        return Apart(self.metres * factor, self.radians * factor)


@dataclass(frozen=True, slots=True)
class _Kept:
    image: CameraImage  # without its bytes
    T_world_cam: F64
    file: str
    depth: str  # file; empty: none
    size: int  # of both
    looked_ns: int | None  # when the map was asked for its depth last; None: it is not to be asked

    @property
    def files(self) -> list[str]:
        """The names of its files."""
        return [self.file, self.depth] if self.depth else [self.file]


@dataclass(slots=True)
class KeyframeStore:
    """Takes photographs as they come and keeps those from new views, at most ``budget_bytes`` of them.

    They are written to ``folder`` at once, so that they need no memory.
    """

    folder: Path
    apart: Apart
    budget_bytes: int
    offered: int = 0
    _kept: list[_Kept] = field(default_factory=list)

    @classmethod
    def by(cls, config: SegmentationConfig, folder: Path) -> KeyframeStore:
        """As configured."""
        apart = Apart(config.keyframe_m, math.radians(config.keyframe_deg))
        return cls(folder, apart, config.keyframes_mb * _MB)

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return sum(kept.size for kept in self._kept)

    def offer(self, image: CameraImage, T_world_cam: F64, look: Look | None = None) -> bool:
        """Keep a photograph if it shows what none kept shows; says whether it was kept.

        ``look`` gives a view with the reference depth that the map has now, which is kept with the photograph.
        While the camera stands still it is renewed: the map learns of a view that needs no other photograph.
        """
        self.offered += 1
        if not image.encoded or not np.isfinite(T_world_cam).all():
            return False
        if is_new(self._views(image.name), T_world_cam, self.apart):
            depth = b"" if look is None else _seen_by(look, image.model, T_world_cam)
            return self._keep(image, T_world_cam, depth, image.stamp_ns if look else None)
        if look is not None:
            self._renew(image, T_world_cam, look)
        return False

    def take_over(self, map_folder: Path) -> None:
        """Begin with the photographs of a map made before, and their depth; says how many cannot be read.

        Raises InputError where their index is damaged.
        """
        missing: list[str] = []
        for keyframe, image in _readable(map_folder, missing.append):
            self.offered += 1
            if is_new(self._views(image.name), keyframe.T_world_cam, self.apart):
                self._keep(image, keyframe.T_world_cam, _content(keyframe.depth), None)
        if missing:
            say(
                f"{len(missing)} photographs kept for questions cannot be read, the first: {missing[0]}; "
                "it goes on without them"
            )

    def _keep(self, image: CameraImage, T_world_cam: F64, depth: bytes, looked_ns: int | None) -> bool:
        bare = CameraImage(image.name, image.stamp_ns, b"", image.model, image.T_cam_lidar, image.exposure_s)
        file, size = file_of(image, self.offered), len(image.encoded) + len(depth)
        depth_file = f"{Path(file).stem}{_DEPTH}" if depth else ""
        kept = _Kept(bare, T_world_cam, file, depth_file, size, looked_ns)
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / kept.file).write_bytes(image.encoded)  # scratch: no need to wait for the disk
        if depth:
            (self.folder / kept.depth).write_bytes(depth)
        self._kept.append(kept)
        self._keep_budget()
        return any(item is kept for item in self._kept)

    def _renew(self, image: CameraImage, T_world_cam: F64, look: Look) -> None:
        """The depth of the camera's last photograph, if the camera still stands where it was taken."""
        of_camera = (k for k in range(len(self._kept) - 1, -1, -1) if self._kept[k].image.name == image.name)
        if (k := next(of_camera, None)) is None:
            return
        last = self._kept[k]
        if last.looked_ns is None or image.stamp_ns - last.looked_ns < _RENEW_NS:
            return
        if is_new([last.T_world_cam], T_world_cam, self.apart.scaled(_STILL)):
            return
        depth, path = _seen_by(look, last.image.model, last.T_world_cam), self.folder / last.depth
        size = last.size + len(depth) - path.stat().st_size
        path.write_bytes(depth)
        self._kept[k] = replace(last, size=size, looked_ns=image.stamp_ns)
        self._keep_budget()

    def _keep_budget(self) -> None:
        while self.size > self.budget_bytes and self._kept:
            self._thin()

    def after_copy(self) -> None:
        """In a copy of the process that takes over: the other may have thinned out the photographs."""
        self._kept = [k for k in self._kept if all((self.folder / name).exists() for name in k.files)]

    def save(self, map_folder: Path) -> int:
        """Move them into ``map/keyframes`` and write the index; returns bytes written."""
        into = map_folder / FOLDER
        into.mkdir(parents=True, exist_ok=True)
        for name in (name for kept in self._kept for name in kept.files):
            (self.folder / name).replace(into / name)
        content = (json.dumps({"photos": [_entry(kept) for kept in self._kept]}, indent=1) + "\n").encode()
        write_bytes(into / INDEX, content)
        return self.size + len(content)

    def _views(self, camera: str) -> list[F64]:
        return [kept.T_world_cam for kept in self._kept if kept.image.name == camera]

    def _thin(self) -> None:
        """Farther apart from now on; what is kept already is chosen anew, in order of time."""
        before, self._kept = self._kept, []
        self.apart = self.apart.scaled(_THINNING)
        for kept in before:
            if is_new(self._views(kept.image.name), kept.T_world_cam, self.apart):
                self._kept.append(kept)
            else:
                self._delete(kept)
        if len(before) == 1:  # one photograph beyond the budget
            for kept in self._kept:
                self._delete(kept)
            self._kept = []

    def _delete(self, kept: _Kept) -> None:
        for name in kept.files:
            (self.folder / name).unlink(missing_ok=True)


def is_new(views: Sequence[F64], T_world_cam: F64, apart: Apart) -> bool:
    """Whether a view (T_world_cam, z forward) differs from all of ``views``: moved and turned together count."""
    if not views:
        return True
    stack = np.stack(views)
    moved = np.linalg.norm(stack[:, :3, 3] - T_world_cam[:3, 3], axis=1)
    turned = np.arccos(np.clip(stack[:, :3, 2] @ T_world_cam[:3, 2], -1.0, 1.0))
    return bool(np.all(moved / apart.metres + turned / apart.radians >= 1.0))


def _seen_by(look: Look, camera: CameraModel, T_world_cam: F64) -> bytes:
    sight = look(camera, T_world_cam)
    return encode_depth(sight.depth, sight.lens)


def _content(path: Path | None) -> bytes:
    """Of a file; nothing where it is not there."""
    return path.read_bytes() if path is not None and path.is_file() else b""


def _entry(kept: _Kept) -> dict[str, Any]:
    model = kept.image.model
    return {
        "file": kept.file,
        **({"depth": kept.depth} if kept.depth else {}),
        "camera": kept.image.name,
        "stamp_ns": kept.image.stamp_ns,
        "width": model.width,
        "height": model.height,
        "fx": model.fx,
        "fy": model.fy,
        "cx": model.cx,
        "cy": model.cy,
        "distortion": list(model.distortion),
        "T_cam_world": inverse(kept.T_world_cam).tolist(),
    }


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A photograph of a finished map: its file, camera and pose; ``depth`` is the file of what the map knew of its
    view when it was taken, None where nothing was kept."""

    file: Path
    camera: str
    stamp_ns: int
    model: CameraModel
    T_world_cam: F64
    depth: Path | None = None

    def known_depth(self, lens: F64, refuse: Callable[[str], None]) -> F32:
        """The depth map of that time for a ``Sight`` with that ``lens``; empty where none can be read, which
        ``refuse`` is told."""
        try:
            if self.depth is not None:
                return decode_depth(self.depth.read_bytes(), lens)
        except OSError as error:
            refuse(f"cannot read {self.depth}: {error.strerror}")
        except InputError as error:
            refuse(f"{self.depth} {error}")
        return np.empty((0, 0, 4), np.float32)


def read_keyframes(map_folder: Path) -> list[Keyframe]:
    """The photographs of a map (its ``map`` folder), in order of time.

    Raises InputError where none were kept or the index cannot be read.
    """
    found = _indexed(map_folder)
    if not found:
        raise InputError(
            f"{map_folder} has no photographs to look at; map a recording that has images, with --query TEXT"
        )
    return found


def _indexed(map_folder: Path) -> list[Keyframe]:
    """The photographs of the first index that names some, in order of time; none where none does."""
    for index in (map_folder / FOLDER / INDEX, map_folder / _OTHER_INDEX):
        if not index.is_file():
            continue
        try:
            found = [_keyframe(index.parent, row) for row in read_json(index)["photos"]]
        except (AttributeError, ValueError, KeyError, OverflowError, TypeError, OSError) as error:
            raise InputError(f"{index} cannot be read ({error}); map the recording again") from None
        if found:
            return sorted(found, key=lambda item: (item.stamp_ns, item.camera))
    return []


def photographs(map_folder: Path) -> Iterator[tuple[CameraImage, F64]]:
    """The photographs of a map, whole, in a frame of their own, and T_world_cam (4, 4); none where none were kept.

    Raises InputError where their index is damaged.
    """
    for keyframe, image in _readable(map_folder):
        yield image, keyframe.T_world_cam


def _readable(
    map_folder: Path, missing: Callable[[str], None] = lambda sentence: None
) -> Iterator[tuple[Keyframe, CameraImage]]:
    for k in _indexed(map_folder):
        try:
            encoded = k.file.read_bytes()
        except OSError as error:
            missing(f"{k.file} ({error.strerror})")
            continue
        yield k, CameraImage(k.camera, k.stamp_ns, encoded, k.model, np.eye(4))


def _keyframe(folder: Path, row: dict[str, Any]) -> Keyframe:
    path = _inside(folder, row["file"])
    view = view_of(row, "a pose")
    width, height = int(row.get("width", 0)), int(row.get("height", 0))
    if not width or not height:
        pixels = decode(path.read_bytes())
        height, width = (0, 0) if pixels is None else pixels.shape[:2]
    model = replace(view.camera, width=width, height=height)
    camera, stamp = str(row.get("camera", path.stem)), int(row.get("stamp_ns", 0))
    depth = _inside(folder, row["depth"]) if row.get("depth") else None
    return Keyframe(path, camera, stamp, model, view.T_world_cam, depth)


def _inside(folder: Path, name: object) -> Path:
    """A file of a map's folder; ValueError where the name is none or leads out of it."""
    relative = Path(name) if isinstance(name, str) and name.isprintable() else None
    if relative is None or relative.is_absolute() or ".." in relative.parts:
        raise ValueError(f"{name!a:.80} is not a file in it")
    return folder / relative


def segment_all(
    keyframes: Sequence[Keyframe],
    backend: Backend,
    prompts: Sequence[Prompt],
    report: Report = silent,
    refuse: Callable[[str], None] = lambda sentence: None,
) -> Iterator[tuple[Keyframe, Segmentation]]:
    """Look for the prompts in every keyframe, in order; ``refuse`` is told of photographs that cannot be used."""
    for done, keyframe in enumerate(keyframes, start=1):
        image = _pixels(keyframe, refuse)
        if image is not None:
            yield keyframe, backend.segment(image, prompts)
        report(done, len(keyframes), keyframe.camera)


def _pixels(keyframe: Keyframe, refuse: Callable[[str], None]) -> U8 | None:
    try:
        image = decode(keyframe.file.read_bytes())
    except OSError as error:
        refuse(f"cannot read {keyframe.file}: {error.strerror}")
        return None
    if image is None:
        refuse(f"{keyframe.file} is not a photograph that can be read")
    elif image.shape[:2] != (keyframe.model.height, keyframe.model.width):
        refuse(f"{keyframe.file} is not of the size of its camera")
        return None
    return image
