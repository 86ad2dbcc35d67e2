"""``artemis-edge export``: the formats by name."""

from __future__ import annotations

from pathlib import Path

from artemis_edge.errors import InputError
from artemis_edge.export.colmap import write_colmap
from artemis_edge.export.glb import write_glb
from artemis_edge.export.laz import write_laz
from artemis_edge.export.obj import write_obj
from artemis_edge.export.ply import write_ply
from artemis_edge.kept_points import KeptPoints, open_points
from artemis_edge.opened_map import map_folder, open_map
from artemis_edge.progress import Report, silent

NAMES = ("ply", "glb", "obj", "laz", "colmap")


def write(map_path: Path, name: str, out: Path, textured: bool = True, report: Report = silent) -> None:
    """Write MAP in one of the formats ``NAMES``.

    Raises InputError when the map lacks what the format needs, RunError when the result cannot be written.
    """
    if name in ("laz", "colmap"):
        folder, kept = _points(map_path, name)
        if name == "colmap":
            write_colmap(out, kept, folder, report)
        else:
            write_laz(out, kept, open_map(map_path, textured=False)[0], report)
        return
    mesh, atlas = open_map(map_path, textured and name != "ply")
    if name == "ply":
        write_ply(out, mesh)
    elif name == "glb":
        write_glb(out, mesh, atlas, report)
    else:
        write_obj(out, mesh, atlas, report)


def _points(map_path: Path, name: str) -> tuple[Path, KeptPoints]:
    folder = map_folder(map_path)
    kept = None if folder is None else open_points(folder)
    if folder is None or kept is None:
        raise InputError(
            f"{map_path} keeps no points, which {name} is made of; give the output directory of "
            "`artemis-edge reprocess` with keep.points above 0"
        )
    return folder, kept
