"""Which directions the surfaces of one scan face: the mean of n n' over its points.

Its smallest eigenvalue says how well the scan could fix the direction of travel that belongs to it. The normals are
those of small cells of the scan itself, for voxel planes of the map smooth stairs to slopes and shelves to walls;
where a cell has too few points, that of the map. A few points of another surface in a cell would tilt its plane by more
than what is asked, so that the plane is found robustly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.eigen3 import smallest_eigen3
from artemis_edge.frames import F32, F64, I64, Bool, DeskewedScan
from artemis_edge.odometry.plane_map import EMPTY, PlaneMap, cell_key, empty_hash, probe
from artemis_edge.odometry.registration import match

CELL_M = 0.3  # smaller cells are tilted by noise, larger ones hold two surfaces; here the mean ratio to the truth is 1
_MIN_POINTS = 12
_MOST_POINTS = 150  # of a cell that are looked at
_DRAWN, _JUDGED = 12, 50  # planes through three points that are tried, and points that judge each
_GATE = 2.5  # deviations of a point's noise
_FITS = 2  # of the plane to the points within the gate, from the best drawn one on
_MAX_TILT2 = 0.02  # squared radian; what is less certain is a scan line, whose normal is anything
_ASKED = 500  # cells without a normal of their own that ask the map
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


def weakest_direction(
    scans: Sequence[DeskewedScan], planes: PlaneMap, T_world_lidar: F64, sigma_m: float
) -> Weakest | None:
    """Of the scans of a frame, in their frame; None where no normal is known. ``sigma_m``: noise of a point."""
    total, count = np.zeros((3, 3)), 0.0
    for scan in scans:
        points = np.ascontiguousarray(scan.points)
        order, starts = by_cell(points, CELL_M)
        spread, known = normal_spread(points, order, starts, sigma_m)
        sizes = np.diff(starts)
        total, count = total + spread, count + float(sizes[known].sum())
        few = (
            sizes < _MIN_POINTS
        )  # other cells without a plane are clutter, which has no normal in the map either
        firsts = points[order[starts[:-1][few]]]
        spread, asked = _asked(firsts, sizes[few], planes, T_world_lidar, sigma_m)
        total, count = total + spread, count + asked
    if count == 0.0:
        return None
    values, vectors = np.linalg.eigh(total / count)
    return Weakest(np.ascontiguousarray(vectors[:, 0]), max(float(values[0]), 0.0))


def _asked(
    points: F32, sizes: I64, planes: PlaneMap, T_world_lidar: F64, sigma_m: float
) -> tuple[F64, float]:
    """Sum over points of n n' (3, 3), and their number, by the map's planes at one point (n, 3) of each cell."""
    some = slice(None, None, max(len(points) // _ASKED, 1))
    matched = match(planes, np.ascontiguousarray(points[some]), T_world_lidar, 0, sigma_m**2)
    if len(matched) == 0:
        return np.zeros((3, 3)), 0.0
    normals = matched[:, 3:6] @ T_world_lidar[:3, :3]
    seen = float(sizes.sum()) * len(matched) / len(points[some])
    return np.asarray(normals.T @ normals * (seen / len(matched)), np.float64), seen


@njit
def by_cell(points: F32, cell_m: float) -> tuple[I64, I64]:
    """Rows of points float32 (n, 3) cell by cell, in order within each, and where each cell begins (m + 1,)."""
    n, m, inverse = len(points), 0, 1.0 / cell_m
    table, cell, count = empty_hash(n), np.empty(n, np.int64), np.zeros(n + 1, np.int64)
    for i in range(n):
        x, y, z = points[i, 0] * inverse, points[i, 1] * inverse, points[i, 2] * inverse
        key = cell_key(0, int(np.floor(x)), int(np.floor(y)), int(np.floor(z)))
        place = probe(table, key)
        if table[place, 0] == EMPTY:
            table[place, 0], table[place, 1] = key, m
            m += 1
        cell[i] = table[place, 1]
        count[cell[i] + 1] += 1
    starts = np.cumsum(count[: m + 1])
    order, at = np.empty(n, np.int64), starts.copy()
    for i in range(n):
        order[at[cell[i]]] = i
        at[cell[i]] += 1
    return order, starts


@njit
def normal_spread(points: F32, order: I64, starts: I64, sigma_m: float) -> tuple[F64, Bool]:
    """Sum over points of n n' (3, 3), by the planes of cells, and which cells have a normal (m,).

    The normals of the two halves of a cell's points err independently, so that their product has no bias, where the
    square of one normal has its variance.
    """
    out, known = np.zeros((3, 3)), np.zeros(len(starts) - 1, np.bool_)
    rows, a, b = np.empty(_MOST_POINTS, np.int64), np.empty(7), np.empty(7)
    for cell in range(len(known)):
        size = starts[cell + 1] - starts[cell]
        used = min(size, _MOST_POINTS)
        for i in range(used):
            rows[i] = order[starts[cell] + i * size // used]
        inside = rows[: _on_plane(points, rows[:used], sigma_m, a)]
        if len(inside) < _MIN_POINTS or not tilt2(a, len(inside)) < _MAX_TILT2:
            continue
        known[cell] = True
        fit(points, inside[::2], a)
        fit(points, inside[1::2], b)
        share = 0.5 * size if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] > 0.0 else -0.5 * size
        for i in range(3):
            for j in range(3):
                out[i, j] += share * (a[i] * b[j] + a[j] * b[i])
    return out, known


@njit
def _on_plane(points: F32, rows: I64, sigma_m: float, plane: F64) -> int:
    """Sort the rows of points on the plane of most of them to the front; returns how many, and the ``plane``."""
    n = len(rows)
    if n < _MIN_POINTS or not draw(points, rows, sigma_m, plane):
        return 0
    for _ in range(_FITS):
        n = keep(points, rows, plane, _GATE * sigma_m)
        if n < _MIN_POINTS:
            return 0
        fit(points, rows[:n], plane)
    return n


@njit
def draw(points: F32, rows: I64, sigma_m: float, plane: F64) -> bool:
    """``plane`` (7,): of those through three of the rows, that which most of them lie on. False if there is none.

    The three are a third of the rows apart, so that the same points always give the same plane.
    """
    m, best, certainty = len(rows), 0.0, 1.0 / sigma_m
    step = max(m // _JUDGED, 1)
    for t in range(_DRAWN):
        i = t * m // (3 * _DRAWN)
        p, q, r = points[rows[i]], points[rows[i + m // 3]], points[rows[i + 2 * m // 3]]
        ux, uy, uz = np.float64(q[0] - p[0]), np.float64(q[1] - p[1]), np.float64(q[2] - p[2])
        vx, vy, vz = np.float64(r[0] - p[0]), np.float64(r[1] - p[1]), np.float64(r[2] - p[2])
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        length = np.sqrt(x * x + y * y + z * z)
        if not length > 0.0:
            continue
        x, y, z = x / length, y / length, z / length
        offset, score = x * p[0] + y * p[1] + z * p[2], 0.0
        for k in range(0, m, step):
            s = points[rows[k]]
            miss2 = ((x * s[0] + y * s[1] + z * s[2] - offset) * certainty) ** 2
            score += 1.0 / (1.0 + miss2 * miss2)
        if score > best:
            best = score
            plane[0], plane[1], plane[2], plane[6] = x, y, z, offset
    return best > 0.0


@njit
def keep(points: F32, rows: I64, plane: F64, gate_m: float) -> int:
    """Sort the rows whose points lie within the gate of a plane to the front; returns how many they are."""
    n = 0
    for i in range(len(rows)):
        p = points[rows[i]]
        if abs(plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2] - plane[6]) < gate_m:
            rows[i], rows[n] = rows[n], rows[i]
            n += 1
    return n


@njit
def fit(points: F32, rows: I64, plane: F64) -> None:
    """``plane`` (7,): normal, variances along it and the two ways across (ascending), n . p on it; of at least 3."""
    n, o = len(rows), points[rows[0]]
    mx = my = mz = xx = xy = xz = yy = yz = zz = 0.0
    for row in rows:
        x = np.float64(points[row, 0] - o[0])
        y = np.float64(points[row, 1] - o[1])
        z = np.float64(points[row, 2] - o[2])
        mx, my, mz = mx + x, my + y, mz + z
        xx, xy, xz = xx + x * x, xy + x * y, xz + x * z
        yy, yz, zz = yy + y * y, yz + y * z, zz + z * z
    mx, my, mz = mx / n, my / n, mz / n
    xx, xy, xz = xx / n - mx * mx, xy / n - mx * my, xz / n - mx * mz
    yy, yz, zz = yy / n - my * my, yz / n - my * mz, zz / n - mz * mz
    smallest_eigen3(xx, xy, xz, yy, yz, zz, plane)
    plane[3] = max(plane[3], 0.0)
    plane[6] = plane[0] * (mx + o[0]) + plane[1] * (my + o[1]) + plane[2] * (mz + o[2])


@njit
def tilt2(plane: F64, count: int) -> float:
    """Variance (squared radian) of the normal of a plane fitted to so many points; infinite for lines.

    First order perturbation of an eigenvector: thin wide / ((wide - thin)^2 k) about either axis across.
    """
    thin, middle, wide = plane[3], plane[4], plane[5]
    if not middle > thin:
        return np.inf
    total: float = thin * (middle / (middle - thin) ** 2 + wide / (wide - thin) ** 2) / (count - 3.0)
    return total
