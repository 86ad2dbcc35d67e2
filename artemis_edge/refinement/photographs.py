"""Images on their way into the map: which can be used, decoded, and which are kept for a second look."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from artemis_edge.frames import F64, U8, CameraImage, CameraModel, TrackedFrame

# Share of an image that must be neither black nor clipped
_LEAST_USABLE = 0.02
_LOOKED_AT_EVERY = 8  # pixels, to judge that
_BLACK, _CLIPPED = 4, 250
# A hand that walks moves 0.1 to 0.15 m and turns up to 0.1 rad between two images at 10 Hz
_HARDLY_M, _HARDLY_RAD = 0.2, 0.1


@dataclass(frozen=True, slots=True)
class Waiting:
    """An image with its pose. ``twist`` (6,) of the body (m/s, rad/s), ``stamp`` the frame it came with."""

    image: CameraImage
    T_world_cam: F64
    twist: F64
    stamp: int


@dataclass(slots=True)
class Refused:
    """Images that could not be used, by reason, and one sentence for each reason."""

    count: dict[str, int] = field(default_factory=dict)
    sentences: dict[str, str] = field(default_factory=dict)

    def add(self, reason: str, image: CameraImage, sentence: str) -> None:
        """Count an image; its sentence is kept if it is the first of its kind."""
        self.count[reason] = self.count.get(reason, 0) + 1
        self.sentences.setdefault(reason, f"camera {image.name}, {image.stamp_ns * 1e-9:.3f} s: {sentence}")


def arrivals(frame: TrackedFrame, stamp: int, refused: Refused) -> list[Waiting]:
    """The images of a frame that have a finite pose and a usable camera model."""
    out = []
    for image, T_world_lidar in zip(frame.images, frame.image_poses, strict=True):
        if not is_calibrated(image.model):
            refused.add("images_without_calibration", image, "its calibration is not that of a camera")
        elif not (np.isfinite(T_world_lidar).all() and np.isfinite(image.T_cam_lidar).all()):
            refused.add("images_without_pose", image, "its pose is not finite")
        else:
            T = T_world_lidar @ np.linalg.inv(image.T_cam_lidar)
            out.append(Waiting(image, T, frame.twist, stamp))
    return out


def is_calibrated(model: CameraModel) -> bool:
    """Whether numbers of a camera model are finite and its focal lengths positive."""
    numbers = (model.fx, model.fy, model.cx, model.cy, *model.distortion)
    return all(math.isfinite(x) for x in numbers) and min(model.fx, model.fy) > 0.0 and model.width > 1


def decode(image: CameraImage, refused: Refused) -> U8 | None:
    """RGB uint8 (h, w, 3), or None for an image that cannot be used."""
    data = np.frombuffer(image.encoded, np.uint8)
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB) if len(data) else None
    except cv2.error:
        pixels = None
    if pixels is None:
        refused.add("images_undecodable", image, "its data are no image")
        return None
    if pixels.shape[:2] != (image.model.height, image.model.width):
        told = f"it has {pixels.shape[1]} x {pixels.shape[0]} pixels, its calibration is for "
        refused.add("images_of_wrong_size", image, told + f"{image.model.width} x {image.model.height}")
        return None
    few = pixels[::_LOOKED_AT_EVERY, ::_LOOKED_AT_EVERY].max(axis=2)
    if np.mean((few > _BLACK) & (few < _CLIPPED)) < _LEAST_USABLE:
        refused.add("images_black_or_clipped", image, "it is black or clipped nearly everywhere")
        return None
    return np.asarray(pixels, np.uint8)


@dataclass(slots=True)
class Alternate:
    """Chooses images of a map that grows: every second one where a camera hardly moves from one to the next.

    Two photographs from nearly the same place tell little more than one, and to see what a photograph shows costs
    the same however little of it is used. ``images`` is for how many each that is taken stands. Unless ``wanted``
    all are taken.
    """

    wanted: bool
    images: int = 1
    _last: dict[str, tuple[F64, bool]] = field(default_factory=dict)

    def takes(self, waiting: Waiting) -> bool:
        """Whether an image is used; to be asked of all, in order."""
        name, T = waiting.image.name, waiting.T_world_cam
        last, skipped = self._last.get(name, (None, True))
        near = self.wanted and last is not None and is_near(last, T, _HARDLY_M, _HARDLY_RAD)
        take = skipped or not near
        self._last[name] = T, not take
        self.images = 2 if near else 1
        return take


@dataclass(slots=True)
class Keyframes:
    """Images kept on disk, at most ``most``, each from another place than the one before.

    When there are too many every second one is let go and images are kept half as densely.
    """

    folder: Path
    most: int
    apart_m: float = 0.3
    apart_rad: float = 0.15
    _kept: list[tuple[Waiting, int, int]] = field(default_factory=list)
    _last: dict[str, F64] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self._kept)

    def offer(self, waiting: Waiting) -> bool:
        """Keep an image if it was taken far enough from the last one kept of its camera."""
        last = self._last.get(waiting.image.name)
        near = last is not None and is_near(last, waiting.T_world_cam, self.apart_m, self.apart_rad)
        if self.most == 0 or near:
            return False
        self.folder.mkdir(parents=True, exist_ok=True)
        with self._path.open("ab") as file:
            at = file.tell()
            file.write(waiting.image.encoded)
        bare = CameraImage(
            waiting.image.name,
            waiting.image.stamp_ns,
            b"",
            waiting.image.model,
            waiting.image.T_cam_lidar,
            waiting.image.exposure_s,
        )
        kept = Waiting(bare, waiting.T_world_cam, waiting.twist, waiting.stamp)
        self._kept.append((kept, at, len(waiting.image.encoded)))
        self._last[waiting.image.name] = waiting.T_world_cam
        if len(self._kept) > self.most:
            self._kept = self._kept[::2]
            self.apart_m, self.apart_rad = 2.0 * self.apart_m, 2.0 * self.apart_rad
        return True

    def get(self, k: int) -> Waiting:
        """Keyframe ``k`` with its data."""
        kept, at, size = self._kept[k]
        with self._path.open("rb") as file:
            file.seek(at)
            encoded = file.read(size)
        image = kept.image
        whole = CameraImage(
            image.name,
            image.stamp_ns,
            encoded,
            image.model,
            image.T_cam_lidar,
            image.exposure_s,
        )
        return Waiting(whole, kept.T_world_cam, kept.twist, kept.stamp)

    def close(self) -> None:
        """Remove the file."""
        self._path.unlink(missing_ok=True)
        self._kept = []

    @property
    def _path(self) -> Path:
        return self.folder / "colour_keyframes.bin"


def is_near(a: F64, b: F64, apart_m: float, apart_rad: float) -> bool:
    """Whether two poses (4, 4) are closer than a distance and an angle."""
    turn = math.acos(min(max((float(np.trace(a[:3, :3].T @ b[:3, :3])) - 1.0) / 2.0, -1.0), 1.0))
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])) < apart_m and turn < apart_rad
