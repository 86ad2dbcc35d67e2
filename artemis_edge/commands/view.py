"""``artemis-edge view``: the map in a browser."""

from __future__ import annotations

import argparse
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from artemis_edge.commands.common import DONE, command

if TYPE_CHECKING:
    from artemis_edge.status import QueryStatus
    from artemis_edge.view.live import LiveView

_PORT, _LAST_PORT = 8080, 65_535


def add(commands: Any) -> None:
    """Declare it."""
    parser = command(commands, "view", run_view, "a map in the browser: a finished one, or one that grows")
    parser.add_argument(
        "map", type=Path, nargs="?", metavar="MAP",
        help="an output directory or a mesh.ply; without: the map that the service makes",
    )  # fmt: skip
    parser.add_argument("--port", type=_port, default=_PORT, metavar="N", help=f"default: {_PORT}")
    parser.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS",
        help="listen for other machines, too, on this address; they need the token that is printed",
    )  # fmt: skip
    parser.add_argument(
        "--live", type=Path, metavar="SOCKET", help="the map of a run with this view.socket instead"
    )


def _port(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= _LAST_PORT:
        raise argparse.ArgumentTypeError(f"'{text}' is no port; give 1 to {_LAST_PORT}, for example {_PORT}")
    return int(text)


def run_view(given: argparse.Namespace) -> int:
    """``artemis-edge view``."""
    if given.map is None:
        live = _live_view(given)
        print(f"open {live.browser.url} (stop with Ctrl-C)", flush=True)
        try:
            live.run()
        except KeyboardInterrupt:
            live.close()
        return DONE
    from artemis_edge.view.finished import FinishedView

    finished = FinishedView(given.map, given.host, given.port)
    print(f"open {finished.browser.url} (stop with Ctrl-C)", flush=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        finished.browser.close()
    return DONE


def _live_view(given: argparse.Namespace) -> LiveView:
    from artemis_edge.service.control import default_path, viewers_path
    from artemis_edge.service.map_feed import MapReader
    from artemis_edge.view.live import LiveView, map_socket

    if given.live is not None:
        return LiveView(MapReader(map_socket(given.live)), given.host, given.port)
    feed = MapReader(map_socket(viewers_path(default_path())))
    return LiveView(feed, given.host, given.port, _ask_service, _questions)


def _questions() -> list[QueryStatus]:
    """What the service is asked, and what lights up for it; none while it does not answer."""
    from artemis_edge.service.control import default_path
    from artemis_edge.tui.remote import RemoteError
    from artemis_edge.tui.socket_remote import SocketRemote

    remote = SocketRemote(default_path())
    try:
        return remote.status().queries
    except RemoteError:
        return []
    finally:
        remote.close()


def _ask_service(text: str) -> Any:
    from artemis_edge.errors import InputError
    from artemis_edge.service.control import default_path
    from artemis_edge.tui.remote import RemoteError
    from artemis_edge.tui.socket_remote import SocketRemote
    from artemis_edge.view.browser import Answer

    remote = SocketRemote(default_path())
    try:
        return Answer(remote.ask(text))
    except RemoteError as error:
        raise InputError(str(error)) from None
    finally:
        remote.close()
