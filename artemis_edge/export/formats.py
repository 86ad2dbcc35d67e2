"""``artemis-edge export``: the formats by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from artemis_edge.colouring import coloured_points
from artemis_edge.errors import InputError
from artemis_edge.export.colmap import write_colmap
from artemis_edge.export.glb import write_glb
from artemis_edge.export.laz import write_laz
from artemis_edge.export.mesh import Mesh
from artemis_edge.export.obj import write_obj
from artemis_edge.export.ply import write_ply
from artemis_edge.geo.place import Placed, read_georeference
from artemis_edge.kept_points import KeptPoints
from artemis_edge.opened_map import map_folder, open_map
from artemis_edge.progress import Report, silent

NAMES = ("ply", "glb", "obj", "laz", "colmap")


def write(
    map_path: Path,
    name: str,
    out: Path,
    textured: bool = True,
    report: Report = silent,
    georeferenced: bool = True,
) -> None:
    """Write MAP in one of the formats ``NAMES``; ``georeferenced``: in its CRS where it has one, except colmap.

    Raises InputError when the map lacks what the format needs, RunError when the result cannot be written.
    """
    placed = _placed(map_path) if georeferenced and name != "colmap" else None
    if name in ("laz", "colmap"):
        folder, kept = _points(map_path, name, report)
        if name == "colmap":
            write_colmap(out, kept, folder, report)
        else:
            write_laz(out, kept, open_map(map_path, textured=False)[0], report, placed)
        return
    mesh, atlas = open_map(map_path, textured and name != "ply")
    words = [] if placed is None else placed.words
    mesh = mesh if placed is None else _in_crs(mesh, placed)
    if name == "ply":
        write_ply(out, mesh, words)
    elif name == "glb":
        write_glb(out, mesh, atlas, report, dict(word.split(" ", 1) for word in words))
    else:
        write_obj(out, mesh, atlas, report, words)


def _placed(map_path: Path) -> Placed | None:
    folder = map_folder(map_path)
    found = None if folder is None else read_georeference(folder)
    return None if found is None else Placed.of(found)


def _in_crs(mesh: Mesh, placed: Placed) -> Mesh:
    """East, north, up less the offset."""
    if not len(mesh.vertices):
        return mesh
    normals = placed.turned(mesh.normals, mesh.vertices.mean(axis=0))
    return replace(mesh, vertices=placed.to_local(mesh.vertices), normals=normals)


def _points(map_path: Path, name: str, report: Report) -> tuple[Path, KeptPoints]:
    folder = map_folder(map_path)
    kept = None if folder is None else coloured_points(folder, report)
    if folder is None or kept is None:
        raise InputError(
            f"{map_path} keeps no points, which {name} is made of; give the output directory of "
            "`artemis-edge reprocess` with keep.points above 0"
        )
    return folder, kept
