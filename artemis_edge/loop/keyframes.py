"""Pieces of the way with what was seen there, a metre or a turn apart."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from artemis_edge.frames import F32, F64, I64, Odometry, SyncedFrame, TrackedFrame, Trajectory
from artemis_edge.odometry import se3
from artemis_edge.trajectory import inverse

_APART_M, _APART_RAD = 1.0, 0.5
_CELL_M = 0.2  # one point of each cell
_FARTHEST_M = 40.0


class Keyframe(NamedTuple):
    """``points`` float64 (n, 3) in the lidar frame at its stamp, of all frames up to the next keyframe."""

    stamp_ns: int
    T_world_lidar: F64
    points: F64


def track_all(odometry: Odometry, frames: Iterable[SyncedFrame]) -> tuple[Trajectory, list[Keyframe]]:
    """Poses of all frames, and the keyframes."""
    stamps, poses = [], []
    keyframes: list[Keyframe] = []
    gathered: list[F64] = []
    for frame in frames:
        tracked = odometry.track(frame)
        T = tracked.T_world_lidar
        stamps.append(tracked.stamp_ns)
        poses.append(T)
        if not keyframes or _far(keyframes[-1].T_world_lidar, T):
            _close(keyframes, gathered)
            gathered = []
            keyframes.append(Keyframe(tracked.stamp_ns, T, np.empty((0, 3))))
        gathered.append(_seen_from(keyframes[-1].T_world_lidar, tracked))
    _close(keyframes, gathered)
    return Trajectory(np.array(stamps, np.int64), np.array(poses).reshape(-1, 4, 4)), keyframes


def _far(T_a: F64, T_b: F64) -> bool:
    step = se3.log(inverse(T_a) @ T_b)
    return bool(np.linalg.norm(step[:3]) > _APART_M or np.linalg.norm(step[3:]) > _APART_RAD)


def _seen_from(T_world_key: F64, tracked: TrackedFrame) -> F64:
    points: list[F32] = [scan.points for scan in tracked.scans]
    cloud = np.concatenate(points) if points else np.empty((0, 3), np.float32)
    near = np.square(cloud).sum(axis=1) < _FARTHEST_M**2
    T = inverse(T_world_key) @ tracked.T_world_lidar
    return thinned(cloud[near] @ T[:3, :3].T + T[:3, 3])


def _close(keyframes: list[Keyframe], gathered: list[F64]) -> None:
    if keyframes:
        keyframes[-1] = keyframes[-1]._replace(points=thinned(np.concatenate(gathered)))


def thinned(points: F64) -> F64:
    """The first point of each cell of 0.2 m."""
    cell: I64 = np.floor(points / _CELL_M).astype(np.int64)
    _, first = np.unique(cell, axis=0, return_index=True)
    kept: F64 = points[np.sort(first)].astype(np.float64)
    return kept


def submap(keyframes: list[Keyframe], k: int, around: int = 2) -> F64:
    """Points (n, 3) of a keyframe and its neighbours, in its own lidar frame."""
    T_key_world = inverse(keyframes[k].T_world_lidar)
    parts = []
    for other in keyframes[max(k - around, 0) : k + around + 1]:
        T = T_key_world @ other.T_world_lidar
        parts.append(other.points @ T[:3, :3].T + T[:3, 3])
    return thinned(np.concatenate(parts))
