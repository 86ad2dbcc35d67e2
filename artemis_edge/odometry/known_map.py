"""A map made before, as the odometry's local map recalls it: points near the sensor, as it walks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from artemis_edge.frames import F32, F64, I64

_CELL_M = 8.0
_AXIS_BITS = 20
_HALF = 1 << (_AXIS_BITS - 1)


class KnownMap:
    """Points float32 (n, 3) in the frame of the map, found by the cells of 8 m that they lie in."""

    def __init__(self, points: F32) -> None:
        cell: I64 = np.floor(points / _CELL_M).astype(np.int64)
        shifted = cell + _HALF
        key = (shifted[:, 0] << (2 * _AXIS_BITS)) | (shifted[:, 1] << _AXIS_BITS) | shifted[:, 2]
        order = np.argsort(key, kind="stable")
        _, first = np.unique(key[order], return_index=True)
        self._points: F32 = np.ascontiguousarray(points[order], np.float32)
        self._start: I64 = np.append(first, len(points)).astype(np.int64)
        self.centre: F64 = (cell[order][first].astype(np.float64) + 0.5) * _CELL_M

    def __len__(self) -> int:
        """Number of cells."""
        return len(self.centre)

    def nearest(self, place: F64, radius_m: float) -> I64:
        """Cells (k,) whose centre is within a radius of a place (3,), the nearest first."""
        away = np.linalg.norm(self.centre - place, axis=1)
        order = np.argsort(away, kind="stable")
        inside: I64 = order[away[order] <= radius_m]
        return inside

    def points_of(self, cells: I64) -> F32:
        """Points (n, 3) of some cells."""
        parts = [self._points[self._start[k] : self._start[k + 1]] for k in cells]
        return np.concatenate(parts) if parts else np.empty((0, 3), np.float32)


class Start(NamedTuple):
    """Where an odometry begins in a known map: T_map_world (4, 4) of the world that it would begin by itself."""

    T_map_world: F64
    known: KnownMap
