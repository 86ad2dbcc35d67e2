"""``artemis-edge view``: the map in a browser."""

from __future__ import annotations

import argparse
import os
import threading
from pathlib import Path
from typing import Any

from artemis_edge.commands.common import DONE, command

_PORT = 8080


def default_socket() -> Path:
    """Where a run feeds its viewer unless told otherwise."""
    return Path(os.environ.get("XDG_RUNTIME_DIR", "/tmp")) / "artemis-edge" / "view.sock"


def add(commands: Any) -> None:
    """Declare it."""
    parser = command(commands, "view", run_view, "a map in the browser: a finished one, or one that grows")
    parser.add_argument(
        "map", type=Path, nargs="?", metavar="MAP", help="an output directory or a mesh.ply; without: live"
    )
    parser.add_argument("--port", type=int, default=_PORT, metavar="N", help=f"default: {_PORT}")
    parser.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS",
        help="listen for other machines, too, on this address; they need the token that is printed",
    )  # fmt: skip
    parser.add_argument(
        "--live", type=Path, default=None, metavar="SOCKET", help="feed of a run, as of its view.socket"
    )


def run_view(given: argparse.Namespace) -> int:
    """``artemis-edge view``."""
    if given.map is not None:
        from artemis_edge.view.finished import FinishedView

        finished = FinishedView(given.map, given.host, given.port)
        _announce(finished.browser.url)
        _wait(finished.browser)
        return DONE
    from artemis_edge.view.live import LiveView

    live = LiveView(given.live or default_socket(), given.host, given.port)
    _announce(live.browser.url)
    live.run()
    print("the run has ended; the map stays until you stop this command", flush=True)
    _wait(live.browser)
    return DONE


def _announce(url: str) -> None:
    print(f"open {url} (stop with Ctrl-C)", flush=True)


def _wait(browser: Any) -> None:
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        browser.close()
