"""Colour of surface points: mip-mapped textures, sun with shadow map, sky light, a little mirrored sky."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import njit
from artemis_drivers.virtual.mesh_builder import F32, F64, I32, U8
from artemis_drivers.virtual.scene import Scene
from artemis_drivers.virtual.textures import LEVELS, MACRO, MACRO_M, SIZE

I64 = NDArray[np.int64]
U32 = NDArray[np.uint32]
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
_SLOW_LOD = float(np.log2(SIZE / MACRO_M))
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
def sample(texels: I32, start: I64, m: int, u: float, v: float, lod: float) -> Vector:
    """Colour 0..255 of material ``m`` at u, v repetitions; ``lod`` is log2 of the pixel's width in texels."""
    lod = min(max(lod, 0.0), LEVELS - 1.001)
    level = int(lod)
    share = lod - level
    a = _bilinear(texels, start[m, level], SIZE >> level, u, v)
    if share < 0.05:
        return a[0], a[1], a[2]
    b = _bilinear(texels, start[m, level + 1], SIZE >> (level + 1), u, v)
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2])


@njit
def _slow(texels: I32, first: int, size: int, u: float, v: float) -> float:
    """Brightness 0..255 of the slow grey picture, bilinear."""
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
def _sky(texels: I32, first: int, d0: float, d1: float, d2: float) -> Vector:
    """Linear light of the sky in a direction: haze at the horizon, blue above, clouds.

    ``first`` is the first texel of the slow picture at half size, from which the clouds are taken.
    """
    cloud = 0.0
    if d2 > 0.03:
        s = 0.133 / d2
        cloud = _slow(texels, first, SIZE // 2, d0 * s, d1 * s)
        cloud = min(max((cloud - 195.0) / 45.0, 0.0), 1.0) * min(d2 * 4.0, 1.0)
    haze = 1.0 / (1.0 + 5.0 * max(d2, 0.0)) ** 2
    r, g, b = 0.22 + 0.45 * haze, 0.40 + 0.32 * haze, 0.75 + 0.05 * haze
    return r + cloud * (0.85 - r), g + cloud * (0.85 - g), b + cloud * (0.87 - b)


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
def _list_samples(ids: I32, canvas: I32, key: U32, pixel: I32, sub: U8, triangle: I32) -> int:
    """What is to be shaded: a pixel's middle (sub 4) where its four sub-pixels see one surface, else each."""
    count = 0
    for i in range(len(canvas)):
        first = ids[canvas[i, 0]]
        same = True
        for k in range(1, 4):
            t = ids[canvas[i, k]]
            same = same and (t == first or (t >= 0 and first >= 0 and key[t] == key[first]))
        if same:
            pixel[count], sub[count], triangle[count] = i, 4, first
            count += 1
            continue
        for k in range(4):
            pixel[count], sub[count], triangle[count] = i, k, ids[canvas[i, k]]
            count += 1
    return count


@njit
def _geometry(
    pixel: I32,
    sub: U8,
    triangle: I32,
    lines: F32,
    R: F64,
    o: F64,
    width: float,
    rows: F32,
    ray: F32,
    point: F32,
    texture: F32,
) -> None:
    """Per sample: ``ray`` direction and cosine to the surface; ``point`` local position; ``texture`` u, v and
    lod of the picture, u, v of the slow picture and its lod.
    """
    for i in range(len(pixel)):
        x, y = lines[pixel[i], sub[i], 0], lines[pixel[i], sub[i], 1]
        inv = 1.0 / np.sqrt(x * x + y * y + 1.0)
        d0 = (R[0, 0] * x + R[0, 1] * y + R[0, 2]) * inv
        d1 = (R[1, 0] * x + R[1, 1] * y + R[1, 2]) * inv
        d2 = (R[2, 0] * x + R[2, 1] * y + R[2, 2]) * inv
        ray[i, 0], ray[i, 1], ray[i, 2] = d0, d1, d2
        if triangle[i] < 0:
            continue
        row = rows[triangle[i]]
        facing = row[0] * d0 + row[1] * d1 + row[2] * d2
        s = (row[3] - (row[0] * o[0] + row[1] * o[1] + row[2] * o[2])) / min(facing, -1e-4)
        p0, p1, p2 = o[0] + s * d0, o[1] + s * d1, o[2] + s * d2
        u = row[4] * p0 + row[5] * p1 + row[6] * p2 + row[7]
        v = row[8] * p0 + row[9] * p1 + row[10] * p2 + row[11]
        # width of the pixel on the surface: between its short and its long axis
        wide = s * (width if sub[i] == 4 else 0.5 * width) / np.sqrt(max(-facing, 0.02))
        lod = np.log2(max(wide, 1e-5))
        ray[i, 3] = facing
        point[i, 0], point[i, 1], point[i, 2] = p0, p1, p2
        texture[i, 0], texture[i, 1], texture[i, 2] = u, v, lod + row[12]
        texture[i, 3], texture[i, 4] = u * row[15] + row[13], v * row[15] + row[14]
        texture[i, 5] = lod + _SLOW_LOD


@njit
def _paint(triangle: I32, look: U8, texture: F32, texels: I32, start: I64, light: F32) -> None:
    """Reflectance 0..~1 of the samples, linear: picture, tint and slow changes of brightness."""
    for i in range(len(triangle)):
        t = triangle[i]
        if t < 0:
            continue
        r, g, b = sample(texels, start, look[t, 3], texture[i, 0], texture[i, 1], texture[i, 2])
        level = int(min(max(texture[i, 5], 0.0), LEVELS - 1.0))
        slow = _slow(texels, start[MACRO, level], SIZE >> level, texture[i, 3], texture[i, 4])
        k = slow / (_MACRO_MEAN * 255.0 * 255.0)
        r, g, b = r * k * look[t, 0], g * k * look[t, 1], b * k * look[t, 2]
        light[i, 0], light[i, 1], light[i, 2] = r * r, g * g, b * b


@njit
def _illuminate(
    triangle: I32, rows: F32, point: F32, depth: F32, sun_rows: F32, sun: F32, light: F32
) -> None:
    """Multiply the reflectance by the light that arrives: sun where its map sees the point, and sky."""
    for i in range(len(triangle)):
        if triangle[i] < 0:
            continue
        row = rows[triangle[i]]
        direct = max(row[0] * sun[0] + row[1] * sun[1] + row[2] * sun[2], 0.0)
        if direct > 0.0:
            direct *= _sunlit(depth, sun_rows, point[i, 0], point[i, 1], point[i, 2])
        sky = 0.62 + 0.38 * row[2]
        light[i, 0] *= _SUN[0] * direct + _SKY[0] * sky
        light[i, 1] *= _SUN[1] * direct + _SKY[1] * sky
        light[i, 2] *= _SUN[2] * direct + _SKY[2] * sky


@njit
def _mirror(
    triangle: I32, look: U8, rows: F32, ray: F32, gloss: F32, texels: I32, clouds: int, light: F32
) -> None:
    """Sky where nothing was met, and mirrored sky (below the horizon a dark street) on glossy materials."""
    for i in range(len(triangle)):
        d0, d1, d2 = ray[i, 0], ray[i, 1], ray[i, 2]
        if triangle[i] < 0:
            light[i, 0], light[i, 1], light[i, 2] = _sky(texels, clouds, d0, d1, d2)
            continue
        shine = gloss[look[triangle[i], 3]]
        if shine == 0.0:
            continue
        row, facing = rows[triangle[i]], ray[i, 3]
        rim = max(1.0 + facing, 0.0)
        share = min(shine + (1.0 - shine) * rim * rim * rim * rim * rim, 0.5)  # Schlick 1994
        e = -2.0 * facing
        up = d2 + e * row[2]
        r, g, b = 0.10, 0.10, 0.10
        if up > 0.0:
            r, g, b = _sky(texels, clouds, d0 + e * row[0], d1 + e * row[1], up)
        light[i, 0] += share * (r - light[i, 0])
        light[i, 1] += share * (g - light[i, 1])
        light[i, 2] += share * (b - light[i, 2])


@njit
def _gather(pixel: I32, sub: U8, light: F32, out: F32) -> None:
    """Mean of each pixel's samples."""
    for i in range(len(pixel)):
        weight = 1.0 if sub[i] == 4 else 0.25
        for a in range(3):
            out[pixel[i], a] += weight * light[i, a]


def shade_image(
    scene: Scene, shadow: ShadowMap, ids: I32, lines: F32, canvas: I32, T_world_cam: F64, pixel: float
) -> F32:
    """Linear light float32 (h, w, 3).

    ``ids`` triangle numbers of a canvas; ``canvas`` int32 (h, w, 4) flat canvas index of each pixel's four
    sub-pixels; ``lines`` float32 (h, w, 5, 2) their lines of sight x/z, y/z, the fifth that of the pixel's
    middle; ``pixel`` its width in radians.
    """
    height, width = canvas.shape[:2]
    surface, textures = scene.surface, scene.atlas.arrays
    number, sub, triangle = (np.empty(4 * height * width, kind) for kind in (np.int32, np.uint8, np.int32))
    count = _list_samples(ids.reshape(-1), canvas.reshape(-1, 4), surface.key, number, sub, triangle)
    number, sub, triangle = number[:count], sub[:count], triangle[:count]
    ray, point, texture = (np.empty((count, k), np.float32) for k in (4, 3, 6))
    o, R = T_world_cam[:3, 3] - scene.origin, np.ascontiguousarray(T_world_cam[:3, :3])
    _geometry(number, sub, triangle, lines.reshape(-1, 5, 2), R, o, pixel, surface.rows, ray, point, texture)
    light = np.empty((count, 3), np.float32)
    _paint(triangle, surface.look, texture, textures.texels, textures.start, light)
    _illuminate(triangle, surface.rows, point, shadow.depth, shadow.rows, shadow.sun, light)
    clouds = int(textures.start[MACRO, 1])
    _mirror(triangle, surface.look, surface.rows, ray, textures.gloss, textures.texels, clouds, light)
    out = np.zeros((height * width, 3), np.float32)
    _gather(number, sub, light, out)
    return out.reshape(height, width, 3)
