"""Patches of surface that an image is compared with: sampling, and the normal equations of their grey values.

A patch is 8 x 8 points on the plane of a surface, one pixel apart in the image that it was taken from; seen from
elsewhere the plane itself gives the warp. Direct alignment as in Zheng et al., FAST-LIVO2 (T-RO 2024), with the
gradients of the reference (Baker and Matthews, IJCV 2004), so that they are computed once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.frames import F32, F64, U8, Bool
from artemis_edge.lens import distort, slope

SIDE = 8
RIM = SIDE + 2  # one more pixel on each side, for the gradients
UNKNOWNS = 7  # right perturbation of T_world_lidar (6), log of the inverse exposure
_PIXELS = SIDE * SIDE
# Nothing nearer to a camera is looked at: there a centimetre of its mount's error is some 20 pixels.
NEAREST_M = 0.3
_LEAST_AREA, _MOST_AREA = (
    0.15,
    8.0,
)  # pixels here to one pixel of the reference: else the patch is not comparable
_KERNEL2 = 4.0  # Geman-McClure: a residual of two deviations has a quarter of the weight


class Eye(NamedTuple):
    """A camera at one level: ``K`` fx fy cx cy in pixels of the level, ``distortion`` (5,), T_cam_lidar (4, 4)."""

    K: F64
    distortion: F64
    T_cam_lidar: F64


class Patches(NamedTuple):
    """``anchor`` float64 (m, 9): centre in world and its two steps along the surface, m, for one pixel at level 0.

    ``grey`` float32 (m, levels, 64) as taken, ``slope_s`` and ``slope_t`` its derivatives by the steps of the level,
    ``log_inverse_exposure`` (m,) of the image that they were taken from.
    """

    anchor: F64
    grey: F32
    slope_s: F32
    slope_t: F32
    log_inverse_exposure: F64


class Comparison(NamedTuple):
    """``H`` (7, 7), ``g`` (7,) as ``state.NormalEquations``; ``share`` float32 (m,) is how well each patch fits.

    ``share`` is 1 for no residual, 0.25 at two deviations, -1 where the patch is not in the image; ``score`` is their
    mean over the ``seen`` that are.
    """

    H: F64
    g: F64
    share: F32
    score: float
    seen: int


@njit
def project(eye: Eye, x: float, y: float, z: float) -> tuple[float, float]:
    """Pixel of a point in the camera, z > 0."""
    u, v = distort(x / z, y / z, eye.distortion)
    return eye.K[0] * u + eye.K[2], eye.K[1] * v + eye.K[3]


@njit
def transform(T: F64, p: F64) -> tuple[float, float, float]:
    """A point moved by a transform (4, 4)."""
    return (
        T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3],
        T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3],
        T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3],
    )


@njit
def bilinear(grey: U8, u: float, v: float) -> float:
    """Grey value between pixels, for 0 <= u < width - 1 and likewise v."""
    c, r = int(u), int(v)
    a, b = np.float64(u - c), np.float64(v - r)
    upper = (1.0 - a) * grey[r, c] + a * grey[r, c + 1]
    value: float = (1.0 - b) * upper + b * ((1.0 - a) * grey[r + 1, c] + a * grey[r + 1, c + 1])
    return value


@njit
def sample(grey: U8, warp: F64, side: int, out: F64) -> bool:
    """Grey values (side * side,) of a patch; ``warp`` (2, 3) as of :func:`seen_at`. False if part is not seen."""
    half = 0.5 * (side - 1)
    reach_u, reach_v = half * (abs(warp[0, 1]) + abs(warp[0, 2])), half * (abs(warp[1, 1]) + abs(warp[1, 2]))
    u0, v0 = warp[0, 0], warp[1, 0]
    if not (u0 >= reach_u and v0 >= reach_v):
        return False
    if not (u0 + reach_u < grey.shape[1] - 1 and v0 + reach_v < grey.shape[0] - 1):
        return False
    i = 0
    for row in range(side):
        for column in range(side):
            s, t = column - half, row - half
            out[i] = bilinear(
                grey, u0 + warp[0, 1] * s + warp[0, 2] * t, v0 + warp[1, 1] * s + warp[1, 2] * t
            )
            i += 1
    return True


@njit
def seen_at(eye: Eye, T_cam_world: F64, anchor: F64, scale: float, warp: F64, P: F64) -> bool:
    """Where a patch, its steps multiplied by ``scale``, is in an image: ``warp`` (2, 3), its centre and its steps.

    ``P`` (2, 3) are pixels by camera coordinates at the centre. False if it is not before the camera or seen too
    small, too large or from behind.
    """
    x, y, z = transform(T_cam_world, anchor)
    if not z > NEAREST_M:
        return False
    a, b, d = slope(x / z, y / z, eye.distortion)
    fx, fy = eye.K[0] / z, eye.K[1] / z
    P[0, 0], P[0, 1], P[0, 2] = fx * a, fx * b, -fx * (a * x + b * y) / z
    P[1, 0], P[1, 1], P[1, 2] = fy * b, fy * d, -fy * (b * x + d * y) / z
    warp[0, 0], warp[1, 0] = project(eye, x, y, z)
    for k in range(1, 3):
        warp[0, k] = warp[1, k] = 0.0
        for i in range(3):
            moved = 0.0
            for m in range(3):
                moved += T_cam_world[i, m] * anchor[3 * k + m]
            warp[0, k] += scale * P[0, i] * moved
            warp[1, k] += scale * P[1, i] * moved
    det = warp[0, 1] * warp[1, 2] - warp[0, 2] * warp[1, 1]
    return bool(_LEAST_AREA < det < _MOST_AREA)


@njit
def shifts(eye: Eye, T_cam_world: F64, anchor: F64, warp: F64, P: F64, B: F64) -> None:
    """How a right perturbation of T_world_lidar moves what is seen over a patch, in its steps: ``B`` (2, 6)."""
    C = eye.T_cam_lidar
    x, y, z = transform(T_cam_world, anchor)
    # camera coordinates by the perturbation: C (-v + l x w) with l the point in the lidar frame
    x, y, z = x - C[0, 3], y - C[1, 3], z - C[2, 3]
    l0 = C[0, 0] * x + C[1, 0] * y + C[2, 0] * z
    l1 = C[0, 1] * x + C[1, 1] * y + C[2, 1] * z
    l2 = C[0, 2] * x + C[1, 2] * y + C[2, 2] * z
    D = np.empty((3, 6))
    for i in range(3):
        D[i, 0], D[i, 1], D[i, 2] = -C[i, 0], -C[i, 1], -C[i, 2]
        D[i, 3] = C[i, 1] * l2 - C[i, 2] * l1
        D[i, 4] = C[i, 2] * l0 - C[i, 0] * l2
        D[i, 5] = C[i, 0] * l1 - C[i, 1] * l0
    det = warp[0, 1] * warp[1, 2] - warp[0, 2] * warp[1, 1]
    for k in range(6):
        du = P[0, 0] * D[0, k] + P[0, 1] * D[1, k] + P[0, 2] * D[2, k]
        dv = P[1, 0] * D[0, k] + P[1, 1] * D[1, k] + P[1, 2] * D[2, k]
        B[0, k] = (warp[1, 2] * du - warp[0, 2] * dv) / det
        B[1, k] = (warp[0, 1] * dv - warp[1, 1] * du) / det


@njit
def compare(
    grey: U8, eye: Eye, T_cam_world: F64, patches: Patches, level: int, log_exposure: float, sigma: float
) -> Comparison:
    """Compare an image at a level with all patches; ``log_exposure`` is the image's log inverse exposure.

    The residual is I exp(l - l_ref) - I_ref, ``sigma`` its deviation in grey levels; a patch's pixels err alike (its
    place, its plane, blur) and count as one of them.
    """
    m, scale = len(patches.anchor), 2.0**level
    H, g = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
    share = np.full(m, -1.0, np.float32)
    value, B, warp, P = np.empty(_PIXELS), np.empty((2, 6)), np.empty((2, 3)), np.empty((2, 3))
    score, count = 0.0, 0
    for n in range(m):
        anchor = patches.anchor[n]
        if not seen_at(eye, T_cam_world, anchor, scale, warp, P) or not sample(grey, warp, SIDE, value):
            continue
        shifts(eye, T_cam_world, anchor, warp, P, B)
        gain = np.exp(log_exposure - patches.log_inverse_exposure[n])
        ss = st = tt = se = te = ee = sl = tl = ll = el = 0.0
        for i in range(_PIXELS):
            bright = gain * value[i]
            e = bright - patches.grey[n, level, i]
            gs, gt = np.float64(patches.slope_s[n, level, i]), np.float64(patches.slope_t[n, level, i])
            ss, st, tt = ss + gs * gs, st + gs * gt, tt + gt * gt
            se, te, ee = se + gs * e, te + gt * e, ee + e * e
            sl, tl, ll, el = sl + gs * bright, tl + gt * bright, ll + bright * bright, el + e * bright
        e2 = ee / (_PIXELS * sigma * sigma)
        robust = (_KERNEL2 / (_KERNEL2 + e2)) ** 2
        share[n] = robust
        score += robust
        count += 1
        weight = robust / (sigma * sigma * _PIXELS)
        for k in range(6):
            g[k] += weight * (B[0, k] * se + B[1, k] * te)
            left, right = ss * B[0, k] + st * B[1, k], st * B[0, k] + tt * B[1, k]
            for j in range(6):
                H[k, j] += weight * (left * B[0, j] + right * B[1, j])
            cross = weight * (B[0, k] * sl + B[1, k] * tl)
            H[k, 6] += cross
            H[6, k] += cross
        H[6, 6] += weight * ll
        g[6] += weight * el
    return Comparison(H, g, share, score / max(count, 1), count)


@njit
def brightness(grey: U8, eye: Eye, T_cam_world: F64, patches: Patches, level: int) -> F64:
    """By how much the logarithm of each patch's mean is larger in an image than it was; NaN where not seen."""
    out = np.full(len(patches.anchor), np.nan)
    value, warp, P = np.empty(_PIXELS), np.empty((2, 3)), np.empty((2, 3))
    for n in range(len(out)):
        if not seen_at(eye, T_cam_world, patches.anchor[n], 2.0**level, warp, P):
            continue
        if sample(grey, warp, SIDE, value):
            mean, before = value.mean(), np.float64(patches.grey[n, level].mean())
            if mean > 1.0 and before > 1.0:
                out[n] = np.log(mean) - np.log(before) + patches.log_inverse_exposure[n]
    return out


@njit
def steps_of(T_world_cam: F64, pixel_x: float, pixel_y: float, centre: F64, normal: F64, out: F64) -> bool:
    """``out`` (6,): the steps along a plane for one pixel in u and one in v, at level 0; False at grazing angles.

    ``pixel_x`` and ``pixel_y`` are the size of a pixel in normalised coordinates.
    """
    dx, dy, dz = centre[0] - T_world_cam[0, 3], centre[1] - T_world_cam[1, 3], centre[2] - T_world_cam[2, 3]
    across = normal[0] * dx + normal[1] * dy + normal[2] * dz
    forward = T_world_cam[0, 2] * dx + T_world_cam[1, 2] * dy + T_world_cam[2, 2] * dz
    reach = np.sqrt(dx * dx + dy * dy + dz * dz)
    if not abs(across) > 0.08 * reach:
        return False
    for k in range(2):
        size = (pixel_x if k == 0 else pixel_y) * forward
        px, py, pz = (
            dx + size * T_world_cam[0, k],
            dy + size * T_world_cam[1, k],
            dz + size * T_world_cam[2, k],
        )
        other = normal[0] * px + normal[1] * py + normal[2] * pz
        if not abs(other) > 1e-6 * reach or other * across < 0.0:
            return False
        f = across / other
        out[3 * k], out[3 * k + 1], out[3 * k + 2] = f * px - dx, f * py - dy, f * pz - dz
    return True


@njit
def anchors_on(eye: Eye, T_world_cam: F64, centres: F64, normals: F64) -> tuple[F64, Bool]:
    """Anchors (k, 9) of the points on planes (n, 3) that are not seen edge-on, and which those are (n,)."""
    out, good, k = np.empty((len(centres), 9)), np.zeros(len(centres), np.bool_), 0
    for n in range(len(centres)):
        good[n] = steps_of(T_world_cam, 1.0 / eye.K[0], 1.0 / eye.K[1], centres[n], normals[n], out[k, 3:])
        if good[n]:
            out[k, :3] = centres[n]
            k += 1
    return out[:k], good


@njit
def take(
    pyramid: tuple[U8, ...], eyes: tuple[Eye, ...], T_cam_world: F64, anchors: F64
) -> tuple[F32, F32, F32, F64]:
    """Grey values and slopes float32 (m, levels, 64) of patches in an image, and how much they tell (m,).

    ``tell`` is the smaller eigenvalue of a patch's structure tensor at level 0 plus a tenth of the larger, per pixel;
    0 for a patch that is not wholly seen on all levels.
    """
    m, levels = len(anchors), len(pyramid)
    grey = np.zeros((m, levels, _PIXELS), np.float32)
    slope_s, slope_t = np.zeros_like(grey), np.zeros_like(grey)
    tell, value, warp, P = np.zeros(m), np.empty(RIM * RIM), np.empty((2, 3)), np.empty((2, 3))
    for n in range(m):
        seen = True
        for level in range(levels):
            seen = (
                seen
                and seen_at(eyes[level], T_cam_world, anchors[n], 2.0**level, warp, P)
                and sample(pyramid[level], warp, RIM, value)
            )
            if not seen:
                continue
            ss = st = tt = 0.0
            for i in range(_PIXELS):
                j = (i // SIDE + 1) * RIM + i % SIDE + 1
                gs, gt = 0.5 * (value[j + 1] - value[j - 1]), 0.5 * (value[j + RIM] - value[j - RIM])
                grey[n, level, i], slope_s[n, level, i], slope_t[n, level, i] = value[j], gs, gt
                ss, st, tt = ss + gs * gs, st + gs * gt, tt + gt * gt
            if level == 0:
                mean, root = 0.5 * (ss + tt), np.sqrt(0.25 * (ss - tt) ** 2 + st * st)
                tell[n] = (mean - root + 0.1 * (mean + root)) / _PIXELS
        if not seen:
            tell[n] = 0.0
    return grey, slope_s, slope_t, tell
