"""Odometry whose poses are corrected by what closing its loops has shown."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from artemis_edge.frames import F64, Odometry, SyncedFrame, TrackedFrame, Trajectory
from artemis_edge.loop.closure import find_loops, require_extra
from artemis_edge.loop.graph import optimise
from artemis_edge.loop.keyframes import track_all
from artemis_edge.trajectory import interpolate, inverse


@dataclass(slots=True)
class CorrectedOdometry:
    """``inner`` with T_corrected_world of each time applied: ``correction`` has it at the keyframes' stamps."""

    inner: Odometry
    correction: Trajectory

    @property
    def instruction(self) -> str | None:
        """A sentence for the operator, or None."""
        said: str | None = getattr(self.inner, "instruction", None)
        return said

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        """As Odometry: the points are moved by the inner odometry, only the frame's place in world changes."""
        tracked = self.inner.track(frame)
        T = self._at(tracked.stamp_ns)
        direction = tracked.degenerate_direction
        return replace(
            tracked,
            T_world_lidar=T @ tracked.T_world_lidar,
            image_poses=tuple(
                self._at(image.stamp_ns) @ pose
                for image, pose in zip(tracked.images, tracked.image_poses, strict=False)
            ),
            degenerate_direction=None if direction is None else T[:3, :3] @ direction,
        )

    def _at(self, stamp_ns: int) -> F64:
        T: F64 = interpolate(self.correction, np.array([stamp_ns], np.int64))[0]
        return T


@dataclass(frozen=True, slots=True)
class Closed:
    """``correction`` T_corrected_world at the keyframes, ``loops`` that were proved, by how much the end moved, m."""

    correction: Trajectory
    loops: int
    end_moved_m: float

    def sentence(self) -> str:
        """For the user."""
        if not self.loops:
            return "no place was seen again; the poses are the odometry's"
        return f"{self.loops} loops were closed; the end of the way moved by {self.end_moved_m:.3f} m"


def close_loops(make: Callable[[], Odometry], frames: Iterable[SyncedFrame]) -> Closed:
    """Run the odometry over a recording, find its loops and correct it; InputError without the extra."""
    require_extra()
    _, keyframes = track_all(make(), frames)
    stamps = np.array([k.stamp_ns for k in keyframes], np.int64)
    before = np.array([k.T_world_lidar for k in keyframes]).reshape(-1, 4, 4)
    loops = find_loops(keyframes)
    after = optimise(keyframes, loops) if loops else before
    moved = float(np.linalg.norm(after[-1, :3, 3] - before[-1, :3, 3])) if len(before) else 0.0
    return Closed(Trajectory(stamps, after @ inverse(before)), len(loops), moved)
