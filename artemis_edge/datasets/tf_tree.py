"""The transform tree of a recording: static mountings, moving parts, the way from one frame to another."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from artemis_edge.frames import F64, I64, Bool, Trajectory
from artemis_edge.trajectory import covered, interpolate, inverse, matrix_from_quaternion

# A rotation shorter than this has no direction; a length beyond that is not on Earth.
_TINY, _FAR_M = 1e-6, 1e9


class _Edge:
    """Samples of ``T_parent_child``."""

    def __init__(self, moving: bool) -> None:
        self.moving = moving
        self.stamps: list[int] = []
        self.values: list[F64] = []
        self._trajectory: Trajectory | None = None

    def add(self, stamp_ns: int, value: F64) -> None:
        self.stamps.append(stamp_ns)
        self.values.append(value)
        self._trajectory = None

    def moves(self) -> bool:
        """Whether the samples differ, or there is but one of something that was published as moving.

        ROS 1 publishes fixed mountings again and again among the moving transforms.
        """
        return self.moving and (len(self.values) == 1 or bool(np.ptp(np.array(self.values), axis=0).any()))

    def trajectory(self) -> Trajectory:
        """Samples in order of time, the last of each stamp."""
        if self._trajectory is None:
            stamps, values = np.array(self.stamps, np.int64), np.array(self.values)
            order = np.argsort(stamps, kind="stable")
            last = np.append(np.diff(stamps[order]) > 0, True)
            stamps, values = stamps[order][last], values[order][last]
            self._trajectory = Trajectory(stamps, matrix_from_quaternion(values[:, :3], values[:, 3:]))
        return self._trajectory

    def at(self, stamp_ns: I64) -> tuple[F64, Bool]:
        """``T_parent_child`` (n, 4, 4) and where it is known: without motion always, else between samples."""
        samples = self.trajectory()
        if not self.moves():
            return np.broadcast_to(samples.T_world_lidar[-1], (len(stamp_ns), 4, 4)), np.ones(
                len(stamp_ns), bool
            )
        return interpolate(samples, stamp_ns), covered(samples, stamp_ns)


class TransformTree:
    """Frames by name (a leading slash does not count), each below one parent.

    Where a frame was published below several parents, the one with most samples is taken.
    """

    def __init__(self) -> None:
        self.broken = 0
        self._edges: dict[str, dict[str, _Edge]] = {}

    def add(
        self, parent: str, child: str, stamp_ns: int, translation: F64, rotation: F64, *, moving: bool
    ) -> None:
        """One sample of ``T_parent_child``; one that is no transform is counted in ``broken``."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        value = np.concatenate([translation, rotation])
        plausible = bool((np.abs(value) < _FAR_M).all())
        if parent == child or not plausible or np.linalg.norm(rotation) < _TINY:
            self.broken += 1
            return
        edge = self._edges.setdefault(child, {}).setdefault(parent, _Edge(moving))
        edge.moving |= moving
        edge.add(stamp_ns, value)

    def path_up(self, frame: str) -> list[str]:
        """The frame and all above it, the root last."""
        path = [frame.lstrip("/")]
        while (parent := self._parent(path[-1])) is not None and parent not in path:
            path.append(parent)
        return path

    def moves(self, frame: str) -> bool:
        """Whether anything between the frame and its root moves."""
        path = self.path_up(frame)
        return any(self._edges[child][parent].moves() for child, parent in pairwise(path))

    def connected(self, a: str, b: str) -> bool:
        """Whether there is a way between two frames."""
        return self.path_up(a)[-1] == self.path_up(b)[-1]

    def lookup(self, target: str, source: str, stamp_ns: I64) -> tuple[F64, Bool]:
        """``T_target_source`` (n, 4, 4) at stamps (n,), and where it is known.

        Moving parts are interpolated between their samples; only those between the two frames matter.
        """
        up_target, up_source = self.path_up(target), self.path_up(source)
        common = next((frame for frame in up_source if frame in up_target), None)
        if common is None:
            return np.tile(np.eye(4), (len(stamp_ns), 1, 1)), np.zeros(len(stamp_ns), bool)
        T_common_source, known = self._chain(up_source[: up_source.index(common) + 1], stamp_ns)
        T_common_target, known_target = self._chain(up_target[: up_target.index(common) + 1], stamp_ns)
        return inverse(T_common_target) @ T_common_source, known & known_target

    def _parent(self, child: str) -> str | None:
        parents = self._edges.get(child)
        return max(parents, key=lambda name: len(parents[name].stamps)) if parents else None

    def _chain(self, path: list[str], stamp_ns: I64) -> tuple[F64, Bool]:
        """``T_last_first`` of a path upwards."""
        T, known = np.tile(np.eye(4), (len(stamp_ns), 1, 1)), np.ones(len(stamp_ns), bool)
        for child, parent in pairwise(path):
            T_parent_child, here = self._edges[child][parent].at(stamp_ns)
            T, known = T_parent_child @ T, known & here
        return T, known
