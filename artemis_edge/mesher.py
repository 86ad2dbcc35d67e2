"""Section III-B, incremental meshing: plane, projection, 2-D Delaunay, lift, voxel by voxel.

A voxel owns the triangles whose centroid lies in it; re-meshing replaces its patch whole. Neighbouring patches
meet because both triangulate the vertices of the common margin along the same quantised direction, and a triangle
that would use an edge twice in the same direction is not accepted: so no edge ever has more than two triangles
and all triangles around it turn the same way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_edge import block_store as bs
from artemis_edge._jit import kernel
from artemis_edge.block_store import (
    ALIVE,
    AT_MESH,
    BLOCK,
    CHANGED,
    COUNT,
    FRESH,
    HITS,
    LOG_CLASS,
    NORMAL,
    PATCH_AT,
    PATCH_LEN,
    PENDING,
    POSITION,
    QUEUE_LEN,
    QUEUED,
    SEEN,
    WEIGHT,
    Store,
)
from artemis_edge.cell_code import CODES, code_voxel, gather_cells, neighbour_shift
from artemis_edge.config import MesherConfig
from artemis_edge.delaunay import delaunay
from artemis_edge.frames import F32, F64, I32, I64, U8, U32
from artemis_edge.semantic_constraint import SemanticConstraint, confident_class
from artemis_edge.voxel_map import AT_ONCE, RefreshRules, RefreshSpace, VoxelMap, refresh_space, refresh_voxel

# Neighbours' vertices one cell around take part. Two cells halve the edges that neighbours disagree about, but cost
# 60 % more and score no better, because ears close what is left (docs/tuning.md)
MARGIN_CELLS = 1
MOST_VERTICES = 192  # a voxel and its margin; more (dense foliage) are left out, nearest first
MOST_TRIANGLES = 512
FLUSHES = 16  # rounds of the flush; the third finds next to nothing
FLUSH_PART = 4096  # voxels meshed at a time, so that their neighbours fit into memory
MOST_GROUPS = 2  # a voxel may hold both sides of a thin wall
MOST_OBJECTS = 4  # that meet in a voxel
_NO_CLASS = -2
EAR = 1 << 15  # flag in the first code of a triangle that only fills a gap
# Coordinates 10 bits apart: the bits above them, and the least and largest sums of three that are owned
_ABOVE = (512 << 20) | (512 << 10) | 512
_FIRST_SUM, _LAST_SUM = (35 << 20) | (35 << 10) | 35, (46 << 20) | (46 << 10) | 46


class Rules(NamedTuple):
    """When three vertices are surface; lengths in metres."""

    short_edge_m: float  # always accepted up to this length
    long_edge_m: float  # accepted up to this length where well seen
    least_hits: float  # hits of the three corners together that carry just more than a short edge
    agreement: float  # least cosine between a triangle's normal and those of its vertices
    group_cosine: float  # vertices whose normal is nearer than this to the direction are meshed together
    confidence_rate: float  # lambda of eq. 7, for telling objects apart; 0: they are not told apart


class Workspace(NamedTuple):
    """Scratch of one meshing lane, allocated once."""

    neighbour: I32  # (27,)
    grid: I32  # (CODES,) slot or local index, -1
    code: U32  # (1728,)
    slot: U32  # (m,)
    local_code: U32  # (m,)
    spread: I64  # (m,) the code's coordinates 10 bits apart
    own: U8  # (m,)
    used: U8  # (m,)
    klass: I32  # (m,) class that the vertex certainly has, -1 where none
    position: F64  # (m, 3) relative to the voxel's corner
    normal: F64  # (m, 3)
    hits: F64  # (m,) points that hit the vertex' cell, as many as at close range
    edge: U8  # (m, m) directed edges in use
    edges: U32  # (e, 2) list of them
    order: U32  # (m,)
    rank: F64  # (m,)
    x: F64  # (m + 3,)
    y: F64
    corner: U32  # (8 m + 8,) see delaunay.py
    link: U32
    stack: U32
    hole: U32  # (e, 3) free edges: start, end, next of the same start (counted from 1; 0: none)
    hole_of: U32  # (m,) first free edge of a vertex (likewise)
    ear: I32  # (27 MOST_TRIANGLES, 5) neighbours' ears: voxel slot, index, local corners
    triangles: U32  # (MOST_TRIANGLES, 3) local indices
    patch: NDArray[np.uint16]  # (MOST_TRIANGLES, 3) codes
    frame: F64  # (3, 3) rows: first axis, second axis, direction
    direction: F64  # (MOST_OBJECTS * MOST_GROUPS, 3)
    out: F64  # (3,)


def workspace() -> Workspace:
    """Fresh scratch memory."""
    m = MOST_VERTICES
    return Workspace(
        neighbour=np.empty(27, np.int32),
        grid=np.full(CODES, -1, np.int32),
        code=np.empty(1728, np.uint32),
        slot=np.empty(m, np.uint32),
        local_code=np.empty(m, np.uint32),
        spread=np.empty(m, np.int64),
        own=np.empty(m, np.uint8),
        used=np.empty(m, np.uint8),
        klass=np.empty(m, np.int32),
        position=np.empty((m, 3)),
        normal=np.empty((m, 3)),
        hits=np.empty(m),
        edge=np.zeros((m, m), np.uint8),
        edges=np.empty((27 * MOST_TRIANGLES, 2), np.uint32),
        order=np.empty(m, np.uint32),
        rank=np.empty(m),
        x=np.empty(m + 3),
        y=np.empty(m + 3),
        corner=np.empty(8 * m + 8, np.uint32),
        link=np.empty(8 * m + 8, np.uint32),
        stack=np.empty(4 * m + 8, np.uint32),
        hole=np.empty((27 * MOST_TRIANGLES, 3), np.uint32),
        hole_of=np.empty(m, np.uint32),
        ear=np.empty((27 * MOST_TRIANGLES, 5), np.int32),
        triangles=np.empty((MOST_TRIANGLES, 3), np.uint32),
        patch=np.empty((MOST_TRIANGLES, 3), np.uint16),
        frame=np.empty((3, 3)),
        direction=np.empty((MOST_OBJECTS * MOST_GROUPS, 3)),
        out=np.empty(3),
    )


@kernel
def mesh_voxel(store: Store, v: int, voxel_m: float, rules: Rules, w: Workspace) -> bool:
    """Replace the patch of voxel ``v``; False when the triangle pool is full."""
    if not bs.has_vertex(store, v):
        return bs.set_patch(store, v, w.patch, 0)  # without own vertices nothing is owned
    bs.neighbours27(store, v, w.neighbour)
    cells = gather_cells(store, w.neighbour, MARGIN_CELLS, w.grid, w.code)
    n, own = collect_vertices(store, v, cells, voxel_m, w)
    _tell_apart(store, n, rules.confidence_rate, w)
    triangles = plain = 0
    if n >= 3:
        edges, ears = take_neighbour_edges(store, w)
        groups = 0
        klass = _next_class(own, w)
        while klass != _NO_CLASS and groups < MOST_OBJECTS * MOST_GROUPS:
            sides = 0
            while sides < MOST_GROUPS and _direction(own, klass, w):
                triangles, edges = _mesh_group(n, klass, rules, w, triangles, edges)
                for k in range(3):
                    w.direction[groups + sides, k] = w.frame[2, k]
                sides += 1
            groups += sides
            _give_up(n, klass, w)
            klass = _next_class(own, w)
        plain = triangles
        edges = _settle_ears(store, ears, w, edges)
        for g in range(groups):
            triangles, edges = _fill_ears(n, w.direction[g], rules, w, triangles, edges)
        for i in range(edges):
            w.edge[w.edges[i, 0], w.edges[i, 1]] = 0
    for i in range(cells):
        w.grid[w.code[i]] = -1
    for i in range(triangles):
        for k in range(3):
            w.patch[i, k] = w.local_code[w.triangles[i, k]]
        if i >= plain:
            w.patch[i, 0] |= EAR
    return bs.set_patch(store, v, w.patch, triangles)


@kernel
def collect_vertices(store: Store, v: int, cells: int, voxel_m: float, w: Workspace) -> tuple[int, int]:
    """Living vertices of the voxel, which come first, and its margin; how many in all and how many own.

    Positions are relative to the voxel's corner. Afterwards ``grid[code]`` is the local index, or -1 where a cell
    has no living vertex.
    """
    x0, y0, z0 = store.voxel[v, 0] * voxel_m, store.voxel[v, 1] * voxel_m, store.voxel[v, 2] * voxel_m
    n = own = 0
    for i in range(cells):
        code = np.int64(w.code[i])
        s = w.grid[code]
        w.grid[code] = -1
        if store.state[s] != ALIVE or n == MOST_VERTICES:
            continue
        p = store.vertex[s]
        w.slot[n] = s
        w.local_code[n] = code
        X, Y, Z = code >> 10, (code >> 5) & 31, code & 31
        w.spread[n] = (X << 20) | (Y << 10) | Z
        w.own[n] = 1 if ((X - 12) | (Y - 12) | (Z - 12)) & ~3 == 0 else 0
        own += w.own[n]
        w.used[n] = 0
        w.position[n, 0], w.position[n, 1], w.position[n, 2] = (
            p[POSITION] - x0,
            p[POSITION + 1] - y0,
            p[POSITION + 2] - z0,
        )
        w.normal[n, 0], w.normal[n, 1], w.normal[n, 2] = p[NORMAL], p[NORMAL + 1], p[NORMAL + 2]
        w.hits[n] = hits_close_by(store.evidence[s])
        w.grid[code] = n
        n += 1
    return n, own


@kernel
def _tell_apart(store: Store, n: int, rate: float, w: Workspace) -> None:
    """Which object each local vertex certainly belongs to; with classes off, none."""
    told = rate > 0.0 and store.attribute.shape[1] > LOG_CLASS
    for i in range(n):
        w.klass[i] = -1
        if told:
            u = w.neighbour[code_voxel(np.int64(w.local_code[i]))]
            weight = store.voxel_class[u, WEIGHT]
            w.klass[i] = confident_class(store.attribute[w.slot[i]], weight, rate)


@kernel
def _next_class(own: int, w: Workspace) -> int:
    """The lowest certain class among the own vertices not meshed yet; -1 when only uncertain ones are left."""
    found = _NO_CLASS
    for i in range(own):
        if not w.used[i] and (found == _NO_CLASS or found < 0 or 0 <= w.klass[i] < found):
            found = w.klass[i]
    return found


@kernel
def _give_up(n: int, klass: int, w: Workspace) -> None:
    """Vertices of a class that no group took are left out."""
    for i in range(n):
        if w.klass[i] == klass:
            w.used[i] = 1


@kernel
def is_one_object(a: int, b: int, c: int, w: Workspace) -> bool:
    """Whether no two corners certainly belong to different objects: E_semantic keeps no such edge."""
    i, j, k = w.klass[a], w.klass[b], w.klass[c]
    return (i < 0 or j < 0 or i == j) and (j < 0 or k < 0 or j == k) and (i < 0 or k < 0 or i == k)


@kernel
def take_neighbour_edges(store: Store, w: Workspace) -> tuple[int, int]:
    """Mark the directed edges that the neighbours' patches use between local vertices; list their ears.

    Returns (edges, ears). Ears only fill what was left over, so they are listed and not marked: a triangle of
    this voxel's own triangulation may displace them.
    """
    edges = ears = 0
    for k in range(27):
        u = w.neighbour[k]
        if k == 13 or u < 0:
            continue
        shift = neighbour_shift(k)
        at = store.voxel[u, PATCH_AT]
        for t in range(at, at + store.voxel[u, PATCH_LEN]):
            first = np.int64(store.triangle[t, 0])
            a = w.grid[np.uint32((first & ~EAR) + shift)]
            b = w.grid[np.uint32(np.int64(store.triangle[t, 1]) + shift)]
            c = w.grid[np.uint32(np.int64(store.triangle[t, 2]) + shift)]
            if (a < 0) + (b < 0) + (c < 0) > 1:
                continue
            if first & EAR:
                e = w.ear[ears]
                e[0], e[1], e[2], e[3], e[4] = u, t - at, a, b, c
                ears += 1
                continue
            edges = _use_edges(w, a, b, c, edges)
    return edges, ears


@kernel
def _use_edges(w: Workspace, a: int, b: int, c: int, edges: int) -> int:
    if a >= 0 and b >= 0:
        edges = _use_edge(w, a, b, edges)
    if b >= 0 and c >= 0:
        edges = _use_edge(w, b, c, edges)
    if c >= 0 and a >= 0:
        edges = _use_edge(w, c, a, edges)
    return edges


@kernel
def _settle_ears(store: Store, ears: int, w: Workspace, edges: int) -> int:
    """Neighbours' ears whose edges this voxel now uses are removed from their patches; the others are marked.

    From the last to the first, so that moving a patch's last triangle into a gap keeps the listed places valid.
    """
    for i in range(ears - 1, -1, -1):
        u, t, a, b, c = w.ear[i]
        taken = (
            (a >= 0 and b >= 0 and w.edge[a, b] == 1)
            or (b >= 0 and c >= 0 and w.edge[b, c] == 1)
            or (c >= 0 and a >= 0 and w.edge[c, a] == 1)
        )
        if taken:
            store.voxel[u, PATCH_LEN] -= 1
            store.block[store.voxel[u, BLOCK], CHANGED] = max(store.block[store.voxel[u, BLOCK], CHANGED], 1)
            at = store.voxel[u, PATCH_AT]
            last = at + store.voxel[u, PATCH_LEN]
            for k in range(3):
                store.triangle[at + t, k] = store.triangle[last, k]
        else:
            edges = _use_edges(w, a, b, c, edges)
    return edges


@kernel
def _use_edge(w: Workspace, a: int, b: int, edges: int) -> int:
    if w.edge[a, b] == 0:
        w.edge[a, b] = 1
        w.edges[edges, 0] = a
        w.edges[edges, 1] = b
        edges += 1
    return edges


@kernel
def _direction(own: int, klass: int, w: Workspace) -> bool:
    """Projection frame for the own vertices of an object not meshed yet: their mean normal, to the nearest of 26
    directions.

    Quantised so that neighbours project the same way (measured: a third of the conflicts). False: nothing left.
    """
    d = w.frame[2]
    d[:] = 0.0
    left = 0
    for i in range(own):
        if not w.used[i] and w.klass[i] <= klass and (w.klass[i] < 0 or w.klass[i] == klass):
            left += 1
            for k in range(3):
                d[k] += w.normal[i, k]
    length = math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    if left == 0 or length < 1e-9:
        return False
    for k in range(3):
        d[k] = np.rint(d[k] / length)
    length = math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])  # at least one component is >= 0.577
    for k in range(3):
        d[k] /= length
    u, t = w.frame[0], w.frame[1]
    least = 0
    for k in range(1, 3):
        if abs(d[k]) < abs(d[least]):
            least = k
    u[:] = 0.0
    a, b = (least + 1) % 3, (least + 2) % 3
    u[a], u[b] = -d[b], d[a]
    length = math.sqrt(u[a] * u[a] + u[b] * u[b])
    u[a] /= length
    u[b] /= length
    t[0], t[1], t[2] = d[1] * u[2] - d[2] * u[1], d[2] * u[0] - d[0] * u[2], d[0] * u[1] - d[1] * u[0]
    return True


@kernel
def _select(n: int, klass: int, group_cosine: float, w: Workspace) -> int:
    """Vertices of the group that may belong to an object, projected and sorted along a snake; how many."""
    u, t, d = w.frame[0], w.frame[1], w.frame[2]
    m = 0
    for i in range(n):
        if w.used[i] or (w.klass[i] >= 0 and w.klass[i] != klass):
            continue
        g = w.normal[i]
        if g[0] * d[0] + g[1] * d[1] + g[2] * d[2] < group_cosine:
            continue
        p = w.position[i]
        a = p[0] * u[0] + p[1] * u[1] + p[2] * u[2]
        b = p[0] * t[0] + p[1] * t[1] + p[2] * t[2]
        stripe = math.floor(a * 8.0)
        key = 64.0 * stripe + (b if (int(stripe) & 1) == 0 else -b)
        j = m
        while j > 0 and w.rank[j - 1] > key:
            w.rank[j] = w.rank[j - 1]
            w.order[j] = w.order[j - 1]
            j -= 1
        w.rank[j] = key
        w.order[j] = i
        m += 1
    for i in range(m):
        p = w.position[w.order[i]]
        w.x[i] = p[0] * u[0] + p[1] * u[1] + p[2] * u[2]
        w.y[i] = p[0] * t[0] + p[1] * t[1] + p[2] * t[2]
    return m


@kernel
def _mesh_group(
    n: int, klass: int, rules: Rules, w: Workspace, triangles: int, edges: int
) -> tuple[int, int]:
    """Delaunay of one group of one object; accepted own triangles are appended. Returns (triangles, edges)."""
    m = _select(n, klass, rules.group_cosine, w)
    if m >= 3:
        count = delaunay(w.x, w.y, m, w.corner, w.link, w.stack)
        for t in range(count):
            i, j, k = w.corner[4 * t], w.corner[4 * t + 1], w.corner[4 * t + 2]
            if i >= m or j >= m or k >= m:
                continue
            a, b, c = w.order[i], w.order[j], w.order[k]
            if not _is_owned(a, b, c, w.spread) or not is_surface(a, b, c, rules, w):
                continue
            if w.edge[a, b] or w.edge[b, c] or w.edge[c, a]:
                continue
            if klass >= 0 and _holds_another(a, b, c, n, klass, rules.short_edge_m, w):
                continue
            triangles, edges = _accept(a, b, c, w, triangles, edges)
    for i in range(m):
        w.used[w.order[i]] = 1
    return triangles, edges


@kernel
def _holds_another(a: int, b: int, c: int, n: int, klass: int, near_m: float, w: Workspace) -> bool:
    """Whether a vertex of another object lies on the triangle: within a quarter of ``near_m`` of its plane, inside
    its outline as seen along the group's direction. There the surface is the other object's."""
    d, p = w.frame[2], w.position
    for i in range(n):
        if w.klass[i] < 0 or w.klass[i] == klass:
            continue
        if _turn(a, b, i, d, p) <= 0.0 or _turn(b, c, i, d, p) <= 0.0 or _turn(c, a, i, d, p) <= 0.0:
            continue
        height = 0.0
        for k in range(3):
            height += (p[i, k] - (p[a, k] + p[b, k] + p[c, k]) / 3.0) * d[k]
        if abs(height) < 0.25 * near_m:
            return True
    return False


@kernel
def _accept(a: int, b: int, c: int, w: Workspace, triangles: int, edges: int) -> tuple[int, int]:
    if triangles == MOST_TRIANGLES:
        return triangles, edges
    edges = _use_edge(w, a, b, edges)
    edges = _use_edge(w, b, c, edges)
    edges = _use_edge(w, c, a, edges)
    w.triangles[triangles, 0], w.triangles[triangles, 1], w.triangles[triangles, 2] = a, b, c
    return triangles + 1, edges


@kernel
def _is_owned(a: int, b: int, c: int, spread: I64) -> bool:
    """Whether the middle of the three cells lies in the own voxel: by cells, which never move, not by positions.

    Own coordinates are 12..15, so three cell centres have their mean in the voxel when they sum to 35..46: all three
    coordinates at once, the bit above each left over where it is no less than the first and no more than the last.
    """
    total = spread[a] + spread[b] + spread[c]
    return ((total | _ABOVE) - _FIRST_SUM) & ((_LAST_SUM | _ABOVE) - total) & _ABOVE == _ABOVE


@kernel
def _edge2(position: F64, a: int, b: int) -> float:
    dx, dy, dz = (
        position[a, 0] - position[b, 0],
        position[a, 1] - position[b, 1],
        position[a, 2] - position[b, 2],
    )
    return dx * dx + dy * dy + dz * dz


@kernel
def hits_close_by(e: F32) -> float:
    """Points that hit a cell of ``evidence`` row ``e``, divided by their mean weight 1 / (1 + (range / noise range)^2).

    Beams lie the further apart the farther they reach: a surface that is hit once far away would be hit several
    times close by.
    """
    return np.float64(e[HITS]) * e[HITS] / max(np.float64(e[COUNT]), 1e-6)


@kernel
def is_surface(a: int, b: int, c: int, rules: Rules, w: Workspace) -> bool:
    """Whether a triangle is surface: its longest edge against the hits of its corners.

    The wider it is, the more beams would have met what lies between if it were open: so the hits that are asked for
    grow with the square of the longest edge. Hits tell better than the evidence of single corners or than flatness
    (docs/tuning.md).
    """
    longest2 = max(_edge2(w.position, a, b), _edge2(w.position, b, c), _edge2(w.position, c, a))
    if longest2 > rules.long_edge_m * rules.long_edge_m:
        return False
    wider = longest2 / (rules.short_edge_m * rules.short_edge_m)
    if wider > 1.0 and w.hits[a] + w.hits[b] + w.hits[c] < rules.least_hits * wider:
        return False
    return _agreement(a, b, c, w) >= rules.agreement


@kernel
def _agreement(a: int, b: int, c: int, w: Workspace) -> float:
    """Least cosine between a triangle's normal and those of its vertices; -2 for one without area."""
    p, q, r = w.position[a], w.position[b], w.position[c]
    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    vx, vy, vz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    if length < 1e-12:
        return -2.0
    agreement = 1.0
    for i in (a, b, c):
        g = w.normal[i]
        agreement = min(agreement, (nx * g[0] + ny * g[1] + nz * g[2]) / length)
    return agreement


@kernel
def _fill_ears(n: int, d: F64, rules: Rules, w: Workspace, triangles: int, edges: int) -> tuple[int, int]:
    """Close notches and small holes: two free edges b-a, a-x in a row get the triangle (b, a, x).

    Such gaps stay where neighbours disagreed about an edge. The new triangle must be surface by the same rules,
    turn the same way and hold no vertex; at least one corner is the voxel's own.
    """
    for i in range(n):
        w.hole_of[i] = 0
    holes = 0
    for i in range(edges):
        a, b = w.edges[i, 0], w.edges[i, 1]
        if w.edge[b, a] == 0:
            holes = _add_hole(w, b, a, holes)
    i = 0
    while i < holes:  # the list grows while ears are added
        b, a = w.hole[i, 0], w.hole[i, 1]
        i += 1
        j = w.hole_of[a]
        while j > 0 and w.edge[b, a] == 0:
            x = w.hole[j - 1, 1]
            j = w.hole[j - 1, 2]
            if x == b or w.edge[a, x] or w.edge[x, b] or not (w.own[a] or w.own[b] or w.own[x]):
                continue
            if not _faces_out(b, a, x, w) or triangles == MOST_TRIANGLES or not is_one_object(b, a, x, w):
                continue
            if _edge2(w.position, b, x) > rules.long_edge_m * rules.long_edge_m:
                continue
            if _is_loop(w, b, x) or (
                _turn(b, a, x, d, w.position) > 0.0
                and is_surface(b, a, x, rules, w)
                and _is_empty(b, a, x, n, d, w.position)
            ):
                triangles, edges = _accept(b, a, x, w, triangles, edges)
                if w.edge[b, x] == 0:
                    holes = _add_hole(w, b, x, holes)
    return triangles, edges


@kernel
def _is_loop(w: Workspace, b: int, x: int) -> bool:
    """Whether the free edges b-a, a-x close to a loop of three or four: then the hole is smaller than a triangle
    or two and there is nothing to ask."""
    if w.edge[b, x]:
        return True
    j = w.hole_of[x]
    while j > 0:
        y = w.hole[j - 1, 1]
        j = w.hole[j - 1, 2]
        if w.edge[x, y] == 0 and w.edge[b, y] and w.edge[y, b] == 0:
            return True
    return False


@kernel
def _add_hole(w: Workspace, start: int, end: int, holes: int) -> int:
    w.hole[holes, 0], w.hole[holes, 1], w.hole[holes, 2] = start, end, w.hole_of[start]
    w.hole_of[start] = holes + 1
    return holes + 1


@kernel
def _faces_out(a: int, b: int, c: int, w: Workspace) -> bool:
    """Whether a triangle faces the way its vertices do; the rim of a lone triangle is no hole to be closed."""
    for k in range(3):
        w.out[k] = w.normal[a, k] + w.normal[b, k] + w.normal[c, k]
    return _turn(a, b, c, w.out, w.position) > 0.0


@kernel
def _turn(a: int, b: int, c: int, d: F64, position: F64) -> float:
    """Twice the area of a, b, c seen along -d; positive when counter-clockwise."""
    p, q, r = position[a], position[b], position[c]
    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    vx, vy, vz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    return (uy * vz - uz * vy) * d[0] + (uz * vx - ux * vz) * d[1] + (ux * vy - uy * vx) * d[2]


@kernel
def _is_empty(a: int, b: int, c: int, n: int, d: F64, position: F64) -> bool:
    for i in range(n):
        if i != a and i != b and i != c:
            inside = (
                _turn(a, b, i, d, position) > 0.0
                and _turn(b, c, i, d, position) > 0.0
                and _turn(c, a, i, d, position) > 0.0
            )
            if inside:
                return False
    return True


class Schedule(NamedTuple):
    """When a waiting voxel is meshed; stamps count frames."""

    wait: int  # frames a voxel collects evidence before its first patch
    longest_wait: int  # frames after which it is decided whether waiting was worth it
    fresh: int  # new vertices that are worth a new patch
    growth: float  # evidence that has grown by this factor is worth a new patch
    most: int  # voxels a frame


@kernel
def is_due(store: Store, v: int, waited: int, schedule: Schedule) -> bool:
    """Whether enough is new: a first patch after ``wait``, then new vertices or evidence grown ``growth`` fold."""
    row = store.voxel[v]
    if waited < schedule.wait and row[FRESH] < AT_ONCE:
        return False
    if row[AT_MESH] == 0:
        return row[PENDING] > 0
    return row[FRESH] >= schedule.fresh or row[PENDING] >= schedule.growth * row[AT_MESH]


@kernel
def is_worth(store: Store, v: int) -> bool:
    """Whether anything would visibly change: new vertices, or twice the evidence (the first time: any)."""
    row = store.voxel[v]
    return row[FRESH] > 1 or row[PENDING] >= row[AT_MESH]


@kernel
def choose_batch(store: Store, stamp: int, schedule: Schedule, everything: bool, batch: I32) -> int:
    """Take voxels that are due off the queue, at most as many as ``batch`` holds; returns how many.

    Those that have no patch yet come first, so that new surface shows at once; within a kind the oldest first.
    """
    n = 0
    if not everything:
        n = _choose(store, stamp, schedule, False, True, batch, n)
        if n == batch.shape[0]:
            return n  # the rest of the queue has just been looked through and stays
    return _choose(store, stamp, schedule, everything, False, batch, n)


@kernel
def _choose(
    store: Store, stamp: int, schedule: Schedule, everything: bool, only_first: bool, batch: I32, n: int
) -> int:
    """One round of the queue. Voxels not due go back; those that waited longest without being worth it leave the
    queue and keep their pending counts."""
    for _ in range(store.counter[QUEUE_LEN]):
        v = bs.dequeue(store)
        row = store.voxel[v]
        since = row[QUEUED]
        row[QUEUED] = 0
        late = everything or stamp - since >= schedule.longest_wait
        wanted = is_worth(store, v) if late else is_due(store, v, stamp - since, schedule)
        if wanted and n < batch.shape[0] and not (only_first and row[AT_MESH] > 0):
            batch[n] = v
            n += 1
        elif wanted or not late:
            bs.enqueue(store, v, since)
    return n


@kernel
def refresh_batch(store: Store, batch: I32, stamp: int, rules: RefreshRules, w: RefreshSpace) -> None:
    """Refresh the vertices of all voxels of the batch."""
    for v in batch:
        refresh_voxel(store, v, stamp, rules, w)


@kernel
def mesh_batch(store: Store, batch: I32, stamp: int, voxel_m: float, rules: Rules, w: Workspace) -> int:
    """Replace the patches of all voxels of the batch; returns patches refused.

    What the batch's voxels told each other while they were refreshed is in their patches then.
    """
    refused = 0
    for v in batch:
        row = store.voxel[v]
        row[AT_MESH] += max(row[PENDING], 1)
        row[PENDING] = 0
        row[FRESH] = 0
        if not mesh_voxel(store, v, voxel_m, rules, w):
            refused += 1
            row[FRESH] = AT_ONCE
            bs.enqueue(store, v, stamp)
        store.block[store.voxel[v, BLOCK], CHANGED] = stamp
    return refused


class Mesher:
    """Keeps the patches of a ``VoxelMap`` up to date, a bounded number a frame."""

    def __init__(
        self,
        config: MesherConfig,
        voxel_map: VoxelMap,
        make_ready: Callable[[I32, int], None] | None = None,
        constraint: SemanticConstraint | None = None,
    ) -> None:
        """``make_ready`` (blocks, stamp) is called before patches change: their neighbours must be in memory.

        ``constraint`` settles the vertices of what was meshed and tells objects apart.
        """
        self._map = voxel_map
        self._make_ready = make_ready or (lambda blocks, stamp: None)
        cell = voxel_map.cell_m
        self._refresh_rules = RefreshRules(
            cell_m=cell,
            plane_sigma_m=voxel_map.config.plane_sigma_m,
            min_distance_m=config.min_distance * cell,
            least_evidence=config.least_evidence,
        )
        self._refresh_space = refresh_space()
        self._rules = Rules(
            short_edge_m=config.short_edge * cell,
            long_edge_m=config.long_edge * cell,
            least_hits=config.least_hits,
            agreement=config.agreement,
            group_cosine=config.group_cosine,
            confidence_rate=constraint.telling_apart if constraint is not None else 0.0,
        )
        self._schedule = Schedule(
            config.wait_frames, config.longest_wait_frames, config.fresh, config.growth, config.most_voxels
        )
        self._workspace = workspace()
        self._batch = np.empty(config.most_voxels, np.int32)
        self._constraint = constraint
        self.refused = 0

    def update(self, active: I32, stamp: int) -> None:
        """Mesh what is due after the voxels ``active`` received points in frame ``stamp``."""
        enqueue_all(self._map.store, active, stamp)
        n = choose_batch(self._map.store, stamp, self._schedule, False, self._batch)
        batch = self._by_block(self._batch[:n])
        self._make_ready(self._blocks(batch), stamp)
        batch = self._still_there(batch)
        self._refresh(batch, stamp)
        self._mesh(batch, stamp)
        self._settle(batch, stamp)

    def flush(self, stamp: int) -> None:
        """Mesh everything that was postponed. Meshing can promote neighbours, hence until nothing is left.

        All vertices are refreshed before the first patch is made, or most patches would be made twice.
        """
        for _ in range(FLUSHES):
            batch = np.empty(self.waiting, np.int32)
            batch = self._by_block(batch[: choose_batch(self._map.store, stamp, self._schedule, True, batch)])
            if len(batch) == 0:
                return
            parts = [batch[first : first + FLUSH_PART] for first in range(0, len(batch), FLUSH_PART)]
            for stage in (self._refresh, self._mesh, self._settle):
                for part in parts:
                    self._make_ready(self._blocks(part), stamp)
                    stage(self._still_there(part), stamp)

    @property
    def waiting(self) -> int:
        """Voxels in the queue."""
        return int(self._map.store.counter[QUEUE_LEN])

    def _blocks(self, batch: I32) -> I32:
        return np.unique(self._map.store.voxel[batch, BLOCK])

    def _still_there(self, batch: I32) -> I32:
        """The voxels whose blocks did not go to disk after they were taken off the queue."""
        store = self._map.store
        block, inner = store.voxel[batch, BLOCK], store.voxel[batch, :3] & 7
        at = (inner[:, 0] << 6) | (inner[:, 1] << 3) | inner[:, 2]
        there: I32 = batch[(store.block[block, SEEN] >= 0) & (store.block_voxel[block, at] == batch)]
        return there

    def _by_block(self, batch: I32) -> I32:
        """Block by block: voxels of a block share cells and neighbours, which are then in the cache."""
        return batch[np.argsort(self._map.store.voxel[batch, BLOCK], kind="stable")]

    def _refresh(self, batch: I32, stamp: int) -> None:
        refresh_batch(self._map.store, batch, stamp, self._refresh_rules, self._refresh_space)

    def _settle(self, batch: I32, stamp: int) -> None:
        """Semantic constraint (eqs 2-8) on what was just placed and meshed."""
        if self._constraint is not None:
            self._constraint.settle(batch, stamp)

    def _mesh(self, batch: I32, stamp: int) -> None:
        voxel_m = self._map.config.voxel_m
        self.refused += mesh_batch(self._map.store, batch, stamp, voxel_m, self._rules, self._workspace)


@kernel
def enqueue_all(store: Store, voxels: I32, stamp: int) -> None:
    """Let voxels wait for meshing when something about them is new."""
    for v in voxels:
        if store.voxel[v, PENDING] > 0 or store.voxel[v, FRESH] > 0:
            bs.enqueue(store, v, stamp)
