"""The odometry's plane map around the sensor: scans go in, what lies far behind is forgotten."""

from __future__ import annotations

import numpy as np

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import F32, F64
from artemis_edge.odometry.known_map import KnownMap
from artemis_edge.odometry.plane_map import PlaneMap

_EVICT_TRAVEL = 0.25  # share of the range travelled after which far voxels are looked for
_FULL = 0.8  # share of the voxels in use from which room is made
_RECALLED = 0.6  # share up to which a known map fills them
_AT_ONCE = 32  # cells of a known map


class LocalMap:
    """``planes`` is the map; its voxels stay within the range and the number that the configuration says.

    A ``known`` map, in the same frame, is recalled around the sensor.
    """

    def __init__(self, config: OdometryConfig, known: KnownMap | None = None) -> None:
        self.planes = PlaneMap(config.voxel_m, config.levels, config.max_voxels)
        self._config = config
        self._evicted_at = np.zeros(3)
        self._known = known
        self._recalled = np.zeros(0 if known is None else len(known), np.bool_)

    def begin(self, points: F32, T_world_lidar: F64) -> None:
        """Forget everything and begin with what is known there and a scan, points float32 (n, 3) in the lidar frame."""
        self.planes.clear()
        self._recalled[:] = False
        self._evicted_at = T_world_lidar[:3, 3]
        self._recall(self._evicted_at)
        self.planes.insert(points, T_world_lidar)

    def add(self, points: F32, T_world_lidar: F64) -> int:
        """Add a scan; returns how many points found no room."""
        place = T_world_lidar[:3, 3]
        travelled = float(np.linalg.norm(place - self._evicted_at))
        far = travelled > _EVICT_TRAVEL * self._config.max_range_m
        if far or len(self.planes) > _FULL * self._config.max_voxels:
            radius_m = self.planes.evict(place, self._config.max_range_m)
            self._evicted_at = place
            if self._known is not None:
                self._recalled &= np.linalg.norm(self._known.centre - place, axis=1) <= radius_m
                self._recall(place)
        return self.planes.insert(points, T_world_lidar)

    def _recall(self, place: F64) -> None:
        """What is known around a place and not in the map, the nearest first."""
        if self._known is None:
            return
        cells = self._known.nearest(place, self._config.max_range_m)
        cells = cells[~self._recalled[cells]]
        for first in range(0, len(cells), _AT_ONCE):
            if len(self.planes) > _RECALLED * self._config.max_voxels:
                return
            some = cells[first : first + _AT_ONCE]
            self.planes.insert(self._known.points_of(some), np.eye(4))
            self._recalled[some] = True
