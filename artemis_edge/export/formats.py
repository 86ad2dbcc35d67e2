"""``artemis-edge export``: the formats by name."""

from __future__ import annotations

from pathlib import Path

from artemis_edge.export.glb import write_glb
from artemis_edge.export.ply import write_ply
from artemis_edge.opened_map import open_map
from artemis_edge.progress import Report, silent


def write(map_path: Path, name: str, out: Path, textured: bool = True, report: Report = silent) -> None:
    """Write MAP in the format ``name``: ply, glb, obj, laz or colmap.

    Raises InputError when the map lacks what the format needs, RunError when the result cannot be written.
    """
    if name == "ply":
        write_ply(out, open_map(map_path, textured=False)[0])
    elif name == "glb":
        mesh, atlas = open_map(map_path, textured)
        write_glb(out, mesh, atlas, report)
