"""2-D Delaunay triangulation of the few points of a voxel: insertion with Lawson flips.

For tens of points the fixed cost of a library call is larger than the work (SciPy 62 us, own 2 us for 25
points, docs/tuning.md), so this one is our own. Points should come sorted along a snake, which keeps the walk to
the containing triangle short.
"""

from __future__ import annotations

from artemis_edge._jit import kernel
from artemis_edge.frames import F64, I32

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
def _replace(link: I32, triangle: int, old: int, new: int) -> None:
    if triangle >= 0:
        for k in range(3):
            if link[triangle, k] == old:
                link[triangle, k] = new


@kernel
def _walk(x: F64, y: F64, corner: I32, link: I32, t: int, p: int, limit: int) -> int:
    for _ in range(limit):
        a, b, c = corner[t, 0], corner[t, 1], corner[t, 2]
        if _left_of(x, y, a, b, p) < 0.0:
            t = link[t, 2]
        elif _left_of(x, y, b, c, p) < 0.0:
            t = link[t, 0]
        elif _left_of(x, y, c, a, p) < 0.0:
            t = link[t, 1]
        else:
            break
    return t


@kernel
def _split(corner: I32, link: I32, t: int, p: int, n: int) -> None:
    """Triangle t becomes (a, b, p), (b, c, p), (c, a, p) at t, n, n + 1: p is always corner 2."""
    a, b, c = corner[t, 0], corner[t, 1], corner[t, 2]
    over_a, over_b, over_c = link[t, 0], link[t, 1], link[t, 2]
    corner[t, 2] = p
    link[t, 0], link[t, 1], link[t, 2] = n, n + 1, over_c
    corner[n, 0], corner[n, 1], corner[n, 2] = b, c, p
    link[n, 0], link[n, 1], link[n, 2] = n + 1, t, over_a
    corner[n + 1, 0], corner[n + 1, 1], corner[n + 1, 2] = c, a, p
    link[n + 1, 0], link[n + 1, 1], link[n + 1, 2] = t, n, over_b
    _replace(link, over_a, t, n)
    _replace(link, over_b, t, n + 1)


@kernel
def _flip(corner: I32, link: I32, s: int, o: int, k: int) -> None:
    """Exchange the edge a-b of s = (a, b, p) and o (d at corner k) for the edge d-p."""
    b, p, d = corner[s, 1], corner[s, 2], corner[o, k]
    beyond_bd, beyond_da, beyond_bp = link[o, (k + 2) % 3], link[o, (k + 1) % 3], link[s, 0]
    corner[s, 1] = d
    link[s, 2], link[s, 0] = beyond_da, o
    corner[o, 0], corner[o, 1], corner[o, 2] = d, b, p
    link[o, 2], link[o, 0], link[o, 1] = beyond_bd, beyond_bp, s
    _replace(link, beyond_da, o, s)
    _replace(link, beyond_bp, s, o)


@kernel
def delaunay(x: F64, y: F64, n: int, corner: I32, link: I32, stack: I32) -> int:
    """Triangulate points 0..n-1; ``x`` and ``y`` float64 with room for n + 3.

    ``corner`` and ``link`` int32 (2 n + 1, 3) receive counter-clockwise triangles and, opposite each corner, the
    adjacent triangle or -1; ``stack`` int32 (4 n + 8). Triangles with a corner >= n belong to the enclosing
    triangle. Returns the number of triangles. Points must be finite; duplicates give triangles without area.
    """
    x[n], y[n], x[n + 1], y[n + 1], x[n + 2], y[n + 2] = -_FAR, -_FAR, _FAR, -_FAR, 0.0, _FAR
    corner[0, 0], corner[0, 1], corner[0, 2] = n, n + 1, n + 2
    link[0, 0] = link[0, 1] = link[0, 2] = -1
    count, t = 1, 0
    for p in range(n):
        t = _walk(x, y, corner, link, t, p, 4 * n + 8)
        _split(corner, link, t, p, count)
        stack[0], stack[1], stack[2] = t, count, count + 1
        count += 2
        top = 3
        while top > 0:
            top -= 1
            s = stack[top]
            o = link[s, 2]
            if o < 0:
                continue
            k = 0 if link[o, 0] == s else (1 if link[o, 1] == s else 2)
            if in_circle(x, y, corner[s, 0], corner[s, 1], p, corner[o, k]):
                _flip(corner, link, s, o, k)
                stack[top], stack[top + 1] = s, o
                top += 2
    return count
