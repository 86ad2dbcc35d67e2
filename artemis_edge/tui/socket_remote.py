"""The service behind its control socket (docs/control-socket.md), as the terminal wants it."""

from __future__ import annotations

import json
import socket
import threading
from pathlib import Path
from typing import Any

import msgspec

from artemis_edge.frames import MeshDelta
from artemis_edge.service.control import viewers_path
from artemis_edge.service.map_feed import MapReader
from artemis_edge.status import Status
from artemis_edge.tui.remote import RemoteError

_ANSWER_S = 3.0
_MOST_ANSWER = 1 << 22


class SocketRemote:
    """Connects when first asked, and again after the service was away; one request at a time."""

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._path = path
        self._lock = threading.Lock()
        self._socket: socket.socket | None = None
        self._heard = bytearray()
        self._number = 0
        self._map = MapReader(viewers_path(path))

    def status(self) -> Status:
        """The state as the service tells it."""
        try:
            return msgspec.convert(self._ask({"do": "status"}), Status)
        except msgspec.ValidationError:
            raise RemoteError("the service is of another version; update the older of the two") from None

    def deltas(self) -> list[MeshDelta]:
        """News of the mesh, from the socket beside the control socket."""
        return self._map.take()

    def ask(self, text: str) -> str:
        """Add a live question."""
        found = self._ask({"do": "ask", "text": text})
        return str(found["note"]) if found.get("status") == "unsupported" else f"looking for '{text}'"

    def forget(self, text: str) -> str:
        """Remove a live question."""
        self._ask({"do": "forget", "text": text})
        return f"'{text}' is no longer looked for"

    def command(self, name: str) -> str:
        """start, stop or mark."""
        found = self._ask({"do": name})
        return (
            f"marked, number {found['number']}"
            if name == "mark"
            else f"the service is {found.get('phase', '')}"
        )

    def close(self) -> None:
        """Detach."""
        with self._lock:
            self._forget_socket()
            self._map.close()

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        with self._lock:
            self._number += 1
            line = json.dumps({"v": 1, "id": self._number, **request}).encode() + b"\n"
            try:
                answer = self._exchange(line)
            except (OSError, ValueError) as error:
                self._forget_socket()
                raise RemoteError(_sentence(self._path, error)) from None
        if not answer.get("ok"):
            raise RemoteError(str(answer.get("error", "the service refused")))
        result: dict[str, Any] = answer["result"]
        return result

    def _exchange(self, line: bytes) -> dict[str, Any]:
        if self._socket is None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            self._socket.settimeout(_ANSWER_S)
            self._socket.connect(str(self._path))
            self._heard.clear()
        self._socket.sendall(line)
        while True:
            while (end := self._heard.find(b"\n")) < 0:
                data = self._socket.recv(1 << 16)
                if not data or len(self._heard) > _MOST_ANSWER:
                    raise ConnectionResetError("the service closed the connection")
                self._heard += data
            answer = json.loads(bytes(self._heard[:end]))
            del self._heard[: end + 1]
            if isinstance(answer, dict) and answer.get("id") == self._number:
                return answer

    def _forget_socket(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None


def _sentence(path: Path, error: OSError | ValueError) -> str:
    if isinstance(error, FileNotFoundError | ConnectionRefusedError):
        return f"no service listens at {path}; start it with: artemis-edge run, or name its socket: tui --socket PATH"
    if isinstance(error, PermissionError):
        return f"you may not use {path}; join the service's group, or ask its administrator"
    if isinstance(error, TimeoutError):
        return f"the service at {path} does not answer; see its journal"
    return f"the connection to {path} broke ({error}); trying again"
