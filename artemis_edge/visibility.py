"""Free space: what a later scan looks through is not surface any more.

A vertex well in front of what a scan saw in its direction (range_cube.py) was looked through; one at that range
is confirmed. Both are counted, and the vertex is carved when looks through it outweigh the confirmations: a car
that drove on, a mixed point between two surfaces.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from artemis_edge import block_store as bs
from artemis_edge._jit import kernel
from artemis_edge.block_store import (
    ALIVE,
    CARVED,
    CARVED_CELLS,
    CONFIRMED,
    COUNT,
    FRESH,
    HITS,
    IX,
    IY,
    IZ,
    POSITION,
    SUM,
    THROUGH,
    Store,
)
from artemis_edge.class_rows import clear_class
from artemis_edge.config import VoxelMapConfig
from artemis_edge.frames import F32, F64, I32, I64, U8, DeskewedScan, TrackedFrame
from artemis_edge.range_cube import FAR, PIXELS, SPREAD, TILE, RangeCube, Rays, look_up, new_rays, pixel
from artemis_edge.voxel_map import AT_ONCE, VoxelMap, is_seen_through

EVERY = 2  # frames between two judgements; each takes every second block
# With the dynamic filter: earlier scans that look at what is there now, this many frames apart
LOOKS_BACK, APART = 5, 6
MOVED = 0.1  # share of the looks at a movable thing that must have gone through it
MOST_REMOVED = 1 << 20  # places of removed vertices that are remembered


class FreeSpace:
    """Judges the vertices around the sensor by what each scan looked through."""

    def __init__(self, config: VoxelMapConfig, voxel_map: VoxelMap) -> None:
        self._config = config
        self._map = voxel_map
        self._cube = RangeCube()
        self._rules = CarveRules(
            voxel_map.block_m, config.free_space_range_m, config.voxel_m, config.free_space_slope
        )
        self._candidates = new_candidates(MOST_REMOVED if config.dynamic_filter else 1)
        self._earlier: deque[View] = deque(maxlen=LOOKS_BACK)

    def carve(self, frame: TrackedFrame, stamp: int) -> int:
        """Count looks through and confirmations of a frame; returns how many vertices were carved."""
        gone = 0
        if self._config.free_space and stamp % EVERY == 0:
            for scan in frame.scans:
                self._cube.look(scan)
                view = self._view(frame, scan)
                gone += carve(self._map.store, view, self._rules, stamp, self._candidates)
                if self._config.dynamic_filter:
                    gone += self._look_back(view, stamp)
        return gone

    def _look_back(self, view: View, stamp: int) -> int:
        """What earlier scans looked through was not there then: it came since, so it can move.

        One of them a judgement, in turn, each with every second block as the scan itself.
        """
        gone, turn = 0, stamp // EVERY
        if self._earlier:
            earlier = self._earlier[(turn // 2) % len(self._earlier)]
            gone = carve(self._map.store, earlier, self._rules, stamp, self._candidates)
        if turn % (APART // EVERY) == 0:
            self._earlier.append(
                view._replace(range_m=view.range_m.copy(), farthest_m=view.farthest_m.copy())
            )
        return int(gone)

    def remove_movable(self, movable: U8, stamp: int) -> int:
        """Remove what clearly has one of the classes ``movable`` uint8 (CLASSES,) and was looked through at all.

        Of a house a stray look proves nothing; of a person it is enough. Returns how many vertices were removed.
        """
        store = self._map.store
        blocks = np.flatnonzero(store.block[: store.counter[bs.N_BLOCKS], bs.SEEN] >= 0).astype(np.int32)
        return int(remove_movable(store, blocks, movable, stamp, self._candidates))

    @property
    def removed(self) -> F32:
        """Where vertices were removed, float32 (n, 3) world, the first ``MOST_REMOVED``; with the dynamic filter."""
        count = min(int(self._candidates.number[0]), len(self._candidates.gone))
        return (
            self._candidates.gone[:count].copy()
            if self._config.dynamic_filter
            else np.empty((0, 3), np.float32)
        )

    def _view(self, frame: TrackedFrame, scan: DeskewedScan) -> View:
        R, t = frame.T_world_lidar[:3, :3], frame.T_world_lidar[:3, 3]
        centre, cube = R @ scan.origin + t, self._cube
        return View(np.ascontiguousarray(R.T), centre, cube.range_m.reshape(-1, PIXELS), cube.farthest_m)


class View(NamedTuple):
    """Where one scan was taken, and what it saw."""

    R_lidar_world: F64  # (3, 3)
    centre: F64  # (3,) of the scan's origin, world
    range_m: F32  # (6 * PIXELS, PIXELS)
    farthest_m: F32  # (6, TILES, TILES)


class CarveRules(NamedTuple):
    """How looks are judged; lengths in metres."""

    block_m: float
    reach_m: float
    margin_m: float
    slope: float


class Candidates(NamedTuple):
    """Scratch of ``carve``: the cells of one block."""

    corner_of: I32  # (512,) voxels
    corner: F64  # (512, 3) from the scan's origin, world axes [m]
    slot: I32  # (n,) cells
    voxel: I32  # (n,) of each cell
    place: (
        F32  # (3, n) of the cell's centre, then of its points' mean, from the scan's origin, world axes [m]
    )
    total: F32  # (3, n) sum over the cell's points from its centre [m]
    rays: Rays  # to the mean
    gone: F32  # (m, 3) places of the vertices removed so far
    number: I64  # (1,) how many


def new_candidates(remember: int = 1) -> Candidates:
    """Fresh scratch memory; the first ``remember`` places of removed vertices are kept."""
    n = 512 * 64
    return Candidates(
        corner_of=np.empty(512, np.int32),
        corner=np.empty((512, 3)),
        slot=np.empty(n, np.int32),
        voxel=np.empty(n, np.int32),
        place=np.empty((3, n), np.float32),
        total=np.empty((3, n), np.float32),
        rays=new_rays(n),
        gone=np.empty((remember, 3), np.float32),
        number=np.zeros(1, np.int64),
    )


@kernel
def carve(store: Store, view: View, rules: CarveRules, stamp: int, w: Candidates) -> int:
    """Judge the cells of the blocks around the sensor, every second block at a time.

    A cell whose points lie at range r was looked through when the range seen there exceeds r + margin + slope r;
    the margin is a voxel, the slope the error of a range image's pixel at grazing surfaces. Returns how many
    cells lost their evidence.
    """
    block_m, reach_m, o = rules.block_m, rules.reach_m, view.centre
    gone = 0
    for bx in range(math.floor((o[0] - reach_m) / block_m), math.floor((o[0] + reach_m) / block_m) + 1):
        for by in range(math.floor((o[1] - reach_m) / block_m), math.floor((o[1] + reach_m) / block_m) + 1):
            for bz in range(
                math.floor((o[2] - reach_m) / block_m), math.floor((o[2] + reach_m) / block_m) + 1
            ):
                if (bx + by + bz + stamp // EVERY) & 1:
                    continue
                block = bs.find_block(store, bx, by, bz)
                if block >= 0:
                    voxels = _list_voxels(store, block, view, rules, w)
                    n = _list_cells(store, voxels, block_m / 32.0, w)
                    _measure(store.evidence, n, view.R_lidar_world, w)
                    gone += _judge(store, n, view.range_m, rules, stamp, w)
    store.counter[CARVED_CELLS] += gone
    return gone


@kernel
def _list_voxels(store: Store, block: int, view: View, rules: CarveRules, w: Candidates) -> int:
    """Voxels of a block that the scan can say something about, and where their corners lie."""
    voxel_m, o, n = rules.block_m / bs.VOXELS_PER_BLOCK, view.centre, 0
    half = 0.5 * voxel_m
    for inner in range(512):
        v = store.block_voxel[block, inner]
        if v < 0:
            continue
        x = store.voxel[v, IX] * voxel_m - o[0]
        y = store.voxel[v, IY] * voxel_m - o[1]
        z = store.voxel[v, IZ] * voxel_m - o[2]
        if not _is_beyond(x + half, y + half, z + half, half, rules.margin_m, view):
            w.corner_of[n] = v
            w.corner[n, 0], w.corner[n, 1], w.corner[n, 2] = x, y, z
            n += 1
    return n


@kernel
def _list_cells(store: Store, voxels: int, cell_m: float, w: Candidates) -> int:
    """Cells of the listed voxels."""
    n = 0
    for i in range(voxels):
        v = w.corner_of[i]
        mask = store.voxel_mask[v]
        while mask != 0:
            c = bs.lowest_bit(mask)
            mask &= mask - np.uint64(1)
            w.slot[n] = store.voxel_cell[v, c]
            w.voxel[n] = v
            w.place[0, n] = w.corner[i, 0] + ((c >> 4) + 0.5) * cell_m
            w.place[1, n] = w.corner[i, 1] + (((c >> 2) & 3) + 0.5) * cell_m
            w.place[2, n] = w.corner[i, 2] + ((c & 3) + 0.5) * cell_m
            n += 1
    return n


@kernel
def _is_beyond(x: float, y: float, z: float, half: float, margin_m: float, view: View) -> bool:
    """Whether a voxel around x, y, z certainly lies behind all that was seen near it, or nothing was."""
    r = math.sqrt(x * x + y * y + z * z)
    radius = 1.75 * half  # a little more than the voxel's corners: its points were rounded
    if radius > r * SPREAD:
        return False
    R = view.R_lidar_world
    face, row, column = pixel(
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )
    farthest: float = view.farthest_m[face, row // TILE, column // TILE]
    return farthest <= max(r - radius - margin_m, 0.0)


@kernel
def _measure(evidence: F32, n: int, R: F64, w: Candidates) -> None:
    """Range and pixel of the mean of each cell's points: a vertex may not have been made of them yet."""
    for i in range(n):
        e = evidence[w.slot[i]]
        w.rays.range_m[i] = e[COUNT]
        for k in range(3):
            w.total[k, i] = e[SUM + k]
    for k in range(3):
        _add_means(w.rays.range_m[:n], w.total[k], w.place[k])
    for k in range(3):
        _turn(w.place, R[k], w.rays.way[k, :n])
    look_up(w.rays, n)


@kernel
def _add_means(count: F32, total: F32, place: F32) -> None:
    for i in range(count.shape[0]):
        place[i] += total[i] / count[i]  # a cell without evidence gives NaN, which has no pixel


@kernel
def _turn(place: F32, r: F64, out: F32) -> None:
    a, b, c = np.float32(r[0]), np.float32(r[1]), np.float32(r[2])
    for i in range(out.shape[0]):
        out[i] = a * place[0, i] + b * place[1, i] + c * place[2, i]


@kernel
def _judge(store: Store, n: int, range_m: F32, rules: CarveRules, stamp: int, w: Candidates) -> int:
    """Count the looks through each cell and at it; carve what they are too many for."""
    gone, last = 0, -1
    for i in range(n):
        at = w.rays.pixel[i]
        if at < 0:
            continue
        seen, r = range_m[at // PIXELS, at % PIXELS], w.rays.range_m[i]
        if seen <= r - rules.margin_m or seen >= FAR:
            continue
        s = w.slot[i]
        e = store.evidence[s]
        if seen <= r + rules.margin_m + rules.slope * r:
            e[CONFIRMED] += 1.0
            continue
        e[THROUGH] += 1.0
        if is_seen_through(e):
            if store.state[s] == ALIVE:
                _remember(store.vertex[s], w)
            if store.state[s] == ALIVE and w.voxel[i] != last:
                last = w.voxel[i]
                _remesh_around(store, last, stamp)
            _forget(store, s)
            gone += 1
    return gone


@kernel
def remove_movable(store: Store, blocks: I32, movable: U8, stamp: int, w: Candidates) -> int:
    """Kernel of :meth:`FreeSpace.remove_movable` for resident ``blocks``."""
    gone = 0
    for block in blocks:
        for inner in range(512):
            v = store.block_voxel[block, inner]
            if v < 0:
                continue
            before = gone
            mask = store.voxel_mask[v]
            while mask != 0:
                s = store.voxel_cell[v, bs.lowest_bit(mask)]
                mask &= mask - np.uint64(1)
                if store.state[s] == ALIVE and _has_moved(store.evidence[s], store.attribute[s], movable):
                    _remember(store.vertex[s], w)
                    _forget(store, s)
                    gone += 1
            if gone > before:
                _remesh_around(store, v, stamp)
    return gone


@kernel
def _has_moved(e: F32, attribute: F32, movable: U8) -> bool:
    klass = clear_class(attribute)
    return bool(
        klass >= 0
        and movable[klass]
        and e[THROUGH] >= 1.0
        and e[THROUGH] >= MOVED * (e[THROUGH] + e[CONFIRMED])
    )


@kernel
def _forget(store: Store, s: int) -> None:
    """A cell loses its vertex and its evidence, all but what was looked through it."""
    store.state[s] = CARVED
    store.evidence[s, HITS] = 0.0
    for k in range(COUNT, THROUGH):
        store.evidence[s, k] = 0.0


@kernel
def _remember(vertex: F32, w: Candidates) -> None:
    """Keep the place of a vertex that is removed."""
    at = w.number[0]
    if at < w.gone.shape[0]:
        for k in range(3):
            w.gone[at, k] = vertex[POSITION + k]
    w.number[0] += 1


@kernel
def _remesh_around(store: Store, v: int, stamp: int) -> None:
    """A vertex of ``v`` went: every patch that may use it is made anew."""
    x, y, z = store.voxel[v, 0], store.voxel[v, 1], store.voxel[v, 2]
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                block = bs.find_block(store, (x + dx) >> 3, (y + dy) >> 3, (z + dz) >> 3)
                if block >= 0:
                    u = store.block_voxel[block, bs.inner_index(x + dx, y + dy, z + dz)]
                    if u >= 0:
                        store.voxel[u, FRESH] += AT_ONCE
                        bs.enqueue(store, u, stamp)
