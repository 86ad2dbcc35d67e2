"""Mesh deltas: which blocks changed, as arrays a viewer or an exporter can take."""

from __future__ import annotations

import numpy as np

from artemis_edge._jit import kernel
from artemis_edge.block_store import CHANGED, COUNT, EMPTY_KEY, NORMAL, POSITION, Store
from artemis_edge.frames import F32, I32, MeshDelta
from artemis_edge.paging import Page, pack

# Blocks told a frame at most. A viewer redraws a block a few times a second, not ten; what waits is told newest
# state first come, and the pipeline's time stays bounded
MOST_BLOCKS = 48
GREY = 180  # of a vertex no camera has seen


def confidence(evidence: F32) -> F32:
    """How sure a vertex is, float32 (n,) 0..1: 1 - exp(-hits / 4), so 0.22 for one hit and 0.98 for sixteen."""
    return (1.0 - np.exp(-evidence[:, COUNT] / 4.0)).astype(np.float32)


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
        return to_delta(index, pack(self._store, self._slots[:n]))

    def everything(self, index: int) -> MeshDelta:
        """Delta of all blocks not told yet."""
        slots = np.empty(len(self._store.block), np.int32)
        return to_delta(index, pack(self._store, slots[: changed_blocks(self._store, slots)]))


def to_delta(index: int, page: Page) -> MeshDelta:
    """A page as a ``MeshDelta``: only living vertices."""
    alive = page.alive()
    block_of_voxel = np.repeat(np.arange(len(page.block)), page.n_voxels)
    block_of_cell = np.repeat(block_of_voxel, page.n_cells)
    block_of_triangle = np.repeat(block_of_voxel, page.n_triangles)
    edges = np.arange(len(page.block) + 1)
    n = int(alive.sum())
    return MeshDelta(
        index=index,
        block=page.block,
        vertex_start=np.searchsorted(block_of_cell[alive], edges).astype(np.int64),
        triangle_start=np.searchsorted(block_of_triangle, edges).astype(np.int64),
        vertex_id=page.vertex_ids()[alive],
        position=page.vertex[alive, POSITION : POSITION + 3],
        normal=page.vertex[alive, NORMAL : NORMAL + 3],
        colour=np.full((n, 3), GREY, np.uint8),
        label=np.zeros(n, np.uint8),
        confidence=confidence(page.evidence[alive]),
        triangles=page.triangle_ids(),
    )
