"""Which directions the surfaces of one scan face: the mean of n n' over its points.

Its smallest eigenvalue says how well the scan could fix the direction of travel that belongs to it. Planes are those of
small balls of the scan itself, for voxel planes of the map smooth stairs to slopes and shelves to walls; where a ball
has too few points, that of the map. Balls lie about the mean of a grid cell's points and reach beyond the cell: where
the walls of a cell cut a surface, what is left of its noise is a strip that faces anywhere. A few points of another
surface in a ball would tilt its plane by more than what is asked, so that the plane is found robustly.
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

CELL_M = 0.3  # smaller cells are tilted by noise, larger ones hold two surfaces
RADIUS_M = 0.5 * CELL_M  # of a ball, which touches eight cells at most
_MOST_CELLS = 1000  # whose planes are looked for; where a direction is hardly seen there are fewer
_MIN_POINTS = 12
_MOST_POINTS = 300  # of the cells that a ball touches that are looked at
_TOUCHED = 8  # cells, at most
_DRAWN, _JUDGED = 12, 50  # planes through three points that are tried, and points that judge each
_GATE = 2.5  # deviations of a point's noise
_FITS = 2  # of the plane to the points within the gate, from the best drawn one on
_MAX_TILT2 = 0.05  # squared radian; what is less certain is a scan line, whose normal is anything
_ASKED = 500  # cells without a normal of their own that ask the map
# True normals average below 0.01 where a direction is called unobserved; the noise of found ones adds to that
UNOBSERVED = 0.011


class Weakest(NamedTuple):
    """The direction that a scan tells least of: unit vector (3,) and the mean of (n . direction)^2."""

    direction: F64
    share: float

    @property
    def degenerate(self) -> bool:
        """Is the direction as good as unobserved?"""
        return self.share < UNOBSERVED


class Cells(NamedTuple):
    """Points by cells of a grid, m in use.

    ``order`` (n,): rows cell by cell; ``starts`` (m + 1,): where each begins in it; ``table``: hash of key and cell.
    """

    size_m: float
    table: I64
    order: I64
    starts: I64


def weakest_direction(
    scans: Sequence[DeskewedScan], planes: PlaneMap, T_world_lidar: F64, sigma_m: float
) -> Weakest | None:
    """Of the scans of a frame, in their frame; None where no normal is known. ``sigma_m``: noise of a point."""
    total, count = np.zeros((3, 3)), 0.0
    for scan in scans:
        points = np.ascontiguousarray(scan.points)
        cells = by_cell(points, CELL_M)
        spread, counted, crowded = normal_spread(points, cells, RADIUS_M, sigma_m)
        total, count = total + spread, count + float(counted.sum())
        few = ~crowded  # what is crowded and without a plane is clutter in the map too
        sizes = np.diff(cells.starts)
        firsts = points[cells.order[cells.starts[:-1][few]]]
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
def by_cell(points: F32, cell_m: float) -> Cells:
    """Points float32 (n, 3) cell by cell, in order within each."""
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
    return Cells(cell_m, table, order, starts)


@njit
def normal_spread(points: F32, cells: Cells, radius_m: float, sigma_m: float) -> tuple[F64, I64, Bool]:
    """Sum over points of n n' (3, 3); points (m,) of each cell that it counts; which have points enough around them.

    Of many cells every k-th is looked at, the others count as crowded. Of a cell count the points on the plane about
    their mean. The normals of the two halves of a ball's points err independently, so that their product has no bias,
    where the square of one normal has its variance.
    """
    m = len(cells.starts) - 1
    out, counted, crowded = np.zeros((3, 3)), np.zeros(m, np.int64), np.ones(m, np.bool_)
    rows, a, b, centre = np.empty(_MOST_POINTS + _TOUCHED, np.int64), np.empty(7), np.empty(7), np.empty(3)
    for cell in range(0, m, m // _MOST_CELLS + 1):
        own = cells.order[cells.starts[cell] : cells.starts[cell + 1]]
        mean(points, own, centre)
        near = rows[: in_ball(points, cells, centre, radius_m, rows)]
        crowded[cell] = len(near) >= _MIN_POINTS
        inside = near[: _on_plane(points, near, sigma_m, a)]
        if len(inside) < _MIN_POINTS or not tilt2(a, len(inside)) < _MAX_TILT2:
            continue
        counted[cell] = within(points, own, a, _GATE * sigma_m)
        fit(points, inside[::2], a)
        fit(points, inside[1::2], b)
        share = 0.5 * counted[cell] if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] > 0.0 else -0.5 * counted[cell]
        for i in range(3):
            for j in range(3):
                out[i, j] += share * (a[i] * b[j] + a[j] * b[i])
    return out, counted, crowded


@njit
def mean(points: F32, rows: I64, out: F64) -> None:
    """Mean (3,) of some points."""
    out[:] = 0.0
    for row in rows:
        for k in range(3):
            out[k] += points[row, k]
    out /= len(rows)


@njit
def in_ball(points: F32, cells: Cells, centre: F64, radius_m: float, rows: I64) -> int:
    """Write the rows of points in a ball, thinned evenly, and return how many; the radius is half a cell at most."""
    low, high, touched, total = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(_TOUCHED, np.int64), 0
    for k in range(3):
        low[k] = int(np.floor((centre[k] - radius_m) / cells.size_m))
        high[k] = min(int(np.floor((centre[k] + radius_m) / cells.size_m)), low[k] + 1)
    m = n = 0
    for x in range(low[0], high[0] + 1):
        for y in range(low[1], high[1] + 1):
            for z in range(low[2], high[2] + 1):
                place = probe(cells.table, cell_key(0, x, y, z))
                if cells.table[place, 0] != EMPTY:
                    touched[m] = cells.table[place, 1]
                    total += cells.starts[touched[m] + 1] - cells.starts[touched[m]]
                    m += 1
    for cell in touched[:m]:
        for row in cells.order[cells.starts[cell] : cells.starts[cell + 1] : total // _MOST_POINTS + 1]:
            x, y, z = points[row, 0] - centre[0], points[row, 1] - centre[1], points[row, 2] - centre[2]
            if x * x + y * y + z * z < radius_m * radius_m:
                rows[n] = row
                n += 1
    return n


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

    The rows are drawn by the generator of the C standard (7.22.2), begun anew: the same points give the same plane.
    """
    m, best, certainty, seed = len(rows), 0.0, 1.0 / sigma_m, 1
    step, three = max(m // _JUDGED, 1), np.empty(3, np.int64)
    for _ in range(_DRAWN):
        for k in range(3):
            seed = (seed * 1103515245 + 12345) & 0x7FFFFFFF
            three[k] = (seed >> 16) % m
        p, q, r = points[rows[three[0]]], points[rows[three[1]]], points[rows[three[2]]]
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
def within(points: F32, rows: I64, plane: F64, gate_m: float) -> int:
    """How many points lie within the gate of a plane."""
    n = 0
    for row in rows:
        p = points[row]
        n += abs(plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2] - plane[6]) < gate_m
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
