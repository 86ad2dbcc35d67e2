"""``artemis-edge evaluate texture``: a map's texture against photographs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from artemis_edge.commands.common import DONE, command, json_option, print_json


def add(kinds: Any) -> None:
    """Declare it among the kinds of ``evaluate``."""
    parser = command(kinds, "texture", run_evaluate_texture, "a map's texture against photographs")
    parser.add_argument("map", type=Path, metavar="MAP", help="an output directory or a mesh.ply")
    parser.add_argument(
        "--photos", type=Path, required=True, metavar="PHOTOS.json", help="as reprocess --holdout writes it"
    )
    json_option(parser)


def run_evaluate_texture(given: argparse.Namespace) -> int:
    """``artemis-edge evaluate texture``."""
    from artemis_edge.evaluate import texture
    from artemis_edge.progress import progress

    with progress("comparing", plain=given.json) as report:
        result = texture.run(given.map, given.photos, report)
    if given.json:
        print_json(result.to_json())
    else:
        print(texture.to_text(result))
    return DONE
