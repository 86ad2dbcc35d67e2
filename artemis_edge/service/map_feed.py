"""The growing mesh for viewers, over a Unix socket beside the control socket; the mapping never waits for one.

A message is a little-endian uint32 length and as many bytes: a JSON line that names the arrays, then their bytes
(docs/control-socket.md). A viewer that is slow gets the newest state of each block later, never an older one first.
There is no thread: the mapping process forks copies of itself (checkpoint.py), and threads do not survive that.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge.frames import MeshDelta
from artemis_edge.newest import Newest

_LENGTH = struct.Struct("<I")
MOST_MESSAGE = 1 << 28
MOST_VIEWERS = 8
_BLOCKS = 24  # in one message: some hundred kB
_FIELDS = (
    "block", "vertex_start", "triangle_start", "vertex_id", "position", "normal", "colour", "label",
    "confidence", "triangles", "probability",
)  # fmt: skip


def to_bytes(delta: MeshDelta) -> bytes:
    """One message without its length."""
    arrays = [np.ascontiguousarray(getattr(delta, name)) for name in _FIELDS]
    head = {
        "index": delta.index,
        "arrays": [[n, a.dtype.str, a.shape] for n, a in zip(_FIELDS, arrays, strict=True)],
    }
    return json.dumps(head).encode() + b"\n" + b"".join(a.tobytes() for a in arrays)


def from_bytes(data: bytes) -> MeshDelta:
    """Inverse of ``to_bytes``; ValueError for bytes that are no message."""
    line, newline, rest = data.partition(b"\n")
    head: dict[str, Any] = json.loads(line)
    at, arrays = 0, {}
    for name, kind, shape in head["arrays"]:
        dtype = np.dtype(kind)
        count = int(np.prod(shape))
        if not newline or dtype.hasobject or at + count * dtype.itemsize > len(rest):
            raise ValueError("message cut off")
        arrays[name] = np.frombuffer(rest, dtype, count, at).reshape(shape)
        at += count * dtype.itemsize
    if set(arrays) != set(_FIELDS):
        raise ValueError("message without all arrays")
    return MeshDelta(index=int(head["index"]), **arrays)


class _Viewer:
    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self.newest = Newest()
        self.unsent = memoryview(b"")
        self.began_s = 0.0  # with the message that was sent last


class MapFeed:
    """Serves viewers in ``turn``, which is called after every frame and while there is nothing to do."""

    def __init__(self, path: Path, mode: int) -> None:
        self.path = path
        with contextlib.suppress(FileNotFoundError):
            path.unlink()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        before = os.umask(0o777 & ~mode)
        try:
            self._listener.bind(str(path))
        except OSError:
            self._listener.close()
            raise
        finally:
            os.umask(before)
        self._listener.listen()
        self._listener.setblocking(False)
        self._viewers: list[_Viewer] = []
        self.most_hz = 0.0  # messages a second to each viewer; 0: without bound

    def __len__(self) -> int:
        return len(self._viewers)

    @property
    def waiting(self) -> bool:
        """Whether a viewer has not been told everything yet."""
        return any(len(viewer.newest) or viewer.unsent for viewer in self._viewers)

    def add(self, delta: MeshDelta) -> None:
        """News for all viewers."""
        for viewer in self._viewers:
            viewer.newest.add(delta)

    def turn(self) -> bool:
        """Accept and send what goes without waiting; True if a viewer is new and must be told the whole map."""
        new = self._accept()
        for viewer in [*self._viewers]:
            try:
                self._send(viewer)
            except BlockingIOError:
                continue
            except OSError:
                self._viewers.remove(viewer)
                viewer.socket.close()
        return new

    def forget_viewers(self) -> None:
        """In a copy of the process that takes over: what was half sent is lost; viewers connect again."""
        for viewer in self._viewers:
            with contextlib.suppress(OSError):
                viewer.socket.shutdown(socket.SHUT_RDWR)  # the copies of this process hold it open, too
            viewer.socket.close()
        self._viewers.clear()

    def close(self) -> None:
        """Let all viewers go and remove the socket."""
        self.forget_viewers()
        self._listener.close()
        with contextlib.suppress(OSError):
            self.path.unlink()

    def _accept(self) -> bool:
        new = False
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                if len(self._viewers) >= MOST_VIEWERS:
                    connection.close()
                    continue
                connection.setblocking(False)
                self._viewers.append(_Viewer(connection))
                new = True
        return new

    def _send(self, viewer: _Viewer) -> None:
        if not viewer.unsent:
            now = time.monotonic()
            if self.most_hz > 0.0 and now - viewer.began_s < 1.0 / self.most_hz:
                return
            viewer.began_s = now
            delta = viewer.newest.take(_BLOCKS)
            if delta is None:
                return
            message = to_bytes(delta)
            viewer.unsent = memoryview(_LENGTH.pack(len(message)) + message)
        viewer.unsent = viewer.unsent[viewer.socket.send(viewer.unsent) :]


class MapReader:
    """The viewer's side: ``take`` gives the deltas that have arrived, without waiting."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._socket: socket.socket | None = None
        self._heard = bytearray()

    def take(self) -> list[MeshDelta]:
        """News; empty while nobody is there. Connects again by itself."""
        try:
            self._hear()
        except OSError:
            self.close()
        found = []
        while len(self._heard) >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._heard)
            if length > MOST_MESSAGE:
                self.close()
                break
            end = _LENGTH.size + length
            if len(self._heard) < end:
                break
            try:
                found.append(from_bytes(bytes(self._heard[_LENGTH.size : end])))
            except (ValueError, KeyError, TypeError):
                self.close()
                break
            del self._heard[:end]
        return found

    def close(self) -> None:
        """Detach."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None
        self._heard.clear()

    def _hear(self) -> None:
        if self._socket is None:
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                connection.connect(str(self._path))
            except OSError:
                connection.close()
                raise
            connection.setblocking(False)
            self._socket = connection
        with contextlib.suppress(BlockingIOError):
            while data := self._socket.recv(1 << 20):
                self._heard += data
            raise ConnectionResetError
