"""Silhouettes: where a near surface ends before a far one, a photograph mostly shows an edge.

Points of the LiDAR at such places are projected into a photograph, the strongest edge across the silhouette is
looked for nearby, and its distance is a residual (the idea of Levinson and Thrun, RSS 2013, with the search across
the edge of Harris and Stennett's RAPID, 1990).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from artemis_edge._jit import njit
from artemis_edge.calibrate.photometric import PARAMETERS, Normal, View, in_sensors, motion_columns
from artemis_edge.frames import F32, F64, I64, U8

_NEAREST_M, _FARTHEST_M = 0.5, 30.0
_JUMP_M, _JUMP_SHARE = 0.3, 0.15  # a step in depth that is a silhouette
_STEP_PX = 0.5  # of the search across an edge
_LEAST_GRADIENT = 3.0  # grey levels a pixel
_BORDER_PX = 3
_POINTS_A_CELL = 2.0
_KERNEL2 = 1.0 / 9.0  # squared share of the reach at which the weight is a quarter


class Silhouettes(NamedTuple):
    """Points (n, 3) in world on the rim of near surfaces, and the image direction (n, 2) across the rim."""

    points: F64
    across: F64


def silhouettes(size: tuple[int, int], K: F64, T_cam_world: F64, points: F64) -> Silhouettes:
    """Silhouettes in a view of ``size`` (h, w) pixels, from points (m, 3) in world: cells as fine as they fill."""
    seen = points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    ahead = (seen[:, 2] > _NEAREST_M) & (seen[:, 2] < _FARTHEST_M * 3.0)
    points, seen = points[ahead], seen[ahead]
    u, v = K[0] * seen[:, 0] / seen[:, 2] + K[2], K[1] * seen[:, 1] / seen[:, 2] + K[3]
    within = int(((u > 0) & (u < size[1]) & (v > 0) & (v < size[0])).sum())
    if within == 0:
        return Silhouettes(np.empty((0, 3)), np.empty((0, 2)))
    coarse = max(int(np.ceil(np.sqrt(size[0] * size[1] * _POINTS_A_CELL / within))), size[1] // 320, 1)
    h, w = size[0] // coarse, size[1] // coarse
    column, row = np.floor((u + 0.5) / coarse).astype(np.int64), np.floor((v + 0.5) / coarse).astype(np.int64)
    inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
    points, z, cell = points[inside], seen[inside, 2], (row * w + column)[inside]
    order = np.lexsort((z, cell))
    first = order[np.flatnonzero(np.r_[True, np.diff(cell[order]) > 0])] if len(order) else order
    depth = np.full(h * w, np.nan)
    depth[cell[first]] = z[first]
    owner = np.full(h * w, -1)
    owner[cell[first]] = first
    rows, columns, direction = _rims(depth.reshape(h, w))
    index = owner.reshape(h, w)[rows, columns]
    return Silhouettes(np.ascontiguousarray(points[index]), direction)


def _rims(depth: F64) -> tuple[I64, I64, F64]:
    """Cells on the near side of a jump in depth, and the direction (n, 2) to the far side."""
    background = np.isnan(depth)
    filled = np.where(background, 0.0, depth)
    weight = np.where(background, 0.0, 1.0)
    limit = np.where(background, np.inf, depth + _JUMP_M + _JUMP_SHARE * filled)
    across = np.zeros((*depth.shape, 2))
    far_sides = np.zeros(depth.shape, np.int64)
    known = np.zeros(depth.shape, np.int64)
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            if du or dv:
                other = np.roll(filled, (-dv, -du), (0, 1))
                there = np.roll(weight, (-dv, -du), (0, 1)) > 0
                beyond = there & (other > limit)
                length = np.hypot(du, dv)
                across[beyond] += (du / length, dv / length)
                far_sides += beyond
                known += there
    rim = (far_sides >= 2) & (far_sides <= 5) & (known >= 6) & (filled < _FARTHEST_M)
    rim[:1], rim[-1:], rim[:, :1], rim[:, -1:] = False, False, False, False
    norm = np.linalg.norm(across, axis=2)
    rim &= norm > 1.0
    rows, columns = np.nonzero(rim)
    return rows, columns, across[rows, columns] / norm[rows, columns, None]


def smooth_gradients(grey: U8, sigma_px: float) -> tuple[F32, F32]:
    """Gradients of a photograph along u and v, grey levels a pixel, after smoothing."""
    soft = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), sigma_px)
    gx = cv2.Sobel(soft, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    gy = cv2.Sobel(soft, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    return np.asarray(gx, np.float32), np.asarray(gy, np.float32)


@njit
def _strength(gx: F32, gy: F32, u: float, v: float, nu: float, nv: float) -> float:
    """Gradient across a silhouette at the nearest pixel, without sign."""
    r, c = int(np.floor(v + 0.5)), int(np.floor(u + 0.5))
    return float(abs(nu * gx[r, c] + nv * gy[r, c]))


@njit
def attract(
    view: View, gx: F32, gy: F32, T_cam_lidar: F64, points: F64, across: F64, swell: F64, reach_px: float
) -> Normal:
    """Normal equations of the distances from silhouettes to the strongest edges within ``reach_px``.

    Two more unknowns: by how many pixels along u and v near surfaces look larger to the LiDAR than they are.
    """
    size = PARAMETERS + 2
    H, g, cost, count = np.zeros((size, size)), np.zeros(size), 0.0, 0
    K = view.K
    J = np.empty(size)
    margin = reach_px + _BORDER_PX
    steps = int(reach_px / _STEP_PX)
    for n in range(len(points)):
        lx, ly, lz, x, y, z = in_sensors(view, T_cam_lidar, points[n])
        if not z > _NEAREST_M:
            continue
        u, v = K[0] * x / z + K[2], K[1] * y / z + K[3]
        if not (margin <= u < gx.shape[1] - margin and margin <= v < gx.shape[0] - margin):
            continue
        nu, nv = across[n, 0], across[n, 1]
        best, at, total = 0.0, 0.0, 0.0
        for k in range(-steps, steps + 1):
            s = _strength(gx, gy, u + k * _STEP_PX * nu, v + k * _STEP_PX * nv, nu, nv)
            total += s
            if s > best:
                best, at = s, k * _STEP_PX
        mean = total / (2 * steps + 1)
        if best < _LEAST_GRADIENT or best < 2.0 * mean or abs(at) > (steps - 0.5) * _STEP_PX:
            continue
        e = -at  # the silhouette should move by ``at`` across
        motion = motion_columns(T_cam_lidar, view.twist, lx, ly, lz, x, y, z)
        for k in range(PARAMETERS):
            du = K[0] * (motion[0, k] - x / z * motion[2, k]) / z
            dv = K[1] * (motion[1, k] - y / z * motion[2, k]) / z
            J[k] = nu * du + nv * dv
        J[PARAMETERS], J[PARAMETERS + 1] = nu * nu, nv * nv
        e += J[PARAMETERS] * swell[0] + J[PARAMETERS + 1] * swell[1]
        k2 = reach_px * reach_px * _KERNEL2
        weight = (k2 / (k2 + e * e)) ** 2
        cost += e * e * k2 / (k2 + e * e)
        count += 1
        for k in range(size):
            g[k] += weight * e * J[k]
            for m in range(size):
                H[k, m] += weight * J[k] * J[m]
    return Normal(H, g, cost, count)
