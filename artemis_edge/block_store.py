"""Arrays that hold the map, and the hash of blocks that finds things in them.

Space is cut into cells of edge ``r`` (the point spacing), voxels of 4 x 4 x 4 cells and blocks of 8 x 8 x 8
voxels. A block is found by an open-addressing hash of its int64 key; everything below it is direct indexing, so
cost per point does not grow with the map. All arrays are allocated once at the size the memory budget allows;
the operating system gives the pages when they are first touched.

One cell holds at most one vertex, so a vertex is named by its cell and keeps that name when its block goes to
disk and comes back.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_edge._jit import kernel
from artemis_edge.frames import F32, I32, I64, U8

CELLS_PER_VOXEL = 4  # along an edge: 64 cells are one uint64 mask
VOXELS_PER_BLOCK = 8
EMPTY_KEY = -(2**63) + 1

# Columns of Store.evidence: sums over the points of a cell, relative to the cell's centre [m]
COUNT, SUM, SQUARE, VIEW, THROUGH, CONFIRMED, HITS = 0, 1, 4, 10, 13, 14, 15
# Columns of Store.vertex
POSITION, NORMAL, ROUGHNESS = 0, 3, 6
# Columns of Store.attribute: mean colour (linear order red, green, blue, 0..255) and its information 1 / variance,
# then the log-probabilities lambda of the classes (eq. 12). A row of zeros is a vertex nobody has looked at
COLOUR, INFORMATION, LOG_CLASS = 0, 3, 4
CLASSES = 16  # background and 15 slots
# Columns of Store.voxel_class: class sums of eq. 1, then the accumulated weight W_sem of eq. 7
WEIGHT = CLASSES
# Columns of Store.voxel
# PENDING: hits since the last meshing; FRESH: new vertices since then; AT_MESH: hits the last meshing knew;
# QUEUED: stamp at which it began to wait for meshing, 0 when it does not
IX, IY, IZ, BLOCK, PENDING, FRESH, AT_MESH, PATCH_AT, PATCH_LEN, PATCH_ROOM, TOUCHED, QUEUED = range(12)
# Columns of Store.block
BX, BY, BZ, SEEN, CHANGED = range(5)
# Slots of Store.counter
N_BLOCKS, N_VOXELS, N_CELLS, N_TRIANGLES, FREE_BLOCKS, FREE_VOXELS, FREE_CELLS = range(7)
QUEUE_AT, QUEUE_LEN, REFUSED_POINTS, CARVED_CELLS, TOUCHED_BLOCKS = range(7, 12)

# Store.state: what a cell's vertex is
EVIDENCE_ONLY, ALIVE, CARVED = 0, 1, 2

# Of the pools, touched when they are allocated: a first touch of 2 MB inside a frame takes 0.3 to 6 ms
TOUCHED_SHARE = 0.1
PAGE_BYTES = 4096
PATCH_CLASSES = 8  # rooms of 8, 16, ... 1024 triangles
SMALLEST_ROOM = 8


class Store(NamedTuple):
    """The map's memory. A free slot of a pool is listed in its ``free_*`` stack."""

    hash_key: I64  # (h,)
    hash_slot: I32  # (h,)
    block: I32  # (b, 5)
    block_voxel: I32  # (b, 512) voxel slot or -1
    touched_block: I32  # (b,) blocks that received points in this frame
    voxel: I32  # (v, 12)
    voxel_mask: NDArray[np.uint64]  # (v,) which cells hold evidence
    voxel_cell: I32  # (v, 64) cell slot or -1
    voxel_class: F32  # (v, 0) or (v, 17) with classes
    evidence: F32  # (c, 16) one cache line
    vertex: F32  # (c, 8)
    attribute: F32  # (c, 0), (c, 4) with colours or (c, 20) with classes too
    state: U8  # (c,)
    triangle: NDArray[np.uint16]  # (t, 3) cell codes relative to the owning voxel
    queue: I32  # (v,) ring of voxels that wait for meshing
    counter: I64  # (12,)
    free_block: I32
    free_voxel: I32
    free_cell: I32
    free_patch: I32  # (PATCH_CLASSES, v)
    free_patches: I64  # (PATCH_CLASSES,)


def bytes_per_voxel(
    cells_per_voxel: float = 10.0, triangles_per_voxel: float = 24.0, attributes: int = 0
) -> float:
    """Memory of one occupied voxel with its cells and triangles [bytes].

    Ten cells and 24 triangle slots a voxel are what street and hall recordings fill (docs/tuning.md).
    """
    cell = 16 * 4 + 8 * 4 + attributes * 4 + 1 + 4
    return (
        class_columns(attributes) * 4
        + 64 * 4
        + 12 * 4
        + 8
        + 4
        + 4
        + PATCH_CLASSES * 4
        + cells_per_voxel * cell
        + triangles_per_voxel * 6
    )


def class_columns(attributes: int) -> int:
    """Columns of ``Store.voxel_class`` beside ``attributes`` columns of ``Store.attribute``."""
    return WEIGHT + 1 if attributes > LOG_CLASS else 0


def allocate(budget_bytes: float, attributes: int = 0) -> Store:
    """An empty map that can grow to ``budget_bytes``; ``attributes`` columns a vertex: 0, 4 or 20.

    ``TOUCHED_SHARE`` of it is resident from the start, so that no frame of the first minute waits for pages.
    """
    voxels = max(int(budget_bytes / bytes_per_voxel(attributes=attributes)), 4096)
    cells, triangles, blocks = voxels * 10, voxels * 24, max(voxels // 8, 512)
    slots = 1 << int(np.ceil(np.log2(2 * blocks)))
    store = Store(
        hash_key=np.full(slots, EMPTY_KEY, np.int64),
        hash_slot=np.zeros(slots, np.int32),
        block=np.empty((blocks, 5), np.int32),
        block_voxel=np.empty((blocks, 512), np.int32),
        touched_block=np.empty(blocks, np.int32),
        voxel=np.empty((voxels, 12), np.int32),
        voxel_mask=np.empty(voxels, np.uint64),
        voxel_cell=np.empty((voxels, 64), np.int32),
        voxel_class=np.zeros((voxels, class_columns(attributes)), np.float32),
        evidence=np.zeros((cells, 16), np.float32),
        vertex=np.zeros((cells, 8), np.float32),
        attribute=np.zeros((cells, attributes), np.float32),
        state=np.zeros(cells, np.uint8),
        triangle=np.empty((triangles, 3), np.uint16),
        queue=np.empty(voxels, np.int32),
        counter=np.zeros(12, np.int64),
        free_block=np.empty(blocks, np.int32),
        free_voxel=np.empty(voxels, np.int32),
        free_cell=np.empty(cells, np.int32),
        free_patch=np.empty((PATCH_CLASSES, voxels), np.int32),
        free_patches=np.zeros(PATCH_CLASSES, np.int64),
    )
    for pool in (
        store.voxel,
        store.voxel_cell,
        store.block_voxel,
        store.evidence,
        store.vertex,
        store.triangle,
    ):
        every_page = pool.reshape(-1).view(np.uint8)[: int(TOUCHED_SHARE * pool.nbytes) : PAGE_BYTES]
        every_page[:] = 0
    return store


@kernel
def block_key(bx: int, by: int, bz: int) -> int:
    """Key of a block: 21 bits an axis, enough for 3,000 km of 3.2 m blocks."""
    return ((int(bx) + 1048576) << 42) | ((int(by) + 1048576) << 21) | (int(bz) + 1048576)


@kernel
def home_slot(key: int, mask: int) -> int:
    """Where a key would like to be; Fibonacci hashing spreads keys that differ in few bits."""
    spread = (np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20)
    return int(np.int64(spread) & mask)


@kernel
def find_slot(hash_key: I64, key: int) -> int:
    """Place of ``key`` in the hash, or the empty place where it would go (linear probing)."""
    mask = hash_key.shape[0] - 1
    at = home_slot(key, mask)
    while hash_key[at] != EMPTY_KEY and hash_key[at] != key:
        at = (at + 1) & mask
    return at


@kernel
def find_block(store: Store, bx: int, by: int, bz: int) -> int:
    """Slot of a resident block or -1."""
    key = block_key(bx, by, bz)
    at = find_slot(store.hash_key, key)
    return store.hash_slot[at] if store.hash_key[at] == key else -1


@kernel
def find_or_add_block(store: Store, bx: int, by: int, bz: int) -> int:
    """Slot of a block, made resident and empty if it was not; -1 when the pool is full."""
    key = block_key(bx, by, bz)
    at = find_slot(store.hash_key, key)
    if store.hash_key[at] == key:
        return store.hash_slot[at]
    slot = _take(store.counter, store.free_block, FREE_BLOCKS, N_BLOCKS, store.block.shape[0])
    if slot < 0:
        return -1
    store.hash_key[at] = key
    store.hash_slot[at] = slot
    store.block[slot, BX] = bx
    store.block[slot, BY] = by
    store.block[slot, BZ] = bz
    store.block[slot, SEEN] = 0
    store.block[slot, CHANGED] = 0
    store.block_voxel[slot, :] = -1
    return slot


@kernel
def add_voxel(store: Store, block: int, inner: int, x: int, y: int, z: int) -> int:
    """A fresh voxel at place ``inner`` of a block; -1 when the pool is full."""
    v = _take(store.counter, store.free_voxel, FREE_VOXELS, N_VOXELS, store.voxel.shape[0])
    if v < 0:
        return -1
    store.block_voxel[block, inner] = v
    store.voxel[v, :] = 0
    store.voxel[v, IX] = x
    store.voxel[v, IY] = y
    store.voxel[v, IZ] = z
    store.voxel[v, BLOCK] = block
    store.voxel_mask[v] = 0
    store.voxel_cell[v, :] = -1
    store.voxel_class[v, :] = 0.0
    return v


@kernel
def add_cell(store: Store, v: int, c: int) -> int:
    """A fresh cell ``c`` of voxel ``v``; -1 when the pool is full. What is free in the pool is all zeros."""
    s = _take(store.counter, store.free_cell, FREE_CELLS, N_CELLS, store.evidence.shape[0])
    if s < 0:
        return -1
    store.voxel_cell[v, c] = s
    store.voxel_mask[v] |= np.uint64(1) << np.uint64(c)
    return s


@kernel
def inner_index(x: int, y: int, z: int) -> int:
    """Place of a voxel in its block."""
    return ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)


@kernel
def _take(counter: I64, free: I32, free_count: int, used: int, room: int) -> int:
    if counter[free_count] > 0:
        counter[free_count] -= 1
        return free[counter[free_count]]
    if counter[used] >= room:
        return -1
    counter[used] += 1
    return counter[used] - 1


@kernel
def lowest_bit(mask: int) -> int:
    """Place of the lowest set bit of a uint64 that is not 0.

    Counts the ones below it (Warren, Hacker's Delight, 5-1), which the compiler turns into one instruction.
    """
    x = (mask & (~mask + np.uint64(1))) - np.uint64(1)
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int(np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56)))


@kernel
def neighbours27(store: Store, v: int, out: I32) -> None:
    """Slots of the 3 x 3 x 3 voxels around ``v`` (x slowest, z fastest; itself at 13), -1 where none."""
    x, y, z = store.voxel[v, IX], store.voxel[v, IY], store.voxel[v, IZ]
    own = store.voxel[v, BLOCK]
    hx, hy, hz = x & 7, y & 7, z & 7
    k = 0
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                u, w, t = hx + dx, hy + dy, hz + dz
                if ((u | w | t) & ~7) == 0:
                    out[k] = store.block_voxel[own, (u << 6) | (w << 3) | t]
                else:
                    block = find_block(store, (x + dx) >> 3, (y + dy) >> 3, (z + dz) >> 3)
                    out[k] = -1 if block < 0 else store.block_voxel[block, inner_index(u, w, t)]
                k += 1


@kernel
def has_vertex(store: Store, v: int) -> bool:
    """Whether a voxel has a living vertex."""
    mask = store.voxel_mask[v]
    while mask != 0:
        if store.state[store.voxel_cell[v, lowest_bit(mask)]] == ALIVE:
            return True
        mask &= mask - np.uint64(1)
    return False


@kernel
def set_patch(store: Store, v: int, buffer: NDArray[np.uint16], n: int) -> bool:
    """Replace the triangles of a voxel; False (nothing changed) when the triangle pool is full."""
    room = store.voxel[v, PATCH_ROOM]
    if n > room:
        grade = 0
        while (SMALLEST_ROOM << grade) < n:
            grade += 1
        at = _take_patch(store, grade)
        if at < 0:
            return False
        release_patch(store, v)
        store.voxel[v, PATCH_AT] = at
        store.voxel[v, PATCH_ROOM] = SMALLEST_ROOM << grade
    at = store.voxel[v, PATCH_AT]
    for i in range(n):
        for k in range(3):
            store.triangle[at + i, k] = buffer[i, k]
    store.voxel[v, PATCH_LEN] = n
    return True


@kernel
def _take_patch(store: Store, grade: int) -> int:
    if store.free_patches[grade] > 0:
        store.free_patches[grade] -= 1
        return store.free_patch[grade, store.free_patches[grade]]
    at = store.counter[N_TRIANGLES]
    if at + (SMALLEST_ROOM << grade) > store.triangle.shape[0]:
        return -1
    store.counter[N_TRIANGLES] += SMALLEST_ROOM << grade
    return at


@kernel
def release_patch(store: Store, v: int) -> None:
    """Give the triangles of a voxel back to the pool."""
    room = store.voxel[v, PATCH_ROOM]
    if room > 0:
        grade = 0
        while (SMALLEST_ROOM << grade) < room:
            grade += 1
        store.free_patch[grade, store.free_patches[grade]] = store.voxel[v, PATCH_AT]
        store.free_patches[grade] += 1
    store.voxel[v, PATCH_ROOM] = 0
    store.voxel[v, PATCH_LEN] = 0


@kernel
def enqueue(store: Store, v: int, stamp: int) -> None:
    """Let a voxel wait for meshing, once."""
    if store.voxel[v, QUEUED] == 0:
        store.voxel[v, QUEUED] = stamp
        room = store.queue.shape[0]
        store.queue[(store.counter[QUEUE_AT] + store.counter[QUEUE_LEN]) % room] = v
        store.counter[QUEUE_LEN] += 1


@kernel
def dequeue(store: Store) -> int:
    """The voxel that waits longest, taken off the queue (its QUEUED stamp is left for the caller)."""
    v = store.queue[store.counter[QUEUE_AT]]
    store.counter[QUEUE_AT] = (store.counter[QUEUE_AT] + 1) % store.queue.shape[0]
    store.counter[QUEUE_LEN] -= 1
    return v


@kernel
def remove_block(store: Store, block: int) -> None:
    """Forget a block and give its memory back. None of its voxels may wait in the queue."""
    for inner in range(512):
        v = store.block_voxel[block, inner]
        if v < 0:
            continue
        release_patch(store, v)
        for c in range(64):
            s = store.voxel_cell[v, c]
            if s >= 0:
                store.evidence[s, :] = 0.0
                store.vertex[s, :] = 0.0
                store.attribute[s, :] = 0.0
                store.state[s] = EVIDENCE_ONLY
                store.free_cell[store.counter[FREE_CELLS]] = s
                store.counter[FREE_CELLS] += 1
        store.free_voxel[store.counter[FREE_VOXELS]] = v
        store.counter[FREE_VOXELS] += 1
    row = store.block[block]
    remove_key(
        store.hash_key, store.hash_slot, find_slot(store.hash_key, block_key(row[BX], row[BY], row[BZ]))
    )
    store.block[block, SEEN] = -1
    store.block[block, CHANGED] = 0
    store.free_block[store.counter[FREE_BLOCKS]] = block
    store.counter[FREE_BLOCKS] += 1


@kernel
def remove_key(hash_key: I64, hash_slot: I32, hole: int) -> None:
    """Empty a place and move later keys of the run back (Knuth 6.4, algorithm R)."""
    mask = hash_key.shape[0] - 1
    at = hole
    while True:
        hash_key[hole] = EMPTY_KEY
        while True:
            at = (at + 1) & mask
            key = hash_key[at]
            if key == EMPTY_KEY:
                return
            home = home_slot(key, mask)
            if ((at - home) & mask) >= ((at - hole) & mask):
                break
        hash_key[hole] = hash_key[at]
        hash_slot[hole] = hash_slot[at]
        hole = at
