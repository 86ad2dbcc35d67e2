"""The odometry's plane map around the sensor: scans go in, what lies far behind is forgotten."""

from __future__ import annotations

import numpy as np

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import F32, F64
from artemis_edge.odometry.plane_map import PlaneMap

_EVICT_TRAVEL = 0.25  # share of the range travelled after which far voxels are looked for
_FULL = 0.8  # share of the voxels in use from which room is made


class LocalMap:
    """``planes`` is the map; its voxels stay within the range and the number that the configuration says."""

    def __init__(self, config: OdometryConfig) -> None:
        self.planes = PlaneMap(config.voxel_m, config.levels, config.max_voxels)
        self._config = config
        self._evicted_at = np.zeros(3)

    def begin(self, points: F32, T_world_lidar: F64) -> None:
        """Forget everything and begin with a scan, points float32 (n, 3) in the lidar frame."""
        self.planes.clear()
        self.planes.insert(points, T_world_lidar)
        self._evicted_at = T_world_lidar[:3, 3]

    def add(self, points: F32, T_world_lidar: F64) -> int:
        """Add a scan; returns how many points found no room."""
        place = T_world_lidar[:3, 3]
        travelled = float(np.linalg.norm(place - self._evicted_at))
        far = travelled > _EVICT_TRAVEL * self._config.max_range_m
        if far or len(self.planes) > _FULL * self._config.max_voxels:
            self.planes.evict(place, self._config.max_range_m)
            self._evicted_at = place
        return self.planes.insert(points, T_world_lidar)
