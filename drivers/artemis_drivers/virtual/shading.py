"""Colour of surface points: mip-mapped textures, sun with shadow map, sky light, a little mirrored sky."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from artemis_drivers._jit import inline, njit
from artemis_drivers.virtual.mesh_builder import F32, F64, I32, U8
from artemis_drivers.virtual.scene import Scene
from artemis_drivers.virtual.textures import LEVELS, SIZE, TextureAtlas

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
_MACRO_SPAN_M = 11.3


@dataclass(frozen=True, slots=True)
class ShadowMap:
    """``depth`` float32 (h, w) metres along the sun's rays, inf where nothing; ``rows`` float32 (3, 4) maps
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


@inline
def _texel(texels: U8, first: int, size: int, x: int, y: int) -> tuple[float, float, float]:
    k = first + (y & (size - 1)) * size + (x & (size - 1))
    return float(texels[k, 0]), float(texels[k, 1]), float(texels[k, 2])


@inline
def _bilinear(texels: U8, first: int, size: int, u: float, v: float) -> tuple[float, float, float]:
    """Colour 0..255 at picture coordinates u, v (1 = one repetition, v upwards)."""
    x, y = u * size - 0.5, (1.0 - v) * size - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - x0, y - y0
    a = _texel(texels, first, size, x0, y0)
    b = _texel(texels, first, size, x0 + 1, y0)
    c = _texel(texels, first, size, x0, y0 + 1)
    d = _texel(texels, first, size, x0 + 1, y0 + 1)
    wa, wb, wc, wd = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    return (
        wa * a[0] + wb * b[0] + wc * c[0] + wd * d[0],
        wa * a[1] + wb * b[1] + wc * c[1] + wd * d[1],
        wa * a[2] + wb * b[2] + wc * c[2] + wd * d[2],
    )


@njit
def sample(texels: U8, start: np.ndarray, metres: F32, m: int, u: float, v: float, lod: float) -> tuple[float, float, float]:  # type: ignore[type-arg] # fmt: skip
    """Colour 0..255 of material ``m`` at u, v metres; ``lod`` is log2 of the pixel's width in texels."""
    lod = min(max(lod, 0.0), LEVELS - 1.001)
    level = int(lod)
    share = lod - level
    u, v = u / metres[m], v / metres[m]
    a = _bilinear(texels, start[m, level], SIZE >> level, u, v)
    if share < 0.05:
        return a
    b = _bilinear(texels, start[m, level + 1], SIZE >> (level + 1), u, v)
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2])


@inline
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


@inline
def sky_colour(texels: U8, start: np.ndarray, metres: F32, dx: float, dy: float, dz: float) -> tuple[float, float, float]:  # type: ignore[type-arg] # fmt: skip
    """Linear light of the sky in a direction: haze at the horizon, blue above, clouds."""
    up = max(dz, 0.0)
    cloud = 0.0
    if dz > 0.03:
        s = 1.5 / dz
        cloud, _, _ = sample(texels, start, metres, 0, dx * s, dy * s, 1.0)
        cloud = min(max((cloud - 195.0) / 45.0, 0.0), 1.0) * min(dz * 4.0, 1.0)
    haze = np.exp(-4.0 * up)
    r = 0.22 + 0.45 * haze
    g = 0.40 + 0.32 * haze
    b = 0.75 + 0.05 * haze
    return r + cloud * (0.85 - r), g + cloud * (0.85 - g), b + cloud * (0.87 - b)


@njit
def shade(
    t: int,
    o: F64,
    d: tuple[float, float, float],
    pixel: float,
    plane: F32,
    uv: F32,
    texels_per_m: F32,
    shift: F32,
    material: np.ndarray,  # type: ignore[type-arg]
    tint: U8,
    texels: U8,
    start: np.ndarray,  # type: ignore[type-arg]
    metres: F32,
    gloss: F32,
    shadow: F32,
    shadow_rows: F32,
    sun: F32,
) -> tuple[float, float, float]:
    """Linear light 0..~1.5 from triangle ``t`` along the ray o + s d (local frame); ``pixel`` is its width in
    radians.
    """
    n0, n1, n2 = plane[t, 0], plane[t, 1], plane[t, 2]
    facing = n0 * d[0] + n1 * d[1] + n2 * d[2]
    s = (plane[t, 3] - (n0 * o[0] + n1 * o[1] + n2 * o[2])) / min(facing, -1e-4)
    x, y, z = o[0] + s * d[0], o[1] + s * d[1], o[2] + s * d[2]
    u = uv[t, 0, 0] * x + uv[t, 0, 1] * y + uv[t, 0, 2] * z + uv[t, 0, 3]
    v = uv[t, 1, 0] * x + uv[t, 1, 1] * y + uv[t, 1, 2] * z + uv[t, 1, 3]
    # width of the pixel on the surface: between its short and its long axis
    width = s * pixel / np.sqrt(max(-facing, 0.02))
    m = material[t]
    lod = np.log2(max(width * texels_per_m[t], 1e-6))
    r, g, b = sample(texels, start, metres, m, u, v, lod)
    slow_lod = np.log2(max(width * (SIZE / _MACRO_SPAN_M), 1e-6))
    slow, _, _ = sample(texels, start, metres, 0, u + shift[t, 0], v + shift[t, 1], slow_lod)
    k = slow / (217.0 * 255.0 * 255.0)
    r, g, b = r * k * tint[t, 0], g * k * tint[t, 1], b * k * tint[t, 2]
    direct = n0 * sun[0] + n1 * sun[1] + n2 * sun[2]
    if direct > 0.0:
        direct *= _sunlit(shadow, shadow_rows, x, y, z)
    direct = max(direct, 0.0)
    sky = 0.62 + 0.38 * n2
    r, g, b = r * r, g * g, b * b
    r *= _SUN[0] * direct + _SKY[0] * sky
    g *= _SUN[1] * direct + _SKY[1] * sky
    b *= _SUN[2] * direct + _SKY[2] * sky
    if gloss[m] > 0.0:
        mirror = gloss[m] + (1.0 - gloss[m]) * (1.0 + max(facing, -1.0)) ** 5  # Schlick 1994
        mirror = min(mirror * 1.0, 0.6) if gloss[m] > 0.1 else gloss[m]
        e = -2.0 * facing
        dz = d[2] + e * n2
        if dz > 0.0:
            q = sky_colour(texels, start, metres, d[0] + e * n0, d[1] + e * n1, dz)
        else:
            q = (0.10, 0.10, 0.10)
        r, g, b = r + mirror * (q[0] - r), g + mirror * (q[1] - g), b + mirror * (q[2] - b)
    return r, g, b


@njit
def _pixels(
    ids: I32, lines: F32, canvas: I32, R: F64, o: F64, pixel: float, plane: F32, uv: F32, texels_per_m: F32, shift: F32,
    material: np.ndarray, tint: U8, texels: U8, start: np.ndarray, metres: F32, gloss: F32, shadow: F32, shadow_rows: F32, sun: F32, out: F32,  # type: ignore[type-arg]
) -> None:  # fmt: skip
    """Mean light of four sub-pixels; one shading where all four see the same triangle."""
    height, width = out.shape[:2]
    for row in range(height):
        for column in range(width):
            first = ids[canvas[row, column, 0]]
            same = True
            for k in range(1, 4):
                same = same and ids[canvas[row, column, k]] == first
            r, g, b = 0.0, 0.0, 0.0
            count = 1 if same else 4
            for k in range(count):
                j = 4 if same else k  # line 4 is the middle of the pixel
                lx, ly = lines[row, column, j, 0], lines[row, column, j, 1]
                inv = 1.0 / np.sqrt(lx * lx + ly * ly + 1.0)
                lx, ly = lx * inv, ly * inv
                d = (
                    R[0, 0] * lx + R[0, 1] * ly + R[0, 2] * inv,
                    R[1, 0] * lx + R[1, 1] * ly + R[1, 2] * inv,
                    R[2, 0] * lx + R[2, 1] * ly + R[2, 2] * inv,
                )
                t = first if same else ids[canvas[row, column, k]]
                if t < 0:
                    c = sky_colour(texels, start, metres, d[0], d[1], d[2])
                else:
                    c = shade(t, o, d, pixel if same else 0.5 * pixel, plane, uv, texels_per_m, shift, material, tint, texels, start, metres, gloss, shadow, shadow_rows, sun)  # fmt: skip
                r, g, b = r + c[0], g + c[1], b + c[2]
            out[row, column, 0], out[row, column, 1], out[row, column, 2] = r / count, g / count, b / count


def shade_image(
    scene: Scene, shadow: ShadowMap, ids: I32, lines: F32, canvas: I32, T_world_cam: F64, pixel: float
) -> F32:
    """Linear light float32 (h, w, 3).

    ``ids`` triangle numbers of a canvas; ``canvas`` int32 (h, w, 4) flat canvas index of each pixel's four
    sub-pixels; ``lines`` float32 (h, w, 5, 2) their lines of sight x/z, y/z, the fifth that of the pixel's
    middle; ``pixel`` its width in radians.
    """
    s, a = scene.surface, scene.atlas
    out = np.empty((*canvas.shape[:2], 3), np.float32)
    o = T_world_cam[:3, 3] - scene.origin
    R = np.ascontiguousarray(T_world_cam[:3, :3])
    _pixels(ids.reshape(-1), lines, canvas, R, o, pixel, s.plane, s.uv, s.texels_per_m, s.shift, s.material, s.tint, a.texels, a.start, a.metres, a.gloss, shadow.depth, shadow.rows, shadow.sun, out)  # fmt: skip
    return out


def picture_luma(atlas: TextureAtlas, material: int) -> float:
    """Mean brightness 0..255 of a material's picture."""
    return float(atlas.mean_luma[material])
