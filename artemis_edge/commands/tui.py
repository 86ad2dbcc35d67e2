"""``artemis-edge tui``: the operator's terminal."""

from __future__ import annotations

import argparse
import os
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from artemis_edge.commands.common import DONE, FELL_SHORT, command
from artemis_edge.errors import InputError

if TYPE_CHECKING:
    from artemis_edge.tui.remote import Remote


def add(commands: Any) -> None:
    """Declare ``tui``."""
    parser = command(commands, "tui", run_attach, "watch and steer the service from a terminal")
    parser.add_argument(
        "--socket",
        type=Path,
        metavar="PATH",
        help="control socket of the service (default: where run puts it)",
    )


def run_attach(given: argparse.Namespace) -> int:
    """``artemis-edge tui``."""
    from artemis_edge.service.control import default_path
    from artemis_edge.tui.socket_remote import SocketRemote

    _require_terminal("'artemis-edge view' shows the map in a browser, programs ask the control socket")
    run_app(SocketRemote(given.socket or default_path()), Path())
    return DONE


def run_app(remote: Remote, sessions: Path) -> None:
    """Show ``remote`` until the operator leaves."""
    from artemis_edge.tui.app import ArtemisTui
    from artemis_edge.tui.graphics import find_graphics
    from artemis_edge.tui.history import History, history_file

    try:
        colour, keys, history = _has_colour(), read_keys(keys_file()), History(history_file())
        ArtemisTui(remote, sessions, colour, keys, history, find_graphics() if colour else None).run()
    finally:
        remote.close()


def _require_terminal(instead: str) -> None:
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise InputError(f"the terminal application needs a terminal; {instead}")


def keys_file() -> Path:
    """Where the operator may change keys (XDG configuration folder)."""
    base = os.environ.get("XDG_CONFIG_HOME")
    return (Path(base) if base else Path.home() / ".config") / "artemis-edge" / "keys.toml"


def read_keys(file: Path) -> dict[str, str]:
    """Keys by the names of commands (``ask = "a"``); empty without a file. InputError where it is wrong."""
    try:
        keys = tomllib.loads(file.read_text())
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{file} is not valid TOML: {error}") from None
    wrong = [name for name, key in keys.items() if not isinstance(key, str) or not key]
    if wrong:
        raise InputError(f'{file}: {wrong[0]} should be the name of a key, for example {wrong[0]} = "a"')
    return keys


def _has_colour() -> bool:
    return "NO_COLOR" not in os.environ and os.environ.get("TERM", "") not in ("dumb", "vt100", "")


def run_demo(given: argparse.Namespace, seed: int) -> int:
    """``artemis-edge demo --tui``."""
    from artemis_edge.session.results import prepare
    from artemis_edge.tui.child import DemoRemote

    _require_terminal("leave --tui out")
    prepare(given.out)
    remote = DemoRemote(
        given.world, given.seconds, seed, given.out, list(getattr(given, "query", None) or [])
    )
    run_app(remote, given.out)
    finished = (given.out / "report.html").exists()
    print(f"report: {given.out / 'report.html'}" if finished else "left before the map was saved")
    return DONE if finished else FELL_SHORT
