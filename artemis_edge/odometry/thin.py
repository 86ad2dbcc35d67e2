"""Thinning of a frame: few points to register, more to add to the map, each with its own time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.config import OdometryConfig
from artemis_edge.frames import F32, F64, I64, LidarScan, SyncedFrame
from artemis_edge.odometry.deskew import move_points
from artemis_edge.odometry.plane_map import EMPTY, empty_hash, probe
from artemis_edge.odometry.scan_motion import steady

_BITS = 21  # +-2^20 cells an axis
_TRIES = 4  # sizes tried for a frame; the next frame goes on from the last
_CLOSE = 1.3  # number of points accepted, as a ratio to what was asked for


class TimedPoints(NamedTuple):
    """Points float32 (n, 3) in the lidar frame at their own times float32 (n,), s from a stamp."""

    points: F32
    time_s: F32

    def at_one_time(self, twist: F64) -> F32:
        """The points moved to one time by a body twist (6,)."""
        return np.asarray(move_points(self.points, self.time_s, 0.0, steady(twist), np.eye(4)), np.float32)

    def take(self, rows: I64) -> TimedPoints:
        """Some of the points."""
        return TimedPoints(self.points[rows], self.time_s[rows])


class ThinScan(NamedTuple):
    """A frame thinned: its middle time, points for the map and points to register, times from that middle.

    Registering the middle halves what an unsteady velocity does, whatever the stamp stands for.
    """

    stamp_ns: int
    dense: TimedPoints
    sparse: TimedPoints


class Thinner:
    """Picks points of a frame: every ``insert_m`` for the map, about ``points`` of them to register.

    The spacing of the latter follows the scene, so that a room and a street cost the same.
    """

    def __init__(self, config: OdometryConfig) -> None:
        self._config = config
        self._spacing_m = config.insert_m

    def thin(self, frame: SyncedFrame) -> ThinScan:
        """Thin a frame with at least one scan; points out of range or not finite are left out."""
        c = self._config
        parts = [self._dense(scan, frame.stamp_ns) for scan in frame.scans]
        points, time_s = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        middle_s = 0.5 * float(time_s.min() + time_s.max()) if len(time_s) else 0.0
        dense = TimedPoints(points, time_s - np.float32(middle_s))
        for _ in range(_TRIES):
            rows = first_per_voxel(dense.points, self._spacing_m, 0.0, np.inf)
            ratio = len(rows) / c.points
            if 1 / _CLOSE < ratio < _CLOSE or (ratio <= 1 and self._spacing_m <= c.insert_m):
                break
            # points lie on surfaces: their number goes with the square of the spacing
            self._spacing_m = max(c.insert_m, self._spacing_m * max(ratio, 0.1) ** 0.5)
        return ThinScan(frame.stamp_ns + round(middle_s * 1e9), dense, dense.take(rows))

    def _dense(self, scan: LidarScan, stamp_ns: int) -> TimedPoints:
        """Points for the map of one scan, in the lidar frame, their times relative to the frame's stamp."""
        c, T = self._config, scan.T_lidar_sensor
        rows = first_per_voxel(np.ascontiguousarray(scan.points), c.insert_m, c.min_range_m, c.max_range_m)
        points = scan.points[rows]
        if not np.array_equal(T, np.eye(4)):
            points = (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        time_s = np.zeros(len(rows), np.float32) if scan.offset_s is None else scan.offset_s[rows]
        return TimedPoints(points, time_s + np.float32((scan.stamp_ns - stamp_ns) * 1e-9))


@njit
def first_per_voxel(points: F32, voxel_m: float, min_range_m: float, max_range_m: float) -> I64:
    """Rows (m,) of those points float32 (n, 3) that come first in their voxel, in order.

    Points that are not finite or whose distance from the origin lies outside the ranges are left out.
    """
    table = empty_hash(len(points))
    rows = np.empty(len(points), np.int64)
    n, inverse, half = 0, 1.0 / voxel_m, 1 << (_BITS - 1)
    low, high = min_range_m**2, max_range_m**2
    for row in range(len(points)):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        range2 = x * x + y * y + z * z
        if not (range2 >= low and range2 <= high):  # written so that NaN fails
            continue
        ix, iy, iz = int(np.floor(x * inverse)), int(np.floor(y * inverse)), int(np.floor(z * inverse))
        key = (((ix + half) << _BITS | (iy + half)) << _BITS) | (iz + half)
        place = probe(table, key)
        if table[place, 0] == EMPTY:
            table[place, 0] = key
            rows[n] = row
            n += 1
    return rows[:n].copy()
