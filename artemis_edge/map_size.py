"""How large a map is, counted along its deltas."""

from __future__ import annotations

import numpy as np

from artemis_edge.frames import MeshDelta


class MapSize:
    """Vertices and triangles of all blocks as they were told last."""

    def __init__(self) -> None:
        self.vertices = self.triangles = 0
        self._blocks: dict[tuple[int, ...], tuple[int, int]] = {}

    def add(self, delta: MeshDelta) -> None:
        """Blocks of the delta count with what they hold now."""
        counts = zip(
            np.diff(delta.vertex_start).tolist(), np.diff(delta.triangle_start).tolist(), strict=True
        )
        for block, (vertices, triangles) in zip(map(tuple, delta.block.tolist()), counts, strict=True):
            before = self._blocks.get(block, (0, 0))
            self._blocks[block] = vertices, triangles
            self.vertices += vertices - before[0]
            self.triangles += triangles - before[1]
