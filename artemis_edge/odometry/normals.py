"""Which directions the surfaces of one scan face: the mean of n n' over its points.

Its smallest eigenvalue says how well the scan could fix the direction of travel that belongs to it. The normals are
those of small cells of the scan itself, for voxel planes of the map smooth stairs to slopes and shelves to walls;
where a cell has too few points, that of the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.eigen3 import smallest_eigen3
from artemis_edge.frames import F64, I64, Bool, DeskewedScan
from artemis_edge.odometry.plane_map import PlaneMap, sum_points
from artemis_edge.odometry.registration import match

CELL_M = 0.4  # of 0.15 to 0.4 m the one whose flags agree best with the true normals of virtual worlds
_MIN_POINTS = 12
_MIN_WIDTH2 = (0.02 * CELL_M) ** 2  # narrower is a line, of any normal
_ASKED = 500  # cells without a normal of their own that ask the map
_GATE2 = 0.03**2  # m2; such a cell's centre lies on a plane if it is within three of these deviations
_MAX_TILT2 = 0.05  # squared radian; what is less certain is a scan line, whose normal is anything
# True normals average below 0.01 where a direction is called unobserved; those of cells are noisier
UNOBSERVED = 0.0125


class Weakest(NamedTuple):
    """The direction that a scan tells least of: unit vector (3,) and the mean of (n . direction)^2."""

    direction: F64
    share: float

    @property
    def degenerate(self) -> bool:
        """Is the direction as good as unobserved?"""
        return self.share < UNOBSERVED


def weakest_direction(scans: Sequence[DeskewedScan], planes: PlaneMap, T_world_lidar: F64) -> Weakest | None:
    """Of the scans of a frame, in their frame; None where no normal is known."""
    total, count = np.zeros((3, 3)), 0.0
    for scan in scans:
        cells, sums = sum_points(np.ascontiguousarray(scan.points), np.eye(4), CELL_M)
        spread, known = normal_spread(sums)
        total, count = total + spread, count + float(sums[known, 0].sum())
        spread, points = _asked(cells[~known], sums[~known], planes, T_world_lidar)
        total, count = total + spread, count + points
    if count == 0.0:
        return None
    values, vectors = np.linalg.eigh(total / count)
    return Weakest(np.ascontiguousarray(vectors[:, 0]), max(float(values[0]), 0.0))


def _asked(cells: I64, sums: F64, planes: PlaneMap, T_world_lidar: F64) -> tuple[F64, float]:
    """Sum over points of n n' (3, 3), and their number, by the map's planes at the centres of cells."""
    some = slice(None, None, max(len(cells) // _ASKED, 1))
    centres = cells[some] * CELL_M + sums[some, 1:4] / sums[some, :1]
    matched = match(planes, centres.astype(np.float32), T_world_lidar, 0, _GATE2)
    if len(matched) == 0:
        return np.zeros((3, 3)), 0.0
    normals = matched[:, 3:6] @ T_world_lidar[:3, :3]
    points = float(sums[:, 0].sum()) * len(matched) / len(centres)
    return np.asarray(normals.T @ normals * (points / len(matched)), np.float64), points


@njit
def normal_spread(sums: F64) -> tuple[F64, Bool]:
    """Sum over points of n n' (3, 3), by count and moments of cells (m, 10), and which cells have a normal (m,).

    A normal fitted to k points tilts about an in-plane axis with the variance thickness / (k extent); what that
    adds to n n' is taken off again.
    """
    out, known, e = np.zeros((3, 3)), np.zeros(len(sums), np.bool_), np.empty(6)
    n, C = np.empty(3), np.empty((3, 3))
    for row in range(len(sums)):
        k = sums[row, 0]
        if k < _MIN_POINTS:
            continue
        s = sums[row] / k
        C[0, 0], C[0, 1], C[0, 2] = s[4] - s[1] * s[1], s[5] - s[1] * s[2], s[6] - s[1] * s[3]
        C[1, 1], C[1, 2], C[2, 2] = s[7] - s[2] * s[2], s[8] - s[2] * s[3], s[9] - s[3] * s[3]
        smallest_eigen3(C[0, 0], C[0, 1], C[0, 2], C[1, 1], C[1, 2], C[2, 2], e)
        e[3] = max(e[3], 0.0)
        n[0], n[1], n[2], thin, middle, wide = e
        if not middle > _MIN_WIDTH2 or thin * (1.0 / middle + 1.0 / wide) > _MAX_TILT2 * (k - 3.0):
            continue
        noise = thin / (k - 3.0)
        tilt = noise * (1.0 / middle + 1.0 / wide)
        known[row] = True
        for a in range(3):
            for b in range(a, 3):
                nn = n[a] * n[b]
                same = 1.0 if a == b else 0.0
                # inverse of C within the plane, by Cayley-Hamilton
                inverse = ((middle + wide) * (same - nn) - C[a, b] + thin * nn) / (middle * wide)
                out[a, b] += k * (nn * (1.0 + tilt) - noise * inverse)
    for a in range(3):
        for b in range(a):
            out[a, b] = out[b, a]
    return out, known
