"""Point-to-plane registration of a thinned scan against the plane map.

The residual of point p with plane (n, c) is r = n . (T p - c); its variance

    s^2 = sigma^2 + tau^2 + t (1 + (1 + d' M d) / k)

has the noise sigma of a point, the misalignment tau still expected, the thickness t of the plane and the
prediction variance of a plane fitted to k points at the in-plane place d (M: inverse in-plane covariance),
so that the edge of a half-seen plane counts little and a plane of three scan lines counts little across
them. A point whose fine voxel has no plane within three deviations asks the coarser voxels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from artemis_edge._jit import kernel, njit
from artemis_edge.frames import F32, F64
from artemis_edge.odometry import se3
from artemis_edge.odometry.motion import Prediction
from artemis_edge.odometry.plane_map import (
    CENTRE,
    COUNT,
    NORMAL,
    SPREAD,
    THICKNESS,
    PlaneMap,
    Table,
    probe,
    refresh,
    voxel_key,
)
from artemis_edge.odometry.thin import TimedPoints

DEGENERATE = 0.01  # smallest eigenvalue of the weighted mean of n n' for which a direction is observed
_PASSES = 2  # the motion within the scan is corrected anew after the first
_ITERATIONS = 12
_CONVERGED_M = 1e-3  # mean displacement of the points by a step; a thirtieth of their noise
_REMATCH = 0.05  # displacement, as a share of the voxel in use, after which planes are looked up again
GATE2 = 9.0  # three deviations
_GRAZING2 = 0.05**2  # squared sine of incidence; a sheet seen edge-on is one laser line and its noise
_KERNEL2 = 4.0  # Geman-McClure: a residual of two deviations has a quarter of the weight
# point in the lidar frame (3), normal (3), n . c (1), variance of the plane there (1), which plane (1), the variance
# of its place (1), of its points (1), and by how much its tilts vary more, rad2/m2 (1)
MATCH_COLUMNS = 12
VARIANCE, PLANE, PLACE, THICK, TILT = 7, 8, 9, 10, 11


class Registration(NamedTuple):
    """Pose, how well each direction is observed, number of matches, share of the scan explained.

    ``N`` (3, 3) is the mean of n n' over the matches in the lidar frame, weighted by their certainty.
    """

    T_world_lidar: F64
    N: F64
    matches: int
    score: float


class Linearised(NamedTuple):
    """Normal equations of a right perturbation T exp(x): ``H`` (6, 6) x = -``g`` (6,).

    ``matches`` is the number of inliers, ``weight`` the sum of their weights (1/m2), ``score`` the sum of the
    robust part of them, 0..1 each.
    """

    H: F64
    g: F64
    matches: int
    weight: float
    score: float

    def observed(self) -> F64:
        """Weighted mean of n n' (3, 3); zero without matches."""
        return self.H[:3, :3] / self.weight if self.weight > 0.0 else np.zeros((3, 3))


def register(
    plane_map: PlaneMap,
    scan: TimedPoints,
    prediction: Prediction,
    guess: F64,
    tau_m: float,
    sigma_m: float,
) -> Registration:
    """Gauss-Newton from a guess T_world_lidar that is wrong by about ``tau_m`` at the points.

    Starts on voxels twice as large as the misalignment and refines as the steps shrink.
    """
    T, arm = guess, arm_m(scan.points)
    level, matched, moved = -1, np.empty((0, MATCH_COLUMNS)), 0.0
    for _ in range(_PASSES):
        points = scan.at_one_time(prediction.twist(T))
        stale = True
        for _ in range(_ITERATIONS):
            finest = plane_map.level_of(2.0 * tau_m)
            if stale or finest != level or moved > _REMATCH * plane_map.voxel_m * 2**finest:
                level, moved, stale = finest, 0.0, False
                matched = match(plane_map, points, T, finest, sigma_m**2 + tau_m**2)
            x = _step(linearise(matched, T, sigma_m**2 + tau_m**2), T, prediction)
            T = T @ se3.exp(x)
            step = float(np.linalg.norm(x[:3]) + arm * np.linalg.norm(x[3:]))
            moved, tau_m = moved + step, min(0.5 * tau_m, step)
            if step < _CONVERGED_M and level == 0:
                break
    return judge(plane_map, points, T, sigma_m)


def judge(
    plane_map: PlaneMap, points: F32, T_world_lidar: F64, sigma_m: float, finest: int = 0
) -> Registration:
    """How well points float32 (n, 3) of one time fit the map at a pose."""
    lin = linearise(match(plane_map, points, T_world_lidar, finest, sigma_m**2), T_world_lidar, sigma_m**2)
    return Registration(T_world_lidar, lin.observed(), lin.matches, lin.score / max(len(points), 1))


def match(plane_map: PlaneMap, points: F32, T_world_lidar: F64, finest: int, noise2: float) -> F64:
    """Planes that explain points: (m, 12) rows as the kernels take them; ``noise2`` = sigma^2 + tau^2, m2."""
    m: F64 = match_planes(
        plane_map.table, plane_map.voxel_m, finest, plane_map.levels, points, T_world_lidar, noise2
    )
    return m


def arm_m(points: F32 | F64) -> float:
    """Root mean square range of points, m: what a turn by one radian moves them by."""
    return float(np.sqrt(3.0 * np.mean(np.square(points, dtype=np.float64)))) if len(points) else 0.0


def _step(lin: Linearised, T_world_lidar: F64, prediction: Prediction) -> F64:
    """Perturbation (6,) that solves the normal equations and the prior.

    A direction that the planes hardly observe borrows from the prediction what it lacks to the threshold:
    otherwise the noise of the normals would hold the sensor still along a corridor.
    """
    P = prediction.information()
    values, vectors = np.linalg.eigh(lin.observed())
    lent = np.maximum(DEGENERATE - values, 0.0) * lin.weight
    P[:3, :3] += (vectors * lent) @ vectors.T
    off = se3.log(se3.inverse(prediction.T_world_lidar) @ T_world_lidar)
    x: F64 = -np.linalg.solve(lin.H + P, lin.g + P @ off)
    return x


@njit
def match_planes(
    table: Table, voxel_m: float, finest: int, levels: int, points: F32, T_world_lidar: F64, noise2: float
) -> F64:
    """For each point the plane of the finest voxel that explains it; points without one are left out."""
    T, inverse, n = T_world_lidar, 1.0 / voxel_m, 0
    out = np.empty((len(points), MATCH_COLUMNS))
    for i in range(len(points)):
        px, py, pz = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        ix, iy, iz = int(np.floor(x * inverse)), int(np.floor(y * inverse)), int(np.floor(z * inverse))
        for level in range(finest, levels):
            slot = table.hash[probe(table.hash, voxel_key(level, ix, iy, iz)), 1]
            if slot < 0 or not refresh(table, slot, voxel_m):
                continue
            w = table.rows[slot]
            if _grazing(w, x - T[0, 3], y - T[1, 3], z - T[2, 3]):
                continue
            dx, dy, dz = x - w[CENTRE], y - w[CENTRE + 1], z - w[CENTRE + 2]
            r = w[NORMAL] * dx + w[NORMAL + 1] * dy + w[NORMAL + 2] * dz
            variance = w[THICKNESS] * (1.0 + (1.0 + _spread(w, dx, dy, dz)) / w[COUNT])
            if r * r <= GATE2 * (noise2 + variance):
                o = out[n]
                o[0], o[1], o[2] = px, py, pz
                o[3], o[4], o[5] = w[NORMAL], w[NORMAL + 1], w[NORMAL + 2]
                o[6] = o[3] * w[CENTRE] + o[4] * w[CENTRE + 1] + o[5] * w[CENTRE + 2]
                o[VARIANCE], o[PLANE] = variance, slot
                o[PLACE], o[THICK] = w[THICKNESS] / w[COUNT], w[THICKNESS]
                o[TILT] = w[SPREAD] + w[SPREAD + 3] + w[SPREAD + 5]
                n += 1
                break
    return out[:n]


@njit
def _grazing(row: F64, vx: float, vy: float, vz: float) -> bool:
    """Does the line of sight (world, m) lie in the plane?"""
    across = row[NORMAL] * vx + row[NORMAL + 1] * vy + row[NORMAL + 2] * vz
    return bool(across * across < _GRAZING2 * (vx * vx + vy * vy + vz * vz))


@njit
def _spread(row: F64, dx: float, dy: float, dz: float) -> float:
    """d' M d of the module's formula."""
    m = row[SPREAD:]
    x = m[0] * dx + 2.0 * (m[1] * dy + m[2] * dz)
    y = m[3] * dy + 2.0 * m[4] * dz
    return float(dx * x + dy * y + m[5] * dz * dz)


@njit
def linearise(matched: F64, T_world_lidar: F64, noise2: float) -> Linearised:
    """Robust normal equations of matched planes (m, 12); matches beyond three deviations have no weight."""
    H, g, J = np.zeros((6, 6)), np.zeros(6), np.empty(6)
    matches, total, score = 0, 0.0, 0.0
    for i in range(len(matched)):
        r = residual(matched[i], T_world_lidar, J)
        s2 = noise2 + matched[i, VARIANCE]
        if r * r > GATE2 * s2:
            continue
        robust = geman_mcclure(r * r / s2)
        weight = robust / s2
        matches += 1
        total += weight
        score += robust
        accumulate(H, g, J, r, weight)
    mirror(H)
    return Linearised(H, g, matches, total, score)


@kernel
def residual(row: F64, T_world_lidar: F64, J: F64) -> float:
    """r of the module's formula, m, for a matched plane (12,); its derivatives go to ``J`` (6,)."""
    T = T_world_lidar
    # by index: unpacking a slice takes a quarter longer here
    px, py, pz, n0, n1, n2, nc = row[0], row[1], row[2], row[3], row[4], row[5], row[6]
    for k in range(3):
        J[k] = n0 * T[0, k] + n1 * T[1, k] + n2 * T[2, k]
    J[3], J[4], J[5] = py * J[2] - pz * J[1], pz * J[0] - px * J[2], px * J[1] - py * J[0]
    r: float = J[0] * px + J[1] * py + J[2] * pz + n0 * T[0, 3] + n1 * T[1, 3] + n2 * T[2, 3] - nc
    return r


@kernel
def geman_mcclure(r2: float) -> float:
    """Share of its weight, 0..1, that a residual keeps; ``r2`` is its square in variances."""
    return (_KERNEL2 / (_KERNEL2 + r2)) ** 2


@kernel
def accumulate(H: F64, g: F64, J: F64, r: float, weight: float) -> None:
    """Add weight J' J to the upper triangle of ``H`` (6, 6) and weight J' r to ``g`` (6,)."""
    for a in range(6):
        g[a] += weight * r * J[a]
        for b in range(a, 6):
            H[a, b] += weight * J[a] * J[b]


@kernel
def mirror(H: F64) -> None:
    """Copy the upper triangle of ``H`` (6, 6) to the lower."""
    for a in range(6):
        for b in range(a):
            H[a, b] = H[b, a]
