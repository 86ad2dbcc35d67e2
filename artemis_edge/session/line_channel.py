"""JSON lines on a stream socket between our own processes: never waits, never raises when the other end is gone."""

from __future__ import annotations

import json
import socket
from typing import Any

_MOST_UNSENT = 1 << 20
_MOST_LINE = 1 << 20


class LineChannel:
    """One end. ``closed`` once the other end is gone; ``dropped`` counts lines that nobody took for too long."""

    def __init__(self, sock: socket.socket) -> None:
        self.socket = sock
        self.closed = False
        self.dropped = 0
        sock.setblocking(False)
        self._in = bytearray()
        self._out = bytearray()

    def say(self, line: dict[str, Any]) -> None:
        """Send, or keep until there is room."""
        if len(self._out) > _MOST_UNSENT:
            self.dropped += 1
            return
        self._out += json.dumps(line, separators=(",", ":")).encode() + b"\n"
        self.push()

    def forget(self) -> None:
        """In a copy of the process: what is half said belongs to the other."""
        self._in.clear()
        self._out.clear()

    def push(self) -> None:
        """Send what is waiting."""
        while self._out and not self.closed:
            try:
                del self._out[: self.socket.send(self._out)]
            except BlockingIOError:
                return
            except OSError:
                self.closed = True

    def lines(self) -> list[dict[str, Any]]:
        """What has arrived; what is no JSON object is left out."""
        self.push()
        while not self.closed:
            try:
                data = self.socket.recv(1 << 16)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data:
                self.closed = True
            self._in += data
        *whole, rest = bytes(self._in).split(b"\n")
        self._in = bytearray(rest[:_MOST_LINE])
        return [line for text in whole if (line := _object(text)) is not None]


def _object(text: bytes) -> dict[str, Any] | None:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None
