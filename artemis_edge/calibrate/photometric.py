"""Photometric consistency: a surface patch that two photographs see must look alike in both.

The unknowns are the mount of the camera, T_cam_lidar exp'd from the left by x (6,), and its time offset (7th). A
patch is 5 x 5 points in space on the plane of the surface; brightness may differ between photographs by a gain
and an offset for each patch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.frames import F64, U8

PARAMETERS = 7
_SIDE = 5  # pixels of a patch; one more on each side for its gradient
_WIDE = _SIDE + 2
_PIXELS = _SIDE * _SIDE
_LEAST_AREA = 0.05  # pixels of a view to one of the patch: seen at a grazing angle, or from far away
_NEAREST_M = 0.3
_NOISE2 = 9.0  # grey levels squared: noise and jpeg; a patch of less contrast says nothing
_KERNEL2 = 0.15  # share of a patch's contrast that is unexplained at which its weight is a quarter


class View(NamedTuple):
    """A photograph at one level: ``grey`` (h, w), ``K`` fx fy cx cy there, where it was taken and how it moved.

    ``T_lidar_world`` (4, 4) and the LiDAR's body ``twist`` (6,) at the time of the exposure.
    """

    grey: U8
    K: F64
    T_lidar_world: F64
    twist: F64


class Normal(NamedTuple):
    """Normal equations: ``H`` (7, 7) x = -``g`` (7,); ``cost`` is the sum of robust residuals of ``seen`` patches."""

    H: F64
    g: F64
    cost: float
    seen: int


@njit
def motion_columns(C: F64, w: F64, lx: float, ly: float, lz: float, x: float, y: float, z: float) -> F64:
    """How the unknowns move a point (x, y, z) in the camera, (lx, ly, lz) in the LiDAR: (3, 7)."""
    out = np.zeros((3, PARAMETERS))
    out[0, 0] = out[1, 1] = out[2, 2] = 1.0
    out[1, 3], out[2, 3] = -z, y
    out[0, 4], out[2, 4] = z, -x
    out[0, 5], out[1, 5] = -y, x
    # what stands in the world moves by -(v + w x l) a second as seen from the LiDAR
    sx = -(w[0] + w[4] * lz - w[5] * ly)
    sy = -(w[1] + w[5] * lx - w[3] * lz)
    sz = -(w[2] + w[3] * ly - w[4] * lx)
    for j in range(3):
        out[j, 6] = C[j, 0] * sx + C[j, 1] * sy + C[j, 2] * sz
    return out


@njit
def in_sensors(view: View, T_cam_lidar: F64, point: F64) -> tuple[float, float, float, float, float, float]:
    """A point of the world (its first three numbers) as seen from the LiDAR, x y z, and from the camera, x y z."""
    M, C = view.T_lidar_world, T_cam_lidar
    lx = M[0, 0] * point[0] + M[0, 1] * point[1] + M[0, 2] * point[2] + M[0, 3]
    ly = M[1, 0] * point[0] + M[1, 1] * point[1] + M[1, 2] * point[2] + M[1, 3]
    lz = M[2, 0] * point[0] + M[2, 1] * point[1] + M[2, 2] * point[2] + M[2, 3]
    x = C[0, 0] * lx + C[0, 1] * ly + C[0, 2] * lz + C[0, 3]
    y = C[1, 0] * lx + C[1, 1] * ly + C[1, 2] * lz + C[1, 3]
    z = C[2, 0] * lx + C[2, 1] * ly + C[2, 2] * lz + C[2, 3]
    return lx, ly, lz, x, y, z


@njit
def _look(view: View, T_cam_lidar: F64, anchor: F64, value: F64, B: F64) -> bool:
    """Grey values (7, 7) of a patch in a view, and how the unknowns move the patch over its surface.

    ``B`` (2, 7): steps of the surface's grid by which what is seen there shifts. False if part of the patch lies
    outside of the photograph.
    """
    M, C, w = view.T_lidar_world, T_cam_lidar, view.twist
    lx, ly, lz, x, y, z = in_sensors(view, T_cam_lidar, anchor)
    if not z > _NEAREST_M:
        return False
    step = np.empty((3, 2))  # of the grid, in the camera
    for k in range(2):
        a, b, c = anchor[3 + 3 * k], anchor[4 + 3 * k], anchor[5 + 3 * k]
        px = M[0, 0] * a + M[0, 1] * b + M[0, 2] * c
        py = M[1, 0] * a + M[1, 1] * b + M[1, 2] * c
        pz = M[2, 0] * a + M[2, 1] * b + M[2, 2] * c
        for j in range(3):
            step[j, k] = C[j, 0] * px + C[j, 1] * py + C[j, 2] * pz
    grey, fx, fy, cx, cy = view.grey, view.K[0], view.K[1], view.K[2], view.K[3]
    for i in range(_WIDE * _WIDE):
        s, t = i % _WIDE - _WIDE // 2, i // _WIDE - _WIDE // 2
        depth = z + s * step[2, 0] + t * step[2, 1]
        if not depth > _NEAREST_M:
            return False
        u = fx * (x + s * step[0, 0] + t * step[0, 1]) / depth + cx
        v = fy * (y + s * step[1, 0] + t * step[1, 1]) / depth + cy
        if not (0.0 <= u < grey.shape[1] - 1 and 0.0 <= v < grey.shape[0] - 1):
            return False
        c, r = int(u), int(v)
        a, b = np.float64(u - c), np.float64(v - r)
        upper = (1.0 - a) * grey[r, c] + a * grey[r, c + 1]
        value[i] = (1.0 - b) * upper + b * ((1.0 - a) * grey[r + 1, c] + a * grey[r + 1, c + 1])
    # pixels by grid steps, and pixels by the unknowns
    gx, gy = fx / z, fy / z
    hx, hy = -gx * x / z, -gy * y / z
    a, b = gx * step[0, 0] + hx * step[2, 0], gx * step[0, 1] + hx * step[2, 1]
    c, d = gy * step[1, 0] + hy * step[2, 0], gy * step[1, 1] + hy * step[2, 1]
    det = a * d - b * c
    if not abs(det) > _LEAST_AREA:
        return False
    motion = motion_columns(C, w, lx, ly, lz, x, y, z)
    for k in range(PARAMETERS):
        du, dv = gx * motion[0, k] + hx * motion[2, k], gy * motion[1, k] + hy * motion[2, k]
        B[0, k], B[1, k] = (d * du - b * dv) / det, (a * dv - c * du) / det
    return True


@njit
def _normalise(value: F64) -> float:
    """Take the mean out and divide by the deviation, noise included; returns the contrast, the variance."""
    mean, contrast = value.mean(), 0.0
    for i in range(len(value)):
        value[i] -= mean
        contrast += value[i] * value[i]
    contrast /= len(value)
    value /= np.sqrt(contrast + _NOISE2)
    return contrast


@njit
def compare(first: View, second: View, T_cam_lidar: F64, anchors: F64) -> Normal:
    """Normal equations of all patches that both photographs see.

    ``anchors`` (n, 9): centre in world, and the two steps along the surface, m, from one pixel to the next. The
    gradient is the mean of both photographs' on the surface: with each its own, noise would look like
    information on what moves both alike.
    """
    H, g, cost, count = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS), 0.0, 0
    a, b = np.empty(_WIDE * _WIDE), np.empty(_WIDE * _WIDE)
    Ba, Bb = np.empty((2, PARAMETERS)), np.empty((2, PARAMETERS))
    for n in range(len(anchors)):
        if not (
            _look(first, T_cam_lidar, anchors[n], a, Ba) and _look(second, T_cam_lidar, anchors[n], b, Bb)
        ):
            continue
        if _normalise(a) < _NOISE2 or _normalise(b) < _NOISE2:
            continue
        ss = st = tt = se = te = e2 = 0.0
        for row in range(1, _WIDE - 1):
            for column in range(1, _WIDE - 1):
                i = row * _WIDE + column
                gs = 0.25 * (a[i + 1] - a[i - 1] + b[i + 1] - b[i - 1])
                gt = 0.25 * (a[i + _WIDE] - a[i - _WIDE] + b[i + _WIDE] - b[i - _WIDE])
                e = b[i] - a[i]
                ss, st, tt = ss + gs * gs, st + gs * gt, tt + gt * gt
                se, te, e2 = se + gs * e, te + gt * e, e2 + e * e / _PIXELS
        weight = (_KERNEL2 / (_KERNEL2 + e2)) ** 2 / _PIXELS
        cost += e2 * _KERNEL2 / (_KERNEL2 + e2)
        count += 1
        B = Bb - Ba
        for k in range(PARAMETERS):
            g[k] += weight * (B[0, k] * se + B[1, k] * te)
            left, right = ss * B[0, k] + st * B[1, k], st * B[0, k] + tt * B[1, k]
            for m in range(PARAMETERS):
                H[k, m] += weight * (left * B[0, m] + right * B[1, m])
    return Normal(H, g, cost, count)
