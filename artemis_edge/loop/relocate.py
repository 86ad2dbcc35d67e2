"""Finding out, as a recording goes on, where in a saved map it is made."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from artemis_edge.frames import F32, F64, Odometry, SyncedFrame, TrackedFrame
from artemis_edge.loop.recognition import Place, Recognition
from artemis_edge.odometry import se3
from artemis_edge.odometry.thin import first_per_voxel

_SPACING_M, _FARTHEST_M = 0.15, 40.0
_MORE = 1.5  # a piece is looked for again when so much more of it is seen
_LEAST_S = 2.0  # between two looks: each takes seconds of CPU
_LEAST_POINTS = 2000
_LONGEST_M = (
    30.0  # of way, after which a piece begins anew: its odometry has drifted, or it is not in the map
)


class Found(NamedTuple):
    """T_map_world (4, 4) of the recording's own world, when it was known (ns), looks taken, and how clear it was."""

    T_map_world: F64
    stamp_ns: int
    looks: int
    place: Place


class Search:
    """Takes tracked frames of a recording's own world until they are recognised; ``looks`` counts the attempts.

    A piece of the way is gathered and looked for as it grows, for two rooms look alike until the corner is seen.
    """

    def __init__(self, recognition: Recognition) -> None:
        self.looks = 0
        self._recognition = recognition
        self._piece: F32 = np.empty((0, 3), np.float32)
        self._looked_at = 0
        self._looked_ns = 0
        self._way_m = 0.0
        self._last: F64 | None = None

    def add(self, tracked: TrackedFrame) -> Found | None:
        """Take a frame; where it was recognised, once that is clear."""
        T = tracked.T_world_lidar
        if self._last is None:
            self._looked_ns = tracked.stamp_ns
        else:
            self._way_m += float(np.linalg.norm(T[:3, 3] - self._last[:3, 3]))
        self._last = T
        self._gather(tracked)
        enough = len(self._piece) > max(_MORE * self._looked_at, _LEAST_POINTS)
        found = None
        if enough and (tracked.stamp_ns - self._looked_ns) * 1e-9 > _LEAST_S:
            found = self._look(tracked.stamp_ns)
        if found is None and self._way_m > _LONGEST_M:
            found = self._look(tracked.stamp_ns)
            self._piece, self._looked_at, self._way_m = self._piece[:0], 0, 0.0
        return found

    def last_look(self) -> Found | None:
        """At the end of the recording: with all there is."""
        return None if self._last is None else self._look(self._looked_ns)

    def _look(self, stamp_ns: int) -> Found | None:
        """The piece in axes of the world about its middle, so that its heading is free to be found."""
        if len(self._piece) < _LEAST_POINTS:
            return None
        self.looks += 1
        self._looked_at, self._looked_ns = len(self._piece), stamp_ns
        middle: F64 = self._piece.mean(axis=0, dtype=np.float64)
        place = self._recognition.find((self._piece - middle).astype(np.float32))
        if place is None:
            return None
        T_piece_world = np.eye(4)
        T_piece_world[:3, 3] = -middle
        return Found(se3.orthonormal(place.T_map_piece @ T_piece_world), stamp_ns, self.looks, place)

    def _gather(self, tracked: TrackedFrame) -> None:
        parts = [self._piece]
        R, t = tracked.T_world_lidar[:3, :3], tracked.T_world_lidar[:3, 3]
        for scan in tracked.scans:
            rows = first_per_voxel(np.ascontiguousarray(scan.points), _SPACING_M, 0.5, _FARTHEST_M)
            parts.append((scan.points[rows] @ R.T + t).astype(np.float32))
        piece = np.concatenate(parts)
        self._piece = piece[first_per_voxel(piece, _SPACING_M, 0.0, np.inf)]


def search_all(
    recognition: Recognition, make: Callable[[], Odometry], frames: Iterable[SyncedFrame]
) -> Found | None:
    """Run an odometry over a recording until it is recognised."""
    odometry, search = make(), Search(recognition)
    for frame in frames:
        found = search.add(odometry.track(frame))
        if found is not None:
            return found
    return search.last_look()
