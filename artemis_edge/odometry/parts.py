"""A frame in parts: where no IMU tells how the rig moved within a scan, it is registered bit by bit."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from artemis_edge.frames import Bool, LidarScan, SyncedFrame
from artemis_edge.odometry import se3
from artemis_edge.odometry.deskew import window
from artemis_edge.odometry.path import Path, PoseAt
from artemis_edge.odometry.scan_motion import ScanMotion, through, times
from artemis_edge.odometry.state import State


class Steps(NamedTuple):
    """What the parts of a frame gave, in order of time: the path to each and the state at its end."""

    steps: tuple[tuple[Path, State], ...]

    @property
    def last(self) -> State:
        """The state at the end of the frame."""
        return self.steps[-1][1]

    def at(self, stamp_ns: int) -> PoseAt:
        """The LiDAR at a time, by the part that holds it."""
        path, state = next((step for step in self.steps if step[1].stamp_ns >= stamp_ns), self.steps[-1])
        return path.at(state, (stamp_ns - state.stamp_ns) * 1e-9)

    def motion(self, stamp_ns: int, first_s: float, last_s: float) -> ScanMotion:
        """The LiDAR's motion over a window of seconds after a time, referred to its pose at that time."""
        if len(self.steps) == 1:
            path, state = self.steps[0]
            since_s = (stamp_ns - state.stamp_ns) * 1e-9
            return path.motion(state, first_s + since_s, last_s + since_s).referred_to(since_s)
        ends = times(first_s, last_s)
        poses = np.array([self.at(stamp_ns + round(1e9 * float(t))).T_world_lidar for t in ends])
        return through(ends, se3.inverse(self.at(stamp_ns).T_world_lidar) @ poses)


def in_parts(frame: SyncedFrame, part_s: float) -> tuple[SyncedFrame, ...]:
    """The frame cut by time into equal parts no longer than ``part_s``; all samples of the IMU are in each.

    A frame whose points all have one time stays whole.
    """
    first_s, last_s = window(frame)
    number = int(np.ceil((last_s - first_s) / part_s))
    if number < 2:
        return (frame,)
    cuts = np.linspace(first_s, last_s, number + 1)
    cuts[0], cuts[-1] = -np.inf, np.inf
    image_s = [(image.stamp_ns - frame.stamp_ns) * 1e-9 for image in frame.images]
    return tuple(
        replace(
            frame,
            scans=tuple(_between(scan, frame.stamp_ns, low, high) for scan in frame.scans),
            images=tuple(i for i, t in zip(frame.images, image_s, strict=True) if low < t <= high),
        )
        for low, high in pairwise(cuts)
    )


def _between(scan: LidarScan, stamp_ns: int, low_s: float, high_s: float) -> LidarScan:
    """The points of a scan later than one time after the stamp and not later than another."""
    shift_s = (scan.stamp_ns - stamp_ns) * 1e-9
    time_s = np.zeros(len(scan.points)) if scan.offset_s is None else scan.offset_s.astype(np.float64)
    inside: Bool = (time_s + shift_s > low_s) & (time_s + shift_s <= high_s)
    return replace(
        scan,
        points=scan.points[inside],
        offset_s=None if scan.offset_s is None else scan.offset_s[inside],
        intensity=None if scan.intensity is None else scan.intensity[inside],
    )
