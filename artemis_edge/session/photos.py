"""PHOTOS.json: its entries, and photographs kept out of the map, written with their poses for ``evaluate texture``."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote, unquote

import numpy as np

from artemis_edge.export.atomic import write_bytes
from artemis_edge.frames import (
    F64,
    CameraImage,
    CameraModel,
    Odometry,
    SyncedFrame,
    TrackedFrame,
    Trajectory,
)
from artemis_edge.lens import CAMERA_RULE, is_camera
from artemis_edge.trajectory import covered, interpolate, inverse, is_pose

INDEX = "PHOTOS.json"
FOLDER = "photos"
# The names that ``HeldOut`` gives: camera and number.
_NAMED = re.compile(r".+_\d{6,}\.(png|jpg)")
_PNG_MAGIC = b"\x89PNG"


class EntryError(ValueError):
    """An entry of an index is complete, but its numbers are those of no camera or no pose."""


class View(NamedTuple):
    """What an entry says of a photograph: its camera, without a size (0 x 0), and ``T_world_cam`` (4, 4)."""

    camera: CameraModel
    T_world_cam: F64


@dataclass(frozen=True, slots=True)
class _Photo:
    file: str
    image: CameraImage


@dataclass(frozen=True, slots=True)
class _Watching:
    odometry: Odometry
    held: HeldOut

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        return self.held.track(self.odometry, frame)


@dataclass(slots=True)
class HeldOut:
    """Takes every ``every``-th image of each camera, in order of time, out of the frames (0: none).

    The photographs are written to ``out`` as they come, so that they need no memory. Raises RunError when
    they cannot be.
    """

    out: Path
    every: int
    _seen: dict[str, int] = field(default_factory=dict)
    _photos: list[_Photo] = field(default_factory=list)
    _of_frame: tuple[CameraImage, ...] = ()
    _poses: dict[tuple[str, int], F64] = field(default_factory=dict)

    def take(self, frame: SyncedFrame) -> SyncedFrame:
        """The frame without what is held out."""
        self._of_frame = ()
        if self.every == 0 or not frame.images:
            return frame
        kept = tuple(image for image in frame.images if not self._takes(image))
        return replace(frame, images=kept)

    def watching(self, odometry: Odometry) -> Odometry:
        """The odometry, asked besides where the photographs held out were taken."""
        return odometry if self.every == 0 else _Watching(odometry, self)

    def track(self, odometry: Odometry, frame: SyncedFrame) -> TrackedFrame:
        """The tracked frame; the photographs held out of it get the pose at their time, but go no further."""
        held = self._of_frame
        if not held:
            return odometry.track(frame)
        self._of_frame = ()
        tracked = odometry.track(replace(frame, images=(*frame.images, *held)))
        n = len(frame.images)
        for image, T in zip(held, tracked.image_poses[n:], strict=False):
            self._poses[image.name, image.stamp_ns] = T
        return replace(tracked, images=tracked.images[:n], image_poses=tracked.image_poses[:n])

    def _takes(self, image: CameraImage) -> bool:
        number = self._seen.get(image.name, 0) + 1
        self._seen[image.name] = number
        if number % self.every:
            return False
        file = f"{FOLDER}/{file_of(image, number)}"
        (self.out / FOLDER).mkdir(exist_ok=True)
        write_bytes(self.out / file, image.encoded)
        bare = replace(image, encoded=b"")
        self._photos.append(_Photo(file, bare))
        self._of_frame = (*self._of_frame, bare)
        return True

    def remove_earlier(self) -> None:
        """Remove what an earlier run held out there: its index, and its photographs that are not this run's.

        Nothing is touched where there is no index, and no file that another program named.
        """
        if not (self.out / INDEX).is_file():
            return
        ours = {self.out / photo.file for photo in self._photos}
        folder = self.out / FOLDER
        for file in list(folder.iterdir()) if folder.is_dir() else []:
            if file not in ours and _NAMED.fullmatch(file.name) and file.is_file():
                file.unlink()
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
        (self.out / INDEX).unlink()

    def write_index(
        self, path: Path, trajectory: Trajectory, falloff: Mapping[str, F64] | None = None
    ) -> int:
        """Write PHOTOS.json; returns how many photographs have no pose and are not in it.

        The pose of a photograph is the odometry's at the middle of its exposure, else interpolated there. An entry
        has ``falloff`` where that of its camera's lens is known.
        """
        stamps = np.array([photo.image.stamp_ns for photo in self._photos], np.int64)
        known = covered(trajectory, stamps)
        poses = interpolate(trajectory, stamps) if known.any() else np.empty((0, 4, 4))
        content = []
        for k, photo in enumerate(self._photos):
            T = self._poses.get((photo.image.name, photo.image.stamp_ns), poses[k] if known[k] else None)
            known[k] = T is not None
            if T is not None:
                known_of_lens = {} if falloff is None else _falloff(falloff.get(photo.image.name))
                content.append(photo_entry(photo.file, photo.image, T) | known_of_lens)
        write_bytes(path, (json.dumps({"photos": content}, indent=1) + "\n").encode())
        return int(np.count_nonzero(~known))


def _falloff(coefficients: F64 | None) -> dict[str, Any]:
    return {} if coefficients is None else {"falloff": [round(float(a), 6) for a in coefficients]}


def file_of(image: CameraImage, number: int) -> str:
    """Name for the file of a camera's encoded image; a camera's name may hold what names of files may not."""
    return f"{quote(image.name, safe='', errors='replace')}_{number:06d}.{suffix_of(image.encoded)}"


def camera_of(file: str) -> tuple[str, int]:
    """Camera and number of a file that :func:`file_of` named; ValueError where it named none."""
    camera, _, number = Path(file).stem.rpartition("_")
    return unquote(camera), int(number)


def suffix_of(encoded: bytes) -> str:
    """``png`` or ``jpg``, for the name of an encoded image's file."""
    return "png" if encoded.startswith(_PNG_MAGIC) else "jpg"


def photo_entry(file: str, image: CameraImage, T_world_lidar: F64) -> dict[str, Any]:
    """Entry of PHOTOS.json for an image whose ``T_world_lidar`` at its stamp is known."""
    model = image.model
    T_cam_world: Sequence[Any] = (image.T_cam_lidar @ inverse(T_world_lidar)).tolist()
    return {
        "file": file,
        "fx": model.fx,
        "fy": model.fy,
        "cx": model.cx,
        "cy": model.cy,
        "distortion": list(model.distortion),
        "T_cam_world": T_cam_world,
    }


def view_of(entry: Any, pose: str = "T_cam_world") -> View:
    """Camera and pose of an entry that :func:`photo_entry` made, or another program.

    Raises EntryError, whose sentence calls the matrix ``pose``, where the numbers cannot be; AttributeError, KeyError,
    OverflowError, TypeError or another ValueError where the entry is not complete.
    """
    fx, fy, cx, cy = (float(entry[key]) for key in ("fx", "fy", "cx", "cy"))
    k1, k2, p1, p2, k3 = (float(k) for k in entry["distortion"])
    T_cam_world = np.array(entry["T_cam_world"], np.float64)
    if not is_camera(fx, fy, cx, cy) or not np.isfinite([k1, k2, p1, p2, k3]).all():
        raise EntryError(f"the distortion must be finite, and {CAMERA_RULE}")
    if not is_pose(T_cam_world):
        raise EntryError(f"{pose} is not a rotation and a translation as a 4 x 4 matrix")
    return View(CameraModel(0, 0, fx, fy, cx, cy, (k1, k2, p1, p2, k3)), inverse(T_cam_world))
