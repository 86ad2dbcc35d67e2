"""Mesh deltas: which blocks changed, as arrays a viewer or an exporter can take."""

from __future__ import annotations

import math

import numpy as np

from artemis_edge._jit import kernel
from artemis_edge.block_store import (
    ALIVE,
    BX,
    CHANGED,
    COUNT,
    EMPTY_KEY,
    IX,
    IY,
    IZ,
    NORMAL,
    PATCH_AT,
    PATCH_LEN,
    POSITION,
    Store,
    block_key,
)
from artemis_edge.frames import F32, I32, I64, MeshDelta
from artemis_edge.paging import EAR_MASK

# Blocks told a frame at most. A viewer redraws a block a few times a second, not ten; what waits is told newest
# state first come, and the pipeline's time stays bounded
MOST_BLOCKS = 48
GREY = 180  # of a vertex no camera has seen


def confidence(evidence: F32) -> F32:
    """How sure a vertex is, float32 (n,) 0..1: 1 - exp(-hits / 4), so 0.22 for one hit and 0.98 for sixteen."""
    return (1.0 - np.exp(-evidence[:, COUNT] / 4.0)).astype(np.float32)


@kernel
def count_delta(store: Store, slots: I32, vertex_start: I64, triangle_start: I64) -> None:
    """Where each block's living vertices and triangles begin; both arrays (b + 1,)."""
    vertex_start[0] = triangle_start[0] = 0
    for i in range(slots.shape[0]):
        vertices = triangles = 0
        for inner in range(512):
            v = store.block_voxel[slots[i], inner]
            if v < 0:
                continue
            triangles += store.voxel[v, PATCH_LEN]
            for c in range(64):
                s = store.voxel_cell[v, c]
                if s >= 0 and store.state[s] == ALIVE:
                    vertices += 1
        vertex_start[i + 1] = vertex_start[i] + vertices
        triangle_start[i + 1] = triangle_start[i] + triangles


@kernel
def fill_delta(
    store: Store, slots: I32, ids: I64, position: F32, normal: F32, sure: F32, triangles: I64
) -> None:
    """Copy living vertices and triangles of blocks, in the order of ``slots``.

    A vertex is named by its cell as a block is by its place: see ``paging.Page.vertex_ids``.
    """
    i = j = 0
    for slot in slots:
        for inner in range(512):
            v = store.block_voxel[slot, inner]
            if v < 0:
                continue
            x, y, z = store.voxel[v, IX] * 4, store.voxel[v, IY] * 4, store.voxel[v, IZ] * 4
            for c in range(64):
                s = store.voxel_cell[v, c]
                if s < 0 or store.state[s] != ALIVE:
                    continue
                ids[i] = block_key(x + (c >> 4), y + ((c >> 2) & 3), z + (c & 3))
                for k in range(3):
                    position[i, k] = store.vertex[s, POSITION + k]
                    normal[i, k] = store.vertex[s, NORMAL + k]
                sure[i] = np.float32(1.0 - math.exp(-store.evidence[s, COUNT] / 4.0))
                i += 1
            at = store.voxel[v, PATCH_AT]
            for t in range(at, at + store.voxel[v, PATCH_LEN]):
                for k in range(3):
                    code = np.int64(store.triangle[t, k]) & EAR_MASK
                    triangles[j, k] = block_key(
                        x + (code >> 10) - 12, y + ((code >> 5) & 31) - 12, z + (code & 31) - 12
                    )
                j += 1


@kernel
def changed_blocks(store: Store, out: I32) -> int:
    """Slots of resident blocks that changed since they were told, oldest change first up to room; clears them."""
    n = 0
    for at in range(store.hash_key.shape[0]):
        if store.hash_key[at] == EMPTY_KEY or store.block[store.hash_slot[at], CHANGED] == 0:
            continue
        slot = store.hash_slot[at]
        stamp = store.block[slot, CHANGED]
        j = min(n, out.shape[0] - 1)
        if n == out.shape[0] and store.block[out[j], CHANGED] <= stamp:
            continue
        while j > 0 and store.block[out[j - 1], CHANGED] > stamp:
            out[j] = out[j - 1]
            j -= 1
        out[j] = slot
        n = min(n + 1, out.shape[0])
    for i in range(n):
        store.block[out[i], CHANGED] = 0
    return n


class Outbox:
    """Hands out the blocks that changed."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._slots = np.empty(MOST_BLOCKS, np.int32)

    def changed(self, index: int) -> MeshDelta:
        """Delta of one frame: at most ``MOST_BLOCKS`` blocks, those that wait longest."""
        n = changed_blocks(self._store, self._slots)
        return to_delta(index, self._store, self._slots[:n])

    def everything(self, index: int) -> MeshDelta:
        """Delta of all blocks not told yet."""
        slots = np.empty(len(self._store.block), np.int32)
        return to_delta(index, self._store, slots[: changed_blocks(self._store, slots)])


def to_delta(index: int, store: Store, slots: I32) -> MeshDelta:
    """Resident blocks as a ``MeshDelta``: only living vertices."""
    vertex_start, triangle_start = np.empty(len(slots) + 1, np.int64), np.empty(len(slots) + 1, np.int64)
    count_delta(store, slots, vertex_start, triangle_start)
    n = int(vertex_start[-1])
    delta = MeshDelta(
        index=index,
        block=store.block[slots, BX : BX + 3],
        vertex_start=vertex_start,
        triangle_start=triangle_start,
        vertex_id=np.empty(n, np.int64),
        position=np.empty((n, 3), np.float32),
        normal=np.empty((n, 3), np.float32),
        colour=np.full((n, 3), GREY, np.uint8),
        label=np.zeros(n, np.uint8),
        confidence=np.empty(n, np.float32),
        triangles=np.empty((int(triangle_start[-1]), 3), np.int64),
    )
    fill_delta(store, slots, delta.vertex_id, delta.position, delta.normal, delta.confidence, delta.triangles)
    return delta
