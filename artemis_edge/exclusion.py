"""Zones around the scanner whose points are the operator, a tripod or the vehicle: left out before anything else.

They move with the scanner: all of them are told in the frame of the primary LiDAR (x ahead, z up), m. What falls into
one is counted as ``operator_points`` in the frame's losses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from artemis_edge.config import ExclusionConfig
from artemis_edge.errors import InputError
from artemis_edge.frames import F32, F64, Bool, LidarScan, SyncedFrame

LOST = "operator_points"


@dataclass(frozen=True, slots=True)
class Zones:
    """The zones of a configuration; ``Zones.of`` raises InputError for one that holds nothing."""

    rules: ExclusionConfig

    @classmethod
    def of(cls, rules: ExclusionConfig) -> Zones:
        """Checked."""
        for box in rules.boxes:
            if not (np.isfinite(box).all() and all(box[k] < box[k + 3] for k in range(3))):
                raise InputError(
                    f"exclusion.boxes: {list(box)} holds nothing; a box is x_min, y_min, z_min, x_max, y_max, z_max"
                )
        for cylinder in rules.cylinders:
            if not (np.isfinite(cylinder).all() and cylinder[2] > 0.0 and cylinder[3] < cylinder[4]):
                raise InputError(
                    f"exclusion.cylinders: {list(cylinder)} holds nothing; a cylinder is x, y, radius, z_min, z_max"
                )
        return cls(rules)

    def __bool__(self) -> bool:
        """Whether there is any zone."""
        return bool(self.rules.behind_m > 0.0 or self.rules.boxes or self.rules.cylinders)

    def applied(self, frame: SyncedFrame) -> SyncedFrame:
        """The frame without the points in the zones; the frame itself where there are none."""
        if not self:
            return frame
        scans = tuple(self._outside(scan) for scan in frame.scans)
        count = sum(len(a.points) - len(b.points) for a, b in zip(frame.scans, scans, strict=True))
        if not count:
            return frame
        return replace(frame, scans=scans, lost={**frame.lost, LOST: frame.lost.get(LOST, 0) + count})

    def inside(self, points: F32) -> Bool:
        """Which of the points (n, 3) in the primary LiDAR's frame lie in a zone, bool (n,)."""
        x, y, z = points[:, 0], points[:, 1], points[:, 2]
        found = np.zeros(len(points), np.bool_)
        rules = self.rules
        if rules.behind_m > 0.0:
            across2 = x * x + y * y
            least = math.cos(math.radians(rules.behind_deg) / 2.0)
            found |= (across2 < rules.behind_m**2) & (-x >= least * np.sqrt(across2))
        for x0, y0, z0, x1, y1, z1 in rules.boxes:
            found |= (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1) & (z >= z0) & (z <= z1)
        for cx, cy, radius, z0, z1 in rules.cylinders:
            found |= ((x - cx) ** 2 + (y - cy) ** 2 <= radius * radius) & (z >= z0) & (z <= z1)
        return found

    def _outside(self, scan: LidarScan) -> LidarScan:
        inside = self.inside(_in_lidar(scan.points, scan.T_lidar_sensor))
        if not inside.any():
            return scan
        kept = ~inside
        return replace(
            scan,
            points=scan.points[kept],
            offset_s=None if scan.offset_s is None else scan.offset_s[kept],
            intensity=None if scan.intensity is None else scan.intensity[kept],
        )


def _in_lidar(points: F32, T_lidar_sensor: F64) -> F32:
    if np.array_equal(T_lidar_sensor, np.eye(4)):
        return points
    moved: F32 = (points @ T_lidar_sensor[:3, :3].T + T_lidar_sensor[:3, 3]).astype(np.float32)
    return moved
