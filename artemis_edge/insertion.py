"""Adding a scan's points to the evidence of their cells.

Points are taken in chunks that stay in the processor's first cache, in three steps: arithmetic over columns, which
the compiler turns into vector instructions; the cell of each point; the sums. One step a loop lets the processor
wait for many cache misses at a time, which halves the cost per point.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from artemis_edge import block_store as bs
from artemis_edge._jit import kernel
from artemis_edge.block_store import (
    COUNT,
    FRESH,
    HITS,
    PENDING,
    REFUSED_POINTS,
    SEEN,
    TOUCHED,
    TOUCHED_BLOCKS,
    Store,
)
from artemis_edge.frames import F32, F64, I32

CHUNK = 256
# A cell with this much evidence no longer asks for re-meshing: its mean moves by less than sigma / 8
SETTLED_COUNT = 64.0
# Moments stop growing here, far below where float32 sums lose digits
SATURATED_COUNT = 1000.0
NOWHERE = -(2**30)


class InsertRules(NamedTuple):
    """Which points count and how much; lengths in metres."""

    cell_m: float
    min_range_m: float
    max_range_m: float
    noise_range_m: float
    trust: float  # share that each point counts: less where the frame's place is not sure


class Chunk(NamedTuple):
    """Scratch of ``insert_points``: columns of up to ``CHUNK`` points."""

    ray: F32  # (3, CHUNK) from the scan's origin to the point, lidar axes [m]
    weight: F32  # (CHUNK,) 0: out of range
    weight_per_m: F32  # (CHUNK,)
    cell: I32  # (3, CHUNK)
    offset: F32  # (3, CHUNK) from the cell's centre [m]
    sight: F32  # (3, CHUNK) weighted unit vector to the sensor, world axes
    voxel: I32  # (CHUNK,) slot
    slot: I32  # (CHUNK,) of the cell; -1: not added


def new_chunk() -> Chunk:
    """Fresh scratch memory."""
    return Chunk(
        ray=np.empty((3, CHUNK), np.float32),
        weight=np.empty(CHUNK, np.float32),
        weight_per_m=np.empty(CHUNK, np.float32),
        cell=np.empty((3, CHUNK), np.int32),
        offset=np.empty((3, CHUNK), np.float32),
        sight=np.empty((3, CHUNK), np.float32),
        voxel=np.empty(CHUNK, np.int32),
        slot=np.empty(CHUNK, np.int32),
    )


@kernel
def insert_points(
    store: Store,
    points: F32,
    T_world_lidar: F64,
    origin: F64,
    rules: InsertRules,
    stamp: int,
    touched: I32,
    n: int,
    w: Chunk,
) -> int:
    """Add points (n, 3) in the lidar frame to their cells; ``touched`` gets voxels first seen at ``stamp``.

    A point weighs 1 / (1 + (range / noise_range)^2): the inverse variance of a LiDAR whose error is a constant
    in range plus a constant in angle, relative to its variance at close range; times ``trust``. Returns the length of
    ``touched``; points that find the pool full are left out (the caller makes room and is told by the counters).
    """
    for start in range(0, points.shape[0], CHUNK):
        part = points[start : start + CHUNK]
        _locate(part, T_world_lidar, origin, rules, w)
        n = _find_cells(store, part.shape[0], stamp, touched, n, w)
        _accumulate(store, part.shape[0], np.float32(rules.trust), w)
    return n


@kernel
def _locate(points: F32, T: F64, origin: F64, rules: InsertRules, w: Chunk) -> None:
    """Cells, weights, offsets and lines of sight of a chunk's points."""
    n = points.shape[0]
    _rays(points, origin, w.ray)
    x, y, z = w.ray[0, :n], w.ray[1, :n], w.ray[2, :n]
    _weigh(x, y, z, rules, w.weight, w.weight_per_m)
    for k in range(3):
        r = T[k]
        start = r[0] * origin[0] + r[1] * origin[1] + r[2] * origin[2] + r[3]
        _along(x, y, z, r, start, rules.cell_m, w.cell[k], w.offset[k])
        _sight(x, y, z, r, w.weight_per_m, w.sight[k])


@kernel
def _rays(points: F32, origin: F64, ray: F32) -> None:
    x, y, z = np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2])
    for i in range(points.shape[0]):
        ray[0, i] = points[i, 0] - x
        ray[1, i] = points[i, 1] - y
        ray[2, i] = points[i, 2] - z


@kernel
def _weigh(x: F32, y: F32, z: F32, rules: InsertRules, weight: F32, weight_per_m: F32) -> None:
    """Weights of rays; 0 out of range and for what is no number."""
    nearest, farthest = np.float32(rules.min_range_m**2), np.float32(rules.max_range_m**2)
    k, one, none = np.float32(1.0 / rules.noise_range_m**2), np.float32(1.0), np.float32(0.0)
    trust = np.float32(rules.trust)
    for i in range(x.shape[0]):
        square = x[i] * x[i] + y[i] * y[i] + z[i] * z[i]
        of_range = trust / (one + square * k)
        weight[i] = of_range if (square >= nearest) & (square <= farthest) else none
        weight_per_m[i] = of_range / np.float32(math.sqrt(max(square, np.float32(1e-12))))


@kernel
def _along(x: F32, y: F32, z: F32, r: F64, start: float, cell_m: float, cell: I32, offset: F32) -> None:
    """One world axis of rays: the cell's coordinate and the place in the cell, from its centre."""
    inverse, r0, r1, r2 = 1.0 / cell_m, r[0], r[1], r[2]
    for i in range(x.shape[0]):
        p = start + r0 * np.float64(x[i]) + r1 * np.float64(y[i]) + r2 * np.float64(z[i])
        c = np.floor(p * inverse)
        cell[i] = np.int32(c)
        offset[i] = np.float32(p - (c + 0.5) * cell_m)


@kernel
def _sight(x: F32, y: F32, z: F32, r: F64, weight_per_m: F32, sight: F32) -> None:
    """One world axis of the weighted directions from points to the sensor."""
    r0, r1, r2 = np.float32(r[0]), np.float32(r[1]), np.float32(r[2])
    for i in range(x.shape[0]):
        sight[i] = -weight_per_m[i] * (r0 * x[i] + r1 * y[i] + r2 * z[i])


@kernel
def _find_cells(store: Store, n_points: int, stamp: int, touched: I32, n: int, w: Chunk) -> int:
    """Slots of the points' cells, made where there are none; returns the length of ``touched``."""
    last_x, last_y, last_z, v = NOWHERE, 0, 0, -1
    last_bx, last_by, last_bz, block = NOWHERE, 0, 0, -1
    for i in range(n_points):
        w.slot[i] = -1
        if w.weight[i] == 0.0:
            continue
        cx, cy, cz = w.cell[0, i], w.cell[1, i], w.cell[2, i]
        x, y, z = cx >> 2, cy >> 2, cz >> 2
        if x != last_x or y != last_y or z != last_z:
            last_x, last_y, last_z = x, y, z
            if x >> 3 != last_bx or y >> 3 != last_by or z >> 3 != last_bz:
                last_bx, last_by, last_bz = x >> 3, y >> 3, z >> 3
                block = _block_at(store, last_bx, last_by, last_bz, stamp)
            v = _voxel_at(store, block, x, y, z)
            if v >= 0 and store.voxel[v, TOUCHED] != stamp:
                store.voxel[v, TOUCHED] = stamp
                touched[n] = v
                n += 1
        w.voxel[i] = v
        if v >= 0:
            w.slot[i] = _cell_at(store, v, ((cx & 3) << 4) | ((cy & 3) << 2) | (cz & 3))
        if w.slot[i] < 0:
            store.counter[REFUSED_POINTS] += 1
    return n


@kernel
def _block_at(store: Store, bx: int, by: int, bz: int, stamp: int) -> int:
    """Slot of a block that receives points, or -1."""
    block: int = bs.find_or_add_block(store, bx, by, bz)
    if block >= 0 and store.block[block, SEEN] != stamp:
        store.block[block, SEEN] = stamp
        store.touched_block[store.counter[TOUCHED_BLOCKS]] = block
        store.counter[TOUCHED_BLOCKS] += 1
    return block


@kernel
def _voxel_at(store: Store, block: int, x: int, y: int, z: int) -> int:
    if block < 0:
        return -1
    inner = bs.inner_index(x, y, z)
    v: int = store.block_voxel[block, inner]
    if v < 0:
        v = bs.add_voxel(store, block, inner, x, y, z)
    return v


@kernel
def _cell_at(store: Store, v: int, c: int) -> int:
    s: int = store.voxel_cell[v, c]
    if s < 0:
        s = bs.add_cell(store, v, c)
        if s >= 0:
            store.voxel[v, FRESH] += 1
    return s


@kernel
def _accumulate(store: Store, n_points: int, trust: np.float32, w: Chunk) -> None:
    """Add the moments of the points about their cells' centres."""
    for i in range(n_points):
        s = w.slot[i]
        if s < 0 or store.evidence[s, COUNT] >= SATURATED_COUNT:
            continue
        e = store.evidence[s]
        if e[COUNT] < SETTLED_COUNT:
            store.voxel[w.voxel[i], PENDING] += 1
        k, x, y, z = w.weight[i], w.offset[0, i], w.offset[1, i], w.offset[2, i]
        kx, ky, kz = k * x, k * y, k * z
        e[HITS] += trust
        # COUNT, SUM, SQUARE and VIEW, read before they are written: then the compiler adds eight at a time
        e0, e1, e2, e3, e4, e5, e6 = (
            e[0] + k,
            e[1] + kx,
            e[2] + ky,
            e[3] + kz,
            e[4] + kx * x,
            e[5] + kx * y,
            e[6] + kx * z,
        )
        e7, e8, e9, e10, e11, e12 = (
            e[7] + ky * y,
            e[8] + ky * z,
            e[9] + kz * z,
            e[10] + w.sight[0, i],
            e[11] + w.sight[1, i],
            e[12] + w.sight[2, i],
        )
        e[0], e[1], e[2], e[3], e[4], e[5], e[6] = e0, e1, e2, e3, e4, e5, e6
        e[7], e[8], e[9], e[10], e[11], e[12] = e7, e8, e9, e10, e11, e12
