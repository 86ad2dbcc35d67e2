"""Light spots: a beam as a bundle of rays that share one walk through the hierarchy.

A beam's Gaussian cross-section is sampled by LANES rays of equal weight. They leave one point and almost one
direction, so boxes are tested once for all of them (against the interval of their directions) and triangles
for all lanes in one vector loop: eight rays cost about twice as much as one, and no edge is missed.

Glass lets a beam pass unless it is hit almost squarely, see ``GLINT_COSINE``.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from artemis_drivers._jit import kernel, njit
from artemis_drivers.virtual.mesh_builder import F32, F64, I32
from artemis_drivers.virtual.moving import near_mover
from artemis_drivers.virtual.raycast import Bvh, Vector, inverse
from artemis_drivers.virtual.scene import Scene

LANES = 8
#: Order of the lanes across the narrow axis: of all orders without correlation that with the widest gaps.
_SHUFFLE = np.array([3, 6, 2, 0, 7, 5, 1, 4])
#: A pane returns a beam within this angle of its normal (assumption: one degree, about lens and spot).
GLINT_COSINE = float(np.cos(np.pi / 180))
_STACK = 96
_EPS, _SLACK = np.float32(2e-6), np.float32(1.0000004)  # as in raycast.py
_NEAREST = np.float32(1e-4)
_F0, _F1, _FINF = np.float32(0), np.float32(1), np.float32(np.inf)

# no NaN reaches these two loops (beams that are not finite are switched off before), and the sign of a zero
# does not matter: told so, the compiler makes vector instructions of their minima
_vector = partial(
    numba.njit, cache=True, nogil=True, error_model="numpy", _nrt=False, fastmath={"nnan", "nsz"}
)


def lane_offsets(wide: float, narrow: float) -> F64:
    """Offsets (lanes, 2) in radians of a spot's rays along its vertical and its horizontal axis.

    ``wide``, ``narrow``: standard deviations of the Gaussian along these axes. Quantiles of equal weight,
    scaled to the exact variance. One lane when the beam is a line.
    """
    if wide == 0 and narrow == 0:
        return np.zeros((1, 2))
    quantile = norm.ppf((np.arange(LANES) + 0.5) / LANES)
    quantile /= np.sqrt(np.mean(quantile**2))
    return np.column_stack([wide * quantile, narrow * quantile[_SHUFFLE]])


class Spots:
    """Where the lanes of a scan's beams met the scene.

    ``origin`` float64 (n, 3) and ``fan`` float32 (n, 3, lanes) unit directions, in world; ``distance`` float32
    (n, lanes) metres, inf where nothing was met; ``triangle`` int32 (n, lanes) of the scene, -1; ``cosine``
    float32 of the angle of incidence and ``texture`` float32 (n, lanes, 2) u, v of the picture met.
    """

    def __init__(self, scene: Scene, origin: F64, fan: F32, time_s: F64, max_range_m: float) -> None:
        n, lanes = len(origin), fan.shape[2]
        # a beam that is not finite has no finite lane
        usable = np.isfinite(origin).all(axis=1) & np.isfinite(fan[:, :, 0]).all(axis=1) & np.isfinite(time_s)
        self.origin = np.where(usable[:, None], origin, 0.0)
        self.fan = fan if usable.all() else np.where(usable[:, None, None], fan, np.float32(0))
        self.distance = np.full((n, lanes), max_range_m, np.float32)
        self.distance[~usable] = 0
        self.triangle = np.full((n, lanes), -1, np.int32)
        self.cosine = np.zeros((n, lanes), np.float32)
        self.texture = np.zeros((n, lanes, 2), np.float32)
        self._meet(scene, time_s)
        self.distance[self.triangle < 0] = np.inf

    def _meet(self, scene: Scene, time_s: F64) -> None:
        local = (self.origin - scene.origin).astype(np.float32)
        everyone = np.arange(len(local), dtype=np.int32)
        meshes = [(scene.bvh, 0, everyone, local, self.fan)]
        cast_fans(scene.bvh, scene.panes[0], 0, everyone, local, self.fan, self.distance, self.triangle)
        if scene.movers:
            # a spot is wider than its axis, by less than a metre wherever a mover is of interest
            reach, axis = _farthest(self.distance), _axes(self.fan)
        for mover, panes in zip(scene.movers, scene.panes[1:], strict=True):
            rows = near_mover(mover, self.origin, axis, time_s, reach, slack_m=1.0)
            if len(rows) == 0:
                continue
            origin, fan = (
                np.empty((len(rows), 3), np.float32),
                np.empty((len(rows), *self.fan.shape[1:]), np.float32),
            )
            _into(mover.pose(time_s[rows]), rows, self.origin, self.fan, origin, fan)
            cast_fans(mover.bvh, panes, mover.first, rows, origin, fan, self.distance, self.triangle)
            meshes.append((mover.bvh, mover.first, rows, origin, fan))
        for bvh, first, rows, origin, fan in meshes:
            part = (first, first + len(bvh.order))
            _surface_met(
                part,
                rows,
                origin,
                fan,
                scene.surface.rows,
                self.distance,
                self.triangle,
                self.cosine,
                self.texture,
            )


def _axes(fan: F32) -> F64:
    """A lane next to the middle of each spot, unit (n, 3)."""
    return np.ascontiguousarray(fan[:, :, fan.shape[2] // 2], np.float64)


@_vector
def _greatest(values: F32) -> Any:
    out = values[0]
    for k in range(1, len(values)):
        out = max(out, values[k])
    return out


@_vector
def _least(values: F32) -> Any:
    out = values[0]
    for k in range(1, len(values)):
        out = min(out, values[k])
    return out


@njit
def _farthest(distance: F32) -> F64:
    """Greatest distance of each beam's lanes."""
    out = np.empty(len(distance))
    for i in range(len(distance)):
        out[i] = _greatest(distance[i])
    return out


@njit
def _into(T_world_local: F64, rows: I32, origin: F64, fan: F32, local: F32, turned: F32) -> None:
    """Origins and lanes of some rows in the frame that a mover has at each one's time."""
    for i in range(len(rows)):
        T, r = T_world_local[i], rows[i]
        for a in range(3):
            local[i, a] = (
                T[0, a] * (origin[r, 0] - T[0, 3])
                + T[1, a] * (origin[r, 1] - T[1, 3])
                + T[2, a] * (origin[r, 2] - T[2, 3])
            )
            x, y, z = np.float32(T[0, a]), np.float32(T[1, a]), np.float32(T[2, a])
            for k in range(fan.shape[2]):
                turned[i, a, k] = x * fan[r, 0, k] + y * fan[r, 1, k] + z * fan[r, 2, k]


@njit
def fan_out(direction: F64, R: F64, offsets: F64, out: F32) -> None:
    """Unit directions (n, 3, lanes) in world of the lanes of beams ``direction`` (n, 3) in the sensor's frame.

    ``R`` (n, 3, 3) turns the sensor's axes into the world's. Lanes are offset along the sensor's vertical and
    across it.
    """
    for i in range(len(direction)):
        x, y, z = direction[i, 0], direction[i, 1], direction[i, 2]
        flat = np.sqrt(x * x + y * y)
        # horizontally across the beam; any across when it points straight up
        hx, hy = (-y / flat, x / flat) if flat > 1e-9 else (0.0, 1.0)
        vx, vy, vz = -z * hy, z * hx, x * hy - y * hx
        for k in range(len(offsets)):
            up, side = offsets[k, 0], offsets[k, 1]
            sx, sy, sz = x + up * vx + side * hx, y + up * vy + side * hy, z + up * vz
            scale = 1.0 / np.sqrt(sx * sx + sy * sy + sz * sz)
            for a in range(3):
                out[i, a, k] = (R[i, a, 0] * sx + R[i, a, 1] * sy + R[i, a, 2] * sz) * scale


@kernel
def _slab(low: Any, high: Any, inv_low: Any, inv_high: Any, near: Any, far: Any) -> Any:
    """Narrow [near, far] to where a ray with a direction between two bounds is between two planes.

    ``low``, ``high``: planes relative to the origin; ``inv_low``, ``inv_high``: inverse of the bounds.
    """
    if inv_high > _F0:
        near = max(near, low * inv_high)
    else:
        far = min(far, low * inv_high)
    if inv_low > _F0:
        far = min(far, high * inv_low)
    else:
        near = max(near, high * inv_low)
    return near, far


@kernel
def _enter_fan(b: F32, first: int, o: Vector, low: Vector, high: Vector, limit: Any) -> Any:
    """Distance at which the first lane may enter a child's box, inf when none does."""
    near, far = _slab(b[first] - o[0], b[first + 3] - o[0], low[0], high[0], _F0, limit)
    near, far = _slab(b[first + 1] - o[1], b[first + 4] - o[1], low[1], high[1], near, far)
    near, far = _slab(b[first + 2] - o[2], b[first + 5] - o[2], low[2], high[2], near, far)
    return near if near <= far * _SLACK else _FINF


@_vector
def _meet_fan(c: F32, number: int, o: Vector, fan: F32, best: F32, hit: I32) -> None:
    """Moeller-Trumbore for all lanes and a row of Bvh.corner; without branches, so that it is vectorised."""
    tx, ty, tz = o[0] - c[0], o[1] - c[1], o[2] - c[2]
    qx = ty * c[5] - tz * c[4]
    qy = tz * c[3] - tx * c[5]
    qz = tx * c[4] - ty * c[3]
    height = c[6] * qx + c[7] * qy + c[8] * qz
    for k in range(fan.shape[1]):
        d0, d1, d2 = fan[0, k], fan[1, k], fan[2, k]
        px = d1 * c[8] - d2 * c[7]
        py = d2 * c[6] - d0 * c[8]
        pz = d0 * c[7] - d1 * c[6]
        det = c[3] * px + c[4] * py + c[5] * pz
        inv = _F1 / det if det != _F0 else _F0
        u = (tx * px + ty * py + tz * pz) * inv
        v = (d0 * qx + d1 * qy + d2 * qz) * inv
        t = height * inv
        ok = (u >= -_EPS) & (v >= -_EPS) & (u + v <= _F1 + _EPS) & (t > _NEAREST) & (t < best[k])
        best[k] = t if ok else best[k]
        hit[k] = number if ok else hit[k]


@kernel
def _mirrors(c: F32, fan: F32) -> bool:
    """Whether a beam meets a pane so squarely that it is thrown back."""
    nx, ny, nz = c[4] * c[8] - c[5] * c[7], c[5] * c[6] - c[3] * c[8], c[3] * c[7] - c[4] * c[6]
    facing = nx * fan[0, 0] + ny * fan[1, 0] + nz * fan[2, 0]
    return bool(facing * facing > (GLINT_COSINE * GLINT_COSINE) * (nx * nx + ny * ny + nz * nz))


@njit
def cast_fans(
    bvh: Bvh,
    clear: NDArray[np.bool_],
    first: int,
    rows: I32,
    origin: F32,
    fan: F32,
    distance: F32,
    triangle: I32,
) -> None:
    """Nearest triangle of one hierarchy for every lane of the beams, where nearer than what is known.

    Beam i of ``origin`` (m, 3) and ``fan`` (m, 3, lanes), both in the hierarchy's local frame, is row
    ``rows[i]`` of ``distance`` and ``triangle`` (n, lanes), which are read and updated; ``clear`` marks the
    triangles of glass, in the order of the leaves; ``first`` is added to the numbers of triangles.
    """
    stack, entry = np.empty(_STACK, np.int32), np.empty(_STACK, np.float32)
    lanes = fan.shape[2]
    best, hit = np.empty(lanes, np.float32), np.empty(lanes, np.int32)
    for i in range(len(rows)):
        best[:] = distance[rows[i]]
        hit[:] = -1
        o = (origin[i, 0], origin[i, 1], origin[i, 2])
        if len(bvh.order):
            _walk(bvh, clear, o, fan[i], best, hit, stack, entry)
        for k in range(lanes):
            if hit[k] >= 0:
                distance[rows[i], k] = best[k]
                triangle[rows[i], k] = first + bvh.order[hit[k]]


@kernel
def _walk(
    bvh: Bvh,
    clear: NDArray[np.bool_],
    o: Vector,
    fan: F32,
    best: F32,
    hit: I32,
    stack: I32,
    entry: F32,
) -> None:
    boxes, child, corner = bvh.boxes, bvh.child, bvh.corner
    low = (inverse(_least(fan[0])), inverse(_least(fan[1])), inverse(_least(fan[2])))
    high = (inverse(_greatest(fan[0])), inverse(_greatest(fan[1])), inverse(_greatest(fan[2])))
    farthest = _greatest(best)
    depth = 1
    stack[0], entry[0] = 0, _F0
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if entry[depth] > farthest:
            continue
        if node < 0:
            code = ~node
            start = code >> 3
            for k in range(start, start + (code & 7)):
                if not clear[k] or _mirrors(corner[k], fan):
                    _meet_fan(corner[k], k, o, fan, best, hit)
            farthest = _greatest(best)
            continue
        box = boxes[node]
        t_a, t_b = _enter_fan(box, 0, o, low, high, farthest), _enter_fan(box, 6, o, low, high, farthest)
        near_side = 0 if t_a <= t_b else 1
        t_near, t_far = (t_a, t_b) if near_side == 0 else (t_b, t_a)
        if t_far < _FINF:
            stack[depth], entry[depth] = child[node, 1 - near_side], t_far
            depth += 1
        if t_near < _FINF:
            stack[depth], entry[depth] = child[node, near_side], t_near
            depth += 1


@njit
def _surface_met(
    part: tuple[int, int],
    rows: I32,
    origin: F32,
    fan: F32,
    surface: F32,
    distance: F32,
    triangle: I32,
    cosine: F32,
    texture: F32,
) -> None:
    """Angle of incidence and picture coordinates of the lanes that met triangles ``part[0]``.. of a part."""
    for i in range(len(rows)):
        r = rows[i]
        for k in range(fan.shape[2]):
            t = triangle[r, k]
            if not part[0] <= t < part[1]:
                continue
            row, s = surface[t], distance[r, k]
            x = origin[i, 0] + s * fan[i, 0, k]
            y = origin[i, 1] + s * fan[i, 1, k]
            z = origin[i, 2] + s * fan[i, 2, k]
            cosine[r, k] = abs(row[0] * fan[i, 0, k] + row[1] * fan[i, 1, k] + row[2] * fan[i, 2, k])
            texture[r, k, 0] = row[4] * x + row[5] * y + row[6] * z + row[7]
            texture[r, k, 1] = row[8] * x + row[9] * y + row[10] * z + row[11]
