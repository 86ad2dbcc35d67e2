"""What a LiDAR observed of a world: the reference that a map of it can fairly be judged by.

A point of a surface counts as observed when a beam met the same object within REACH_M of it, the surface
faces the place that beam came from, and the line from there to the point is free: a beam aimed at it would
have returned. So the far side of things, what others hide, and what lies between two beams further apart than
twice the reach are not asked for, whatever the mapping did with the points. Beams pass panes of glass, so what
lies behind one can be observed; a pane itself is where a beam met it.
"""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import njit
from artemis_drivers.virtual.mesh_builder import F32, F64, I32, U8, WorldMesh
from artemis_drivers.virtual.raycast import first_free_line
from artemis_drivers.virtual.scene import Scene
from artemis_drivers.virtual.textures import TextureAtlas

I64 = NDArray[np.int64]
REACH_M = 0.10
_THIN_M = 0.05  # one beam is remembered per object and cube of this edge: the one that came from nearest
_TRIES = 3  # beams asked for a free line before a point is given up
_SLACK_M = 0.005
_CELL_M = 2 * REACH_M
_COARSE_M = 0.5
_PORTION = 1_000_000  # points handled at once by each worker: bounds memory
_WORKERS = 2  # the kernels release the interpreter lock; the result does not depend on it
_EMPTY = np.int64(-1)
_ROOM = 1 << 16  # beams; doubles as needed


@dataclass(frozen=True, slots=True)
class ObservedSurface:
    """Points float32 (n, 3) on observed surfaces, their unit ``normals`` (n, 3), ``labels`` uint8 (class) and
    ``instance`` int32. ``views`` float32 (n, 3) are unit directions to a place from which a beam would have
    seen the point: one that came to the same object within REACH_M, and whose line to the point is free.
    """

    points: F32
    normals: F32
    views: F32
    labels: U8
    instance: I32


class HitStore:
    """Remembers where beams met objects: of those that met an object in the same cube the one from nearest.

    ``hit`` and ``origin`` float64 (n, 3) in the world, metres, ``instance`` int32 (n,).
    """

    def __init__(self) -> None:
        self._count = 0
        self._beam = np.empty((_ROOM, 6))
        self._object = np.empty(_ROOM, np.int32)
        self._table = np.full(2 * _ROOM, -1, np.int32)

    @property
    def hit(self) -> F64:
        """Where the beams met something."""
        return self._beam[: self._count, :3]

    @property
    def origin(self) -> F64:
        """Where they came from."""
        return self._beam[: self._count, 3:]

    @property
    def instance(self) -> I32:
        """What they met."""
        return self._object[: self._count]

    def add(self, hit: F64, origin: F64, instance: I32) -> None:
        """Add beams: noise-free ``hit`` and ``origin`` float64 (n, 3), ``instance`` of the object met (of
        what stands still, as :func:`witnesses` gives it).
        """
        while self._count + len(hit) > len(self._object):
            self._grow()
        beams = np.hstack([hit, origin])
        self._count = int(remember(beams, instance, self._table, self._beam, self._object, self._count))

    def _grow(self) -> None:
        known, of = self._beam[: self._count], self._object[: self._count]
        room = 2 * len(self._object)
        self._beam, self._object = np.empty((room, 6)), np.empty(room, np.int32)
        self._table = np.full(2 * room, -1, np.int32)
        self._count = int(remember(known, of, self._table, self._beam, self._object, 0))


@njit
def remember(beams: F64, instance: I32, table: I32, kept: F64, kept_instance: I32, count: int) -> int:
    """Put beams (n, 6: hit, origin) into ``kept``, of which ``count`` rows are used; returns how many then are.

    ``table`` is a hash table of rows, -1 where empty, at least twice as long as ``kept``.
    """
    mask = len(table) - 1
    for i in range(len(beams)):
        b = beams[i]
        key = _key(b[0], b[1], b[2], _THIN_M)
        slot = _spread(key ^ (np.int64(instance[i]) * 73856093)) & mask
        while table[slot] >= 0:
            k = kept[table[slot]]
            if kept_instance[table[slot]] == instance[i] and _key(k[0], k[1], k[2], _THIN_M) == key:
                if _length2(b) < _length2(k):
                    k[:] = b
                break
            slot = (slot + 1) & mask
        else:
            table[slot] = count
            kept[count], kept_instance[count] = b, instance[i]
            count += 1
    return count


@njit
def _length2(beam: F64) -> float:
    return float((beam[0] - beam[3]) ** 2 + (beam[1] - beam[4]) ** 2 + (beam[2] - beam[5]) ** 2)


def witnesses(mesh: WorldMesh, atlas: TextureAtlas) -> I32:
    """Per triangle the object that a beam which met it bears witness of, int32 (m,).

    It is the instance; but beams that met the frame of a window say nothing of its pane, which beams pass, so
    panes have numbers of their own.
    """
    return np.where(atlas.arrays.glass[mesh.material], ~mesh.instance, mesh.instance)


def observed_surface(mesh: WorldMesh, scene: Scene, store: HitStore, spacing_m: float) -> ObservedSurface:
    """Points ``spacing_m`` apart on those surfaces of ``mesh`` that the beams in ``store`` observed.

    ``scene`` holds everything that may stand in between (``mesh`` included).
    """
    corners = mesh.corners().astype(np.float64) - scene.origin
    low, high = corners.min(axis=(0, 1)) - REACH_M, corners.max(axis=(0, 1)) + REACH_M
    local = store.hit - scene.origin
    near = np.flatnonzero(((local >= low) & (local <= high)).all(axis=1))
    beams = _beams_index(local[near], store.origin[near] - scene.origin, store.instance[near])
    _, normals = mesh.areas_and_normals()
    parts = _portions(corners, spacing_m)
    witness = witnesses(mesh, scene.atlas)
    with ThreadPoolExecutor(_WORKERS) as pool:
        pieces = list(
            pool.map(
                lambda p: _observed_part(corners[p], normals[p], witness[p], spacing_m, beams, scene),
                parts,
            )
        )
    points = np.concatenate([points for points, _, _ in pieces])
    triangle = np.concatenate([t + part.start for (_, _, t), part in zip(pieces, parts, strict=True)])
    return ObservedSurface(
        points,
        normals[triangle].astype(np.float32),
        np.concatenate([views for _, views, _ in pieces]),
        mesh.class_id[triangle],
        mesh.instance[triangle],
    )


class _Beams(NamedTuple):
    """Beams sorted by cell, as kernels take them.

    ``table`` hash set of the cells, ``start`` (slots, 2) rows of a cell's beams;
    ``coarse`` hash set of the larger cells that have a beam in or beside them. Positions are local.
    """

    hit: F64
    origin: F64
    instance: I32
    table: I64
    start: I64
    coarse: I64


def _beams_index(hit: F64, origin: F64, instance: I32) -> _Beams:
    order, table, start = _index(_pack(np.floor(hit / _CELL_M).astype(np.int64)))
    coarse = _hash_set(np.unique(_pack(_dilated(np.floor(hit / _COARSE_M).astype(np.int64)))))
    return _Beams(hit[order], origin[order], instance[order], table, start, coarse)


def _portions(corners: F64, spacing_m: float) -> list[slice]:
    """Runs of triangles of about _PORTION points each."""
    ends = np.cumsum(_points_at_most(corners, spacing_m))
    cuts = np.searchsorted(ends, np.arange(_PORTION, ends[-1] if len(ends) else 0, _PORTION)) + 1
    edges = np.unique([0, *cuts.tolist(), len(corners)])
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]


def _points_at_most(corners: F64, spacing_m: float) -> F64:
    """Upper bound of the points that :func:`_sample` puts on each triangle."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    longest = edges.max(axis=1)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    rows = np.rint(2 * area / np.maximum(longest, 1e-12) / spacing_m) + 1
    return np.asarray(rows * (longest / spacing_m / 2 + 2) + 2)


def _observed_part(
    corners: F64, normals: F64, instance: I32, spacing_m: float, beams: _Beams, scene: Scene
) -> tuple[F32, F32, I64]:
    """Observed points of some triangles, directions to where they were seen from, and their triangles."""
    room = int(_points_at_most(corners, spacing_m).sum())
    points, triangle = np.empty((room, 3)), np.empty(room, np.int64)
    tries = np.empty((room, _TRIES), np.int32)
    count = _sample(corners, normals, instance, spacing_m, beams, points, triangle, tries)
    points, triangle, tries = points[:count], triangle[:count], tries[:count]
    first = first_free_line(scene.bvh, points, beams.origin, tries, _SLACK_M, scene.panes[0])
    seen = np.flatnonzero(first >= 0)
    views = beams.origin[tries[seen, first[seen]]] - points[seen]
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    return (points[seen] + scene.origin).astype(np.float32), views.astype(np.float32), triangle[seen]


def _pack(cell: I64) -> I64:
    """One non-negative number of a cell (n, 3); 21 bits an axis."""
    half = 1 << 20
    return np.asarray(
        ((cell[:, 0] + half) << 42) | ((cell[:, 1] + half) << 21) | (cell[:, 2] + half), np.int64
    )


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


@njit
def _spread(key: int) -> int:
    """A number whose low bits depend on all of a key's (multiplicative hashing)."""
    k = key * 0x2545F4914F6CDD1D
    return k ^ (k >> 32)


@njit
def _slot(table: I64, key: int) -> int:
    """Slot of a key, or of the empty place where it would stand (open addressing)."""
    mask = len(table) - 1
    k: int = _spread(key) & mask
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


@njit
def _key(x: float, y: float, z: float, cell: float) -> int:
    half = 1 << 20
    i, j, k = int(np.floor(x / cell)), int(np.floor(y / cell)), int(np.floor(z / cell))
    return ((i + half) << 42) | ((j + half) << 21) | (k + half)


@njit
def _beams_near(p: F64, normal: F64, instance: int, beams: _Beams, near: I32) -> int:
    """Up to len(near) beams that met the object within reach of ``p`` and came from the front of it."""
    table, start, hit, origin = beams.table, beams.start, beams.hit, beams.origin
    found = 0
    # cells are twice the reach wide: a sphere of that radius touches two of them along each axis at most
    sx = _CELL_M / 2 if p[0] / _CELL_M - np.floor(p[0] / _CELL_M) >= 0.5 else -_CELL_M / 2
    sy = _CELL_M / 2 if p[1] / _CELL_M - np.floor(p[1] / _CELL_M) >= 0.5 else -_CELL_M / 2
    sz = _CELL_M / 2 if p[2] / _CELL_M - np.floor(p[2] / _CELL_M) >= 0.5 else -_CELL_M / 2
    for n in range(8):
        key = _key(p[0] + (n & 1) * sx, p[1] + (n >> 1 & 1) * sy, p[2] + (n >> 2) * sz, _CELL_M)
        slot = _slot(table, key)
        if table[slot] != key:
            continue
        for k in range(start[slot, 0], start[slot, 1]):
            if beams.instance[k] != instance:
                continue
            d2 = (hit[k, 0] - p[0]) ** 2 + (hit[k, 1] - p[1]) ** 2 + (hit[k, 2] - p[2]) ** 2
            front = 0.0
            for a in range(3):
                front += normal[a] * (origin[k, a] - p[a])
            if d2 <= REACH_M * REACH_M and front > 0:
                near[found] = k
                found += 1
                if found == len(near):
                    return found
    return found


@njit
def _sample(
    corners: F64,
    normals: F64,
    instance: I32,
    spacing: float,
    beams: _Beams,
    points: F64,
    triangle: I64,
    tries: I32,
) -> int:
    """Rows of points on every triangle; keeps those with beams near, returns their number."""
    coarse = beams.coarse
    count = 0
    p = np.empty(3)
    for t in range(len(corners)):
        a, b, c = _longest_edge_first(corners[t])
        base = np.sqrt(((b - a) ** 2).sum())
        along = (b - a) / max(base, 1e-12)
        foot = ((c - a) * along).sum()
        rise = (c - a) - foot * along
        rows = max(int(np.rint(np.sqrt((rise**2).sum()) / spacing)), 1)
        for r in range(rows):
            share = (r + 0.5) / rows
            left, right = share * foot, base - share * (base - foot)
            columns = max(int(np.rint((right - left) / spacing)), 1)
            step = (right - left) / columns
            k = 0
            while k < columns:
                at = left + (k + 0.5) * step
                for axis in range(3):
                    p[axis] = a[axis] + at * along[axis] + share * rise[axis]
                key = _key(p[0], p[1], p[2], _COARSE_M)
                if coarse[_slot(coarse, key)] != key:
                    # no beam within a whole coarse cell, so none near the next points either
                    k += max(int((_COARSE_M - REACH_M) / step), 1)
                    continue
                near = tries[count]
                near[:] = -1
                if _beams_near(p, normals[t], instance[t], beams, near):
                    points[count], triangle[count] = p, t
                    count += 1
                k += 1
    return count


@njit
def _longest_edge_first(corner: F64) -> tuple[F64, F64, F64]:
    best, longest = 0, -1.0
    for k in range(3):
        edge = ((corner[(k + 1) % 3] - corner[k]) ** 2).sum()
        if edge > longest:
            best, longest = k, edge
    return corner[best], corner[(best + 1) % 3], corner[(best + 2) % 3]
