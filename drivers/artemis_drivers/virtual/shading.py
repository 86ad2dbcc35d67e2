"""Colour of surface points: mip-mapped textures, sun with shadow map, sky light, a little mirrored sky."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import njit
from artemis_drivers.virtual.mesh_builder import F32, F64, I32, U8
from artemis_drivers.virtual.scene import Scene, Surface
from artemis_drivers.virtual.textures import LEVELS, MACRO, MACRO_M, SIZE, TextureArrays

I64 = NDArray[np.int64]
Vector = tuple[Any, Any, Any]  # scalars of a kernel

#: Draws triangles: (vertices float32 (n, 3), triangles, T_view_world, (fx, fy, cx, cy), (width, height),
#: orthographic) -> (number of the triangle per pixel, -1 where none; nearness per pixel: 1/z, or -z when
#: orthographic). View coordinates x right, y down, z forward; pixel centres at integers; back faces culled.
Rasteriser = Callable[
    [F32, I32, F64, tuple[float, float, float, float], tuple[int, int], bool], tuple[I32, F32]
]
_SHADOW_M = 0.05  # size of a pixel of the shadow map
_SHADOW_BIAS_M = 0.06
_LARGEST_SHADOW = 8192
_SUN = (1.25, 1.15, 0.98)  # linear light of the sun and of the sky
_SKY = (0.42, 0.47, 0.56)
_MACRO_MEAN = 217.0  # of 0..255, so that the slow picture keeps the mean brightness


class ShadowMap(NamedTuple):
    """What the sun reaches.

    ``depth`` float32 (h, w) metres along the sun's rays, inf where nothing; ``rows`` float32 (3, 4) maps
    local coordinates to column, row and depth; ``sun`` float32 (3,) towards the sun.
    """

    depth: F32
    rows: F32
    sun: F32


def shadow_map(scene: Scene, sun: F64, rasterise: Rasteriser) -> ShadowMap:
    """What the sun sees of the scene."""
    forward = -sun
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    local = (scene.mesh.vertices - scene.origin.astype(np.float32)).astype(np.float32)
    seen = local @ R.T.astype(np.float32)
    low, high = seen.min(axis=0), seen.max(axis=0)
    pixel = max(_SHADOW_M, float((high - low)[:2].max()) / _LARGEST_SHADOW)
    size = (int((high[0] - low[0]) / pixel) + 2, int((high[1] - low[1]) / pixel) + 2)
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = -low[0], -low[1], -low[2]
    _, nearness = rasterise(local, scene.mesh.triangles, T, (1 / pixel, 1 / pixel, 0.0, 0.0), size, True)
    rows = np.concatenate([R, T[:3, 3:]], axis=1)
    rows[:2] /= pixel
    depth = np.where(np.isfinite(nearness), -nearness, np.inf).astype(np.float32)
    return ShadowMap(depth, rows.astype(np.float32), sun.astype(np.float32))


@njit
def _bilinear(texels: I32, first: int, size: int, u: float, v: float) -> Vector:
    """Colour 0..255 at picture coordinates u, v (1 = one repetition, v upwards)."""
    x, y = u * size - 0.5, (1.0 - v) * size - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - x0, y - y0
    mask = size - 1
    left, right = x0 & mask, (x0 + 1) & mask
    upper, lower = first + (y0 & mask) * size, first + ((y0 + 1) & mask) * size
    a, b, c, d = texels[upper + left], texels[upper + right], texels[lower + left], texels[lower + right]
    wa, wb, wc, wd = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    return (
        wa * (a & 255) + wb * (b & 255) + wc * (c & 255) + wd * (d & 255),
        wa * (a >> 8 & 255) + wb * (b >> 8 & 255) + wc * (c >> 8 & 255) + wd * (d >> 8 & 255),
        wa * (a >> 16) + wb * (b >> 16) + wc * (c >> 16) + wd * (d >> 16),
    )


@njit
def _bilinear_red(texels: I32, first: int, size: int, u: float, v: float) -> float:
    """Red of :func:`_bilinear`, for grey pictures."""
    x, y = u * size - 0.5, (1.0 - v) * size - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - x0, y - y0
    mask = size - 1
    left, right = x0 & mask, (x0 + 1) & mask
    upper, lower = first + (y0 & mask) * size, first + ((y0 + 1) & mask) * size
    high = (1 - fx) * (texels[upper + left] & 255) + fx * (texels[upper + right] & 255)
    low = (1 - fx) * (texels[lower + left] & 255) + fx * (texels[lower + right] & 255)
    return float((1 - fy) * high + fy * low)


@njit
def sample(textures: TextureArrays, m: int, u: float, v: float, lod: float) -> Vector:
    """Colour 0..255 of material ``m`` at u, v metres; ``lod`` is log2 of the pixel's width in texels."""
    lod = min(max(lod, 0.0), LEVELS - 1.001)
    level = int(lod)
    share = lod - level
    texels, start = textures.texels, textures.start
    u, v = u / textures.metres[m], v / textures.metres[m]
    a = _bilinear(texels, start[m, level], SIZE >> level, u, v)
    if share < 0.05:
        return a[0], a[1], a[2]
    b = _bilinear(texels, start[m, level + 1], SIZE >> (level + 1), u, v)
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2])


@njit
def sample_slow(textures: TextureArrays, u: float, v: float, lod: float) -> float:
    """Brightness 0..255 of the slow grey picture at u, v metres."""
    level = int(min(max(lod, 0.0), LEVELS - 1.001))
    first, size = textures.start[MACRO, level], SIZE >> level
    return float(_bilinear_red(textures.texels, first, size, u / MACRO_M, v / MACRO_M))


@njit
def _sunlit(depth: F32, rows: F32, x: float, y: float, z: float) -> float:
    """Share of sun 0..1 at a local point: four neighbours of the shadow map, weighted."""
    u = rows[0, 0] * x + rows[0, 1] * y + rows[0, 2] * z + rows[0, 3]
    v = rows[1, 0] * x + rows[1, 1] * y + rows[1, 2] * z + rows[1, 3]
    d = rows[2, 0] * x + rows[2, 1] * y + rows[2, 2] * z + rows[2, 3] - _SHADOW_BIAS_M
    u0, v0 = int(np.floor(u)), int(np.floor(v))
    if u0 < 0 or v0 < 0 or u0 + 1 >= depth.shape[1] or v0 + 1 >= depth.shape[0]:
        return 1.0
    fu, fv = u - u0, v - v0
    lit = 0.0
    if depth[v0, u0] >= d:
        lit += (1 - fu) * (1 - fv)
    if depth[v0, u0 + 1] >= d:
        lit += fu * (1 - fv)
    if depth[v0 + 1, u0] >= d:
        lit += (1 - fu) * fv
    if depth[v0 + 1, u0 + 1] >= d:
        lit += fu * fv
    return lit


@njit
def sky_colour(textures: TextureArrays, d: Vector) -> Vector:
    """Linear light of the sky in a direction: haze at the horizon, blue above, clouds."""
    up = max(d[2], 0.0)
    cloud = 0.0
    if d[2] > 0.03:
        s = 1.5 / d[2]
        cloud = sample_slow(textures, d[0] * s, d[1] * s, 1.0)
        cloud = min(max((cloud - 195.0) / 45.0, 0.0), 1.0) * min(d[2] * 4.0, 1.0)
    haze = np.exp(-4.0 * up)
    r, g, b = 0.22 + 0.45 * haze, 0.40 + 0.32 * haze, 0.75 + 0.05 * haze
    return r + cloud * (0.85 - r), g + cloud * (0.85 - g), b + cloud * (0.87 - b)


@njit
def _mirrored(
    textures: TextureArrays, row: F32, d: Vector, facing: float, gloss: float
) -> tuple[float, Vector]:
    """Share and light of what a glossy surface mirrors: the sky, or a dark street below the horizon."""
    share = gloss + (1.0 - gloss) * (1.0 + max(facing, -1.0)) ** 5  # Schlick 1994
    e = -2.0 * facing
    q = (d[0] + e * row[0], d[1] + e * row[1], d[2] + e * row[2])
    light = sky_colour(textures, q) if q[2] > 0.0 else (0.10, 0.10, 0.10)
    return min(share, 0.5), light


@njit
def shade(
    row: F32, look: U8, o: F64, d: Vector, pixel: float, textures: TextureArrays, shadow: ShadowMap
) -> Vector:
    """Linear light 0..~1.5 from the triangle of ``row`` and ``look`` (see Surface) along the ray o + s d.

    ``pixel`` is the width of the pixel in radians.
    """
    facing = row[0] * d[0] + row[1] * d[1] + row[2] * d[2]
    s = (row[3] - (row[0] * o[0] + row[1] * o[1] + row[2] * o[2])) / min(facing, -1e-4)
    x, y, z = o[0] + s * d[0], o[1] + s * d[1], o[2] + s * d[2]
    u = row[4] * x + row[5] * y + row[6] * z + row[7]
    v = row[8] * x + row[9] * y + row[10] * z + row[11]
    # width of the pixel on the surface: between its short and its long axis
    width = s * pixel / np.sqrt(max(-facing, 0.02))
    m = look[3]
    r, g, b = sample(textures, m, u, v, np.log2(max(width * row[12], 1e-6)))
    slow_lod = 0.0 if width < MACRO_M / SIZE else np.log2(width * (SIZE / MACRO_M))
    slow = sample_slow(textures, u + row[13], v + row[14], slow_lod)
    k = slow / (_MACRO_MEAN * 255.0 * 255.0)
    r, g, b = r * k * look[0], g * k * look[1], b * k * look[2]
    sun = shadow.sun
    direct = max(row[0] * sun[0] + row[1] * sun[1] + row[2] * sun[2], 0.0)
    if direct > 0.0:
        direct *= _sunlit(shadow.depth, shadow.rows, x, y, z)
    sky = 0.62 + 0.38 * row[2]
    r *= r * (_SUN[0] * direct + _SKY[0] * sky)
    g *= g * (_SUN[1] * direct + _SKY[1] * sky)
    b *= b * (_SUN[2] * direct + _SKY[2] * sky)
    gloss = textures.gloss[m]
    if gloss > 0.0:
        share, q = _mirrored(textures, row, d, facing, gloss)
        r, g, b = r + share * (q[0] - r), g + share * (q[1] - g), b + share * (q[2] - b)
    return r, g, b


@njit
def _direction(R: F64, x: float, y: float) -> Vector:
    """Unit direction in the world of the camera's line (x, y, 1)."""
    inv = 1.0 / np.sqrt(x * x + y * y + 1.0)
    return (
        (R[0, 0] * x + R[0, 1] * y + R[0, 2]) * inv,
        (R[1, 0] * x + R[1, 1] * y + R[1, 2]) * inv,
        (R[2, 0] * x + R[2, 1] * y + R[2, 2]) * inv,
    )


@njit
def _pixels(
    ids: I32,
    lines: F32,
    canvas: I32,
    R: F64,
    o: F64,
    pixel: float,
    surface: Surface,
    textures: TextureArrays,
    shadow: ShadowMap,
    out: F32,
) -> None:
    """Mean light of four sub-pixels; one shading where all four see the same surface."""
    rows, look, key = surface.rows, surface.look, surface.key
    for i in range(len(canvas)):
        first = ids[canvas[i, 0]]
        same = True
        for k in range(1, 4):
            t = ids[canvas[i, k]]
            same = same and (t == first or (t >= 0 and first >= 0 and key[t] == key[first]))
        r, g, b = 0.0, 0.0, 0.0
        count = 1 if same else 4
        for k in range(count):
            j = 4 if same else k  # line 4 is the middle of the pixel
            d = _direction(R, lines[i, j, 0], lines[i, j, 1])
            t = ids[canvas[i, k]]
            if t < 0:
                c = sky_colour(textures, d)
            else:
                width = pixel if same else 0.5 * pixel
                c = shade(rows[t], look[t], o, d, width, textures, shadow)
            r, g, b = r + c[0], g + c[1], b + c[2]
        out[i, 0], out[i, 1], out[i, 2] = r / count, g / count, b / count


def shade_image(
    scene: Scene, shadow: ShadowMap, ids: I32, lines: F32, canvas: I32, T_world_cam: F64, pixel: float
) -> F32:
    """Linear light float32 (h, w, 3).

    ``ids`` triangle numbers of a canvas; ``canvas`` int32 (h, w, 4) flat canvas index of each pixel's four
    sub-pixels; ``lines`` float32 (h, w, 5, 2) their lines of sight x/z, y/z, the fifth that of the pixel's
    middle; ``pixel`` its width in radians.
    """
    height, width = canvas.shape[:2]
    out = np.empty((height * width, 3), np.float32)
    o = T_world_cam[:3, 3] - scene.origin
    R = np.ascontiguousarray(T_world_cam[:3, :3])
    _pixels(
        ids.reshape(-1),
        lines.reshape(-1, 5, 2),
        canvas.reshape(-1, 4),
        R,
        o,
        pixel,
        scene.surface,
        scene.atlas.arrays,
        shadow,
        out,
    )
    return out.reshape(height, width, 3)
