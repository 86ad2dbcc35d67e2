"""``artemis-edge render`` and ``export``: pictures and files of a finished map."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from artemis_edge.commands.common import DONE, command

_FORMATS = ("ply", "glb", "obj", "laz", "colmap")  # formats.NAMES, without its imports


def add_render(commands: Any) -> None:
    """Declare ``render``."""
    parser = command(commands, "render", run_render, "picture of a map as a camera would take it")
    parser.add_argument("map", type=Path, metavar="MAP", help="an output directory or a mesh.ply")
    parser.add_argument("--pose", required=True, metavar='"tx ty tz qx qy qz qw"', help="T_world_cam")
    parser.add_argument("--intrinsics", required=True, metavar='"w h fx fy cx cy"')
    parser.add_argument("--distortion", metavar='"k1 k2 p1 p2 k3"')
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.png")
    parser.add_argument("--highlight", metavar="TEXT", help="tint the objects or the class of this name")
    parser.add_argument("--depth", type=Path, metavar="FILE.npy", help="metres along z, NaN where nothing")
    parser.add_argument(
        "--falloff", action=argparse.BooleanOptionalAction, default=True,
        help="darken the corners as the lens of the map's camera with these intrinsics does (default)",
    )  # fmt: skip


def add_export(commands: Any) -> None:
    """Declare ``export``."""
    parser = command(commands, "export", run_export, "write a map in another format")
    parser.add_argument("map", type=Path, metavar="MAP", help="an output directory or a mesh.ply")
    parser.add_argument("--format", choices=_FORMATS, required=True)
    parser.add_argument(
        "--out", type=Path, required=True, metavar="PATH", help="a file; for colmap a folder to make"
    )
    parser.add_argument(
        "--textured", action=argparse.BooleanOptionalAction, default=True,
        help="with the photographs' texture, where the format can hold it (default)",
    )  # fmt: skip
    parser.add_argument(
        "--georeferenced", action=argparse.BooleanOptionalAction, default=True,
        help="in the coordinates that `georeference` gave the map, if it did (default)",
    )  # fmt: skip


def run_render(given: argparse.Namespace) -> int:
    """``artemis-edge render``."""
    from artemis_edge import render
    from artemis_edge.export.places import check_file
    from artemis_edge.export.ply import find_mesh
    from artemis_edge.opened_map import map_folder

    read = (find_mesh(given.map), map_folder(given.map))
    check_file("--out", given.out, (".png",), read)
    if given.depth is not None:
        check_file("--depth", given.depth, (".npy",), (given.out, *read))
    render.run(
        given.map,
        given.pose,
        given.intrinsics,
        given.distortion,
        given.out,
        given.depth,
        given.highlight,
        given.falloff,
    )
    return DONE


def run_export(given: argparse.Namespace) -> int:
    """``artemis-edge export``."""
    from artemis_edge.export.formats import write
    from artemis_edge.export.places import check_file, check_new_folder
    from artemis_edge.export.ply import find_mesh
    from artemis_edge.opened_map import map_folder
    from artemis_edge.progress import progress

    read = (find_mesh(given.map), map_folder(given.map))
    if given.format == "colmap":
        check_new_folder("--out", given.out, read)
    else:
        check_file("--out", given.out, (f".{given.format}",), read)
    with progress(f"writing {given.format}") as report:
        write(given.map, given.format, given.out, given.textured, report, given.georeferenced)
    return DONE
