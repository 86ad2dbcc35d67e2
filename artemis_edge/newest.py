"""Newest state wins: deltas pile up while a viewer is away, but a block only once.

Between the pipeline, which never waits, and whoever looks at the map: what is kept is at most one map, however long
nobody asked.
"""

from __future__ import annotations

import threading

import numpy as np

from artemis_edge.frames import MeshDelta


class Newest:
    """Blocks by place, in the state they were told last; to be filled in one thread and emptied in another."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._blocks: dict[tuple[int, int, int], tuple[MeshDelta, int]] = {}

    def add(self, delta: MeshDelta) -> None:
        """Take over a delta's blocks. Cheap: nothing is copied."""
        with self._lock:
            for k, block in enumerate(delta.block.tolist()):
                place = tuple(block)
                self._blocks.pop(place, None)
                self._blocks[place] = delta, k

    def __len__(self) -> int:
        return len(self._blocks)

    def take(self, most: int = 1 << 30) -> MeshDelta | None:
        """One delta of at most ``most`` blocks, those that wait longest; None when there is no news."""
        with self._lock:
            places = list(self._blocks)[:most]
            parts = [self._blocks.pop(place) for place in places]
        return joined(parts) if parts else None


def joined(parts: list[tuple[MeshDelta, int]]) -> MeshDelta:
    """The ``k``-th block of each delta, as one delta."""
    vertices = [slice(int(d.vertex_start[k]), int(d.vertex_start[k + 1])) for d, k in parts]
    triangles = [slice(int(d.triangle_start[k]), int(d.triangle_start[k + 1])) for d, k in parts]

    def rows(name: str, spans: list[slice]) -> np.ndarray:
        return np.concatenate([getattr(d, name)[span] for (d, _), span in zip(parts, spans, strict=True)])

    def starts(spans: list[slice]) -> np.ndarray:
        return np.concatenate(([0], np.cumsum([s.stop - s.start for s in spans]))).astype(np.int64)

    return MeshDelta(
        index=max(d.index for d, _ in parts),
        block=np.stack([d.block[k] for d, k in parts]),
        vertex_start=starts(vertices),
        triangle_start=starts(triangles),
        vertex_id=rows("vertex_id", vertices),
        position=rows("position", vertices),
        normal=rows("normal", vertices),
        colour=rows("colour", vertices),
        label=rows("label", vertices),
        confidence=rows("confidence", vertices),
        triangles=rows("triangles", triangles),
        probability=rows("probability", vertices),
    )
