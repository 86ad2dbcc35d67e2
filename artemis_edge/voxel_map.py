"""Section III-B, voxel fusion: scans are allocated to a 3-D grid that keeps evidence instead of points.

A cell of edge ``r`` accumulates the moments of the points that fall into it. Its vertex is their mean, moved
onto the plane that the surrounding cells agree on: the minimum of the point-to-plane energy (E_geometry of
eq. 2) for that vertex, so that every further scan averages the sensor noise down.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from artemis_edge import block_store as bs
from artemis_edge._jit import kernel
from artemis_edge.block_store import (
    ALIVE,
    CARVED,
    CONFIRMED,
    COUNT,
    EVIDENCE_ONLY,
    FRESH,
    HITS,
    IX,
    IY,
    IZ,
    NORMAL,
    POSITION,
    ROUGHNESS,
    SQUARE,
    SUM,
    THROUGH,
    TOUCHED_BLOCKS,
    VIEW,
    Store,
)
from artemis_edge.cell_code import CODES, NEAR_VOXELS, OWN, code_cell, code_in, code_of, gather_cells
from artemis_edge.class_rows import are_two_objects
from artemis_edge.config import VoxelMapConfig
from artemis_edge.eigen3 import smallest_eigen3
from artemis_edge.frames import F32, F64, I32, U32, TrackedFrame
from artemis_edge.insertion import InsertRules, insert_points, new_chunk

# A plane may be this much thicker than sigma^2: the noise of the angles adds to that of the range
THICK = 1.0
# Points that spread this much more along a plane than across it (variances) tell its direction, if no place on it
LAYERED = 1.5
# Sine of the angle below which a plane of 0.6 m may hide the side it is seen from: three times its tilt when 20 hits
# of 3 cm noise fix it
GRAZING = 0.1
# Cosine between normals above which two planes are the same surface
SAME_PLANE = 0.7
# Fewer hits lie on some plane by chance: three always do
TRUSTED_COUNT = 6.0
# A living vertex gives way below this share of the distance that a new one must keep: what a few hits put apart,
# the mean of many can bring together
STAYS = 0.7
# FRESH of a voxel whose patch must be made anew whatever else it waits for: a vertex it uses is gone
AT_ONCE = 64

# Bits of a code in which all own cells agree (cell_code.py)
_FIRST, _NOT_OWN = code_of(OWN, OWN, OWN), ~code_of(3, 3, 3)


class VoxelMap:
    """The paper's 3-D grid of voxels; see ``block_store`` for its memory, ``paging`` for what goes to disk.

    ``insert`` allocates a frame's points; ``store`` is read and written by the mesher.
    """

    def __init__(self, config: VoxelMapConfig, budget_bytes: float, attributes: int = bs.LOG_CLASS) -> None:
        """``attributes`` columns a vertex carries beside its geometry: 4, or 20 with classes (block_store.py)."""
        self.config = config
        self.cell_m = config.voxel_m / bs.CELLS_PER_VOXEL
        self.block_m = config.voxel_m * bs.VOXELS_PER_BLOCK
        self.store = bs.allocate(budget_bytes, attributes)
        self._touched = np.empty(self.store.voxel.shape[0], np.int32)
        self._insert_rules = InsertRules(
            self.cell_m, config.min_range_m, config.max_range_m, config.noise_range_m, 1.0
        )
        self._doubted = self._insert_rules._replace(trust=config.degenerate_trust)
        self._chunk = new_chunk()

    def insert(self, frame: TrackedFrame, stamp: int) -> I32:
        """Allocate the points of a frame; returns the slots of the voxels that received points.

        ``stamp`` counts frames from 1. ``touched_blocks`` tells the blocks afterwards. The points of a frame that is
        marked ``degenerate`` count less.
        """
        rules = self._doubted if frame.degenerate else self._insert_rules
        self.store.counter[TOUCHED_BLOCKS] = 0
        n = 0
        for scan in frame.scans:
            n = insert_points(
                self.store,
                scan.points,
                frame.T_world_lidar,
                scan.origin,
                rules,
                stamp,
                self._touched,
                n,
                self._chunk,
            )
        return self._touched[:n].copy()

    def touched_blocks(self) -> I32:
        """Slots of the blocks that received points in the last frame."""
        return self.store.touched_block[: self.store.counter[TOUCHED_BLOCKS]]


class RefreshRules(NamedTuple):
    """What makes a vertex; lengths in metres."""

    cell_m: float
    plane_sigma_m: float  # thickness up to which cells agree on a plane
    min_distance_m: float  # living vertices are at least this far apart
    least_evidence: float  # within one and a half cells


class RefreshSpace(NamedTuple):
    """Scratch of ``refresh_voxel``: the 6 x 6 x 6 cells around a voxel."""

    neighbour: I32  # (27,)
    grid: I32  # (CODES,) slot, then local index; -1 where nothing
    code: U32  # (216,)
    slot: U32  # (216,)
    place: F32  # (216, 4) of the vertex where it is alive, else out of reach
    around: U32  # (28,) local indices of the cells around the one being looked at
    moment: F64  # (217, 16) about the voxel's corner; the last row is scratch
    total: F64  # (16,)
    eigen: F64  # (6,)
    wide: F64  # (9,) plane of all 6 x 6 x 6 cells: point, normal to the sensor, smallest and middle eigenvalue, noise


def refresh_space() -> RefreshSpace:
    """Fresh scratch memory."""
    return RefreshSpace(
        neighbour=np.empty(27, np.int32),
        grid=np.full(CODES, -1, np.int32),
        code=np.empty(1728, np.uint32),
        slot=np.empty(216, np.uint32),
        place=np.zeros((216, 4), np.float32),
        around=np.empty(28, np.uint32),
        moment=np.zeros((217, 16)),
        total=np.empty(16),
        eigen=np.empty(6),
        wide=np.empty(9),
    )


@kernel
def refresh_voxel(store: Store, v: int, stamp: int, rules: RefreshRules, w: RefreshSpace) -> None:
    """Recompute the vertices of one voxel from the moments of the 3 x 3 x 3 cells around each.

    A cell becomes a vertex when the evidence around it reaches ``least_evidence`` and no living vertex is nearer
    than ``min_distance_m``.
    """
    bs.neighbours27(store, v, w.neighbour)
    n = gather_cells(store, w.neighbour, 1, w.grid, w.code)
    for i in range(n):
        s = w.grid[w.code[i]]
        w.slot[i] = s
        w.grid[w.code[i]] = i
        _keep_place(store, s, w.place[i])
        _move_moments(store.evidence, s, w.code[i], rules.cell_m, w.moment, i)
    _fit_wide(w.moment, n, w.total, w.eigen, w.wide)
    _turn_to_sensor(store, rules.cell_m, w)
    if w.total[0] >= rules.least_evidence:  # else no cell can have enough around it
        for i in range(n):
            if ((w.code[i] ^ _FIRST) & _NOT_OWN) != 0:
                break  # own cells come first
            if w.moment[i, 0] > 0.0:  # else carved away and not seen again
                _refresh_cell(store, v, i, stamp, rules, w)
    for i in range(n):
        w.grid[w.code[i]] = -1


@kernel
def _refresh_cell(store: Store, v: int, i: int, stamp: int, rules: RefreshRules, w: RefreshSpace) -> None:
    """Place the vertex of the gathered cell ``i`` of voxel ``v``; let it begin or cease to live."""
    state, s, code = store.state, w.slot[i], w.code[i]
    if state[s] == CARVED and not is_seen_through(store.evidence[s]):
        state[s] = EVIDENCE_ONLY
    around = list_around(w.grid, code, w.around)
    _sum_around(w.moment, w.around, around, w.total)
    p = store.vertex[s]
    _fit_vertex(w.moment[i], w.total, w.wide, rules.plane_sigma_m, w.eigen, p)
    edge_m = 4 * rules.cell_m
    p[POSITION] += store.voxel[v, IX] * edge_m
    p[POSITION + 1] += store.voxel[v, IY] * edge_m
    p[POSITION + 2] += store.voxel[v, IZ] * edge_m
    apart = rules.min_distance_m
    if state[s] == ALIVE and _is_crowded(store, w, i, around, STAYS * apart):
        state[s] = EVIDENCE_ONLY
        _tell_neighbours(store, w.neighbour, code, AT_ONCE, stamp)
    elif (
        state[s] == EVIDENCE_ONLY and w.total[0] >= rules.least_evidence and _is_apart(w, i, around, p, apart)
    ):
        state[s] = ALIVE
        _tell_neighbours(store, w.neighbour, code, 1, stamp)
    _keep_place(store, s, w.place[i])


@kernel
def _move_moments(evidence: F32, s: int, code: int, cell_m: float, moment: F64, i: int) -> None:
    """Moments of a cell about the voxel's corner instead of the cell's centre: then sums are plain additions."""
    e = evidence[s]
    m = moment[i]
    k, ux, uy, uz = np.float64(e[COUNT]), np.float64(e[SUM]), np.float64(e[SUM + 1]), np.float64(e[SUM + 2])
    ox = ((code >> 10) - 11.5) * cell_m
    oy = (((code >> 5) & 31) - 11.5) * cell_m
    oz = ((code & 31) - 11.5) * cell_m
    m[0] = k
    m[1], m[2], m[3] = ux + k * ox, uy + k * oy, uz + k * oz
    m[4] = e[SQUARE] + 2.0 * ux * ox + k * ox * ox
    m[5] = e[SQUARE + 1] + ux * oy + uy * ox + k * ox * oy
    m[6] = e[SQUARE + 2] + ux * oz + uz * ox + k * ox * oz
    m[7] = e[SQUARE + 3] + 2.0 * uy * oy + k * oy * oy
    m[8] = e[SQUARE + 4] + uy * oz + uz * oy + k * oy * oz
    m[9] = e[SQUARE + 5] + 2.0 * uz * oz + k * oz * oz
    m[10], m[11], m[12] = e[VIEW], e[VIEW + 1], e[VIEW + 2]
    m[13] = e[HITS]


@kernel
def list_around(grid: I32, at: int, around: U32) -> int:
    """Local indices of the cells of the 3 x 3 x 3 around code ``at`` that hold something; how many.

    Each is written and kept if it is one: no branch for the processor to guess. ``around`` has room for one more.
    """
    n = 0
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                i = grid[np.uint32(at + (dx << 10) + (dy << 5) + dz)]
                around[n] = i
                n += i >= 0
    return n


@kernel
def _sum_around(moment: F64, around: U32, n: int, total: F64) -> None:
    """Moments of the ``n`` cells in ``around``; 16 columns of which 14 are used are whole cache lines."""
    for q in range(16):
        total[q] = 0.0
    for j in range(n):
        i = around[j]
        for q in range(16):
            total[q] += moment[i, q]


@kernel
def _plane(total: F64, eigen: F64) -> tuple[float, float, float]:
    """Mean of accumulated moments; ``eigen`` receives the normal and the eigenvalues of their covariance."""
    k = 1.0 / total[0]
    gx, gy, gz = total[1] * k, total[2] * k, total[3] * k
    smallest_eigen3(
        total[4] * k - gx * gx,
        total[5] * k - gx * gy,
        total[6] * k - gx * gz,
        total[7] * k - gy * gy,
        total[8] * k - gy * gz,
        total[9] * k - gz * gz,
        eigen,
    )
    return gx, gy, gz


@kernel
def _fit_wide(moment: F64, n: int, total: F64, eigen: F64, wide: F64) -> None:
    """Plane of the whole 6 x 6 x 6 cells into ``wide``."""
    for q in range(16):
        total[q] = 0.0
    for i in range(n):
        for q in range(16):
            total[q] += moment[i, q]
    if total[0] == 0.0:
        return
    wide[0], wide[1], wide[2] = _plane(total, eigen)
    wide[3], wide[4], wide[5] = eigen[0], eigen[1], eigen[2]
    wide[6], wide[7] = max(eigen[3], 0.0), max(eigen[4], 0.0)
    wide[8] = total[13] / total[0]


@kernel
def _turn_to_sensor(store: Store, cell_m: float, w: RefreshSpace) -> None:
    """Turn the normal of the wide plane to the side it was seen from.

    Seen at a grazing angle below what the noise tilts the plane, the side is a matter of luck; then the plane of
    the 3 x 3 x 3 voxels tells it, whose tilt is several times smaller.
    """
    wide, total = w.wide, w.total
    vx, vy, vz = total[10], total[11], total[12]
    length = math.sqrt(vx * vx + vy * vy + vz * vz) + 1e-12
    side = (wide[3] * vx + wide[4] * vy + wide[5] * vz) / length
    if abs(side) < GRAZING and wide[7] > 4.0 * wide[6]:
        evidence = total[0]
        _sum_layer(store, cell_m, w)
        if total[0] > evidence:
            _plane(total, w.eigen)
            along = wide[3] * w.eigen[0] + wide[4] * w.eigen[1] + wide[5] * w.eigen[2]
            side = along * (w.eigen[0] * vx + w.eigen[1] * vy + w.eigen[2] * vz)
        total[0] = evidence
    if side < 0.0:
        wide[3], wide[4], wide[5] = -wide[3], -wide[4], -wide[5]


@kernel
def _sum_layer(store: Store, cell_m: float, w: RefreshSpace) -> None:
    """Moments into ``total`` of all cells of the 3 x 3 x 3 voxels that lie on the wide plane, within a cell."""
    wide, own = w.wide, w.moment[216]
    for q in range(16):
        w.total[q] = 0.0
    for k in range(27):
        u = w.neighbour[k]
        if u < 0:
            continue
        mask = store.voxel_mask[u]
        while mask != 0:
            c = bs.lowest_bit(mask)
            mask &= mask - np.uint64(1)
            _move_moments(store.evidence, store.voxel_cell[u, c], code_in(k, c), cell_m, w.moment, 216)
            if own[0] > 0.0:
                dx, dy, dz = own[1] / own[0] - wide[0], own[2] / own[0] - wide[1], own[3] / own[0] - wide[2]
                if abs(dx * wide[3] + dy * wide[4] + dz * wide[5]) < cell_m:
                    for q in range(16):
                        w.total[q] += own[q]


@kernel
def _fit_vertex(own: F64, total: F64, wide: F64, plane_sigma_m: float, eigen: F64, p: F32) -> None:
    """Position, normal and roughness of one vertex, about the voxel's corner (E_geometry of eq. 2).

    Two supports are tried. Where the near cells (3) agree on a plane within sigma, the vertex goes onto it. Where
    they are too few or too noisy, but the wide support (1.5 voxels) is hardly thicker, the surface is a plane as
    far as the noise lets one see, and the vertex goes onto the wide plane, which averages over more points. Else
    (a crease, a bush) it goes onto the near plane only by the share sigma^2 / lambda_0, because there a plane
    would cut the corner (measured: ungated vertices are worse than raw ones at creases).
    """
    thick2 = THICK * plane_sigma_m * plane_sigma_m
    sigma2 = thick2 * total[13] / total[0]  # hits / evidence: the mean of 1 + (range / noise range)^2
    k = 1.0 / own[0]
    mx, my, mz = own[1] * k, own[2] * k, own[3] * k
    gx, gy, gz = _plane(total, eigen)
    nx, ny, nz = eigen[0], eigen[1], eigen[2]
    l0, l1 = max(eigen[3], 0.0), max(eigen[4], 0.0)
    # a plane: the points spread at least twice as far along it as across it
    flat = l1 > 4.0 * l0 and l1 > 1e-8
    share = 0.0
    if flat and l0 <= sigma2 and total[13] >= TRUSTED_COUNT:
        share = 1.0
    elif wide[7] > 4.0 * wide[6] and wide[6] <= thick2 * wide[8]:
        gx, gy, gz = wide[0], wide[1], wide[2]
        nx, ny, nz = wide[3], wide[4], wide[5]
        share = 1.0
    elif flat:
        share = min(1.0, sigma2 / max(l0, 1e-12))
    if share > 0.0:
        d = share * ((mx - gx) * nx + (my - gy) * ny + (mz - gz) * nz)
        mx, my, mz = mx - d * nx, my - d * ny, mz - d * nz
    elif l1 <= LAYERED * l0:
        nx, ny, nz = wide[3], wide[4], wide[5]
    vx, vy, vz = total[10], total[11], total[12]
    if share == 0.0 and l1 <= LAYERED * l0 and wide[7] <= LAYERED * wide[6]:
        # nothing like a plane: the best known direction is where it was seen from
        k = 1.0 / (math.sqrt(vx * vx + vy * vy + vz * vz) + 1e-12)
        nx, ny, nz = vx * k, vy * k, vz * k
    else:
        side = nx * vx + ny * vy + nz * vz
        along = nx * wide[3] + ny * wide[4] + nz * wide[5]
        grazing = side * side < GRAZING * GRAZING * (vx * vx + vy * vy + vz * vz)
        if grazing and wide[7] > 4.0 * wide[6] and abs(along) > SAME_PLANE:
            side = along
        if side < 0.0:
            nx, ny, nz = -nx, -ny, -nz
    p[POSITION], p[POSITION + 1], p[POSITION + 2] = mx, my, mz
    p[NORMAL], p[NORMAL + 1], p[NORMAL + 2] = nx, ny, nz
    p[ROUGHNESS] = math.sqrt(l0)


@kernel
def _tell_neighbours(store: Store, neighbour: I32, code: int, news: int, stamp: int) -> None:
    """A vertex began or ceased to live in the own cell ``code``: voxels that have it in their margin must know."""
    near = NEAR_VOXELS[code_cell(code)]
    while near != 0:
        u = neighbour[bs.lowest_bit(near)]
        near &= near - np.uint64(1)
        if u >= 0 and store.voxel[u, bs.AT_MESH] > 0:
            store.voxel[u, FRESH] += news
            bs.enqueue(store, u, stamp)


@kernel
def is_seen_through(e: F32) -> bool:
    """Whether the looks through a cell outweigh those that ended in it (visibility.py)."""
    return e[THROUGH] >= 2.0 and e[THROUGH] >= 0.3 * (e[THROUGH] + e[CONFIRMED] + 1.0)


@kernel
def _keep_place(store: Store, s: int, place: F32) -> None:
    """Where the vertex of cell ``s`` is, out of reach unless it is alive."""
    if store.state[s] == ALIVE:
        p = store.vertex[s]
        place[0], place[1], place[2] = p[POSITION], p[POSITION + 1], p[POSITION + 2]
    else:
        place[0] = np.inf


@kernel
def _is_crowded(store: Store, w: RefreshSpace, own: int, around: int, distance: float) -> bool:
    """Whether a living vertex with more evidence is nearer to that of the gathered cell ``own`` than ``distance``."""
    s, mine = w.slot[own], w.moment[own, 0]
    p = store.vertex[s]
    for j in range(around):
        i = w.around[j]
        if not _is_near(p, w.place[i], distance) or i == own or w.moment[i, 0] < mine:
            continue
        other = w.slot[i]
        if w.moment[i, 0] == mine and other > s:
            continue
        # where two objects meet, their vertices may
        if not are_two_objects(store.attribute[s], store.attribute[other]):
            return True
    return False


@kernel
def _is_apart(w: RefreshSpace, own: int, around: int, p: F32, distance: float) -> bool:
    """Whether no other living vertex is nearer to ``p``, that of the gathered cell ``own``, than ``distance``."""
    for j in range(around):  # noqa: SIM110 (kernels have no generators)
        if _is_near(p, w.place[w.around[j]], distance) and w.around[j] != own:
            return False
    return True


@kernel
def _is_near(p: F32, q: F32, distance: float) -> bool:
    return (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2 < distance * distance
