"""The last look at a whole mesh before it is written: small holes closed, overlaps mended, whiskers trimmed, islands
left out.

Live, a voxel decides with what it and its neighbours know; what is left open between several voxels shows only in
the whole. Where two voxels cut their common surface differently, a triangle may lie over others and no hole is seen:
the loop of free edges around such an overlap runs the wrong way round. It is mended by taking out one triangle or
two and closing what then is a hole (half of the short loops: docs/tuning.md). Nothing here moves a vertex, and no edge
gets a third triangle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from artemis_edge._jit import kernel
from artemis_edge.frames import F32, I32, I64, U8, Bool

LONGEST_LOOP = 12  # edges of a hole that is closed: about as wide as the longest edge that is surface
# Rounds of closing and trimming: what trimming opens, the next round sees. Trimming whiskers further costs thin
# things more recall than it saves open edges (docs/tuning.md)
ROUNDS = 2
ROOM = LONGEST_LOOP + 1  # corners of a loop that has got one more
_SHIFT = 32


def finish(
    vertices: F32, normals: F32, faces: I32, longest_m: float, smallest_island: int, klass: I32 | None = None
) -> I32:
    """Triangles (t, 3) of the finished mesh over the same ``vertices`` and ``normals`` float32 (n, 3).

    ``klass`` int32 (n,) are classes that vertices clearly have, -1 where none: nothing is closed between two.
    """
    for _ in range(ROUNDS):
        faces = close_loops(vertices, normals, faces, longest_m, klass)
        faces = faces[free_edges(faces).sum(axis=1) < 2]
    faces = close_loops(vertices, normals, faces, longest_m, klass)
    return faces[large_islands(faces, smallest_island)]


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


class Loops(NamedTuple):
    """The free edges of a mesh, sorted by ``start``, and scratch for one loop of them."""

    start: I64  # (n,)
    end: I64
    owner: I64  # (n,) triangle on the other side of each
    used: U8  # (n,)
    ranked: I64  # all directed edges of the mesh, sorted
    loop: I64  # (ROOM,) corners
    edge: I64  # (ROOM,) places in ``start``
    trial: I64  # (ROOM,) corners of a loop that is cut up
    part: I32  # (ROOM, 3) what it was cut into
    least: I32  # (ROOM, 3) the best of several cuts


class Fills(NamedTuple):
    """What closes loops: the triangles of each and those that are taken out for it."""

    fill: I32  # (m, 3)
    loop: I64  # (m,) the loop that a triangle belongs to
    taken: I64  # (n, 2) triangles of the mesh that loop n gives up, -1 for none


def close_loops(vertices: F32, normals: F32, faces: I32, longest_m: float, klass: I32 | None = None) -> I32:
    """Faces with every loop of at most ``LONGEST_LOOP`` edges closed whose diagonals are below ``longest_m``.

    A fill must face as its vertices do: the rim of a small island is a loop too, but its inside is the back.
    With ``klass`` nothing is closed between two.
    """
    keys = _half_edges(faces)
    free = free_edges(faces).T
    # a hole runs against the triangles around it
    start, end = keys[free] & 0xFFFFFFFF, keys[free] >> _SHIFT
    owner = np.broadcast_to(np.arange(len(faces)), keys.shape)[free]
    order = np.lexsort((end, start))
    n = len(start)
    loops = Loops(
        start=start[order],
        end=end[order],
        owner=owner[order],
        used=np.zeros(n, np.uint8),
        ranked=np.sort(keys.ravel()),
        loop=np.empty(ROOM, np.int64),
        edge=np.empty(ROOM, np.int64),
        trial=np.empty(ROOM, np.int64),
        part=np.empty((ROOM, 3), np.int32),
        least=np.empty((ROOM, 3), np.int32),
    )
    room = 2 * n + ROOM
    out = Fills(np.empty((room, 3), np.int32), np.empty(room, np.int64), np.empty((n, 2), np.int64))
    fills, closed = fill_loops(vertices, normals, faces, longest_m, loops, out)
    return _with_fills(faces, Fills(out.fill[:fills], out.loop[:fills], out.taken[:closed]), klass)


def _with_fills(faces: I32, found: Fills, klass: I32 | None) -> I32:
    """Faces with those loops closed that do not get into each other's way: none twice taken, no edge twice used."""
    good = np.ones(len(found.taken), bool)
    if klass is not None:
        corner = klass[found.fill]
        most = corner.max(axis=1, initial=-1)
        good[found.loop[((corner != most[:, None]) & (corner >= 0)).any(axis=1)]] = False
    wanted, which = found.taken.ravel(), np.repeat(np.arange(len(good)), 2)
    wanted, which = wanted[wanted >= 0], which[wanted >= 0]
    again = np.ones(len(wanted), bool)
    again[np.unique(wanted, return_index=True)[1]] = False
    good[which[again]] = False
    mine = _half_edges(found.fill)
    while True:
        keep = np.ones(len(faces), bool)
        keep[wanted[good[which]]] = False
        chosen = good[found.loop]
        keys = np.sort(np.concatenate((_half_edges(faces[keep]).ravel(), mine[:, chosen].ravel())))
        twice = keys[1:][keys[1:] == keys[:-1]]
        bad = np.isin(mine, twice).any(axis=0) & chosen
        if not bad.any():
            return np.concatenate((faces[keep], found.fill[chosen]))
        good[found.loop[bad]] = False


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
def _walk(vertices: F32, normals: F32, w: Loops, seed: int) -> int:
    """Follow free edges from ``seed``; the loop's length when it closes within ``LONGEST_LOOP`` edges, else 0."""
    start, end, loop, edge = w.start, w.end, w.loop, w.edge
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
        step = _next_edge(vertices, normals, start, end, w.used, loop[n - 1], at)
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
def _clip_ears(vertices: F32, normals: F32, longest_m: float, w: Loops, n: int) -> int:
    """Cut the first ``n`` corners of ``w.trial`` into ``w.part`` by the shortest diagonals; 0 when it may not be."""
    loop, part, ranked, count = w.trial, w.part, w.ranked, 0
    while n > 3:
        best, best2 = -1, longest_m * longest_m
        for k in range(n):
            a, c = loop[k - 1 if k else n - 1], loop[(k + 1) % n]
            length2 = _length2(vertices, a, c)
            if length2 <= best2 and not _has(ranked, (a << 32) | c) and not _has(ranked, (c << 32) | a):
                best, best2 = k, length2
        if best < 0:
            return 0
        a, b, c = loop[best - 1 if best else n - 1], loop[best], loop[(best + 1) % n]
        if not _faces_out(vertices, normals, a, b, c):
            return 0
        part[count, 0], part[count, 1], part[count, 2] = a, b, c
        count += 1
        n -= 1
        for k in range(best, n):
            loop[k] = loop[k + 1]
    if not _faces_out(vertices, normals, loop[0], loop[1], loop[2]):
        return 0
    part[count, 0], part[count, 1], part[count, 2] = loop[0], loop[1], loop[2]
    return count + 1


@kernel
def _apex(faces: I32, w: Loops, n: int, k: int) -> int:
    """The corner of the triangle beside the loop's edge ``k`` that is not on that edge."""
    f = faces[w.owner[w.edge[k]]]
    return np.int64(f[0]) + f[1] + f[2] - w.loop[k] - w.loop[(k + 1) % n]


@kernel
def _is_on(w: Loops, n: int, corner: int) -> bool:
    for k in range(n):  # noqa: SIM110 (kernels know no any)
        if w.loop[k] == corner:
            return True
    return False


@kernel
def _keep_shortest(vertices: F32, w: Loops, count: int, longest2: float) -> float:
    """Keep the cut ``w.part`` in ``w.least`` when its longest edge is shorter than that of what was there."""
    longest = 0.0
    for i in range(count):
        for k in range(3):
            longest = max(longest, _length2(vertices, w.part[i, k], w.part[i, (k + 1) % 3]))
    if longest >= longest2:
        return longest2
    _copy_rows(w.part, w.least, 0, count)
    return longest


@kernel
def _copy_rows(source: I32, target: I32, first: int, count: int) -> None:
    for i in range(count):
        for k in range(3):
            target[first + i, k] = source[i, k]


@kernel
def _mend(vertices: F32, normals: F32, faces: I32, longest_m: float, w: Loops, n: int, taken: I64) -> int:
    """Close a loop around an overlap by taking out the triangle beside one edge, or the two beside a corner.

    The two must share their third corner: then it takes the place of the one between them. Of all ways the one
    with the shortest edges is kept in ``w.least``; returns its triangles, 0 when there is none.
    """
    count, longest2 = 0, np.inf
    for k in range(n):
        apex = _apex(faces, w, n, k)
        if _is_on(w, n, apex):
            continue
        after = (k + 1) % n
        pair = _apex(faces, w, n, after) == apex and w.owner[w.edge[k]] != w.owner[w.edge[after]]
        for both in range(2 if pair else 1):
            _replace(w, n, k, apex, both == 1)
            found = _clip_ears(vertices, normals, longest_m, w, n if both else n + 1)
            if found == 0:
                continue
            shorter2 = _keep_shortest(vertices, w, found, longest2)
            if shorter2 < longest2:
                count, longest2 = found, shorter2
                taken[0] = w.owner[w.edge[k]]
                taken[1] = w.owner[w.edge[after]] if both else -1
    return count


@kernel
def _replace(w: Loops, n: int, k: int, apex: int, both: bool) -> None:
    """The loop into ``w.trial`` with ``apex`` after corner ``k``, or in the place of the corner after it."""
    for i in range(n):
        w.trial[i if i <= k or both else i + 1] = w.loop[i]
    w.trial[(k + 1) % n if both else k + 1] = apex


@kernel
def fill_loops(
    vertices: F32, normals: F32, faces: I32, longest_m: float, w: Loops, out: Fills
) -> tuple[int, int]:
    """Walk the free edges and cut up short loops; returns the triangles in ``out.fill`` and the loops closed."""
    count = closed = 0
    for seed in range(w.start.shape[0]):
        if w.used[seed]:
            continue
        n = _walk(vertices, normals, w, seed)
        for k in range(n):
            w.used[w.edge[k]] = 1
        if n == 0:
            continue
        for k in range(n):
            w.trial[k] = w.loop[k]
        out.taken[closed, 0] = out.taken[closed, 1] = -1
        found = _clip_ears(vertices, normals, longest_m, w, n)
        if found > 0:
            _copy_rows(w.part, out.fill, count, found)
        else:
            found = _mend(vertices, normals, faces, longest_m, w, n, out.taken[closed])
            _copy_rows(w.least, out.fill, count, found)
        for i in range(found):
            out.loop[count + i] = closed
        count += found
        closed += found > 0
    return count, closed


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
