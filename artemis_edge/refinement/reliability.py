"""The unified reliability metric W (section III-C, eqs 9-11), for vertices and, by the same kernels, for texels.

W = exp(-((r_photo / sigma_photo)^2 + (r_geom / sigma_geom)^2) / 2). Two things are added to the letter of the
paper, because without them it fails (docs/refinement.md):

- sigma_photo^2 grows by the variance of the mean it compares with. What has been seen once is not yet sure, and a
  first colour that was wrong (somebody stood there, the image was blurred) would else be defended for ever.
- r_geom is what remains after the depth map's own resolution is allowed for, and counts only what lies in front:
  a texel of the current mesh is never in front of that mesh.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from artemis_edge._jit import kernel
from artemis_edge.block_store import COLOUR, INFORMATION, NORMAL, Store
from artemis_edge.frames import F32, F64, I32, U8
from artemis_edge.refinement.camera import Camera
from artemis_edge.refinement.visible import Depth, Visible

# Pixels of the depth map by which a surface may be misplaced in it: one by ``front``, half by rounding
_DEPTH_REACH = 1.5
# Surfaces so steep that they change by more than this share of their distance within that reach hide themselves
_STEEPEST = 0.3
#: In how many parts the surface is divided, of which an image takes some
PARTS = 64
# Levels from which a channel is clipped, and below which a pixel is lost in the dark, with what they weigh then
CLIPPED, CLIPPED_WEIGHT = 250.0, 0.1
_BLACK, _BLACK_WEIGHT = 4.0, 0.3


class Trust(NamedTuple):
    """What W and the weights beside it depend on; see config.RefinementConfig."""

    sigma_photo: float  # grey levels
    sigma_geom: float  # share of the distance
    least: float  # W below which an observation is discarded
    noise2: float  # variance of one good observation of a colour [grey levels^2]
    most: float  # information of a colour at most, in good observations
    forget: float  # share of its information that a colour loses when it is contradicted
    least_cosine: float  # of the viewing angle


class Photo(NamedTuple):
    """One image, decoded, with its camera and the depth map of the mesh as seen from there."""

    camera: Camera
    image: U8  # (h, w, 3) RGB
    depth: Depth
    gain: F32  # (3,) image to map
    shade: (
        F32  # factors that undo the lens's fall-off, over r^2 from the principal point to the farthest corner
    )
    inverse_r2: float  # 1 / r^2 of that corner [1 / pixels^2]
    sharpness: float  # weight by motion blur, 0..1


class Observations(NamedTuple):
    """How one image sees vertices, one row each: those whose ``geometric`` is at least ``Trust.least``.

    ``slot`` int32 cell slots, ``pixel`` float32 (n, 2) u, v, ``depth`` [m] along z, ``cosine`` of the viewing
    angle, ``colour`` float32 (n, 3) after the gain, ``geometric`` the part of W without r_photo, ``reliability``
    the W of eq. 9, which may be smaller: who takes an observation asks for ``Trust.least`` of it too. ``level`` is
    the :func:`exposure_weight` of the pixel as the camera gave it.
    """

    slot: I32
    pixel: F32
    depth: F32
    cosine: F32
    colour: F32
    geometric: F32
    reliability: F32
    level: F32


@kernel
def geometric(front: float, near: float, slope: float, sigma: float) -> float:
    """exp(-(r_geom / sigma)^2 / 2) of a surface of nearness ``near`` where the depth map shows ``front``.

    With d = 1 / near, eq. 11 is |d_proj - d_ref| / d_ref = (front - near) / near. ``slope`` is how much the
    nearness of the surface itself changes within the depth map's resolution.
    """
    r = max(front - near - min(slope, _STEEPEST * near), 0.0) / near
    if r == 0.0:  # nearly always
        return 1.0
    return math.exp(-0.5 * (r / sigma) * (r / sigma))


def clearly_behind(trust: Trust) -> float:
    """How many times as near as a surface what is in front of it must be, for its W to be below ``trust.least``."""
    return 1.0 + trust.sigma_geom * math.sqrt(-2.0 * math.log(trust.least))


@kernel
def photometric(r2: float, information: float, trust: Trust) -> float:
    """exp(-(r_photo / sigma)^2 / 2) of a squared colour difference (eq. 10, sum over the channels)."""
    if information <= 0.0:
        return 1.0
    sigma2 = trust.sigma_photo * trust.sigma_photo + 3.0 * trust.noise2 / information
    return math.exp(-0.5 * r2 / sigma2)


@kernel
def takes_no_part(number: int, share: int, stamp: int) -> bool:
    """Whether what has this number is not among ``share`` of ``PARTS``; others are with other stamps."""
    return share < PARTS and ((int(number) * 37 + stamp * 11) & (PARTS - 1)) >= share


@kernel
def reach_of(camera: Camera, depth: Depth, nx: float, ny: float, distance: float) -> float:
    """Change of nearness within the depth map's resolution on the plane n . x = ``distance`` (camera frame)."""
    per_pixel = abs(nx) / camera.fx + abs(ny) / camera.fy
    return _DEPTH_REACH * depth.step * per_pixel / max(abs(distance), 1e-6)


@kernel
def front_at(depth: Depth, u: float, v: float) -> float:
    """What the depth map shows at a pixel of the image, which must lie inside."""
    scale = 1.0 / depth.step
    near: float = depth.front[np.uint32((v + 0.5) * scale), np.uint32((u + 0.5) * scale)]
    return near


@kernel
def sample(image: U8, u: float, v: float) -> tuple[float, float, float]:
    """Bilinear red, green, blue at a place with 0 <= u < width - 1, 0 <= v < height - 1."""
    column, row = np.uint32(u), np.uint32(v)
    a, b = u - column, v - row
    p, q, r, s = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
    return (
        p * image[row, column, 0]
        + q * image[row, column + 1, 0]
        + r * image[row + 1, column, 0]
        + s * image[row + 1, column + 1, 0],
        p * image[row, column, 1]
        + q * image[row, column + 1, 1]
        + r * image[row + 1, column, 1]
        + s * image[row + 1, column + 1, 1],
        p * image[row, column, 2]
        + q * image[row, column + 1, 2]
        + r * image[row + 1, column, 2]
        + s * image[row + 1, column + 1, 2],
    )


@kernel
def shade_at(photo: Photo, u: float, v: float) -> float:
    """Factor that undoes the lens's fall-off at a pixel."""
    x, y = u - photo.camera.cx, v - photo.camera.cy
    last = photo.shade.shape[0] - 1
    at = min((x * x + y * y) * photo.inverse_r2, 1.0) * last
    k = min(int(at), last - 1)
    return float(photo.shade[k] + (at - k) * (photo.shade[k + 1] - photo.shade[k]))


@kernel
def exposure_weight(r: float, g: float, b: float) -> float:
    """How much a pixel tells by its level as the camera gave it: a clipped channel tells only a lower bound."""
    brightest = max(r, g, b)
    if brightest >= CLIPPED:
        return CLIPPED_WEIGHT
    return _BLACK_WEIGHT if brightest <= _BLACK else 1.0


def new_observations(n: int) -> Observations:
    """Room for ``n`` rows."""
    scalar = np.empty((5, n), np.float32)
    return Observations(
        np.empty(n, np.int32),
        np.empty((n, 2), np.float32),
        scalar[0],
        scalar[1],
        np.empty((n, 3), np.float32),
        scalar[2],
        scalar[3],
        scalar[4],
    )


def observe(
    store: Store, visible: Visible, photo: Photo, trust: Trust, share: int = PARTS, stamp: int = 0
) -> Observations:
    """How ``photo`` sees the listed vertices: those in view and not hidden; colours as the camera gave them.

    Of vertices that have a colour only ``share`` of ``PARTS`` take part, others with another ``stamp``.
    :func:`weigh` fills ``reliability``.
    """
    out = new_observations(int(visible.length[0]))
    n = observe_vertices(store, visible, photo, trust, share, stamp, out)
    return Observations(
        out.slot[:n],
        out.pixel[:n],
        out.depth[:n],
        out.cosine[:n],
        out.colour[:n],
        out.geometric[:n],
        out.reliability[:n],
        out.level[:n],
    )


@kernel
def observe_vertices(
    store: Store, visible: Visible, photo: Photo, trust: Trust, share: int, stamp: int, out: Observations
) -> int:
    """Fill ``out`` but for ``reliability``; returns how many rows."""
    n, camera = 0, photo.camera
    coloured = store.attribute.shape[1] > INFORMATION
    right, bottom = camera.width - 1.0, camera.height - 1.0
    for i in range(visible.length[0]):
        u, v, near = visible.pixel[i, 0], visible.pixel[i, 1], visible.pixel[i, 2]
        if not (0.0 <= u < right and 0.0 <= v < bottom):  # NaN is not
            continue
        s, p = visible.slot[i], visible.point[i]
        if coloured and takes_no_part(s, share, stamp) and store.attribute[s, INFORMATION] > 0.0:
            continue
        nx, ny, nz = _turn(camera.R, store.vertex[s])
        away = nx * p[0] + ny * p[1] + nz * p[2]
        cosine = -away / math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
        if cosine < trust.least_cosine:
            continue
        slope = reach_of(camera, photo.depth, nx, ny, away)
        g = geometric(front_at(photo.depth, u, v), near, slope, trust.sigma_geom)
        if g < trust.least:
            continue
        r, k, b = sample(photo.image, u, v)
        out.slot[n], out.pixel[n, 0], out.pixel[n, 1] = s, u, v
        out.depth[n], out.cosine[n] = p[2], cosine
        out.colour[n, 0], out.colour[n, 1], out.colour[n, 2] = r, k, b
        out.geometric[n], out.level[n] = g, exposure_weight(r, k, b)
        n += 1
    return n


@kernel
def weigh(store: Store, seen: Observations, photo: Photo, trust: Trust) -> None:
    """Bring the colours to the map's exposure and fill ``reliability`` (eq. 9)."""
    gain = photo.gain
    coloured = store.attribute.shape[1] > INFORMATION
    for i in range(seen.slot.shape[0]):
        c, w = seen.colour[i], np.float64(seen.geometric[i])
        f = shade_at(photo, seen.pixel[i, 0], seen.pixel[i, 1])
        c[0], c[1], c[2] = c[0] * f * gain[0], c[1] * f * gain[1], c[2] * f * gain[2]
        if coloured:
            m = store.attribute[seen.slot[i]]
            dr, dg, db = c[0] - m[COLOUR], c[1] - m[COLOUR + 1], c[2] - m[COLOUR + 2]
            w *= photometric(dr * dr + dg * dg + db * db, m[INFORMATION] * trust.noise2, trust)
        seen.reliability[i] = w


@kernel
def _turn(R: F64, vertex: F32) -> tuple[float, float, float]:
    """A vertex's normal in camera coordinates."""
    x, y, z = vertex[NORMAL], vertex[NORMAL + 1], vertex[NORMAL + 2]
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )
