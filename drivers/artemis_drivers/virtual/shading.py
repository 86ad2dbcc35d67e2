"""Colour of surface points: mip-mapped textures, sun with shadow map, sky light, a little mirrored sky."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import kernel, njit
from artemis_drivers.virtual.mesh_builder import F32, F64, I32
from artemis_drivers.virtual.moving import MovingPart
from artemis_drivers.virtual.scene import Scene, Surface
from artemis_drivers.virtual.spans import Canvas, View, draw, new_canvas
from artemis_drivers.virtual.textures import LEVELS, MACRO, MACRO_M, SIZE, TextureArrays

I16 = NDArray[np.int16]
I64 = NDArray[np.int64]
Vector = tuple[Any, Any, Any]  # scalars of a kernel

_SHADOW_M = 0.05  # size of a pixel of the shadow map
_SHADOW_BIAS_M = 0.02
_STEEPEST = 20.0  # metres of depth per metre of the shadow map for which its pixels are made up
_LARGEST_SHADOW = 8192
_MOVER_SHADOW_M = 0.03
_SHADOW_SEEN_M = 50.0  # movers farther away cast none
_SUN = (1.25, 1.15, 0.98)  # linear light of the sun and of the sky
_SKY = (0.42, 0.47, 0.56)
_SLOW_LOD = float(np.log2(SIZE / MACRO_M))
_MACRO_MEAN = 217.0  # of 0..255, so that the slow picture keeps the mean brightness
_LANE = 21  # bits of one colour while four texels are added up
_LANE_MASK = (1 << _LANE) - 1
_STEP_BITS = 6
# positions between two texels: products of two weights have 12 bits, so that a colour stays in its lane
_STEPS = 1 << _STEP_BITS


class ShadowMap(NamedTuple):
    """What the sun reaches.

    ``depth`` float32 (h, w) metres along the sun's rays, inf where nothing; ``rows`` float32 (3, 4) maps
    local coordinates to column, row and depth; ``sun`` float32 (3,) towards the sun; ``pixel`` metres.
    """

    depth: F32
    rows: F32
    sun: F32
    pixel: float


class MoverShadows(NamedTuple):
    """What each of k movers near the camera keeps from the sun, as ShadowMap.depth (k, n, n) and .rows (k, 3, 4)."""

    depth: F32
    rows: F32


class Parts(NamedTuple):
    """The frames of what stands still (row 0) and of each mover (k, ...) at the time of an image.

    ``first`` int32 (k,) number of the first triangle; ``eye`` float64 (k, 3) and ``R_local_cam`` (k, 3, 3):
    the camera in the part's local frame; ``R_scene_local`` and ``t_scene_local``: the part in the scene's.
    """

    first: I32
    eye: F64
    R_local_cam: F64
    R_scene_local: F64
    t_scene_local: F64


class Film(NamedTuple):
    """What arrives at the pixels (n): ``light`` float32 (n, 3), linear, 1 = white; ``depth`` float32 (n,)
    metres along z, inf for the sky; ``part`` int16 (n,) row of :class:`Parts`.
    """

    light: F32
    depth: F32
    part: I16


def local_vertices(scene: Scene) -> F32:
    """Vertices of what stands still, relative to the scene's origin."""
    return np.asarray(scene.mesh.vertices - scene.origin.astype(np.float32), np.float32)


def shadow_map(scene: Scene, sun: F64, local: F32) -> ShadowMap:
    """What the sun sees of what stands still; ``local`` are its vertices relative to the scene's origin."""
    R = _sun_axes(sun)
    seen = local @ R.T.astype(np.float32)
    low, high = seen.min(axis=0), seen.max(axis=0)
    pixel = max(_SHADOW_M, float((high - low)[:2].max()) / _LARGEST_SHADOW)
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = -low[0], -low[1], -low[2]
    canvas = new_canvas(int((high[0] - low[0]) / pixel) + 2, int((high[1] - low[1]) / pixel) + 2, named=False)
    every = np.arange(len(scene.mesh.triangles), dtype=np.int32)
    draw(canvas, View(1 / pixel, 1 / pixel, 0.0, 0.0, True), T, local, scene.mesh.triangles, every, 0)
    rows = np.concatenate([R, T[:3, 3:]], axis=1)
    rows[:2] /= pixel
    depth = np.negative(canvas.nearness, out=canvas.nearness)
    return ShadowMap(depth, rows.astype(np.float32), sun.astype(np.float32), float(pixel))


def mover_shadows(scene: Scene, parts: Parts, sun: F64) -> MoverShadows:
    """What the sun sees of the movers near the camera at the time of an image."""
    away = np.linalg.norm(parts.R_scene_local[0] @ parts.eye[0] - parts.t_scene_local[1:], axis=1)
    near = [k for k, m in enumerate(scene.movers) if away[k] - m.radius < _SHADOW_SEEN_M]
    size = max((int(2 * scene.movers[k].radius / _MOVER_SHADOW_M) + 3 for k in near), default=0)
    out = MoverShadows(
        np.full((len(near), size, size), -np.inf, np.float32), np.empty((len(near), 3, 4), np.float32)
    )
    no_names = np.empty((0, 0), np.int32)
    for row, k in enumerate(near):
        mover, T, R = scene.movers[k], np.eye(4), _sun_axes(sun)
        T[:3, :3] = R @ parts.R_scene_local[k + 1]
        view = View(1 / _MOVER_SHADOW_M, 1 / _MOVER_SHADOW_M, size / 2, size / 2, True)
        every = np.arange(len(mover.mesh.triangles), dtype=np.int32)
        draw(
            Canvas(out.depth[row], no_names, 0, out.depth.shape[1]),
            view,
            T,
            local_mover(mover),
            mover.mesh.triangles,
            every,
            0,
        )
        out.rows[row, :, :3], out.rows[row, :, 3] = R, -R @ parts.t_scene_local[k + 1]
        out.rows[row, :2] /= _MOVER_SHADOW_M
        out.rows[row, :2, 3] += size / 2
    np.negative(out.depth, out=out.depth)
    return out


def local_mover(mover: MovingPart) -> F32:
    """Vertices of a mover in its local frame."""
    return np.asarray(mover.mesh.vertices - mover.bvh.origin, np.float32)


def _sun_axes(sun: F64) -> F64:
    """Rows: right, down and forward for an eye in the sun."""
    forward = -sun
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(sun[2]) < 0.999 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


@kernel(forceinline=True)
def _lanes(texel: Any) -> Any:
    """The three bytes of a texel, _LANE bits apart."""
    t = np.int64(texel)
    return t & 0xFF | (t & 0xFF00) << (_LANE - 8) | (t & 0xFF0000) << (2 * _LANE - 16)


@kernel(forceinline=True)
def _bilinear(texels: I32, first: int, size: int, u: float, v: float) -> Vector:
    """Colour 0..255 at picture coordinates u, v (1 = one repetition, v upwards)."""
    x, y = (u * size - 0.5) * _STEPS, ((1.0 - v) * size - 0.5) * _STEPS
    column, row = int(np.floor(x)), int(np.floor(y))
    fx, fy = column & (_STEPS - 1), row & (_STEPS - 1)
    mask = size - 1
    column, row = column >> _STEP_BITS, row >> _STEP_BITS
    # unsigned: no test for counting from the end
    left, right = np.uint64(column & mask), np.uint64((column + 1) & mask)
    upper, lower = np.uint64(first + (row & mask) * size), np.uint64(first + ((row + 1) & mask) * size)
    gx, gy = _STEPS - fx, _STEPS - fy
    total = _lanes(texels[upper + left]) * (gx * gy) + _lanes(texels[upper + right]) * (fx * gy)
    total += _lanes(texels[lower + left]) * (gx * fy) + _lanes(texels[lower + right]) * (fx * fy)
    scale = 1.0 / (_STEPS * _STEPS)
    return (
        (total & _LANE_MASK) * scale,
        (total >> _LANE & _LANE_MASK) * scale,
        (total >> 2 * _LANE) * scale,
    )


@kernel(forceinline=True)
def sample(texels: I32, start: I64, m: int, u: float, v: float, lod: float) -> Vector:
    """Colour 0..255 of material ``m`` at u, v repetitions; ``lod`` is log2 of the pixel's width in texels.

    Two levels are mixed only in the middle half between them, which looks the same and costs less.
    """
    lod = min(max(lod, 0.0), LEVELS - 1.001)
    level = int(lod)
    share = 2.0 * (lod - level) - 0.5
    if share >= 1.0:
        level += 1
    a = _bilinear(texels, start[m, level], SIZE >> level, u, v)
    if share <= 0.0 or share >= 1.0:
        return a[0], a[1], a[2]
    b = _bilinear(texels, start[m, level + 1], SIZE >> (level + 1), u, v)
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2])


@kernel(forceinline=True)
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


@kernel(forceinline=True)
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


@kernel(forceinline=True)
def _sunlit(depth: F32, rows: F32, x: float, y: float, z: float, slack: float) -> float:
    """Share of sun 0..1 at a local point: four neighbours of the shadow map, weighted.

    ``slack`` metres deeper than the map counts as lit.
    """
    u = rows[0, 0] * x + rows[0, 1] * y + rows[0, 2] * z + rows[0, 3]
    v = rows[1, 0] * x + rows[1, 1] * y + rows[1, 2] * z + rows[1, 3]
    d = rows[2, 0] * x + rows[2, 1] * y + rows[2, 2] * z + rows[2, 3] - slack
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


@kernel(forceinline=True)
def _past_movers(passing: MoverShadows, x: float, y: float, z: float, slack: float) -> float:
    """Share of sun 0..1 at a local point that gets past the movers."""
    lit, size = 1.0, passing.depth.shape[1]
    for k in range(len(passing.rows)):
        rows = passing.rows[k]
        u = rows[0, 0] * x + rows[0, 1] * y + rows[0, 2] * z + rows[0, 3]
        if 0.0 <= u <= size:
            v = rows[1, 0] * x + rows[1, 1] * y + rows[1, 2] * z + rows[1, 3]
            if 0.0 <= v <= size:
                lit *= _sunlit(passing.depth[k], rows, x, y, z, slack)
    return lit


@kernel(forceinline=True)
def _turned(R: F64, x: float, y: float, z: float) -> Vector:
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )


@kernel(forceinline=True)
def _part_of(first: I32, t: int) -> int:
    part = 0
    while part + 1 < len(first) and t >= first[part + 1]:
        part += 1
    return part


@kernel(forceinline=True)
def _paint(
    surface: Surface, textures: TextureArrays, t: int, p: Vector, distance: float, wide: float, facing: float
) -> Vector:
    """Reflectance 0..~1, linear, of triangle ``t`` at its local point: picture, tint and slow changes."""
    row, look = surface.rows[t], surface.look[t]
    u = row[4] * p[0] + row[5] * p[1] + row[6] * p[2] + row[7]
    v = row[8] * p[0] + row[9] * p[1] + row[10] * p[2] + row[11]
    # width of the pixel on the surface: between its short and its long axis
    lod = np.log2(max(distance * wide / np.sqrt(max(-facing, 0.02)), 1e-5))
    r, g, b = sample(textures.texels, textures.start, look[3], u, v, lod + row[12])
    level = int(min(max(lod + _SLOW_LOD, 0.0), LEVELS - 1.0))
    first, size = textures.start[MACRO, level], SIZE >> level
    slow = _slow(textures.texels, first, size, u * row[15] + row[13], v * row[15] + row[14])
    k = slow / (_MACRO_MEAN * 255.0 * 255.0)
    r, g, b = r * k * look[0], g * k * look[1], b * k * look[2]
    return r * r, g * g, b * b


@kernel(forceinline=True)
def _reflected(
    textures: TextureArrays, shine: float, light: Vector, n: Vector, d: Vector, facing: float
) -> Vector:
    """Light with mirrored sky (below the horizon a dark street) on a glossy material."""
    rim = max(1.0 + facing, 0.0)
    share = min(shine + (1.0 - shine) * rim * rim * rim * rim * rim, 0.5)  # Schlick 1994
    e = -2.0 * facing
    up = d[2] + e * n[2]
    r, g, b = 0.10, 0.10, 0.10
    if up > 0.0:
        r, g, b = _sky(textures.texels, textures.start[MACRO, 1], d[0] + e * n[0], d[1] + e * n[1], up)
    return (
        light[0] + share * (r - light[0]),
        light[1] + share * (g - light[1]),
        light[2] + share * (b - light[2]),
    )


@kernel(forceinline=True)
def _shade(
    surface: Surface,
    textures: TextureArrays,
    shadow: ShadowMap,
    passing: MoverShadows,
    parts: Parts,
    t: int,
    part: int,
    x: float,
    y: float,
    wide: float,
) -> tuple[Any, Any, Any, Any]:
    """Linear light and depth along z where the line of sight (x, y, 1) meets triangle ``t`` of ``part``.

    ``wide`` is the width of the pixel in radians.
    """
    inv = 1.0 / np.sqrt(x * x + y * y + 1.0)
    d = _turned(parts.R_local_cam[part], x * inv, y * inv, inv)
    if t < 0:
        r, g, b = _sky(textures.texels, textures.start[MACRO, 1], d[0], d[1], d[2])
        return r, g, b, np.inf
    row, o = surface.rows[t], parts.eye[part]
    facing = min(row[0] * d[0] + row[1] * d[1] + row[2] * d[2], -1e-4)
    s = (row[3] - (row[0] * o[0] + row[1] * o[1] + row[2] * o[2])) / facing
    p = (o[0] + s * d[0], o[1] + s * d[1], o[2] + s * d[2])
    paint = _paint(surface, textures, t, p, s, wide, facing)
    n = (row[0] + 0.0, row[1] + 0.0, row[2] + 0.0)
    if part > 0:
        R, shift = parts.R_scene_local[part], parts.t_scene_local[part]
        n, d = _turned(R, n[0], n[1], n[2]), _turned(R, d[0], d[1], d[2])
        q = _turned(R, p[0], p[1], p[2])
        p = (q[0] + shift[0], q[1] + shift[1], q[2] + shift[2])
    direct = max(n[0] * shadow.sun[0] + n[1] * shadow.sun[1] + n[2] * shadow.sun[2], 0.0)
    if direct > 0.0:
        # a surface seen at a slant by the sun is that much deeper at the next pixel of the map
        slope = 1.42 * min(np.sqrt(max(1.0 - direct * direct, 0.0)) / direct, _STEEPEST)
        slack = _SHADOW_BIAS_M + shadow.pixel * slope
        direct *= _sunlit(shadow.depth, shadow.rows, p[0], p[1], p[2], slack)
        if direct > 0.0:
            slack = _SHADOW_BIAS_M + _MOVER_SHADOW_M * slope
            direct *= _past_movers(passing, p[0], p[1], p[2], slack)
    sky = 0.62 + 0.38 * n[2]
    r = paint[0] * (_SUN[0] * direct + _SKY[0] * sky)
    g = paint[1] * (_SUN[1] * direct + _SKY[1] * sky)
    b = paint[2] * (_SUN[2] * direct + _SKY[2] * sky)
    shine = textures.gloss[surface.look[t, 3]]
    if shine > 0.0:
        r, g, b = _reflected(textures, shine, (r, g, b), n, d, facing)
    return r, g, b, s * inv


@kernel(forceinline=True)
def _one_surface(key: NDArray[np.uint32], a: int, b: int) -> bool:
    return bool(a == b or (a >= 0 and b >= 0 and key[a] == key[b]))


@kernel(forceinline=True)
def _share_of(key: NDArray[np.uint32], ids: I32, four: I32, k: int) -> float:
    """Share of a pixel that shows the surface of sub-pixel k; 0 where an earlier sub-pixel shows it, too."""
    share = 0.25
    for other in range(4):
        if other != k and _one_surface(key, ids[four[k]], ids[four[other]]):
            if other < k:
                return 0.0
            share += 0.25
    return share


@njit
def shade_pixels(
    surface: Surface,
    textures: TextureArrays,
    shadow: ShadowMap,
    passing: MoverShadows,
    parts: Parts,
    ids: I32,
    canvas: I32,
    lines: F32,
    wide: float,
    film: Film,
) -> None:
    """Fill ``film``.

    ``ids`` triangle numbers of a flat canvas; ``canvas`` int32 (n, 4) where on it each pixel's four sub-pixels
    lie; ``lines`` float32 (n, 5, 2) their lines of sight x/z, y/z, the fifth that of the pixel's middle. A
    pixel is shaded once, at its middle, where its sub-pixels see one surface, else once for each surface.
    """
    for i in range(len(canvas)):
        first = ids[canvas[i, 0]]
        same = True
        for k in range(1, 4):
            same = same and _one_surface(surface.key, first, ids[canvas[i, k]])
        if same:
            part = _part_of(parts.first, first)
            x, y = lines[i, 4, 0], lines[i, 4, 1]
            r, g, b, z = _shade(surface, textures, shadow, passing, parts, first, part, x, y, wide)
            film.light[i, 0], film.light[i, 1], film.light[i, 2] = r, g, b
            film.depth[i], film.part[i] = z, part
            continue
        film.light[i, 0] = film.light[i, 1] = film.light[i, 2] = 0.0
        film.depth[i], film.part[i] = np.inf, 0
        for k in range(4):
            t = ids[canvas[i, k]]
            weight = _share_of(surface.key, ids, canvas[i], k)
            if weight == 0.0:
                continue
            part = _part_of(parts.first, t)
            x, y = lines[i, k, 0], lines[i, k, 1]
            r, g, b, z = _shade(surface, textures, shadow, passing, parts, t, part, x, y, 0.7 * wide)
            film.light[i, 0] += weight * r
            film.light[i, 1] += weight * g
            film.light[i, 2] += weight * b
            if z < film.depth[i]:
                film.depth[i], film.part[i] = z, part
