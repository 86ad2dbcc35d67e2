"""What a LiDAR observed of a world: the reference that a map of it can fairly be judged by.

A point of a surface counts as observed when a beam met the same object within REACH_M of it, the surface faces
the place that beam came from, and the line from there to the point is free: a beam aimed at it would have
returned. So the far side of things, what others hide, and what lies between two beams further apart than twice
the reach are not asked for, whatever the mapping did with the points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import inline, njit
from artemis_drivers.virtual.mesh_builder import F32, F64, I32, U8, WorldMesh
from artemis_drivers.virtual.raycast import occluded
from artemis_drivers.virtual.scene import Scene

I64 = NDArray[np.int64]
REACH_M = 0.10
_THIN_M = 0.05  # one beam is remembered per object and cube of this edge: the one that came from nearest
_TRIES = 3  # beams asked for a free line before a point is given up
_SLACK_M = 0.005
_EMPTY = np.int64(-1)


@dataclass(frozen=True, slots=True)
class ObservedSurface:
    """Points float32 (n, 3) on observed surfaces, their unit ``normals`` (n, 3), ``labels`` uint8 (class) and
    ``instance`` int32.
    """

    points: F32
    normals: F32
    labels: U8
    instance: I32


class HitStore:
    """Remembers where beams met objects, thinned: positions, origins (world, metres) and instance numbers."""

    def __init__(self) -> None:
        self._pending: list[tuple[F64, F64, I32]] = []
        self._count = 0
        self.hit = np.empty((0, 3))
        self.origin = np.empty((0, 3))
        self.instance = np.empty(0, np.int32)

    def add(self, hit: F64, origin: F64, instance: I32) -> None:
        """Add beams: noise-free ``hit`` and ``origin`` float64 (n, 3), ``instance`` of the object met."""
        self._pending.append((hit, origin, instance))
        self._count += len(hit)
        if self._count > max(2_000_000, len(self.hit)):
            self.thin()

    def thin(self) -> None:
        """Keep the nearest beam per object and cube."""
        parts = [(self.hit, self.origin, self.instance), *self._pending]
        hit, origin, instance = (np.concatenate(column) for column in zip(*parts, strict=True))
        cube = np.floor(hit / _THIN_M).astype(np.int64)
        key = ((instance.astype(np.int64) * 73856093) ^ (cube[:, 0] * 19349663 + cube[:, 1]) * 83492791) + cube[:, 2]  # fmt: skip
        nearest = np.lexsort((((hit - origin) ** 2).sum(axis=1), key))
        first = np.ones(len(key), bool)
        first[1:] = key[nearest[1:]] != key[nearest[:-1]]
        kept = np.sort(nearest[first])
        self.hit, self.origin, self.instance = hit[kept], origin[kept], instance[kept]
        self._pending, self._count = [], 0


def observed_surface(mesh: WorldMesh, scene: Scene, store: HitStore, spacing_m: float) -> ObservedSurface:
    """Points ``spacing_m`` apart on those surfaces of ``mesh`` that the beams in ``store`` observed.

    ``scene`` holds everything that may stand in between (``mesh`` included).
    """
    store.thin()
    corners = mesh.corners().astype(np.float64) - scene.origin
    low, high = corners.min(axis=(0, 1)) - REACH_M, corners.max(axis=(0, 1)) + REACH_M
    local = store.hit - scene.origin
    near = np.flatnonzero(((local >= low) & (local <= high)).all(axis=1))
    hit, origin, instance = local[near], store.origin[near] - scene.origin, store.instance[near]
    order, table, start = _index(_cells(hit))
    hit, origin, instance = hit[order], origin[order], instance[order]
    coarse = _hash_set(np.unique(_pack(_dilated(np.floor(hit / (5 * REACH_M)).astype(np.int64)))))
    _, normals = mesh.areas_and_normals()
    count = _sample(corners, normals, mesh.instance, spacing_m, table, start, hit, origin, instance, coarse, np.empty((0, 3)), np.empty(0, np.int32), np.empty((0, _TRIES), np.int32))  # fmt: skip
    points, triangle = np.empty((count, 3)), np.empty(count, np.int32)
    beams = np.empty((count, _TRIES), np.int32)
    _sample(corners, normals, mesh.instance, spacing_m, table, start, hit, origin, instance, coarse, points, triangle, beams)  # fmt: skip
    seen = _free_line(scene, points, origin, beams)
    triangle = triangle[seen]
    return ObservedSurface(
        (points[seen] + scene.origin).astype(np.float32),
        normals[triangle].astype(np.float32),
        mesh.class_id[triangle],
        mesh.instance[triangle],
    )


def _free_line(scene: Scene, points: F64, origin: F64, beams: I32) -> NDArray[np.bool_]:
    """Which points are seen from the origin of one of their beams (-1: no further beam)."""
    seen = np.zeros(len(points), bool)
    for attempt in range(_TRIES):
        open_ = np.flatnonzero(~seen & (beams[:, attempt] >= 0))
        if len(open_) == 0:
            break
        start = origin[beams[open_, attempt]] + scene.origin
        seen[open_] = ~occluded(scene.bvh, start, points[open_] + scene.origin, _SLACK_M)
    return seen


def _cells(points: F64) -> I64:
    return np.asarray(_pack(np.floor(points / REACH_M).astype(np.int64)), np.int64)


def _pack(cell: I64) -> I64:
    """One non-negative number of a cell (n, 3); 21 bits an axis."""
    half = 1 << 20
    return np.asarray(((cell[:, 0] + half) << 42) | ((cell[:, 1] + half) << 21) | (cell[:, 2] + half), np.int64)  # fmt: skip


def _dilated(cell: I64) -> I64:
    """The cells and all their neighbours, with repetitions."""
    cell = np.unique(cell, axis=0) if len(cell) else cell
    steps = np.stack(np.meshgrid(*([[-1, 0, 1]] * 3), indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray((cell[:, None, :] + steps).reshape(-1, 3), np.int64)


def _index(key: I64) -> tuple[I64, I64, I64]:
    """Order that sorts ``key``; hash set of the distinct keys; per slot of the set its first row and end."""
    order = np.argsort(key, kind="stable")
    distinct, first = np.unique(key[order], return_index=True)
    table = _hash_set(distinct)
    start = np.zeros((len(table), 2), np.int64)
    _fill_start(table, distinct, np.append(first, len(key)), start)
    return order, table, start


def _hash_set(keys: I64) -> I64:
    size = 1 << max(int(np.ceil(np.log2(2 * len(keys) + 2))), 4)
    table = np.full(size, _EMPTY, np.int64)
    _insert(table, keys)
    return table


@inline
def _slot(table: I64, key: int) -> int:
    """Slot of a key, or of the empty place where it would stand (open addressing)."""
    mask = len(table) - 1
    k = key * 0x2545F4914F6CDD1D
    k = (k ^ (k >> 32)) & mask
    while table[k] != key and table[k] != -1:
        k = (k + 1) & mask
    return k


@njit
def _insert(table: I64, keys: I64) -> None:
    for key in keys:
        table[_slot(table, key)] = key


@njit
def _fill_start(table: I64, distinct: I64, bounds: I64, start: I64) -> None:
    for k in range(len(distinct)):
        slot = _slot(table, distinct[k])
        start[slot, 0], start[slot, 1] = bounds[k], bounds[k + 1]


@inline
def _key(x: float, y: float, z: float, cell: float) -> int:
    half = 1 << 20
    i, j, k = int(np.floor(x / cell)), int(np.floor(y / cell)), int(np.floor(z / cell))
    return ((i + half) << 42) | ((j + half) << 21) | (k + half)


@njit
def _beams_near(p: F64, normal: F64, instance: int, table: I64, start: I64, hit: F64, origin: F64, owner: I32, beams: I32) -> int:  # fmt: skip
    """Up to len(beams) beams that met the object within reach of ``p`` and came from the front of it."""
    found = 0
    cell = REACH_M
    for n in range(27):
        # the own cell first: mostly it suffices
        m = (n + 13) % 27
        dx, dy, dz = m // 9 - 1, (m // 3) % 3 - 1, m % 3 - 1
        key = _key(p[0] + dx * cell, p[1] + dy * cell, p[2] + dz * cell, cell)
        slot = _slot(table, key)
        if table[slot] != key:
            continue
        for k in range(start[slot, 0], start[slot, 1]):
            if owner[k] != instance:
                continue
            d2 = (hit[k, 0] - p[0]) ** 2 + (hit[k, 1] - p[1]) ** 2 + (hit[k, 2] - p[2]) ** 2
            front = 0.0
            for a in range(3):
                front += normal[a] * (origin[k, a] - p[a])
            if d2 <= REACH_M * REACH_M and front > 0:
                beams[found] = k
                found += 1
                if found == len(beams):
                    return found
    return found


@njit
def _sample(
    corners: F64, normals: F64, triangle_instance: I32, spacing: float, table: I64, start: I64, hit: F64, origin: F64, owner: I32, coarse: I64,
    points: F64, triangle: I32, beams: I32,
) -> int:  # fmt: skip
    """Rows of points on every triangle; keeps (or, with empty outputs, counts) those with beams near."""
    count = 0
    near = np.empty(_TRIES, np.int32)
    p = np.empty(3)
    for t in range(len(corners)):
        a, b, c = _longest_edge_first(corners[t])
        base = np.sqrt(((b - a) ** 2).sum())
        along = (b - a) / max(base, 1e-12)
        foot = ((c - a) * along).sum()
        rise = (c - a) - foot * along
        height = np.sqrt((rise**2).sum())
        rows = max(int(np.rint(height / spacing)), 1)
        for r in range(rows):
            share = (r + 0.5) / rows
            left, right = share * foot, base - share * (base - foot)
            columns = max(int(np.rint((right - left) / spacing)), 1)
            step = (right - left) / columns
            skip_until = -1
            for k in range(columns):
                if k < skip_until:
                    continue
                at = left + (k + 0.5) * step
                for axis in range(3):
                    p[axis] = a[axis] + at * along[axis] + share * rise[axis]
                coarse_key = _key(p[0], p[1], p[2], 5 * REACH_M)
                if coarse[_slot(coarse, coarse_key)] != coarse_key:
                    # nothing within a whole coarse cell: the next points cannot be near anything either
                    skip_until = k + max(int(4 * REACH_M / step), 1)
                    continue
                near[:] = -1
                if _beams_near(p, normals[t], triangle_instance[t], table, start, hit, origin, owner, near):
                    if len(points):
                        points[count], triangle[count], beams[count] = p, t, near
                    count += 1
    return count


@njit
def _longest_edge_first(corner: F64) -> tuple[F64, F64, F64]:
    best, longest = 0, -1.0
    for k in range(3):
        edge = ((corner[(k + 1) % 3] - corner[k]) ** 2).sum()
        if edge > longest:
            best, longest = k, edge
    return corner[best], corner[(best + 1) % 3], corner[(best + 2) % 3]
