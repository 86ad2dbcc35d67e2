"""A fast scan converter for the virtual camera: which triangle is seen at each pixel of a pinhole canvas.

View coordinates: x right, y down, z forward, metres; a pixel's centre has integer coordinates. A triangle
covers the pixels whose centres lie between its edges; a centre on an edge belongs to one side only, so that
neighbours neither overlap nor leave a gap. Nearness, 1 / z or -z, is linear in the image.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from artemis_drivers._jit import kernel, njit
from artemis_drivers.virtual.mesh_builder import F32, F64, I32

Point = tuple[Any, Any, Any]  # column, row, nearness
_NEAR_M = 0.05
NOTHING = -1


class View(NamedTuple):
    """u = fx x / z + cx (perspective), or fx x + cx where ``orthographic``."""

    fx: float
    fy: float
    cx: float
    cy: float
    orthographic: bool


class Canvas(NamedTuple):
    """``nearness`` float32 (h, w), -inf where nothing; ``triangle`` int32 (h, w), NOTHING there, or (0, 0)
    where nobody asks for it. Only rows ``top`` .. ``bottom`` - 1 are drawn to.
    """

    nearness: F32
    triangle: I32
    top: int
    bottom: int


def new_canvas(width: int, height: int, named: bool = True) -> Canvas:
    """An empty canvas."""
    size = (height, width)
    names = np.full(size if named else (0, 0), NOTHING, np.int32)
    return Canvas(np.full(size, -np.inf, np.float32), names, 0, height)


def clear(canvas: Canvas) -> None:
    """Empty a canvas for the next image."""
    canvas.nearness.fill(-np.inf)
    canvas.triangle.fill(NOTHING)


@njit
def draw(canvas: Canvas, view: View, T: F64, vertices: F32, triangles: I32, numbers: I32, first: int) -> None:
    """Draw the triangles ``numbers`` int32 (k,) of a part; they are named ``first`` + number.

    ``T`` (4, 4) maps ``vertices`` float32 (n, 3) to view coordinates. Triangles seen from behind (normal by
    the right-hand rule away from the eye) are not drawn, nor what is nearer than 5 cm.
    """
    corner = np.empty((3, 3))
    cut = np.empty((4, 3))
    for number in numbers:
        for k in range(3):
            p = vertices[triangles[number, k]]
            for a in range(3):
                corner[k, a] = T[a, 0] * p[0] + T[a, 1] * p[1] + T[a, 2] * p[2] + T[a, 3]
        name = first + number
        if view.orthographic or min(corner[0, 2], corner[1, 2], corner[2, 2]) >= _NEAR_M:
            a, b, c = _place(view, corner[0]), _place(view, corner[1]), _place(view, corner[2])
            _fill(canvas, a, b, c, name)
        elif max(corner[0, 2], corner[1, 2], corner[2, 2]) > _NEAR_M:
            count = _clip(corner, cut)
            for k in range(2, count):
                a, b, c = _place(view, cut[0]), _place(view, cut[k - 1]), _place(view, cut[k])
                _fill(canvas, a, b, c, name)


@kernel(forceinline=True)
def _place(view: View, p: F64) -> Point:
    if view.orthographic:
        return view.fx * p[0] + view.cx, view.fy * p[1] + view.cy, -p[2]
    near = 1.0 / p[2]
    return view.fx * p[0] * near + view.cx, view.fy * p[1] * near + view.cy, near


@kernel(forceinline=True)
def _clip(corner: F64, cut: F64) -> int:
    """What remains of a triangle beyond the near plane (Sutherland & Hodgman 1974)."""
    count = 0
    for k in range(3):
        here, after = corner[k], corner[(k + 1) % 3]
        if here[2] >= _NEAR_M:
            cut[count, 0], cut[count, 1], cut[count, 2] = here[0], here[1], here[2]
            count += 1
        if (here[2] >= _NEAR_M) != (after[2] >= _NEAR_M):
            s = (_NEAR_M - here[2]) / (after[2] - here[2])
            cut[count, 0] = here[0] + s * (after[0] - here[0])
            cut[count, 1] = here[1] + s * (after[1] - here[1])
            cut[count, 2] = _NEAR_M
            count += 1
    return count


@kernel(forceinline=True)
def _fill(canvas: Canvas, a: Point, b: Point, c: Point, name: int) -> None:
    area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if not area < 0.0:  # from behind, edge-on, or not a number
        return
    if max(a[1], b[1], c[1]) < canvas.top or min(a[1], b[1], c[1]) >= canvas.bottom:
        return
    low, high = min(a[2], b[2], c[2]), max(a[2], b[2], c[2])
    gx = ((b[2] - a[2]) * (c[1] - a[1]) - (c[2] - a[2]) * (b[1] - a[1])) / area
    gy = ((c[2] - a[2]) * (b[0] - a[0]) - (b[2] - a[2]) * (c[0] - a[0])) / area
    origin = a[2] - gx * a[0] - gy * a[1]
    if b[1] < a[1]:
        a, b = b, a
    if c[1] < b[1]:
        b, c = c, b
        if b[1] < a[1]:
            a, b = b, a
    _half(canvas, a, c, a, b, gx, gy, origin, low, high, name)
    _half(canvas, a, c, b, c, gx, gy, origin, low, high, name)


@kernel(forceinline=True)
def _half(
    canvas: Canvas,
    a: Point,
    c: Point,
    p: Point,
    q: Point,
    gx: float,
    gy: float,
    origin: float,
    low: float,
    high: float,
    name: int,
) -> None:
    """Rows between p and q, from the edge p q to the long edge a c; every edge is given from the top down, so
    that both its triangles compute the same crossings.
    """
    nearness, triangle = canvas.nearness, canvas.triangle
    width = nearness.shape[1]
    first, last = int(np.ceil(max(p[1], float(canvas.top)))), int(np.ceil(min(q[1], float(canvas.bottom))))
    if first >= last:
        return
    named = triangle.shape[0] > 0
    long_slope, slope = (c[0] - a[0]) / (c[1] - a[1]), (q[0] - p[0]) / (q[1] - p[1])
    for v in range(first, last):
        x0, x1 = a[0] + (v - a[1]) * long_slope, p[0] + (v - p[1]) * slope
        left, right = min(x0, x1), max(x0, x1)
        if not (right > 0.0 and left <= width - 1.0):
            continue
        row = origin + gy * v
        for u in range(int(np.ceil(max(left, 0.0))), int(np.ceil(min(right, float(width))))):
            near = np.float32(min(max(row + gx * u, low), high))
            if near > nearness[v, u]:
                nearness[v, u] = near
                if named:
                    triangle[v, u] = name
