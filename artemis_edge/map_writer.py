"""The finished map: its mesh as one, and the pages that reopen it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from artemis_edge.block_store import NORMAL, POSITION
from artemis_edge.config import Config, to_toml
from artemis_edge.delta import GREY, confidence
from artemis_edge.export.atomic import replacing, write_bytes
from artemis_edge.export.mesh import Mesh
from artemis_edge.export.ply import write_ply
from artemis_edge.frames import I32, I64, Bool
from artemis_edge.paging import Pager, page_bytes

LABELS = {0: "background"}


def gather_mesh(pager: Pager, smallest_island: int) -> Mesh:
    """All patches as one mesh with shared vertices; islands of fewer triangles and unused vertices left out."""
    ids, triangle_ids = [], []
    for page in pager.pages():
        ids.append(page.vertex_ids()[page.alive()])
        triangle_ids.append(page.triangle_ids())
    vertex_id = np.concatenate(ids) if ids else np.empty(0, np.int64)
    order = np.argsort(vertex_id)
    faces = _join(vertex_id, order, triangle_ids)
    del triangle_ids
    faces = faces[large_islands(faces, len(vertex_id), smallest_island)]
    used = np.zeros(len(vertex_id), bool)
    used[faces] = True
    renumber = np.cumsum(used, dtype=np.int32) - np.int32(1)
    position, normal, sure = _attributes(pager, used)
    n = len(position)
    return Mesh(
        vertices=position,
        normals=normal,
        colours=np.full((n, 3), GREY, np.uint8),
        labels=np.zeros(n, np.uint8),
        confidence=sure,
        faces=renumber[faces],
        label_names=LABELS,
    )


def _join(vertex_id: I64, order: I64, triangle_ids: list[I64]) -> I32:
    """Rows of ``vertex_id`` for every triangle; triangles whose vertex no longer lives are left out."""
    ranked = vertex_id[order]
    out = []
    for part in triangle_ids:
        at = np.searchsorted(ranked, part).clip(0, max(len(ranked) - 1, 0))
        whole = (ranked[at] == part).all(axis=1) if len(ranked) else np.zeros(len(part), bool)
        out.append(order[at[whole]].astype(np.int32))
    return np.concatenate(out) if out else np.empty((0, 3), np.int32)


def large_islands(faces: I32, vertices: int, least: int) -> Bool:
    """Which triangles belong to a connected piece of at least ``least`` triangles, bool (t,)."""
    if least <= 1 or len(faces) == 0:
        return np.ones(len(faces), bool)
    a = np.concatenate((faces[:, 0], faces[:, 1]))
    b = np.concatenate((faces[:, 1], faces[:, 2]))
    graph = coo_array((np.ones(len(a), bool), (a, b)), shape=(vertices, vertices))
    piece = connected_components(graph, directed=False)[1][faces[:, 0]]
    keep: Bool = np.bincount(piece)[piece] >= least
    return keep


def _attributes(pager: Pager, used: Bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = int(used.sum())
    position, normal = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
    sure = np.empty(n, np.float32)
    at = row = 0
    for page in pager.pages():
        alive = page.alive()
        pick = np.flatnonzero(alive)[used[at : at + int(alive.sum())]]
        at += int(alive.sum())
        position[row : row + len(pick)] = page.vertex[pick, POSITION : POSITION + 3]
        normal[row : row + len(pick)] = page.vertex[pick, NORMAL : NORMAL + 3]
        sure[row : row + len(pick)] = confidence(page.evidence[pick])
        row += len(pick)
    return position, normal, sure


def write_mesh(path: Path, pager: Pager, smallest_island: int) -> Mesh:
    """Write ``mesh.ply`` and return what was written."""
    mesh = gather_mesh(pager, smallest_island)
    write_ply(path, mesh)
    return mesh


def save_map(folder: Path, pager: Pager, config: Config) -> int:
    """Write ``blocks.bin`` (every block) and ``config.toml`` into ``folder``; returns the size in bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    size = 0
    with replacing(folder / "blocks.bin") as file:
        for page in pager.pages():
            size += file.write(page_bytes(page))
    write_bytes(folder / "config.toml", to_toml(config).encode())
    return size
