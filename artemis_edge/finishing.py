"""The last look at a whole mesh before it is written: small holes closed, whiskers trimmed, islands left out.

Live, a voxel decides with what it and its neighbours know; what is left open between several voxels shows only in
the whole. Nothing here moves a vertex, and no edge gets a third triangle.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from artemis_edge._jit import kernel
from artemis_edge.frames import F32, I32, I64, U8, Bool

LONGEST_LOOP = 12  # edges of a hole that is closed: about as wide as the longest edge that is surface
# Rounds of closing and trimming: what trimming opens, the next round sees. Trimming whiskers further costs thin
# things more recall than it saves open edges (docs/tuning.md)
ROUNDS = 2
_SHIFT = 32


def finish(
    vertices: F32, normals: F32, faces: I32, longest_m: float, smallest_island: int, klass: I32 | None = None
) -> I32:
    """Triangles (t, 3) of the finished mesh over the same ``vertices`` and ``normals`` float32 (n, 3).

    ``klass`` int32 (n,) are classes that vertices clearly have, -1 where none: nothing is closed between two.
    """
    for _ in range(ROUNDS):
        faces = _closed(vertices, normals, faces, longest_m, klass)
        faces = faces[free_edges(faces).sum(axis=1) < 2]
    faces = _closed(vertices, normals, faces, longest_m, klass)
    return faces[large_islands(faces, smallest_island)]


def _closed(vertices: F32, normals: F32, faces: I32, longest_m: float, klass: I32 | None) -> I32:
    closed = close_loops(vertices, normals, faces, longest_m)
    if klass is None:
        return closed
    corner = klass[closed[len(faces) :]]
    most = corner.max(axis=1, initial=-1)
    one = ((corner == most[:, None]) | (corner < 0)).all(axis=1)
    return np.concatenate((faces, closed[len(faces) :][one]))


def _half_edges(faces: I32) -> I64:
    """Keys of the directed edges, int64 (3, t): corner 0-1, 1-2, 2-0."""
    f = faces.astype(np.int64).T
    return np.stack([(f[k] << _SHIFT) | f[(k + 1) % 3] for k in range(3)])


def _twins(keys: I64) -> tuple[I64, Bool]:
    """For each directed edge key (n,) the place of the edge that runs the other way, and whether there is one."""
    order = np.argsort(keys, kind="stable")
    ranked = keys[order]
    wanted = ((keys & 0xFFFFFFFF) << _SHIFT) | (keys >> _SHIFT)
    at = np.searchsorted(ranked, wanted).clip(0, max(len(ranked) - 1, 0))
    found: Bool = ranked[at] == wanted if len(ranked) else np.zeros(0, bool)
    return order[at], found


def free_edges(faces: I32) -> Bool:
    """Which edges of each triangle have no triangle on the other side, bool (t, 3)."""
    return ~_twins(_half_edges(faces).ravel())[1].reshape(3, -1).T


def close_loops(vertices: F32, normals: F32, faces: I32, longest_m: float) -> I32:
    """Faces with every hole of at most ``LONGEST_LOOP`` edges filled whose diagonals are below ``longest_m``.

    A fill must face as its vertices do: the rim of a small island is a loop too, but its inside is the back.
    """
    keys = _half_edges(faces)
    free = free_edges(faces).T
    # a hole runs against the triangles around it
    start, end = keys[free] & 0xFFFFFFFF, keys[free] >> _SHIFT
    order = np.lexsort((end, start))
    start, end = start[order], end[order]
    ranked = np.sort(keys.ravel())
    fill = np.empty((len(start) + LONGEST_LOOP, 3), np.int32)
    used = np.zeros(len(start), np.uint8)
    loop, edge = np.empty(LONGEST_LOOP, np.int64), np.empty(LONGEST_LOOP, np.int64)
    n = fill_loops(vertices, normals, start, end, ranked, longest_m, used, loop, edge, fill)
    return np.concatenate((faces, _without_doubles(faces, fill[:n])))


@kernel
def _first(ranked: I64, key: int) -> int:
    low, high = 0, ranked.shape[0]
    while low < high:
        middle = (low + high) // 2
        if ranked[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def _has(ranked: I64, key: int) -> bool:
    at = _first(ranked, key)
    return at < ranked.shape[0] and ranked[at] == key


@kernel
def _turn_right(vertices: F32, normals: F32, a: int, b: int, c: int) -> float:
    """Angle 0..2 pi from the direction b-a clockwise to the direction b-c, seen against the normal of b."""
    p, q, r, g = vertices[a], vertices[b], vertices[c], normals[b]
    ux, uy, uz = np.float64(p[0] - q[0]), np.float64(p[1] - q[1]), np.float64(p[2] - q[2])
    wx, wy, wz = np.float64(r[0] - q[0]), np.float64(r[1] - q[1]), np.float64(r[2] - q[2])
    sine = -((uy * wz - uz * wy) * g[0] + (uz * wx - ux * wz) * g[1] + (ux * wy - uy * wx) * g[2])
    # the parts across the normal
    un, wn = ux * g[0] + uy * g[1] + uz * g[2], wx * g[0] + wy * g[1] + wz * g[2]
    angle = math.atan2(sine, ux * wx + uy * wy + uz * wz - un * wn)
    return angle if angle > 0.0 else angle + 2.0 * math.pi


@kernel
def _next_edge(vertices: F32, normals: F32, start: I64, end: I64, used: U8, before: int, vertex: int) -> int:
    """Index of the free edge that bounds the same hole after ``before`` - ``vertex``; -1 none.

    Where several pieces of surface touch in a vertex, it is the first one clockwise: a hole lies to the left of
    its edges.
    """
    chosen, least = -1, 7.0
    i = _first(start, vertex)
    while i < start.shape[0] and start[i] == vertex:
        if not used[i]:
            angle = _turn_right(vertices, normals, before, vertex, end[i])
            if angle < least:
                chosen, least = i, angle
        i += 1
    return chosen


@kernel
def _walk(
    vertices: F32, normals: F32, start: I64, end: I64, used: U8, seed: int, loop: I64, edge: I64
) -> int:
    """Follow free edges from ``seed``; the loop's length when it closes within ``LONGEST_LOOP`` edges, else 0."""
    home = start[seed]
    loop[0], edge[0] = home, seed
    n = 1
    at = end[seed]
    while at != home:
        for k in range(n):
            if loop[k] == at:
                return 0
        if n == LONGEST_LOOP:
            return 0
        step = _next_edge(vertices, normals, start, end, used, loop[n - 1], at)
        if step < 0:
            return 0
        loop[n], edge[n] = at, step
        n += 1
        at = end[step]
    return n if n >= 3 else 0


@kernel
def _length2(vertices: F32, a: int, b: int) -> float:
    dx = np.float64(vertices[a, 0]) - vertices[b, 0]
    dy = np.float64(vertices[a, 1]) - vertices[b, 1]
    dz = np.float64(vertices[a, 2]) - vertices[b, 2]
    return dx * dx + dy * dy + dz * dz


@kernel
def _faces_out(vertices: F32, normals: F32, a: int, b: int, c: int) -> bool:
    p, q, r = vertices[a], vertices[b], vertices[c]
    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    vx, vy, vz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    total = 0.0
    for i in (a, b, c):
        g = normals[i]
        total += nx * g[0] + ny * g[1] + nz * g[2]
    return total > 0.0


@kernel
def _clip_ears(
    vertices: F32, normals: F32, ranked: I64, longest_m: float, loop: I64, n: int, fill: I32, count: int
) -> int:
    """Triangulate a loop by its shortest diagonals; returns the new count, or the old one when it may not be."""
    first = count
    while n > 3:
        best, best2 = -1, longest_m * longest_m
        for k in range(n):
            a, c = loop[k - 1 if k else n - 1], loop[(k + 1) % n]
            length2 = _length2(vertices, a, c)
            if length2 <= best2 and not _has(ranked, (a << 32) | c) and not _has(ranked, (c << 32) | a):
                best, best2 = k, length2
        if best < 0:
            return first
        a, b, c = loop[best - 1 if best else n - 1], loop[best], loop[(best + 1) % n]
        if not _faces_out(vertices, normals, a, b, c):
            return first
        fill[count, 0], fill[count, 1], fill[count, 2] = a, b, c
        count += 1
        n -= 1
        for k in range(best, n):
            loop[k] = loop[k + 1]
    if not _faces_out(vertices, normals, loop[0], loop[1], loop[2]):
        return first
    fill[count, 0], fill[count, 1], fill[count, 2] = loop[0], loop[1], loop[2]
    return count + 1


@kernel
def fill_loops(
    vertices: F32,
    normals: F32,
    start: I64,
    end: I64,
    ranked: I64,
    longest_m: float,
    used: U8,
    loop: I64,
    edge: I64,
    fill: I32,
) -> int:
    """Walk the free edges (sorted by ``start``) and triangulate short loops; returns triangles in ``fill``.

    ``ranked`` are all directed edges, sorted. ``loop`` and ``edge`` are scratch of LONGEST_LOOP.
    """
    count = 0
    for seed in range(start.shape[0]):
        if used[seed]:
            continue
        n = _walk(vertices, normals, start, end, used, seed, loop, edge)
        if n == 0:
            continue
        filled = _clip_ears(vertices, normals, ranked, longest_m, loop, n, fill, count)
        if filled > count:
            count = filled
            for k in range(n):
                used[edge[k]] = 1
    return count


def large_islands(faces: I32, least: int) -> Bool:
    """Which triangles belong to a piece of at least ``least`` triangles joined by edges, bool (t,).

    A corner in common does not join: such pieces hang in the air as single triangles do.
    """
    if least <= 1 or len(faces) == 0:
        return np.ones(len(faces), bool)
    twin, joined = _twins(_half_edges(faces).ravel())
    here, there = np.flatnonzero(joined) % len(faces), twin[joined] % len(faces)
    graph = coo_array((np.ones(len(here), bool), (here, there)), shape=(len(faces), len(faces)))
    piece = connected_components(graph, directed=False)[1]
    keep: Bool = np.bincount(piece)[piece] >= least
    return keep


def _without_doubles(faces: I32, fill: I32) -> I32:
    """Fills whose directed edges are used by no other triangle: two holes may want the same diagonal."""
    keys, mine = _half_edges(faces).ravel(), _half_edges(fill)
    twice = np.sort(np.concatenate((keys, mine.ravel())))
    twice = twice[1:][twice[1:] == twice[:-1]]
    return fill[~np.isin(mine, twice).any(axis=0)]
