"""Section III-B, incremental meshing: plane, projection, 2-D Delaunay, lift, voxel by voxel.

A voxel owns the triangles whose centroid lies in it; re-meshing replaces its patch whole. Neighbouring patches
meet because both triangulate the vertices of the common margin along the same quantised direction, and a triangle
that would use an edge twice in the same direction is not accepted: so no edge ever has more than two triangles
and all triangles around it turn the same way.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_edge import block_store as bs
from artemis_edge._jit import njit
from artemis_edge.block_store import ALIVE, COUNT, NORMAL, PATCH_AT, PATCH_LEN, POSITION, Store
from artemis_edge.cell_code import CODES, gather_cells, neighbour_shift
from artemis_edge.delaunay import delaunay
from artemis_edge.frames import F64, I32, U8

MARGIN_CELLS = 2  # neighbours' vertices within half a voxel take part (measured: half of it, 2.8 x the conflicts)
MOST_VERTICES = 192  # a voxel and its margin; more (dense foliage) are left out, nearest first
MOST_TRIANGLES = 512


class Rules(NamedTuple):
    """When three vertices are surface; lengths in metres."""

    short_edge_m: float  # always accepted up to this length
    long_edge_m: float  # accepted up to this length between well-seen vertices
    well_seen: float  # evidence that makes a vertex well seen
    agreement: float  # least cosine between a triangle's normal and those of its vertices
    group_cosine: float  # vertices whose normal is nearer than this to the direction are meshed together


class Workspace(NamedTuple):
    """Scratch of one meshing lane, allocated once."""

    neighbour: I32  # (27,)
    grid: I32  # (CODES,) slot or local index, -1
    code: I32  # (1728,)
    slot: I32  # (m,)
    local_code: I32  # (m,)
    own: U8  # (m,)
    used: U8  # (m,)
    position: F64  # (m, 3) relative to the voxel's corner
    normal: F64  # (m, 3)
    evidence: F64  # (m,)
    edge: U8  # (m, m) directed edges in use
    edges: I32  # (e, 2) list of them
    order: I32  # (m,)
    rank: F64  # (m,)
    x: F64  # (m + 3,)
    y: F64
    corner: I32  # (2 m + 1, 3)
    link: I32
    stack: I32
    triangles: I32  # (MOST_TRIANGLES, 3) local indices
    patch: NDArray[np.uint16]  # (MOST_TRIANGLES, 3) codes
    frame: F64  # (3, 3) rows: first axis, second axis, direction
    eigen: F64  # (6,)
    tally: NDArray[np.int64]  # (8,) 0 voxels, 1 vertices, 2 accepted, 3 edge taken, 4 too long, 5 normals, 6 ears


def workspace() -> Workspace:
    """Fresh scratch memory."""
    m = MOST_VERTICES
    return Workspace(
        neighbour=np.empty(27, np.int32),
        grid=np.full(CODES, -1, np.int32),
        code=np.empty(1728, np.int32),
        slot=np.empty(m, np.int32),
        local_code=np.empty(m, np.int32),
        own=np.empty(m, np.uint8),
        used=np.empty(m, np.uint8),
        position=np.empty((m, 3)),
        normal=np.empty((m, 3)),
        evidence=np.empty(m),
        edge=np.zeros((m, m), np.uint8),
        edges=np.empty((27 * MOST_TRIANGLES, 2), np.int32),
        order=np.empty(m, np.int32),
        rank=np.empty(m),
        x=np.empty(m + 3),
        y=np.empty(m + 3),
        corner=np.empty((2 * m + 1, 3), np.int32),
        link=np.empty((2 * m + 1, 3), np.int32),
        stack=np.empty(8 * m, np.int32),
        triangles=np.empty((MOST_TRIANGLES, 3), np.int32),
        patch=np.empty((MOST_TRIANGLES, 3), np.uint16),
        frame=np.empty((3, 3)),
        eigen=np.empty(6),
        tally=np.zeros(8, np.int64),
    )


@njit
def mesh_voxel(store: Store, v: int, voxel_m: float, rules: Rules, w: Workspace) -> bool:
    """Replace the patch of voxel ``v``; False when the triangle pool is full."""
    bs.neighbours27(store, v, w.neighbour)
    cells = gather_cells(store, w.neighbour, MARGIN_CELLS, w.grid, w.code)
    n = collect_vertices(store, v, cells, voxel_m, w)
    triangles = 0
    if n >= 3:
        edges = take_neighbour_edges(store, n, w)
        for _ in range(2):  # a voxel may hold both sides of a thin wall
            if not _direction(n, rules.group_cosine, w):
                break
            before = triangles
            triangles, edges = _mesh_group(n, voxel_m, rules, w, triangles, edges)
            for _ in range(3):
                filled = triangles
                triangles, edges = _fill_ears(n, rules, w, triangles, edges)
                if triangles == filled:
                    break
            if triangles == before:
                break
        for i in range(edges):
            w.edge[w.edges[i, 0], w.edges[i, 1]] = 0
    for i in range(cells):
        w.grid[w.code[i]] = -1
    for i in range(triangles):
        for k in range(3):
            w.patch[i, k] = w.local_code[w.triangles[i, k]]
    w.tally[0] += 1
    w.tally[1] += n
    w.tally[2] += triangles
    return bs.set_patch(store, v, w.patch, triangles)


@njit
def collect_vertices(store: Store, v: int, cells: int, voxel_m: float, w: Workspace) -> int:
    """Living vertices of the voxel and its margin, positions relative to the voxel's corner.

    Afterwards ``grid[code]`` is the local index, or -1 where a cell has no living vertex.
    """
    x0, y0, z0 = store.voxel[v, 0] * voxel_m, store.voxel[v, 1] * voxel_m, store.voxel[v, 2] * voxel_m
    n = 0
    for i in range(cells):
        code = w.code[i]
        s = w.grid[code]
        w.grid[code] = -1
        if store.state[s] != ALIVE or n == MOST_VERTICES:
            continue
        p = store.vertex[s]
        w.slot[n] = s
        w.local_code[n] = code
        X, Y, Z = code >> 10, (code >> 5) & 31, code & 31
        w.own[n] = 1 if ((X - 12) | (Y - 12) | (Z - 12)) & ~3 == 0 else 0
        w.used[n] = 0
        w.position[n, 0], w.position[n, 1], w.position[n, 2] = (
            p[POSITION] - x0,
            p[POSITION + 1] - y0,
            p[POSITION + 2] - z0,
        )
        w.normal[n, 0], w.normal[n, 1], w.normal[n, 2] = p[NORMAL], p[NORMAL + 1], p[NORMAL + 2]
        w.evidence[n] = store.evidence[s, COUNT]
        w.grid[code] = n
        n += 1
    return n


@njit
def take_neighbour_edges(store: Store, n: int, w: Workspace) -> int:
    """Mark the directed edges that the 26 neighbours' patches use between local vertices; returns how many."""
    edges = 0
    for k in range(27):
        u = w.neighbour[k]
        if k == 13 or u < 0:
            continue
        shift = neighbour_shift(k)
        at = store.voxel[u, PATCH_AT]
        for t in range(at, at + store.voxel[u, PATCH_LEN]):
            a = w.grid[np.int64(store.triangle[t, 0]) + shift]
            b = w.grid[np.int64(store.triangle[t, 1]) + shift]
            c = w.grid[np.int64(store.triangle[t, 2]) + shift]
            if a >= 0 and b >= 0:
                edges = _use_edge(w, a, b, edges)
            if b >= 0 and c >= 0:
                edges = _use_edge(w, b, c, edges)
            if c >= 0 and a >= 0:
                edges = _use_edge(w, c, a, edges)
    return edges


@njit
def _use_edge(w: Workspace, a: int, b: int, edges: int) -> int:
    if w.edge[a, b] == 0:
        w.edge[a, b] = 1
        w.edges[edges, 0] = a
        w.edges[edges, 1] = b
        edges += 1
    return edges


@njit
def _direction(n: int, group_cosine: float, w: Workspace) -> bool:
    """Projection frame for the own vertices not meshed yet: their mean normal, to the nearest of 26 directions.

    Quantised so that neighbours project the same way (measured: a third of the conflicts). False: nothing left.
    """
    d = w.frame[2]
    d[:] = 0.0
    left = 0
    for i in range(n):
        if w.own[i] and not w.used[i]:
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


@njit
def _select(n: int, group_cosine: float, w: Workspace) -> int:
    """Local vertices of the group, projected and sorted along a snake; returns how many."""
    u, t, d = w.frame[0], w.frame[1], w.frame[2]
    m = 0
    for i in range(n):
        if w.used[i]:
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


@njit
def _mesh_group(n: int, voxel_m: float, rules: Rules, w: Workspace, triangles: int, edges: int) -> tuple[int, int]:
    """Delaunay of one group; accepted own triangles are appended. Returns (triangles, edges)."""
    m = _select(n, rules.group_cosine, w)
    if m >= 3:
        count = delaunay(w.x, w.y, m, w.corner, w.link, w.stack)
        for t in range(count):
            i, j, k = w.corner[t, 0], w.corner[t, 1], w.corner[t, 2]
            if i >= m or j >= m or k >= m:
                continue
            a, b, c = w.order[i], w.order[j], w.order[k]
            if not _is_owned(a, b, c, voxel_m, w.position) or not is_surface(a, b, c, rules, w):
                continue
            if w.edge[a, b] or w.edge[b, c] or w.edge[c, a]:
                w.tally[3] += 1
                continue
            triangles, edges = _accept(a, b, c, w, triangles, edges)
    for i in range(m):
        w.used[w.order[i]] = 1
    return triangles, edges


@njit
def _accept(a: int, b: int, c: int, w: Workspace, triangles: int, edges: int) -> tuple[int, int]:
    if triangles == MOST_TRIANGLES:
        return triangles, edges
    edges = _use_edge(w, a, b, edges)
    edges = _use_edge(w, b, c, edges)
    edges = _use_edge(w, c, a, edges)
    w.triangles[triangles, 0], w.triangles[triangles, 1], w.triangles[triangles, 2] = a, b, c
    return triangles + 1, edges


@njit
def _is_owned(a: int, b: int, c: int, voxel_m: float, position: F64) -> bool:
    for k in range(3):
        middle = (position[a, k] + position[b, k] + position[c, k]) / 3.0
        if middle < 0.0 or middle >= voxel_m:
            return False
    return True


@njit
def _edge2(position: F64, a: int, b: int) -> float:
    dx, dy, dz = position[a, 0] - position[b, 0], position[a, 1] - position[b, 1], position[a, 2] - position[b, 2]
    return dx * dx + dy * dy + dz * dz


@njit
def is_surface(a: int, b: int, c: int, rules: Rules, w: Workspace) -> bool:
    """Whether a triangle is surface: its edges against its evidence, its normal against its vertices'."""
    longest = max(_edge2(w.position, a, b), _edge2(w.position, b, c), _edge2(w.position, c, a))
    least = min(w.evidence[a], w.evidence[b], w.evidence[c])
    limit = rules.long_edge_m if least >= rules.well_seen else rules.short_edge_m
    if longest > limit * limit:
        w.tally[4] += 1
        return False
    p, q, r = w.position[a], w.position[b], w.position[c]
    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    vx, vy, vz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    if length < 1e-12:
        return False
    for i in (a, b, c):
        g = w.normal[i]
        if nx * g[0] + ny * g[1] + nz * g[2] < rules.agreement * length:
            w.tally[5] += 1
            return False
    return True


@njit
def _fill_ears(n: int, rules: Rules, w: Workspace, triangles: int, edges: int) -> tuple[int, int]:
    """Close notches and small holes: two free edges b-a, a-x in a row get the triangle (b, a, x).

    Such gaps stay where neighbours disagreed about an edge. The new triangle must be surface by the same rules,
    turn the same way and hold no vertex; at least one corner is the voxel's own.
    """
    known = edges
    d = w.frame[2]
    for i in range(known):
        a, b = w.edges[i, 0], w.edges[i, 1]
        if w.edge[b, a]:
            continue
        for j in range(known):
            if w.edges[j, 1] != a:
                continue
            x = w.edges[j, 0]
            if x == b or w.edge[a, x] or w.edge[b, a] or w.edge[x, b]:
                continue
            if not (w.own[a] or w.own[b] or w.own[x]):
                continue
            if _turn(b, a, x, d, w.position) <= 0.0 or not is_surface(b, a, x, rules, w):
                continue
            if not _is_empty(b, a, x, n, d, w.position):
                continue
            triangles, edges = _accept(b, a, x, w, triangles, edges)
            w.tally[6] += 1
            break
    return triangles, edges


@njit
def _turn(a: int, b: int, c: int, d: F64, position: F64) -> float:
    """Twice the area of a, b, c seen along -d; positive when counter-clockwise."""
    p, q, r = position[a], position[b], position[c]
    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    vx, vy, vz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    return (uy * vz - uz * vy) * d[0] + (uz * vx - ux * vz) * d[1] + (ux * vy - uy * vx) * d[2]


@njit
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
