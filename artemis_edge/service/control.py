"""The control socket: JSON lines over a Unix socket, several clients, none of which the service ever waits for.

docs/control-socket.md is the protocol. Who may connect is decided by the file mode of the socket.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import socket
import stat
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from artemis_edge.errors import InputError, UserError

VERSION = 1
MOST_LINE = 1 << 16  # bytes of a request
MOST_CLIENTS = 16
_MOST_UNSENT = 1 << 20
_REQUESTS_A_TURN = 20  # of one client: the others and the devices have their turn, too
_LEAST_EVERY_S = 0.05
_WAITING = 64  # connections not yet accepted

Answer = Callable[[str, dict[str, Any]], dict[str, Any]]


@dataclass(slots=True)
class _Client:
    socket: socket.socket
    heard: bytearray = field(default_factory=bytearray)
    unsent: bytearray = field(default_factory=bytearray)
    every_s: float | None = None
    told_s: float = 0.0
    closing: bool = False


class ControlSocket:
    """Serves requests by ``answer(what, request)``, which raises UserError with a sentence for the client.

    ``path`` is made with file mode ``mode``; InputError if another service has it. ``refused`` counts requests that
    were no requests, ``skipped`` states not sent to a client that was behind.
    """

    def __init__(self, path: Path, mode: int, answer: Answer) -> None:
        self.path = path
        self.refused = self.skipped = 0
        self._answer = answer
        self._clients: list[_Client] = []
        self._listener = _listen(path, mode)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)

    def turn(self, state: Callable[[], dict[str, Any]], timeout_s: float = 0.0) -> None:
        """Serve what has arrived, waiting up to ``timeout_s``; tell subscribers the ``state`` when it is due."""
        for key, _ in self._selector.select(timeout_s):
            if key.fileobj is self._listener:
                self._accept()
            else:
                self._hear(key.data)
        now, told = time.monotonic(), None
        for client in self._clients:
            if client.every_s is not None and now - client.told_s >= client.every_s:
                client.told_s = now
                if client.unsent:  # newest state wins: it gets the next one
                    self.skipped += 1
                    continue
                told = told or {"v": VERSION, "event": "status", "data": state()}
                self._say(client, told)
        for client in [*self._clients]:
            self._push(client)

    def tell(self, event: dict[str, Any]) -> None:
        """An event for all subscribers."""
        for client in self._clients:
            if client.every_s is not None:
                self._say(client, {"v": VERSION, "event": "event", "data": event})

    def close(self) -> None:
        """Send what is waiting as far as it goes, let all clients go, remove the socket."""
        for client in [*self._clients]:
            self._push(client)
            self._drop(client)
        self._selector.close()
        self._listener.close()
        with contextlib.suppress(OSError):
            self.path.unlink()

    def _accept(self) -> None:
        """Everybody who waits; one too many is shown the door."""
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                connection.setblocking(False)
                if len(self._clients) >= MOST_CLIENTS:
                    connection.close()
                    continue
                client = _Client(connection)
                self._clients.append(client)
                self._selector.register(connection, selectors.EVENT_READ, client)

    def _hear(self, client: _Client) -> None:
        try:
            data = client.socket.recv(MOST_LINE)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return
        client.heard += data
        served = 0
        while served < _REQUESTS_A_TURN and (end := client.heard.find(b"\n")) >= 0:
            line = bytes(client.heard[:end])
            del client.heard[: end + 1]
            served += 1
            self._serve(client, line)
        if len(client.heard) > MOST_LINE:
            self._refuse(client, None, f"a request has at most {MOST_LINE} bytes")
            self._push(client)
            self._drop(client)

    def _serve(self, client: _Client, line: bytes) -> None:
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            self._refuse(client, None, "a request is one JSON object on one line")
            return
        if not isinstance(request, dict) or not isinstance(request.get("do"), str):
            self._refuse(client, None, 'a request is an object with a text "do"')
            return
        number = request.get("id")
        if isinstance(number, dict | list):
            number = None
        if request.get("v", VERSION) != VERSION:
            self._refuse(client, number, f"this service speaks version {VERSION} of the protocol")
            return
        try:
            result = self._own(client, request) or self._answer(request["do"], request)
        except UserError as error:
            self._say(client, {"v": VERSION, "id": number, "ok": False, "error": str(error)})
            return
        self._say(client, {"v": VERSION, "id": number, "ok": True, "result": result})

    def _own(self, client: _Client, request: dict[str, Any]) -> dict[str, Any] | None:
        """What concerns the connection itself."""
        if request["do"] == "subscribe":
            every = request.get("every_s", 0.5)
            if (
                isinstance(every, bool)
                or not isinstance(every, int | float)
                or not _LEAST_EVERY_S <= every <= 60.0
            ):
                raise InputError(f"every_s is a number of seconds from {_LEAST_EVERY_S} to 60")
            client.every_s = float(every)
            return {"every_s": client.every_s}
        if request["do"] == "unsubscribe":
            client.every_s = None
            return {"every_s": None}
        return None

    def _refuse(self, client: _Client, number: object, why: str) -> None:
        self.refused += 1
        self._say(client, {"v": VERSION, "id": number, "ok": False, "error": why})

    def _say(self, client: _Client, line: dict[str, Any]) -> None:
        client.unsent += json.dumps(line, separators=(",", ":")).encode() + b"\n"
        if len(client.unsent) > _MOST_UNSENT:  # it asks and does not listen
            client.closing = True

    def _push(self, client: _Client) -> None:
        try:
            while client.unsent and not client.closing:
                del client.unsent[: client.socket.send(client.unsent)]
        except BlockingIOError:
            return
        except OSError:
            client.closing = True
        if client.closing:
            self._drop(client)

    def _drop(self, client: _Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self._selector.unregister(client.socket)
            client.socket.close()


def control_path(given: str) -> Path:
    """The path of the settings, or where it is by default."""
    return Path(given) if given else default_path()


def default_path() -> Path:
    """artemis.sock in the service's runtime directory, else in the user's."""
    for name in ("RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR"):
        if folder := os.environ.get(name, "").split(":")[0]:
            return Path(folder) / "artemis.sock"
    return Path(f"/tmp/artemis-edge-{os.getuid()}") / "artemis.sock"


def viewers_path(control: Path) -> Path:
    """Where the growing mesh is told, beside the control socket."""
    return control.with_name(control.name + ".map")


def _listen(path: Path, mode: int) -> socket.socket:
    """A listening socket of a file mode; InputError if the place is taken or cannot be used."""
    try:
        path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
        if path.exists() or path.is_symlink():
            _remove_stale(path)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        before = os.umask(0o777 & ~mode)
        try:
            listener.bind(str(path))
        finally:
            os.umask(before)
        path.chmod(mode)
        listener.listen(_WAITING)
    except OSError as error:
        raise InputError(f"cannot make the control socket {path}: {error.strerror or error}") from None
    listener.setblocking(False)
    return listener


def _remove_stale(path: Path) -> None:
    """A socket that nobody listens at; anything else is somebody's."""
    if not stat.S_ISSOCK(path.lstat().st_mode):
        raise InputError(f"{path} is there and no socket; give another place for the control socket")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as trial:
        try:
            trial.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            path.unlink(missing_ok=True)
            return
    raise InputError(
        f"another artemis-edge runs and listens at {path}; stop it, or give another service.socket"
    )
