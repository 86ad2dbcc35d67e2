"""2-D Delaunay triangulation of the few points of a voxel: insertion with Lawson flips.

For tens of points the fixed cost of a library call is larger than the work (SciPy 62 us, own 2 us for 25
points, docs/tuning.md), so this one is our own. Points should come sorted along a snake, which keeps the walk to
the containing triangle short.
"""

from __future__ import annotations

import numpy as np

from artemis_edge._jit import kernel
from artemis_edge.frames import F64, U32

# Corners of the triangle that encloses everything, in units of the coordinates (voxels are below 10 m)
_FAR = 1.0e3


@kernel
def _left_of(x: F64, y: F64, a: int, b: int, p: int) -> float:
    return (x[b] - x[a]) * (y[p] - y[a]) - (y[b] - y[a]) * (x[p] - x[a])


@kernel
def in_circle(x: F64, y: F64, a: int, b: int, c: int, p: int) -> bool:
    """True when p is surely inside the circle through a, b, c (counter-clockwise).

    The bound is Shewchuk's for the rounding of this determinant (4 ulp of the permanent); flipping only when
    the sign is certain is what makes the flips end.
    """
    dx, dy, ex, ey, fx, fy = x[a] - x[p], y[a] - y[p], x[b] - x[p], y[b] - y[p], x[c] - x[p], y[c] - y[p]
    ap, bp, cp = dx * dx + dy * dy, ex * ex + ey * ey, fx * fx + fy * fy
    det = dx * (ey * cp - bp * fy) - dy * (ex * cp - bp * fx) + ap * (ex * fy - ey * fx)
    if det <= 0.0:
        return False
    permanent = (
        abs(dx) * (abs(ey) * cp + bp * abs(fy))
        + abs(dy) * (abs(ex) * cp + bp * abs(fx))
        + ap * (abs(ex * fy) + abs(ey * fx))
    )
    return det > 1.2e-15 * permanent


@kernel
def _at(places: U32, i: int) -> int:
    """An element that is a place itself. Unsigned, so that the compiler need not ask whether it counts from the end:
    that question at every look-up took a quarter of the time."""
    return int(np.int64(places[i]))


@kernel
def _walk(x: F64, y: F64, corner: U32, link: U32, t: int, p: int, limit: int) -> int:
    for _ in range(limit):
        a, b, c = _at(corner, t), _at(corner, t + 1), _at(corner, t + 2)
        if _left_of(x, y, a, b, p) < 0.0:
            t = _at(link, t + 2) & ~3
        elif _left_of(x, y, b, c, p) < 0.0:
            t = _at(link, t) & ~3
        elif _left_of(x, y, c, a, p) < 0.0:
            t = _at(link, t + 1) & ~3
        else:
            break
    return t


@kernel
def _split(corner: U32, link: U32, t: int, p: int, u: int) -> None:
    """The triangle (a, b, c) at t becomes (a, b, p), (b, c, p), (c, a, p) at t, u, u + 4: p is always corner 2."""
    v = u + 4
    a, b, c = _at(corner, t), _at(corner, t + 1), _at(corner, t + 2)
    beyond_bc, beyond_ca = _at(link, t), _at(link, t + 1)
    corner[t + 2] = p
    link[t], link[t + 1] = u + 1, v
    corner[u], corner[u + 1], corner[u + 2] = b, c, p
    link[u], link[u + 1], link[u + 2] = v + 1, t, beyond_bc
    corner[v], corner[v + 1], corner[v + 2] = c, a, p
    link[v], link[v + 1], link[v + 2] = t + 1, u, beyond_ca
    link[beyond_bc], link[beyond_ca] = u + 2, v + 2


@kernel
def _flip(corner: U32, link: U32, s: int, over: int) -> int:
    """Exchange the edge a-b of s = (a, b, p) and the triangle on its other side, whose corner d is at ``over``, for
    the edge d-p. Returns the place of that triangle."""
    o, k = over & ~3, over & 3
    b, p, d = _at(corner, s + 1), _at(corner, s + 2), _at(corner, over)
    beyond_da = _at(link, o + (k + 1 if k < 2 else 0))
    beyond_bd = _at(link, o + (k - 1 if k > 0 else 2))
    beyond_bp = _at(link, s)
    corner[s + 1] = d
    link[s + 2], link[s] = beyond_da, o + 1
    corner[o], corner[o + 1], corner[o + 2] = d, b, p
    link[o], link[o + 1], link[o + 2] = beyond_bp, s, beyond_bd
    link[beyond_da], link[beyond_bd], link[beyond_bp] = s + 2, o + 2, o
    return o


@kernel
def delaunay(x: F64, y: F64, n: int, corner: U32, link: U32, stack: U32) -> int:
    """Triangulate points 0..n-1; ``x`` and ``y`` float64 with room for n + 3.

    ``corner`` and ``link`` uint32 (4 (2 n + 2),) receive counter-clockwise triangles: number t has its corners at
    4 t, 4 t + 1, 4 t + 2. ``link`` tells for each of these places the place of the corner that lies across the
    opposite edge; where there is none, 4 (2 n + 1). ``stack`` uint32 (4 n + 8). Triangles with a corner >= n belong
    to the enclosing triangle. Returns the number of triangles. Points must be finite; duplicates give triangles
    without area.
    """
    x[n], y[n], x[n + 1], y[n + 1], x[n + 2], y[n + 2] = -_FAR, -_FAR, _FAR, -_FAR, 0.0, _FAR
    outside = 4 * (2 * n + 1)
    corner[0], corner[1], corner[2] = n, n + 1, n + 2
    link[0] = link[1] = link[2] = outside
    end, t = 4, 0
    for p in range(n):
        t = _walk(x, y, corner, link, t, p, 4 * n + 8)
        _split(corner, link, t, p, end)
        stack[0], stack[1], stack[2] = t, end, end + 4
        end += 8
        top = 3
        while top > 0:
            top -= 1
            s = _at(stack, top)
            over = _at(link, s + 2)
            if over == outside:
                continue
            if in_circle(x, y, _at(corner, s), _at(corner, s + 1), p, _at(corner, over)):
                stack[top], stack[top + 1] = s, _flip(corner, link, s, over)
                top += 2
    return end // 4
