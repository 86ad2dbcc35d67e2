"""Section III-B, eqs 2 to 8: the unified energy, minimised by nonlinear Gauss-Seidel on the active vertices.

    E_total = E_geometry + lambda_sem E_semantic + lambda_smooth E_smoothness                               (2)

Active are the vertices of the voxels that were just meshed: their positions come fresh from the evidence, and what
is computed here is what stays until their evidence changes. N(v_i) are the living vertices of the cells around
v_i's own, which are those that the triangulation connects it with. docs/semantics.md says how every point that the
paper leaves open is resolved.

E_smoothness and E_geometry move a vertex along its normal and turn the normal. E_semantic has its least value where
no edge joins two objects: the triangulation keeps none (``mesher.py`` triangulates objects apart), and here the
vertices on both sides slide in their surfaces towards where these meet, by at most half the point spacing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from artemis_edge import block_store as bs
from artemis_edge._jit import kernel
from artemis_edge.block_store import (
    ALIVE,
    BLOCK,
    CHANGED,
    CLASSES,
    FRESH,
    LOG_CLASS,
    NORMAL,
    POSITION,
    ROUGHNESS,
    WEIGHT,
    Store,
)
from artemis_edge.cell_code import CODES, OWN, cells_within, code_of, code_voxel, gather_cells
from artemis_edge.class_rows import clear_class
from artemis_edge.config import SemanticsConfig
from artemis_edge.frames import F32, F64, I32, U8, U32
from artemis_edge.paging import resident_blocks
from artemis_edge.refinement.semantics import probabilities
from artemis_edge.voxel_map import AT_ONCE

MARGIN = 1  # cells around a voxel in which neighbours are looked for
# A clear class (class_rows.py) is an object's own, as far as triangles are concerned, when its voxel is so confident
# (eq. 7)
CONFIDENT_XI = 0.5
# Neighbours whose normals differ more do not lie on one surface, whatever their class (cosine)
ONE_SURFACE = 0.9
# Cosine between normals above which two surfaces continue each other, so that they meet half-way
COPLANAR = 0.9
# Bits of a code in which all own cells agree (cell_code.py)
_FIRST, _NOT_OWN = code_of(OWN, OWN, OWN), ~code_of(3, 3, 3)


class Energy(NamedTuple):
    """The constants of eqs 2 to 8; lengths in metres."""

    lambda_sem: float
    lambda_smooth: float
    tau: float  # eq. 5
    rate: float  # lambda of eq. 7
    sim: bool  # eq. 5; False: sim = 1
    spacing_m: float  # r: unit of the edge lengths L
    sigma_m: float  # noise of the evidence along the normal: scale of E_geometry


class Space(NamedTuple):
    """Scratch: the cells of a voxel and its margin."""

    neighbour: I32  # (27,)
    grid: I32  # (CODES,) slot, then row; -1 where nothing
    code: U32  # (1728,)


class Rows(NamedTuple):
    """The living vertices of a batch's voxels and their margins, each once: what is known of them does not change
    while they move."""

    of: I32  # (cells,) row + 1 of a cell's vertex, 0 where it has none
    slot: U32  # (n,)
    P: F32  # (n, CLASSES) P_sem
    best: I32  # (n,) most probable class
    certain: I32  # (n,) class that it certainly has, -1 where none
    entropy: F64  # (n,)
    xi: F64  # (n,) semantic confidence, eq. 7


class Own(NamedTuple):
    """The vertices of the batch's voxels, which move, and N(v_i) of each."""

    row: U32  # (m,)
    voxel: U32  # (m,) slot
    anchor: F32  # (m, 8) where the evidence puts it
    start: U32  # (m + 1,) its neighbours are those from start[i] to start[i + 1]
    other: U32  # (e,) row of a neighbour
    sim: F64  # (e,) sim_semantic with it (eq. 5); -1 until it is needed


def new_space() -> Space:
    """Fresh scratch memory."""
    return Space(np.empty(27, np.int32), np.full(CODES, -1, np.int32), np.empty(1728, np.uint32))


def new_rows(of: I32, room: int) -> Rows:
    """Memory for ``room`` rows."""
    return Rows(
        of,
        np.empty(room, np.uint32),
        np.empty((room, CLASSES), np.float32),
        np.empty(room, np.int32),
        np.empty(room, np.int32),
        np.empty(room),
        np.empty(room),
    )


def new_own(room: int) -> Own:
    """Memory for ``room`` vertices with 26 neighbours each."""
    return Own(
        np.empty(room, np.uint32),
        np.empty(room, np.uint32),
        np.empty((room, 8), np.float32),
        np.empty(room + 1, np.uint32),
        np.empty(26 * room + 1, np.uint32),  # one more: written before it is known whether it stays
        np.empty(26 * room),
    )


class SemanticConstraint:
    """Minimises the energy over batches of voxels; ``active`` uint8 (CLASSES,) are the slots in use."""

    def __init__(
        self, config: SemanticsConfig, store: Store, cell_m: float, sigma_m: float, active: U8
    ) -> None:
        self._store, self._active, self._sweeps = store, active, config.sweeps
        self.most_sweeps = config.sweeps  # the overload control lowers it
        self.energy = Energy(
            config.lambda_sem,
            config.lambda_smooth,
            config.temperature,
            config.confidence_rate,
            config.sim_semantic,
            cell_m,
            sigma_m,
        )
        self._space = new_space()
        self._rows = new_rows(np.zeros(len(store.state), np.int32), 4096)
        self._own = new_own(1024)

    @property
    def telling_apart(self) -> float:
        """lambda of eq. 7 for the triangulation; 0 where E_semantic has no weight."""
        return self.energy.rate if self.energy.lambda_sem > 0.0 else 0.0

    def unsettle(self, stamp: int) -> None:
        """Let all voxels where objects meet be placed and meshed once more: classes have become surer since."""
        if self.telling_apart > 0.0:
            blocks = np.empty(len(self._store.block), np.int32)
            blocks = blocks[: resident_blocks(self._store, blocks)]
            wake_borders(
                self._store,
                np.sort(blocks),
                self.energy.rate,
                stamp,
                np.empty(27, np.int32),
                np.zeros(len(self._store.voxel), np.int32),
            )

    def settle(self, batch: I32, stamp: int) -> None:
        """Move the vertices of the voxels ``batch``, which were just placed by their evidence.

        Nothing moves while no class is asked for.
        """
        if not self._active[1:].any():
            return
        store, w = self._store, self._space
        own, cells = count_cells(store, batch, w.neighbour)
        if cells > len(self._rows.slot):
            self._rows = new_rows(self._rows.of, 2 * cells)
        if own > len(self._own.row):
            self._own = new_own(2 * own)
        rows, mine = self._rows, self._own
        known, n = gather(store, batch, self.energy, self._active, w, rows, mine)
        for _ in range(min(self._sweeps, self.most_sweeps)):
            sweep(store, n, self.energy, rows, mine)
        if self.energy.lambda_sem > 0.0:
            slide(store, n, self.energy, rows, mine)
        rows.of[rows.slot[:known]] = 0


@kernel
def count_cells(store: Store, batch: I32, neighbour: I32) -> tuple[int, int]:
    """Most vertices that the voxels can have, and with their margins; ``neighbour`` int32 (27,) is scratch."""
    own = cells = 0
    for v in batch:
        own += cells_within(store, v, MARGIN, 13)
        bs.neighbours27(store, v, neighbour)
        for k in range(27):
            if neighbour[k] >= 0:
                cells += cells_within(store, neighbour[k], MARGIN, k)
    return own, cells


@kernel
def gather(
    store: Store, batch: I32, energy: Energy, active: U8, w: Space, rows: Rows, own: Own
) -> tuple[int, int]:
    """List the living vertices of the voxels and their margins; how many ``rows``, and how many move."""
    known = n = edges = 0
    for v in batch:
        if not bs.has_vertex(store, v):
            continue
        bs.neighbours27(store, v, w.neighbour)
        cells = gather_cells(store, w.neighbour, MARGIN, w.grid, w.code)
        known = _number(store, cells, energy, active, w, rows, known)
        for i in range(cells):
            code = np.int64(w.code[i])
            if ((code ^ _FIRST) & _NOT_OWN) != 0:
                break  # own cells come first
            row = w.grid[code]
            if row < 0:
                continue
            own.row[n], own.voxel[n], own.start[n] = row, v, edges
            for q in range(8):
                own.anchor[n, q] = store.vertex[rows.slot[row], q]
            edges = _list_neighbours(w.grid, code, row, own.other, edges)
            n += 1
        for i in range(cells):
            w.grid[w.code[i]] = -1
    own.start[n] = edges
    own.sim[:edges] = -1.0
    return known, n


@kernel
def _number(store: Store, cells: int, energy: Energy, active: U8, w: Space, rows: Rows, known: int) -> int:
    """Put the row of each gathered cell's vertex into the grid, -1 where none lives; new ones are described."""
    for i in range(cells):
        code = np.int64(w.code[i])
        s = w.grid[code]
        if store.state[s] != ALIVE:
            w.grid[code] = -1
            continue
        if rows.of[s] == 0:
            weight = store.voxel_class[w.neighbour[code_voxel(code)], WEIGHT]
            rows.slot[known] = s
            rows.best[known] = probabilities(store.attribute[s, LOG_CLASS:], active, rows.P[known])
            rows.certain[known] = confident_class(store.attribute[s], weight, energy.rate)
            rows.entropy[known] = entropy(rows.P[known])
            rows.xi[known] = 1.0 - math.exp(-energy.rate * weight)  # eq. 7
            known += 1
            rows.of[s] = known
        w.grid[code] = rows.of[s] - 1
    return known


@kernel
def _list_neighbours(grid: I32, code: int, row: int, other: U32, n: int) -> int:
    """Append the rows of the 3 x 3 x 3 cells around ``code`` but its own."""
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                j = grid[np.uint32(code + (dx << 10) + (dy << 5) + dz)]
                other[n] = j
                n += (j >= 0) & (j != row)
    return n


@kernel
def entropy(P: F32) -> float:
    """-sum P log P."""
    total = 0.0
    for c in range(CLASSES):
        if P[c] > 0.0:
            total -= P[c] * math.log(P[c])
    return total


@kernel
def jensen_shannon(P: F32, Q: F32, entropy_P: float, entropy_Q: float) -> float:
    """JS divergence 0..ln 2 of eq. 3: H((P + Q) / 2) - (H(P) + H(Q)) / 2."""
    mixed = 0.0
    for c in range(CLASSES):
        m = 0.5 * (P[c] + Q[c])
        if m > 0.0:
            mixed -= m * math.log(m)
    return max(mixed - 0.5 * (entropy_P + entropy_Q), 0.0)


@kernel
def similarity(i: int, j: int, energy: Energy, rows: Rows) -> float:
    """sim_semantic of eq. 5.

    What is known of a vertex counts by its confidence: between vertices of which nothing is known there is no
    boundary.
    """
    if not energy.sim:
        return 1.0
    sure = 0.99
    best = rows.best[i]
    if best == rows.best[j] and rows.P[i, best] > sure and rows.P[j, best] > sure:
        return 1.0
    js = jensen_shannon(rows.P[i], rows.P[j], rows.entropy[i], rows.entropy[j])
    return math.exp(-energy.tau * math.sqrt(rows.xi[i] * rows.xi[j] * js))


@kernel
def sweep(store: Store, n: int, energy: Energy, rows: Rows, own: Own) -> None:
    """One Gauss-Seidel sweep: each of the ``n`` vertices takes the least energy given the others as they are now."""
    for i in range(n):
        _relax(store, i, energy, rows, own)


@kernel
def _relax(store: Store, i: int, energy: Energy, rows: Rows, own: Own) -> None:
    """Turn the normal of vertex ``i`` to the least of E_smoothness, then move it along it to the least of E_total."""
    p, start = store.vertex[rows.slot[own.row[i]]], own.anchor[i]
    nx, ny, nz = np.float64(start[NORMAL]), np.float64(start[NORMAL + 1]), np.float64(start[NORMAL + 2])
    ax, ay, az = np.float64(start[POSITION]), np.float64(start[POSITION + 1]), np.float64(start[POSITION + 2])
    # evidence that does not lie on a plane says less about where the surface is and which way it faces
    sigma2 = energy.sigma_m * energy.sigma_m
    trust = sigma2 / (sigma2 + start[ROUGHNESS] * start[ROUGHNESS])
    mx, my, mz = trust * nx, trust * ny, trust * nz
    top = bottom = 0.0
    for e in range(own.start[i], own.start[i + 1]):
        q = store.vertex[rows.slot[own.other[e]]]
        gx, gy, gz = np.float64(q[NORMAL]), np.float64(q[NORMAL + 1]), np.float64(q[NORMAL + 2])
        if p[NORMAL] * gx + p[NORMAL + 1] * gy + p[NORMAL + 2] * gz < ONE_SURFACE:
            continue
        ex, ey, ez = ax - q[POSITION], ay - q[POSITION + 1], az - q[POSITION + 2]
        length = max(math.sqrt(ex * ex + ey * ey + ez * ez), 0.1 * energy.spacing_m)
        w_geo = energy.spacing_m / length
        if own.sim[e] < 0.0:
            own.sim[e] = similarity(own.row[i], own.other[e], energy, rows)
        w_smooth = energy.lambda_smooth * own.sim[e] * w_geo  # eq. 8
        mx, my, mz = mx + w_smooth * gx, my + w_smooth * gy, mz + w_smooth * gz
        across = nx * gx + ny * gy + nz * gz
        top += w_smooth * (ex * gx + ey * gy + ez * gz) * across
        bottom += w_smooth * across * across
    length = math.sqrt(mx * mx + my * my + mz * mz)
    if length > 1e-9:
        p[NORMAL], p[NORMAL + 1], p[NORMAL + 2] = mx / length, my / length, mz / length
    if bottom == 0.0:
        return
    step = -top / (trust + bottom)
    step = max(min(step, energy.sigma_m), -energy.sigma_m)
    p[POSITION], p[POSITION + 1], p[POSITION + 2] = ax + step * nx, ay + step * ny, az + step * nz


@kernel
def confident_class(attribute: F32, weight: float, rate: float) -> int:
    """The class a vertex certainly has, -1 where none: clear of all others (log), its voxel confident (eq. 7)."""
    if weight <= 0.0 or 1.0 - math.exp(-rate * weight) < CONFIDENT_XI:
        return -1
    return int(clear_class(attribute))


@kernel
def wake_borders(store: Store, blocks: I32, rate: float, stamp: int, neighbour: I32, kinds: I32) -> None:
    """Enqueue the voxels of ``blocks`` that, with their neighbours, hold vertices certain of different classes.

    ``neighbour`` int32 (27,) and ``kinds`` int32 (voxels,) are scratch.
    """
    for block in blocks:
        for inner in range(512):
            v = store.block_voxel[block, inner]
            if v >= 0:
                kinds[v] = classes_in(store, v, rate)
    for block in blocks:
        for inner in range(512):
            v = store.block_voxel[block, inner]
            if v < 0 or kinds[v] == 0:
                continue
            bs.neighbours27(store, v, neighbour)
            together = 0
            for u in neighbour:
                together |= kinds[u] if u >= 0 else 0
            if together & (together - 1) != 0:
                store.voxel[v, FRESH] += AT_ONCE
                bs.enqueue(store, v, stamp)


@kernel
def classes_in(store: Store, v: int, rate: float) -> int:
    """The certain classes of a voxel's vertices as bits."""
    bits = 0
    for c in range(64):
        s = store.voxel_cell[v, c]
        if s >= 0 and store.state[s] == ALIVE:
            k = confident_class(store.attribute[s], store.voxel_class[v, WEIGHT], rate)
            bits |= 1 << k if k >= 0 else 0
    return bits


@kernel
def slide(store: Store, n: int, energy: Energy, rows: Rows, own: Own) -> None:
    """Tangential motion under E_semantic: vertices beside another object go to where the two surfaces meet."""
    for i in range(n):
        if rows.certain[own.row[i]] >= 0 and _slide_one(store, i, energy, rows, own):
            block = store.voxel[own.voxel[i], BLOCK]
            store.block[block, CHANGED] = max(store.block[block, CHANGED], 1)


@kernel
def _slide_one(store: Store, i: int, energy: Energy, rows: Rows, own: Own) -> bool:
    """The mean of the ways to where the surface of vertex ``i`` meets those of other objects beside it."""
    row = own.row[i]
    p = store.vertex[rows.slot[row]]
    nx, ny, nz = np.float64(p[NORMAL]), np.float64(p[NORMAL + 1]), np.float64(p[NORMAL + 2])
    sx = sy = sz = total = 0.0
    for k in range(own.start[i], own.start[i + 1]):
        j = own.other[k]
        if rows.certain[j] < 0 or rows.certain[j] == rows.certain[row]:
            continue
        q = store.vertex[rows.slot[j]]
        ex, ey, ez = (
            np.float64(q[POSITION]) - p[POSITION],
            np.float64(q[POSITION + 1]) - p[POSITION + 1],
            np.float64(q[POSITION + 2]) - p[POSITION + 2],
        )
        away = ex * nx + ey * ny + ez * nz
        tx, ty, tz = ex - away * nx, ey - away * ny, ez - away * nz
        length = math.sqrt(tx * tx + ty * ty + tz * tz)
        if length < 1e-6:
            continue
        gx, gy, gz = np.float64(q[NORMAL]), np.float64(q[NORMAL + 1]), np.float64(q[NORMAL + 2])
        share = _meeting(nx * gx + ny * gy + nz * gz, ex, ey, ez, gx, gy, gz, tx, ty, tz)
        weight = energy.lambda_sem * rows.xi[row] * rows.xi[j] * energy.spacing_m / length  # eq. 6
        sx, sy, sz = sx + weight * share * tx, sy + weight * share * ty, sz + weight * share * tz
        total += weight
    if total == 0.0:
        return False
    sx, sy, sz = sx / total, sy / total, sz / total
    length = math.sqrt(sx * sx + sy * sy + sz * sz)
    if length < 1e-6:
        return False
    step = min(1.0, 0.5 * energy.spacing_m / length)
    p[POSITION] += step * sx
    p[POSITION + 1] += step * sy
    p[POSITION + 2] += step * sz
    return True


@kernel
def _meeting(
    cosine: float,
    ex: float,
    ey: float,
    ez: float,
    gx: float,
    gy: float,
    gz: float,
    tx: float,
    ty: float,
    tz: float,
) -> float:
    """Share 0..1 of the way t in one surface towards the other's vertex (at e, normal g) at which the two meet."""
    if abs(cosine) > COPLANAR:
        return 0.5
    along = tx * gx + ty * gy + tz * gz
    if abs(along) < 1e-9:
        return 0.5
    return min(max((ex * gx + ey * gy + ez * gz) / along, 0.0), 1.0)
