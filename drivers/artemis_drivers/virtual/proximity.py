"""Whether any surface of a world lies near a point: exact, with the hierarchy of the ray caster."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import kernel, njit
from artemis_drivers.virtual.mesh_builder import F32, F64, I32
from artemis_drivers.virtual.raycast import Bvh

_STACK = 128
_FLAT = 1e-10  # a triangle thinner than this (sine squared) is only edges
_WORKERS = 2


def anything_within(bvh: Bvh, points: F64, limit_m: F64) -> NDArray[np.bool_]:
    """Per point (n, 3) in world whether a triangle is nearer than its limit (n,) in metres; False for NaN."""
    out = np.empty(len(points), bool)
    local = points - bvh.origin
    edges = [k * len(points) // _WORKERS for k in range(_WORKERS + 1)]

    def part(first: int, last: int) -> None:
        _anything_within(bvh, local[first:last], limit_m[first:last], out[first:last])

    with ThreadPoolExecutor(_WORKERS) as pool:
        list(pool.map(part, edges[:-1], edges[1:]))
    return out


@njit
def _anything_within(bvh: Bvh, points: F64, limit: F64, out: NDArray[np.bool_]) -> None:
    stack = np.empty(_STACK, np.int32)
    for i in range(len(points)):
        out[i] = _near(bvh, points[i, 0], points[i, 1], points[i, 2], limit[i] * limit[i], stack)


@kernel
def _near(bvh: Bvh, x: float, y: float, z: float, limit2: float, stack: I32) -> bool:
    depth = 1
    stack[0] = 0
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if node < 0:
            first = ~node >> 3
            for k in range(first, first + (~node & 7)):
                if _triangle_distance2(bvh.corner[k], x, y, z) < limit2:
                    return True
            continue
        box = bvh.boxes[node]
        a, b = _box_distance2(box, 0, x, y, z), _box_distance2(box, 6, x, y, z)
        near = 0 if a <= b else 1
        if max(a, b) < limit2:
            stack[depth] = bvh.child[node, 1 - near]
            depth += 1
        if min(a, b) < limit2:
            stack[depth] = bvh.child[node, near]
            depth += 1
    return False


@kernel
def _box_distance2(box: F32, first: int, x: float, y: float, z: float) -> Any:
    dx = max(box[first] - x, x - box[first + 3], 0.0)
    dy = max(box[first + 1] - y, y - box[first + 4], 0.0)
    dz = max(box[first + 2] - z, z - box[first + 5], 0.0)
    return dx * dx + dy * dy + dz * dz


@kernel
def _triangle_distance2(c: F32, x: float, y: float, z: float) -> Any:
    """Squared distance to a triangle (a row of Bvh.corner): to its plane where the foot of the point is
    inside, else to the nearest of its edges (Ericson, "Real-Time Collision Detection", 5.1.5).
    """
    px, py, pz = x - c[0], y - c[1], z - c[2]
    e11 = c[3] * c[3] + c[4] * c[4] + c[5] * c[5]
    e22 = c[6] * c[6] + c[7] * c[7] + c[8] * c[8]
    e12 = c[3] * c[6] + c[4] * c[7] + c[5] * c[8]
    d1, d2 = px * c[3] + py * c[4] + pz * c[5], px * c[6] + py * c[7] + pz * c[8]
    squared = e11 * e22 - e12 * e12
    if squared > _FLAT * e11 * e22:
        u, v = (e22 * d1 - e12 * d2) / squared, (e11 * d2 - e12 * d1) / squared
        if u >= 0 and v >= 0 and u + v <= 1:
            qx, qy = px - u * c[3] - v * c[6], py - u * c[4] - v * c[7]
            qz = pz - u * c[5] - v * c[8]
            return qx * qx + qy * qy + qz * qz
    first = _edge_distance2(px, py, pz, c[3], c[4], c[5])
    second = _edge_distance2(px, py, pz, c[6], c[7], c[8])
    third = _edge_distance2(px - c[3], py - c[4], pz - c[5], c[6] - c[3], c[7] - c[4], c[8] - c[5])
    return min(first, second, third)


@kernel
def _edge_distance2(px: float, py: float, pz: float, ex: float, ey: float, ez: float) -> Any:
    """Squared distance from a point, given from the edge's start, to the edge."""
    share = (px * ex + py * ey + pz * ez) / max(ex * ex + ey * ey + ez * ez, 1e-30)
    share = min(max(share, 0.0), 1.0)
    qx, qy, qz = px - share * ex, py - share * ey, pz - share * ez
    return qx * qx + qy * qy + qz * qz
