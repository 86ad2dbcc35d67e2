"""Is the mesh a surface: edges with too many or too few triangles, and their winding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from artemis_edge.frames import F32, I32, I64, Bool


@dataclass(frozen=True, slots=True)
class Topology:
    """Shares 0..1 of all edges; ``orientation_share`` of the edges with two triangles.

    A non-manifold edge has more than two triangles, a boundary edge one. An edge is consistently oriented
    when its two triangles run through it in opposite directions. ``degenerate_triangles`` name a vertex twice
    and take part in nothing.
    """

    edges: int
    non_manifold_share: float
    boundary_share: float
    orientation_share: float
    degenerate_triangles: int


def topology(vertices: F32, faces: I32) -> Topology:
    """Count edges; vertices at exactly the same place count as one, so that no copy hides a seam."""
    corner = _merge(vertices)[faces]
    whole = (corner[:, 0] != corner[:, 1]) & (corner[:, 1] != corner[:, 2]) & (corner[:, 2] != corner[:, 0])
    triangles, forward = _triangles_per_edge(corner[whole], len(vertices))
    paired = triangles == 2
    return Topology(
        edges=len(triangles),
        non_manifold_share=_share(triangles > 2),
        boundary_share=_share(triangles == 1),
        orientation_share=_share(forward[paired] == 1) if paired.any() else 1.0,
        degenerate_triangles=int(np.count_nonzero(~whole)),
    )


def _merge(vertices: F32) -> I64:
    """For each vertex the number of its place."""
    place = (vertices + np.float32(0.0)).view(np.uint32).reshape(-1, 3)  # + 0 makes -0 and 0 the same bits
    order = np.lexsort((place[:, 2], place[:, 1], place[:, 0]))
    differs = np.any(place[order[1:]] != place[order[:-1]], axis=1)
    number = np.zeros(len(vertices), np.int64)
    number[order[1:]] = np.cumsum(differs)
    return number


def _triangles_per_edge(corner: I64, vertices: int) -> tuple[I64, I64]:
    """Per undirected edge: its triangles, and how many of them run from the lower to the higher vertex."""
    start, end = corner.reshape(-1), np.roll(corner, -1, axis=1).reshape(-1)
    upward = start < end
    key = np.where(upward, start * vertices + end, end * vertices + start)
    key = np.sort(key * 2 + upward)
    edge = key >> 1
    first = np.flatnonzero(np.concatenate([[True], edge[1:] != edge[:-1]])[: len(edge)])
    count = np.diff(np.append(first, len(edge)))
    forward = np.add.reduceat(key & 1, first) if len(first) else np.empty(0, np.int64)
    return count, forward


def _share(condition: Bool) -> float:
    return float(np.count_nonzero(condition) / len(condition)) if len(condition) else 0.0
