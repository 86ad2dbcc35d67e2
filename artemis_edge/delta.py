"""Mesh deltas: which blocks changed, as arrays a viewer or an exporter can take."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from artemis_edge._jit import kernel
from artemis_edge.block_store import (
    ALIVE,
    BX,
    CHANGED,
    CLASSES,
    COLOUR,
    COUNT,
    INFORMATION,
    IX,
    IY,
    IZ,
    LOG_CLASS,
    N_BLOCKS,
    NORMAL,
    PATCH_AT,
    PATCH_LEN,
    POSITION,
    Store,
    block_key,
    lowest_bit,
)
from artemis_edge.frames import F32, I32, I64, U8, MeshDelta
from artemis_edge.paging import EAR_MASK

# Blocks told a frame at most: the pipeline's time stays bounded. What waits is told in its newest state
MOST_BLOCKS = 24
# Frames until a block that goes on changing is told again: a viewer redraws it a few times a second, not ten
AGAIN_AFTER = 5
GREY = 180  # of a vertex no camera has seen


def confidence(evidence: F32) -> F32:
    """How sure a vertex is, float32 (n,) 0..1: 1 - exp(-hits / 4), so 0.22 for one hit and 0.98 for sixteen."""
    return sureness(evidence[:, COUNT].copy())


def sureness(hits: F32) -> F32:
    """``confidence`` of weighted hits, in their place."""
    np.multiply(hits, np.float32(-0.25), out=hits)
    return np.negative(np.expm1(hits, out=hits), out=hits)


class Listing(NamedTuple):
    """What blocks hold, listed before it is copied; scratch memory as long as the pools.

    A list a loop lets the processor wait for many cache misses at a time: four times as fast as one loop for all.
    """

    voxel: I32  # slots
    cell: I32  # slots of cells, then of living vertices
    name: I64  # of cells, then of living vertices


def new_listing(store: Store) -> Listing:
    """Fresh scratch; its memory is touched only as far as the largest delta needs."""
    return Listing(
        voxel=np.empty(
            len(store.voxel) + 1, np.int32
        ),  # one more: written before it is known whether it stays
        cell=np.empty(len(store.state), np.int32),
        name=np.empty(len(store.state), np.int64),
    )


@kernel
def list_voxels(store: Store, slots: I32, voxel: I32, start: I64) -> None:
    """Voxels of blocks; those of block k are ``voxel[start[k] : start[k + 1]]``."""
    n = 0
    for k in range(slots.shape[0]):
        start[k] = n
        for inner in range(512):
            voxel[n] = store.block_voxel[slots[k], inner]
            n += voxel[n] >= 0
    start[slots.shape[0]] = n


@kernel
def list_cells(store: Store, w: Listing, voxel_start: I64, start: I64) -> None:
    """Cells of the listed voxels, by block as in ``list_voxels``; and their names.

    A vertex is named by its cell as a block is by its place: see ``paging.Page.vertex_ids``.
    """
    n = 0
    for k in range(start.shape[0] - 1):
        start[k] = n
        for v in w.voxel[voxel_start[k] : voxel_start[k + 1]]:
            corner = _corner_name(store, v)
            mask = store.voxel_mask[v]
            while mask != 0:
                c = lowest_bit(mask)
                mask &= mask - np.uint64(1)
                w.cell[n] = store.voxel_cell[v, c]
                w.name[n] = corner + ((c >> 4) << 42) + (((c >> 2) & 3) << 21) + (c & 3)
                n += 1
    start[start.shape[0] - 1] = n


@kernel
def keep_living(store: Store, w: Listing, start: I64) -> None:
    """Close up the listed cells to those that are living vertices; ``start`` follows."""
    n, begin = 0, start[0]
    for k in range(start.shape[0] - 1):
        end = start[k + 1]
        for i in range(begin, end):
            s, name = w.cell[i], w.name[i]
            w.cell[n], w.name[n] = s, name
            n += store.state[s] == ALIVE
        begin = end
        start[k + 1] = n


@kernel
def count_triangles(store: Store, voxel: I32, voxel_start: I64, start: I64) -> None:
    """Where each block's triangles begin."""
    start[0] = 0
    for k in range(start.shape[0] - 1):
        start[k + 1] = start[k]
        for v in voxel[voxel_start[k] : voxel_start[k + 1]]:
            start[k + 1] += store.voxel[v, PATCH_LEN]


@kernel
def _corner_name(store: Store, v: int) -> int:
    """Name of a voxel's first cell; to a name, cells in x, y and z add 2^42, 2^21 and 1."""
    return block_key(store.voxel[v, IX] * 4, store.voxel[v, IY] * 4, store.voxel[v, IZ] * 4)


@kernel
def copy_vertices(store: Store, cells: I32, position: F32, normal: F32, hits: F32) -> None:
    """Position, normal and evidence of the vertices in ``cells``."""
    for i in range(cells.shape[0]):
        s = cells[i]
        for k in range(3):
            position[i, k] = store.vertex[s, POSITION + k]
            normal[i, k] = store.vertex[s, NORMAL + k]
    for i in range(cells.shape[0]):
        hits[i] = store.evidence[cells[i], COUNT]


@kernel
def read_colours(store: Store, cells: I32, colour: U8) -> None:
    """Mean colours of the vertices in ``cells``, GREY where no camera has seen them."""
    known = store.attribute.shape[1] > INFORMATION
    for i in range(cells.shape[0]):
        for k in range(3):
            colour[i, k] = GREY
            if known and store.attribute[cells[i], INFORMATION] > 0.0:
                colour[i, k] = int(min(max(store.attribute[cells[i], COLOUR + k] + 0.5, 0.0), 255.0))


@kernel
def copy_triangles(store: Store, voxels: I32, triangles: I64) -> None:
    """Vertex names of the triangles of ``voxels``, (t, 3)."""
    j = 0
    for v in voxels:
        corner = _corner_name(store, v) - block_key(12, 12, 12) + block_key(0, 0, 0)
        at = store.voxel[v, PATCH_AT]
        for t in range(at, at + store.voxel[v, PATCH_LEN]):
            for k in range(3):
                code = np.int64(store.triangle[t, k]) & EAR_MASK
                triangles[j, k] = corner + ((code >> 10) << 42) + (((code >> 5) & 31) << 21) + (code & 31)
            j += 1


@kernel
def copy_labels(store: Store, cells: I32, active: U8, label: U8, probability: U8) -> None:
    """Most probable class of the vertices in ``cells`` and its probability; 0 where no image saw them or none is there.

    The softmax is over the ``active`` slots: others would be background once more.
    """
    for i in range(cells.shape[0]):
        row = store.attribute[cells[i]]
        best = 0
        for c in range(1, CLASSES):
            if row[LOG_CLASS + c] > row[LOG_CLASS + best]:
                best = c
        label[i] = best
        probability[i] = 0
        if best > 0:
            total = 0.0
            for c in range(CLASSES):
                if active[c]:
                    total += math.exp(row[LOG_CLASS + c] - row[LOG_CLASS + best])
            probability[i] = int(255.0 / max(total, 1.0) + 0.5)


class Outbox:
    """Hands out the blocks that changed; ``active`` uint8 (CLASSES,) are the slots in use, None without classes."""

    def __init__(self, store: Store, active: U8 | None = None) -> None:
        self._store = store
        self._active = active
        self._listing = new_listing(store)
        self._turn = AGAIN_AFTER
        # By slot: turn when a block was told last, and since when it has something to tell, 0 when it has not. A
        # slot's next block may wait a little for its predecessor's sake
        self._told = np.zeros(len(store.block), np.int32)
        self._since = np.zeros(len(store.block), np.int32)

    def changed(self, index: int) -> MeshDelta:
        """Delta of one frame: at most ``MOST_BLOCKS`` blocks, those that wait longest."""
        slots = self._changed()
        self._since[slots[self._since[slots] == 0]] = self._turn
        due = slots[self._told[slots] <= self._turn - AGAIN_AFTER]
        return self._tell(index, due[np.argsort(self._since[due], kind="stable")[:MOST_BLOCKS]])

    def everything(self, index: int) -> MeshDelta:
        """Delta of all blocks not told yet."""
        return self._tell(index, self._changed())

    def _changed(self) -> I32:
        # only resident blocks have CHANGED set: what goes to disk has been told
        used = self._store.counter[N_BLOCKS]
        return np.flatnonzero(self._store.block[:used, CHANGED]).astype(np.int32)

    def _tell(self, index: int, slots: I32) -> MeshDelta:
        self._store.block[slots, CHANGED] = 0
        self._since[slots] = 0
        self._told[slots] = self._turn
        self._turn += 1
        return to_delta(index, self._store, slots, self._listing, self._active)


def to_delta(index: int, store: Store, slots: I32, listing: Listing, active: U8 | None = None) -> MeshDelta:
    """Resident blocks as a ``MeshDelta``: only living vertices. ``active`` as in :class:`Outbox`."""
    voxel_start, vertex_start, triangle_start = np.empty((3, len(slots) + 1), np.int64)
    list_voxels(store, slots, listing.voxel, voxel_start)
    list_cells(store, listing, voxel_start, vertex_start)
    keep_living(store, listing, vertex_start)
    count_triangles(store, listing.voxel, voxel_start, triangle_start)
    n = int(vertex_start[-1])
    delta = MeshDelta(
        index=index,
        block=store.block[slots, BX : BX + 3],
        vertex_start=vertex_start,
        triangle_start=triangle_start,
        vertex_id=listing.name[:n].copy(),
        position=np.empty((n, 3), np.float32),
        normal=np.empty((n, 3), np.float32),
        colour=np.empty((n, 3), np.uint8),
        label=np.zeros(n, np.uint8),
        confidence=np.empty(n, np.float32),
        triangles=np.empty((int(triangle_start[-1]), 3), np.int64),
        probability=np.zeros(0 if active is None else n, np.uint8),
    )
    copy_vertices(store, listing.cell[:n], delta.position, delta.normal, delta.confidence)
    read_colours(store, listing.cell[:n], delta.colour)
    sureness(delta.confidence)
    if active is not None:
        copy_labels(store, listing.cell[:n], active, delta.label, delta.probability)
    copy_triangles(store, listing.voxel[: voxel_start[-1]], delta.triangles)
    return delta
