"""``artemis-edge georeference``: a map in the coordinates of a country."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from artemis_edge.commands.common import DONE, command, json_option, print_json

_LIMIT_M = 0.3


def add(commands: Any) -> None:
    """Declare it."""
    parser = command(commands, "georeference", run_georeference, "place a map by control points")
    parser.add_argument("map", type=Path, metavar="MAP", help="an output directory")
    parser.add_argument(
        "--points", type=Path, required=True, metavar="FILE.csv",
        help="control points: name, x, y, z (or mark, above) and east, north, up (or longitude, latitude, up)",
    )  # fmt: skip
    parser.add_argument("--epsg", type=int, required=True, metavar="CODE", help="a projected CRS, in metres")
    parser.add_argument(
        "--limit", type=float, default=_LIMIT_M, metavar="METRES",
        help=f"refuse points that fit worse, rms (default: {_LIMIT_M:g})",
    )  # fmt: skip
    parser.add_argument(
        "--session", type=Path, metavar="SESSION", help="the recording in which marks were set"
    )
    json_option(parser)


def run_georeference(given: argparse.Namespace) -> int:
    """``artemis-edge georeference``."""
    from artemis_edge.geo.place import georeference, to_json
    from artemis_edge.geo.report import add_to_report, read_report, sentence
    from artemis_edge.opened_map import map_folder

    folder = map_folder(given.map)
    if folder is not None:
        read_report(folder.parent)  # before anything is kept
    made = georeference(given.map, given.points, given.epsg, given.limit, given.session)
    assert folder is not None
    add_to_report(folder.parent, made)
    if given.json:
        print_json(to_json(made))
        return DONE
    print(sentence(made))
    width = max(len(point.name) for point in made.points)
    for point in made.points:
        east, north, up = point.off
        print(
            f"{point.name:<{width}}  {point.distance_m:.3f} m  (east {east:+.3f}, north {north:+.3f}, up {up:+.3f})"
        )
    print("exports are in these coordinates now; --no-georeferenced leaves them in the map's")
    return DONE
