"""Point-to-plane registration of a thinned scan against the plane map: one linearisation, compiled.

The residual of point p is r = n . (T p - c) with variance

    s^2 = sigma^2 + tau^2 + t (1 + (1 + d' M d) / n)

sensor noise sigma, expected misalignment tau of the present guess, thickness t of the plane and the prediction
variance of a plane fitted to n points at the in-plane place d (M: inverse in-plane covariance). A point whose fine
voxel has no plane, or none within three deviations, asks the coarser ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.frames import F32, F64
from artemis_edge.odometry import se3
from artemis_edge.odometry.motion import Motion, Prediction
from artemis_edge.odometry.plane_map import CENTRE, COUNT, NORMAL, SPREAD, THICKNESS, PlaneMap, Table, probe, refresh, voxel_key
from artemis_edge.odometry.thin import TimedPoints

_GATE2 = 9.0  # three standard deviations
_KERNEL2 = 4.0  # Geman-McClure: a residual of two deviations has a quarter of the weight


_PASSES = 2  # the motion within the scan is corrected anew after the first
_ITERATIONS = 12
_CONVERGED_M = 1e-3  # mean displacement of the points by a step
DEGENERATE = 0.01  # smallest eigenvalue of the mean of n n' below which a direction counts as not observed


class Registration(NamedTuple):
    """Outcome: pose, mean of n n' over the matches (lidar frame), their number, and the share explained 0..1."""

    T_world_lidar: F64
    N: F64
    matches: int
    score: float


def register(
    plane_map: PlaneMap,
    scan: TimedPoints,
    motion: Motion,
    prediction: Prediction,
    guess: F64,
    tau_m: float,
    sigma_m: float,
) -> Registration:
    """Gauss-Newton from a guess T_world_lidar that is wrong by about ``tau_m`` at the points.

    Starts on voxels twice as large as the misalignment and refines as the steps shrink. A direction that the
    planes do not observe borrows the missing information from the prediction.
    """
    T, arm = guess, arm_m(scan.points)
    for _ in range(_PASSES):
        points = scan.at_stamp(motion.twist_to(T, prediction.elapsed_s))
        for _ in range(_ITERATIONS):
            lin = linearise(*plane_map.kernel_view(2.0 * tau_m), points, T, sigma_m**2 + tau_m**2)
            x = _step(lin, T, prediction, sigma_m)
            T = T @ se3.exp(x)
            moved = float(np.linalg.norm(x[:3]) + arm * np.linalg.norm(x[3:]))
            tau_m = min(0.5 * tau_m, moved)
            if moved < _CONVERGED_M:
                break
    lin = linearise(*plane_map.kernel_view(0.0), points, T, sigma_m**2)
    return Registration(T, lin.N, lin.matches, lin.score / max(len(points), 1))


def _step(lin: Linearised, T: F64, prediction: Prediction, sigma_m: float) -> F64:
    """Solve for the perturbation (6,), prior included."""
    P = prediction.information()
    values, vectors = np.linalg.eigh(lin.N)
    lent = np.maximum(DEGENERATE - values, 0.0) * lin.matches / sigma_m**2
    P[:3, :3] += (vectors * lent) @ vectors.T
    off = se3.log(se3.inverse(prediction.T_world_lidar) @ T)
    x: F64 = -np.linalg.solve(lin.H + P, lin.g + P @ off)
    return x


def arm_m(points: F32) -> float:
    """Root mean square range of points, m: what a turn by one radian moves them by."""
    return float(np.sqrt(np.mean(np.square(points, dtype=np.float64)) * 3.0)) if len(points) else 0.0


class Linearised(NamedTuple):
    """Normal equations of a right perturbation T exp(x): ``H`` (6, 6), ``g`` (6,), H x = -g.

    ``N`` (3, 3) is the mean of n n' over the matches in the lidar frame, ``matches`` their number, ``score`` the
    sum of the robust weights 0..1: how much of the scan lies on the map.
    """

    H: F64
    g: F64
    N: F64
    matches: int
    score: float


@njit
def _match(
    table: Table, voxel_m: float, levels: int, finest: int, x: float, y: float, z: float, noise2: float
) -> tuple[int, float, float]:
    """Slot of the plane that explains a point (or -1), the residual and its variance."""
    ix, iy, iz = int(np.floor(x / voxel_m)), int(np.floor(y / voxel_m)), int(np.floor(z / voxel_m))
    for level in range(finest, levels):
        place = probe(table.hash, voxel_key(level, ix, iy, iz))
        slot = table.hash[place, 1]
        if slot < 0 or not refresh(table, slot, voxel_m):
            continue
        w = table.rows[slot]
        dx, dy, dz = x - w[CENTRE], y - w[CENTRE + 1], z - w[CENTRE + 2]
        r = w[NORMAL] * dx + w[NORMAL + 1] * dy + w[NORMAL + 2] * dz
        k = SPREAD
        spread = dx * (w[k] * dx + 2.0 * (w[k + 1] * dy + w[k + 2] * dz))
        spread += dy * (w[k + 3] * dy + 2.0 * w[k + 4] * dz) + w[k + 5] * dz * dz
        variance = noise2 + w[THICKNESS] * (1.0 + (1.0 + spread) / w[COUNT])
        if r * r <= _GATE2 * variance:
            return slot, r, variance
    return -1, 0.0, 1.0


@njit
def linearise(
    table: Table, voxel_m: float, levels: int, finest: int, points: F32, T: F64, noise2: float
) -> Linearised:
    """Robust normal equations of points float32 (n, 3) (lidar frame) at the guess T_world_lidar.

    ``noise2`` is sigma^2 + tau^2 in m2; the kernel is Geman-McClure on the normalised residual.
    """
    H, g, N, matches, score = np.zeros((6, 6)), np.zeros(6), np.zeros((3, 3)), 0, 0.0
    J = np.empty(6)
    for i in range(len(points)):
        px, py, pz = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        slot, r, variance = _match(table, voxel_m, levels, finest, x, y, z, noise2)
        if slot < 0:
            continue
        n = table.rows[slot, NORMAL : NORMAL + 3]
        for k in range(3):
            J[k] = n[0] * T[0, k] + n[1] * T[1, k] + n[2] * T[2, k]
        J[3], J[4], J[5] = py * J[2] - pz * J[1], pz * J[0] - px * J[2], px * J[1] - py * J[0]
        robust = (_KERNEL2 / (_KERNEL2 + r * r / variance)) ** 2
        weight = robust / variance
        matches += 1
        score += robust
        for a in range(6):
            g[a] += weight * r * J[a]
            for b in range(a, 6):
                H[a, b] += weight * J[a] * J[b]
        for a in range(3):
            for b in range(3):
                N[a, b] += J[a] * J[b]
    for a in range(6):
        for b in range(a):
            H[a, b] = H[b, a]
    return Linearised(H, g, N / max(matches, 1), matches, score)
