"""The finished map: its mesh as one, and the pages that reopen it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from artemis_edge.block_store import CLASSES, COLOUR, INFORMATION, LOG_CLASS, NORMAL, POSITION
from artemis_edge.config import Config, to_toml
from artemis_edge.delta import GREY, confidence
from artemis_edge.export.atomic import replacing, write_bytes
from artemis_edge.export.mesh import Mesh, bare_mesh
from artemis_edge.export.ply import write_ply
from artemis_edge.finishing import finish
from artemis_edge.frames import F32, I32, I64, U8
from artemis_edge.paging import Pager, page_bytes
from artemis_edge.semantic_map import SemanticMap, clear_classes, start_blank

LABELS = {0: "background"}


def gather_mesh(
    pager: Pager,
    longest_m: float,
    smallest_island: int,
    semantics: SemanticMap | None = None,
    exposure: float = 1.0,
) -> Mesh:
    """All patches as one finished mesh (finishing.py) with shared vertices; unused vertices are left out.

    With ``semantics`` vertices carry their most probable class, and what no image saw that of its surroundings.
    Colours are multiplied by ``exposure``.
    """
    ids, triangle_ids = [], []
    for page in pager.pages():
        ids.append(page.vertex_ids()[page.alive()])
        triangle_ids.append(page.triangle_ids())
    vertex_id = np.concatenate(ids) if ids else np.empty(0, np.int64)
    order = np.argsort(vertex_id)
    faces = _join(vertex_id, order, triangle_ids)
    del triangle_ids
    position, normal, sure, colour = _attributes(pager, len(vertex_id), exposure)
    lam = None if semantics is None else _classes(pager, len(vertex_id))
    klass = None if lam is None else clear_classes(lam)
    faces = finish(position, normal, faces, longest_m, smallest_island, klass)
    used = np.zeros(len(vertex_id), bool)
    used[faces] = True
    renumber = np.cumsum(used, dtype=np.int32) - np.int32(1)
    n = int(used.sum())
    faces = renumber[faces]
    labels = np.zeros(n, np.uint8)
    if semantics is not None and lam is not None:
        labels = semantics.finished_labels(lam[used], position[used], normal[used], faces)
    return Mesh(
        vertices=position[used],
        normals=normal[used],
        colours=colour[used],
        labels=labels,
        confidence=sure[used],
        faces=faces,
        label_names=LABELS if semantics is None else semantics.names,
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


def _attributes(pager: Pager, n: int, exposure: float) -> tuple[F32, F32, F32, U8]:
    """Position (n, 3), normal (n, 3), confidence (n,) and colour (n, 3) of all living vertices, in order of pages."""
    position, normal = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
    sure, colour = np.empty(n, np.float32), np.full((n, 3), GREY, np.uint8)
    row = 0
    for page in pager.pages():
        alive = page.alive()
        rows = slice(row, row + int(alive.sum()))
        position[rows] = page.vertex[alive, POSITION : POSITION + 3]
        normal[rows] = page.vertex[alive, NORMAL : NORMAL + 3]
        sure[rows] = confidence(page.evidence[alive])
        _colour_into(colour[rows], page.attribute[alive], exposure)
        row = rows.stop
    return position, normal, sure, colour


def _colour_into(colour: U8, attribute: F32, exposure: float) -> None:
    """Mean colours (n, 3), times ``exposure``, of vertices that a camera has seen; the others stay."""
    if attribute.shape[1] > INFORMATION:
        seen = attribute[:, INFORMATION] > 0.0
        colour[seen] = (attribute[seen, COLOUR : COLOUR + 3] * exposure + 0.5).clip(0, 255)


def _classes(pager: Pager, n: int) -> F32:
    """Log-probabilities float32 (n, CLASSES) of all living vertices; where nobody looked, those of the voxel."""
    out, row = np.empty((n, CLASSES), np.float32), 0
    for page in pager.pages():
        alive = np.flatnonzero(page.alive())
        voxel = np.repeat(np.arange(len(page.n_cells)), page.n_cells)[alive]
        part = out[row : row + len(alive)]
        part[:] = page.attribute[alive, LOG_CLASS:]
        start_blank(part, page.voxel_class[voxel])
        row += len(alive)
    return out


def write_mesh(
    path: Path,
    pager: Pager,
    longest_m: float,
    smallest_island: int,
    semantics: SemanticMap | None = None,
    exposure: float = 1.0,
) -> Mesh:
    """Write ``mesh.ply`` and return what was written."""
    mesh = gather_mesh(pager, longest_m, smallest_island, semantics, exposure)
    write_ply(path, mesh)
    return mesh


REMOVED = "removed.ply"


def write_removed(folder: Path, places: F32) -> int:
    """Write where the dynamic filter removed vertices, points float32 (n, 3), into ``folder``; returns bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    write_ply(folder / REMOVED, bare_mesh(places, np.empty((0, 3), np.int32)))
    return (folder / REMOVED).stat().st_size


def save_map(folder: Path, pager: Pager, config: Config) -> int:
    """Write ``blocks.bin`` (every block) and ``config.toml`` into ``folder``; returns the size in bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    size = 0
    with replacing(folder / "blocks.bin") as file:
        for page in pager.pages():
            size += file.write(page_bytes(page))
    write_bytes(folder / "config.toml", to_toml(config).encode())
    return size
