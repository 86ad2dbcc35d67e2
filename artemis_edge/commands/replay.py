"""``artemis-edge replay``: a session through the pipeline as it was live, or on the wire through virtual devices."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from artemis_edge.commands.common import DONE, command
from artemis_edge.errors import InputError


def add(commands: Any) -> None:
    """Declare the command."""
    parser = command(commands, "replay", run, "map a session exactly as it was mapped live")
    parser.add_argument("session", type=Path, metavar="SESSION", help="a session (folder or .mcap)")
    parser.add_argument(
        "--wire",
        action="store_true",
        help="instead: send it as virtual devices would, for 'artemis-edge run'",
    )
    parser.add_argument(
        "--speed", type=float, metavar="X", help="times as fast as recorded (default: no waiting)"
    )
    parser.add_argument(
        "--rig",
        type=Path,
        default=Path("virtual-rig"),
        metavar="DIR",
        help="with --wire: where the devices appear",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="default: the folder 'replay' in the session")


def run(given: argparse.Namespace) -> int:
    """``artemis-edge replay``."""
    if given.speed is not None and not 0.0 < given.speed <= 1000.0:
        raise InputError(f"--speed {given.speed:g}: give a number above 0, for example 2")
    return _wire(given) if given.wire else _map(given)


def _map(given: argparse.Namespace) -> int:
    from artemis_edge.progress import progress
    from artemis_edge.session.replay import Pace, replay

    if not given.session.exists():
        raise InputError(f"there is no {given.session}; give a session, a folder or a .mcap file")
    folder = given.session if given.session.is_dir() else given.session.parent
    out = given.out or folder / "replay"
    with progress(f"replaying {given.session.name}") as report:
        saved = replay(given.session, out, pace=Pace(given.speed or 0.0), report=report)["report"]
    print(
        f"{saved['frames']} frames mapped, {saved['frames_dropped']} dropped; {saved['triangles']} triangles"
    )
    print(f"mesh    {out / 'mesh.ply'}")
    return DONE


def _wire(given: argparse.Namespace) -> int:
    from artemis_edge.session.wire_replay import play

    if given.speed not in (None, 1.0):
        raise InputError("--wire plays at the pace of real devices; leave --speed away")
    return play(given.session, given.rig)
