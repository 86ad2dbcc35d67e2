"""``artemis-edge evaluate semantics`` and ``ask``: labels measured, questions answered."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from artemis_edge.commands.common import DONE, command, json_option, print_json


def add_evaluate(kinds: Any) -> None:
    """Declare it among the kinds of ``evaluate``."""
    parser = command(kinds, "semantics", run_evaluate_semantics, "a map's labels against a labelled cloud")
    parser.add_argument("map", type=Path, metavar="MAP", help="an output directory or a mesh.ply")
    parser.add_argument("--labels", type=Path, required=True, metavar="CLOUD.ply")
    json_option(parser)


def add_ask(commands: Any) -> None:
    """Declare ``ask``."""
    parser = command(commands, "ask", run_ask, "find things in a finished map")
    parser.add_argument("map", type=Path, metavar="MAP", help="an output directory")
    parser.add_argument("text", nargs="+", metavar="TEXT", help="for example 'red car'; each is a question")
    parser.add_argument(
        "--model", default="", metavar="NAME", help="of 'models list' (default: the map's own)"
    )
    parser.add_argument("--meshes", type=Path, metavar="DIR", help="write a PLY file for each object found")
    json_option(parser)


def run_evaluate_semantics(given: argparse.Namespace) -> int:
    """``artemis-edge evaluate semantics``."""
    from artemis_edge.evaluate import semantics

    result = semantics.run(given.map, given.labels)
    if given.json:
        print_json(result.to_json())
    else:
        print(semantics.to_text(result))
    return DONE


def run_ask(given: argparse.Namespace) -> int:
    """``artemis-edge ask``."""
    from artemis_edge import ask
    from artemis_edge.export.objects import objects_json
    from artemis_edge.export.places import check_folder
    from artemis_edge.progress import progress

    if given.meshes is not None:
        check_folder("--meshes", given.meshes)
    with progress("looking", plain=given.json) as report:
        replies = ask.ask(given.map, given.text, given.model, report, given.meshes)
    if given.json:
        print_json(objects_json(replies))
    else:
        print(ask.to_text(replies))
    return DONE
