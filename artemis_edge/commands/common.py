"""What all commands share: how they are declared, exit codes, JSON on stdout."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import Any

Handler = Callable[[argparse.Namespace], int]

DONE, FELL_SHORT, BAD_USE = 0, 1, 2


def command(commands: Any, name: str, handler: Handler, text: str) -> argparse.ArgumentParser:
    """Declare a command."""
    parser: argparse.ArgumentParser = commands.add_parser(name, help=text, description=text)
    parser.set_defaults(handler=handler)
    return parser


def json_option(parser: argparse.ArgumentParser) -> None:
    """``--json``."""
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout")


def print_json(value: Any) -> None:
    """One object, on one line, in ASCII: the same bytes whatever the terminal's encoding is."""
    print(json.dumps(value, allow_nan=False))
