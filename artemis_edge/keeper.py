"""What of the input stays beside the map: points and images, for the baseline of ``evaluate texture`` and exports,
and keyframes, for questions asked later.

Everything is written between frames, never inside one.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np

from artemis_edge.config import KeepConfig, SegmentationConfig
from artemis_edge.frames import F32, F64, CameraModel, LidarScan, SyncedFrame, TrackedFrame, Trajectory
from artemis_edge.kept_images import ImageSpool
from artemis_edge.kept_points import PointSpool, open_points
from artemis_edge.segmentation.keyframes import KeyframeStore
from artemis_edge.sight import Sight
from artemis_edge.trajectory import inverse

Prepare = Callable[[SyncedFrame], SyncedFrame]


class Tracker(Protocol):
    """What the keeper needs of the pipeline: the last frame that was tracked, and the depth of the map after it."""

    tracked: TrackedFrame | None

    def sight(self, camera: CameraModel, T_world_cam: F64) -> Sight:
        """The view of a camera with the reference depth that the map has now."""
        ...


class Keeper:
    """Keeps what the frames of a run brought, in ``folder`` until it is saved."""

    def __init__(
        self, folder: Path, rules: KeepConfig, segmentation: SegmentationConfig | None = None
    ) -> None:
        """Without ``segmentation`` no keyframes are kept."""
        self._points = PointSpool(folder / "points", rules.points)
        images = folder / "images"
        images.mkdir()
        self._images = ImageSpool(images, rules.images)
        self._keyframes = (
            None if segmentation is None else KeyframeStore.by(segmentation, folder / "keyframes")
        )
        self._pending: tuple[SyncedFrame, Tracker] | None = None

    def take_over(self, folder: Path) -> None:
        """Begin with what the folder ``map/`` of a map made before has kept."""
        points = open_points(folder)
        if points is not None:
            self._points.take_over(points)
        self._images.take_over(folder)
        if self._keyframes is not None:
            self._keyframes.take_over(folder)

    def between(self, prepare: Prepare, tracker: Tracker) -> Prepare:
        """``prepare``, which is called before every frame, after what the last frame brought is written."""

        def both(frame: SyncedFrame) -> SyncedFrame:
            self.store()
            frame = prepare(frame)
            self._pending = frame, tracker
            return frame

        return both

    def store(self) -> None:
        """Write what the last frame brought, if it could be tracked."""
        if self._pending is None:
            return
        frame, mapper = self._pending
        tracked, self._pending = mapper.tracked, None
        if tracked is None or tracked.index != frame.index:
            return
        for image in frame.images:
            self._images.add(image)
        self._offer_keyframes(tracked, mapper)
        for scan, moved in zip(frame.scans, tracked.scans, strict=True):
            time_s, intensity = _of_rows(scan, len(moved.points))
            points = _to_world(moved.points, tracked.T_world_lidar)
            self._points.add(points, scan.stamp_ns, time_s, intensity)

    def _offer_keyframes(self, tracked: TrackedFrame, mapper: Tracker) -> None:
        """Images whose pose is known, with the depth that the map has at their time."""
        if self._keyframes is not None and tracked.image_poses:
            for image, T_world_lidar in zip(tracked.images, tracked.image_poses, strict=True):
                T_world_cam = T_world_lidar @ inverse(image.T_cam_lidar)
                self._keyframes.offer(image, T_world_cam, mapper.sight)

    def after_copy(self) -> None:
        """In a copy of the process that takes over (service/checkpoint.py): as the files are now."""
        self._points.after_copy()
        self._images.after_copy()
        if self._keyframes is not None:
            self._keyframes.after_copy()

    def save(self, folder: Path, trajectory: Trajectory) -> int:
        """Write points, images and keyframes into a map's folder; returns the size in bytes."""
        self.store()
        size = self._points.save(folder) + self._images.save(folder, trajectory)
        if self._keyframes is not None and len(self._keyframes):
            size += self._keyframes.save(folder)
        return size


def _to_world(points: F32, T_world_lidar: F64) -> F32:
    R, t = T_world_lidar[:3, :3], T_world_lidar[:3, 3]
    world: F32 = (points @ R.T + t).astype(np.float32)
    return world


def _of_rows(scan: LidarScan, count: int) -> tuple[F32, F32 | None]:
    """Time and intensity of the points; zero and unknown where an odometry leaves points out."""
    same = count == len(scan.points)
    zero = np.zeros(count, np.float32)
    return scan.offset_s if same and scan.offset_s is not None else zero, scan.intensity if same else None
