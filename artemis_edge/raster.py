"""Kernels of the z-buffer rasteriser: projection, clipping, filling, interpolation.

View coordinates: x right, y down, z forward, metres. A pixel's centre has integer coordinates (as in OpenCV).
The z-buffer holds nearness, which is linear in the image and grows towards the viewer: 1/z in perspective, -z
in an orthographic view. On equal nearness the triangle drawn first stays.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.frames import F32, F64, I32, U8

NOTHING = -1  # of the triangle buffer
_LEAST_LENGTH = 1e-6  # of a normal
_NEAR_CORNERS = 4  # a triangle cut by the near plane has at most four


class Projection(NamedTuple):
    """View to image: u = fx x / z + cx, or fx x + cx when ``orthographic`` (fx then in pixels per metre).

    Nothing nearer than ``near`` (m) is drawn; ``cull`` leaves out triangles seen from behind.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    near: float
    orthographic: bool
    cull: bool


@njit
def _to_image(p: Projection, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Pixel u, v and nearness of a point in view coordinates that is not nearer than the near plane."""
    if p.orthographic:
        return p.fx * x + p.cx, p.fy * y + p.cy, -z
    inverse = 1.0 / z
    return p.fx * x * inverse + p.cx, p.fy * y * inverse + p.cy, inverse


@njit
def project(vertices: F32, T: F64, p: Projection, points: F32, image: F32) -> None:
    """Vertices float32 (n, 3) of the world by ``T`` (4, 4) to ``points`` (n, 3) in view coordinates and to
    ``image`` (n, 3): u, v and nearness, or NaN where nearer than the near plane.
    """
    for i in range(len(vertices)):
        x, y, z = float(vertices[i, 0]), float(vertices[i, 1]), float(vertices[i, 2])
        a = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        b = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        c = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        points[i, 0], points[i, 1], points[i, 2] = a, b, c
        if c >= p.near:
            image[i, 0], image[i, 1], image[i, 2] = _to_image(p, a, b, c)
        else:
            image[i, 0] = image[i, 1] = image[i, 2] = np.nan


@njit
def _fill(
    a: tuple[float, float, float],
    b: tuple[float, float, float],
    c: tuple[float, float, float],
    cull: bool,
    name: int,
    nearness: F32,
    triangle: I32,
) -> None:
    """Draw the triangle of three image points (u, v, nearness), its edges included, as number ``name``."""
    height, width = nearness.shape
    left, right = max(min(a[0], b[0], c[0]), 0.0), min(max(a[0], b[0], c[0]), width - 1.0)
    top, bottom = max(min(a[1], b[1], c[1]), 0.0), min(max(a[1], b[1], c[1]), height - 1.0)
    if not (left <= right and top <= bottom):
        return
    first_u, last_u = int(np.ceil(left)), int(np.floor(right))
    first_v, last_v = int(np.ceil(top)), int(np.floor(bottom))
    if first_u > last_u or first_v > last_v:
        return
    area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if area == 0.0 or (cull and area > 0.0):
        return
    side = 1.0 if area > 0.0 else -1.0
    for v in range(first_v, last_v + 1):
        va, vb, vc = a[1] - v, b[1] - v, c[1] - v
        for u in range(first_u, last_u + 1):
            ua, ub, uc = (a[0] - u) * side, (b[0] - u) * side, (c[0] - u) * side
            # For a common edge neighbours compute the same number with the other sign: no gap between them.
            wa, wb, wc = ub * vc - uc * vb, uc * va - ua * vc, ua * vb - ub * va
            if wa >= 0.0 and wb >= 0.0 and wc >= 0.0:
                near = np.float32((wa * a[2] + wb * b[2] + wc * c[2]) / (wa + wb + wc))
                if near > nearness[v, u]:
                    nearness[v, u] = near
                    triangle[v, u] = name


@njit
def _fill_clipped(points: F32, face: I32, p: Projection, name: int, nearness: F32, triangle: I32) -> None:
    """Draw what remains of a triangle in front of the near plane (Sutherland & Hodgman 1974)."""
    image = np.empty((_NEAR_CORNERS, 3))
    count = 0
    for k in range(3):
        here, after = points[face[k]], points[face[(k + 1) % 3]]
        if here[2] >= p.near:
            image[count, 0], image[count, 1], image[count, 2] = _to_image(p, here[0], here[1], here[2])
            count += 1
        if (here[2] >= p.near) != (after[2] >= p.near):
            s = (p.near - here[2]) / (after[2] - here[2])
            x, y = here[0] + s * (after[0] - here[0]), here[1] + s * (after[1] - here[1])
            image[count, 0], image[count, 1], image[count, 2] = _to_image(p, x, y, p.near)
            count += 1
    a = (image[0, 0], image[0, 1], image[0, 2])
    for k in range(2, count):
        b = (image[k - 1, 0], image[k - 1, 1], image[k - 1, 2])
        c = (image[k, 0], image[k, 1], image[k, 2])
        _fill(a, b, c, p.cull, name, nearness, triangle)


@njit
def draw(
    points: F32, image: F32, faces: I32, p: Projection, first: int, nearness: F32, triangle: I32
) -> None:
    """Draw faces int32 (m, 3), numbered from ``first``, into ``nearness`` and ``triangle`` (h, w).

    ``points`` and ``image`` are those of :func:`project`. The buffers, float32 and int32, start as -inf and
    NOTHING and may hold what was drawn before.
    """
    for k in range(len(faces)):
        i, j, m = faces[k, 0], faces[k, 1], faces[k, 2]
        near_sum = image[i, 2] + image[j, 2] + image[m, 2]
        if not np.isnan(near_sum):
            a = (float(image[i, 0]), float(image[i, 1]), float(image[i, 2]))
            b = (float(image[j, 0]), float(image[j, 1]), float(image[j, 2]))
            c = (float(image[m, 0]), float(image[m, 1]), float(image[m, 2]))
            _fill(a, b, c, p.cull, first + k, nearness, triangle)
        elif points[i, 2] >= p.near or points[j, 2] >= p.near or points[m, 2] >= p.near:
            _fill_clipped(points, faces[k], p, first + k, nearness, triangle)


@njit
def _weights(a: F32, b: F32, c: F32, x: float, y: float, orthographic: bool) -> tuple[float, float, float]:
    """Barycentric weights, not normalised, where the sight line (x, y) meets the plane of triangle a, b, c.

    In perspective the line is (x, y, 1) t and a corner's weight the volume spanned by the line and the other
    two corners, which makes the interpolation perspective-correct.
    """
    if orthographic:
        return (
            (b[0] - x) * (c[1] - y) - (c[0] - x) * (b[1] - y),
            (c[0] - x) * (a[1] - y) - (a[0] - x) * (c[1] - y),
            (a[0] - x) * (b[1] - y) - (b[0] - x) * (a[1] - y),
        )
    return _volume(b, c, x, y), _volume(c, a, x, y), _volume(a, b, x, y)


@njit
def _volume(b: F32, c: F32, x: float, y: float) -> float:
    """Triple product of (x, y, 1), b and c."""
    b0, b1, b2 = float(b[0]), float(b[1]), float(b[2])
    c0, c1, c2 = float(c[0]), float(c[1]), float(c[2])
    return x * (b1 * c2 - b2 * c1) + y * (b2 * c0 - b0 * c2) + b0 * c1 - b1 * c0


@njit
def corner_weights(
    a: F32, b: F32, c: F32, x: float, y: float, orthographic: bool
) -> tuple[float, float, float]:
    """Barycentric weights of where the sight line (x, y) meets the triangle of three points in view coordinates.

    A line that just misses the triangle takes its border.
    """
    wa, wb, wc = _weights(a, b, c, x, y, orthographic)
    sign = 1.0 if wa + wb + wc > 0.0 else -1.0
    wa, wb, wc = max(wa * sign, 0.0), max(wb * sign, 0.0), max(wc * sign, 0.0)
    total = wa + wb + wc
    if total > 0.0:
        return wa / total, wb / total, wc / total
    return 1.0, 0.0, 0.0  # seen exactly edge-on


class Looks(NamedTuple):
    """Colours uint8 (n, 3) and normals float32 (n, 3), of any length, of vertices."""

    colours: U8
    normals: F32


class Lamp(NamedTuple):
    """Light from a unit ``direction`` (3,) beside that from everywhere, ``ambient`` 0..1; the ``paper`` behind."""

    direction: F64
    ambient: float
    paper: U8


@njit
def brightness(lamp: Lamp, x: float, y: float, z: float) -> float:
    """Of a matt surface with this normal, 0..1; either side of it counts."""
    length = max(math.sqrt(x * x + y * y + z * z), _LEAST_LENGTH)
    cosine = abs(x * lamp.direction[0] + y * lamp.direction[1] + z * lamp.direction[2]) / length
    return float(lamp.ambient + (1.0 - lamp.ambient) * cosine)


@njit
def shade(
    points: F32, faces: I32, triangle: I32, p: Projection, looks: Looks, lamp: Lamp, dim: F32, out: U8
) -> None:
    """Lit colours into ``out`` uint8 (h, w, 3), each pixel the mean of a square of those of ``triangle``.

    ``triangle`` int32 (k h, k w), a few more rows or columns do no harm; ``dim`` float32 of its shape darkens, or is
    empty.
    """
    height, width = out.shape[:2]
    fine = max(triangle.shape[0] // height, 1)
    total, seen, last = np.empty(3), np.empty((3, 9)), NOTHING
    for row in range(height):
        for column in range(width):
            total[:] = 0.5 * fine * fine  # to round
            for n in range(fine * fine):
                v, u = row * fine + n // fine, column * fine + n % fine
                t = triangle[v, u]
                if t != last and t >= 0:
                    _corners(points, faces, t, p.orthographic, looks, seen)
                    last = t
                if t < 0:
                    for k in range(3):
                        total[k] += lamp.paper[k]
                else:
                    darker = dim[v, u] if dim.size else 1.0
                    _add_shaded(seen, (u - p.cx) / p.fx, (v - p.cy) / p.fy, lamp, darker, total)
            for k in range(3):
                out[row, column, k] = np.uint8(min(total[k] / (fine * fine), 255.0))


@njit
def _corners(points: F32, faces: I32, t: int, orthographic: bool, looks: Looks, out: F64) -> None:
    """Of each corner of a triangle: its barycentric weight as 1, x and y make it up; colour and normal.

    The weight is that of :func:`_weights`, which is linear in the sight line (x, y).
    """
    for k in range(3):
        i, b, c = faces[t, k], faces[t, (k + 1) % 3], faces[t, (k + 2) % 3]
        b0, b1, b2 = float(points[b, 0]), float(points[b, 1]), float(points[b, 2])
        c0, c1, c2 = float(points[c, 0]), float(points[c, 1]), float(points[c, 2])
        if orthographic:
            b2 = c2 = 1.0
        out[k, 0], out[k, 1], out[k, 2] = b0 * c1 - b1 * c0, b1 * c2 - b2 * c1, b2 * c0 - b0 * c2
        for m in range(3):
            out[k, 3 + m] = looks.colours[i, m]
            out[k, 6 + m] = looks.normals[i, m]


@njit
def _add_shaded(corners: F64, x: float, y: float, lamp: Lamp, darker: float, total: F64) -> None:
    """Add what the sight line (x, y) sees of a triangle; one that just misses it takes its border."""
    a = corners[0, 0] + corners[0, 1] * x + corners[0, 2] * y
    b = corners[1, 0] + corners[1, 1] * x + corners[1, 2] * y
    c = corners[2, 0] + corners[2, 1] * x + corners[2, 2] * y
    sign = 1.0 if a + b + c > 0.0 else -1.0
    a, b, c = max(a * sign, 0.0), max(b * sign, 0.0), max(c * sign, 0.0)
    if not a + b + c > 0.0:  # exactly edge-on
        a = 1.0
    share = 1.0 / (a + b + c)
    a, b, c = a * share, b * share, c * share
    nx = a * corners[0, 6] + b * corners[1, 6] + c * corners[2, 6]
    ny = a * corners[0, 7] + b * corners[1, 7] + c * corners[2, 7]
    nz = a * corners[0, 8] + b * corners[1, 8] + c * corners[2, 8]
    light = darker * brightness(lamp, nx, ny, nz)
    for k in range(3, 6):
        total[k - 3] += light * (a * corners[0, k] + b * corners[1, k] + c * corners[2, k])


@njit
def interpolate(
    points: F32,
    faces: I32,
    triangle: I32,
    lines: F32,
    orthographic: bool,
    values: F32,
    out: F32,
    depth: F32,
) -> None:
    """Values float32 (n, k) of the vertices at each pixel into ``out`` (h, w, k), z into ``depth`` (h, w).

    ``triangle`` int32 (h, w) names the triangle seen, ``lines`` float32 (h, w, 2) the sight line of the
    pixel: x / z and y / z, or x and y when orthographic. A line that just misses its triangle takes its
    border. Pixels of no triangle are left as they are.
    """
    height, width = triangle.shape
    for v in range(height):
        for u in range(width):
            t = triangle[v, u]
            if t < 0:
                continue
            i, j, m = faces[t, 0], faces[t, 1], faces[t, 2]
            x, y = lines[v, u, 0], lines[v, u, 1]
            wa, wb, wc = corner_weights(points[i], points[j], points[m], x, y, orthographic)
            depth[v, u] = wa * points[i, 2] + wb * points[j, 2] + wc * points[m, 2]
            for k in range(values.shape[1]):
                out[v, u, k] = wa * values[i, k] + wb * values[j, k] + wc * values[m, k]
