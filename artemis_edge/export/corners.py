"""Corners of textured faces: a vertex is one for all faces that put it on the same place of the page."""

from __future__ import annotations

import numpy as np

from artemis_edge.frames import F32, I32


def shared_corners(faces: I32, uv: F32) -> tuple[I32, F32, I32]:
    """For faces int32 (m, 3) with ``uv`` float32 (m, 3, 2): the different pairs of a vertex int32 (c,) and its
    place float32 (c, 2), ordered by vertex, and the faces as rows of these int32 (m, 3).
    """
    vertex, place = faces.reshape(-1), np.ascontiguousarray(uv, np.float32).reshape(-1, 2)
    order = np.lexsort((place[:, 1], place[:, 0], vertex))
    vertex, place = vertex[order], place[order]
    new = np.ones(len(order), bool)
    new[1:] = (vertex[1:] != vertex[:-1]) | (place[1:] != place[:-1]).any(axis=1)
    row = np.empty(len(order), np.int32)
    row[order] = np.cumsum(new, dtype=np.int32) - np.int32(1)
    return vertex[new], place[new], row.reshape(-1, 3)
