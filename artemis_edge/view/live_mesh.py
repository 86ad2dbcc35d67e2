"""A growing map as a viewer keeps it: blocks in their newest state, drawn in regions of 4 x 4 x 4 blocks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from artemis_edge.export.mesh import Mesh, bare_mesh
from artemis_edge.frames import F32, I32, I64, U8, MeshDelta

#: Blocks along an edge of a region: few enough objects for a browser, small enough to send again when one changes.
REGION_BLOCKS = 4

BlockKey = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Patch:
    """What one block shows: arrays as in ``MeshDelta``."""

    vertex_id: I64
    position: F32
    colour: U8
    label: U8
    confidence: F32
    triangles: I64
    probability: U8


def patches(delta: MeshDelta) -> Iterator[tuple[BlockKey, Patch]]:
    """The blocks of a delta."""
    for k, (x, y, z) in enumerate(delta.block.tolist()):
        v = slice(delta.vertex_start[k], delta.vertex_start[k + 1])
        t = slice(delta.triangle_start[k], delta.triangle_start[k + 1])
        yield (
            (x, y, z),
            Patch(
                delta.vertex_id[v],
                delta.position[v],
                delta.colour[v],
                delta.label[v],
                delta.confidence[v],
                delta.triangles[t],
                delta.probability[v],
            ),
        )


class LiveMesh:
    """Takes deltas; ``take_dirty`` names regions to draw again, the ones that wait longest first."""

    def __init__(self) -> None:
        self.blocks: dict[BlockKey, Patch] = {}
        self._regions: dict[BlockKey, set[BlockKey]] = {}
        self._dirty: dict[BlockKey, None] = {}

    def apply(self, delta: MeshDelta) -> None:
        """Replace the blocks of a delta."""
        for key, patch in patches(delta):
            self.blocks[key] = patch
            self._regions.setdefault(region_of(key), set()).add(key)
            # a triangle of the neighbouring block may use a vertex of this one
            for near in around(key):
                if near in self.blocks:
                    self._dirty.setdefault(region_of(near))

    def redraw(self, labels: Sequence[int]) -> None:
        """Have the regions drawn again that hold vertices of these labels."""
        for key, patch in self.blocks.items() if labels else ():
            if np.isin(patch.label, labels).any():
                self._dirty.setdefault(region_of(key))

    def take_dirty(self, most: int) -> list[BlockKey]:
        """At most so many regions that changed since they were taken."""
        taken = list(self._dirty)[:most]
        for key in taken:
            del self._dirty[key]
        return taken

    def region_mesh(self, region: BlockKey) -> Mesh:
        """The triangles of a region's blocks; those whose vertex is not known yet are left out."""
        own = sorted(self._regions.get(region, ()))
        used = sorted({near for key in own for near in around(key) if near in self.blocks})
        if not used:
            return bare_mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
        parts = [self.blocks[key] for key in used]
        ids = np.concatenate([part.vertex_id for part in parts])
        triangles = np.concatenate([self.blocks[key].triangles for key in own])
        faces = rows_of(ids, triangles)
        kept = np.unique(faces)
        renumber = np.zeros(len(ids), np.int32)
        renumber[kept] = np.arange(len(kept), dtype=np.int32)
        return bare_mesh(
            np.concatenate([part.position for part in parts])[kept],
            renumber[faces],
            colours=np.concatenate([part.colour for part in parts])[kept],
            labels=np.concatenate([part.label for part in parts])[kept],
            confidence=np.concatenate([part.confidence for part in parts])[kept],
        )


def region_of(block: BlockKey) -> BlockKey:
    """The region a block lies in."""
    return block[0] // REGION_BLOCKS, block[1] // REGION_BLOCKS, block[2] // REGION_BLOCKS


def around(key: BlockKey) -> list[BlockKey]:
    """A block and its neighbours."""
    x, y, z = key
    return [(x + i, y + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]


def rows_of(ids: I64, triangles: I64) -> I32:
    """Rows of ``ids`` (n,) for the vertices of triangles (t, 3), without those that name another."""
    if len(ids) == 0 or len(triangles) == 0:
        return np.empty((0, 3), np.int32)
    order = np.argsort(ids, kind="stable")
    at = np.searchsorted(ids[order], triangles).clip(0, len(ids) - 1)
    known = (ids[order[at]] == triangles).all(axis=1)
    rows: I32 = order[at[known]].astype(np.int32)
    return rows


def extent(blocks: dict[BlockKey, Patch]) -> tuple[F32, F32]:
    """Lowest and highest corner (3,) of what is known, for a first look."""
    points = [part.position for part in blocks.values() if len(part.position)]
    everything = np.concatenate(points or [np.zeros((1, 3), np.float32)])
    return everything.min(axis=0), everything.max(axis=0)
