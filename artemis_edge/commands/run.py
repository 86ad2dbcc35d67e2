"""``artemis-edge run``: the service."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from artemis_edge.commands.common import command
from artemis_edge.errors import InputError


def add(commands: Any) -> None:
    """Declare the command."""
    parser = command(commands, "run", run, "record and map with the devices of the rig, until stopped")
    parser.add_argument("--config", metavar="FILE", help="devices, mounting, service (docs/hardware.md)")
    parser.add_argument(
        "--query", action="append", default=[], metavar="TEXT", help="what to look for; repeatable"
    )
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--session", type=Path, metavar="DIR", help="where to record (default: a new folder)")
    which.add_argument(
        "--continue",
        type=Path,
        metavar="SESSION",
        dest="go_on",
        help="record more into a session; begin where it ended",
    )
    parser.add_argument(
        "--seconds", type=float, metavar="S", help="end after so long; default: until stopped"
    )


def run(given: argparse.Namespace) -> int:
    """``artemis-edge run``."""
    from artemis_edge.service.daemon import Daemon, Wanted
    from artemis_edge.service.settings import load

    if given.go_on is not None and not (given.go_on.is_dir() and any(given.go_on.glob("*.mcap"))):
        raise InputError(f"{given.go_on} is no session; --continue needs the folder of a recording")
    if given.session is not None and (given.session.is_file() or _holds_something(given.session)):
        raise InputError(f"{given.session} is there already; choose another --session, or --continue it")
    if given.seconds is not None and not given.seconds > 0:
        raise InputError(f"--seconds {given.seconds:g}: give a number above 0")
    wanted = Wanted(given.session, given.go_on, tuple(given.query), given.seconds)
    return Daemon(load(given.config), wanted).run()


def _holds_something(folder: Path) -> bool:
    return folder.is_dir() and any(folder.iterdir())
