"""Mesh deltas from the pipeline to a viewer in another process, over a Unix socket.

The pipeline never waits: a message is written as far as the socket takes it, what changed meanwhile is merged, block
by block, newest state wins, and a viewer that falls behind by too much is let go.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import F32, F64, I32, I64, U8, MeshDelta

_MAGIC = b"ARTFEED1"
_HEADER = struct.Struct("<8sqqqq")  # magic, bytes that follow, poses, blocks, vertices (triangles: the rest)
_SEND_BUFFER = 4 << 20
_MESSAGE_BYTES = 8 << 20
_MOST_PENDING = 64 << 20
_DRAIN_EVERY_S = 0.01
_VERTEX_BYTES, _TRIANGLE_BYTES = 8 + 12 + 3 + 1 + 4, 24

BlockKey = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Patch:
    """What one block shows: arrays as in ``MeshDelta``."""

    vertex_id: I64
    position: F32
    colour: U8
    label: U8
    confidence: F32
    triangles: I64

    @property
    def nbytes(self) -> int:
        """Bytes on the wire, without the block's own row."""
        return len(self.vertex_id) * _VERTEX_BYTES + len(self.triangles) * _TRIANGLE_BYTES


@dataclass(frozen=True, slots=True)
class Update:
    """One message: positions of the sensor float32 (p, 3), oldest first, and blocks in their newest state."""

    path: F32
    blocks: dict[BlockKey, Patch]


def patches(delta: MeshDelta) -> Iterator[tuple[BlockKey, Patch]]:
    """The blocks of a delta, copied, so that the delta's own arrays need not live on."""
    for k, block in enumerate(delta.block.tolist()):
        v = slice(delta.vertex_start[k], delta.vertex_start[k + 1])
        t = slice(delta.triangle_start[k], delta.triangle_start[k + 1])
        yield (
            (block[0], block[1], block[2]),
            Patch(
                delta.vertex_id[v].copy(),
                delta.position[v].copy(),
                delta.colour[v].copy(),
                delta.label[v].copy(),
                delta.confidence[v].copy(),
                delta.triangles[t].copy(),
            ),
        )


class LiveFeed:
    """The pipeline's end: listens on ``path``, serves the viewer that attached last, at most ``most_hz`` messages/s.

    ``attached`` turns true when a viewer has come that knows nothing yet; whoever tells it everything sets it
    back. ``let_go`` counts viewers that fell behind. Raises InputError if the socket cannot be made.
    """

    def __init__(self, path: Path, most_hz: float = 5.0) -> None:
        self.path = path
        self.attached = False
        self.let_go = 0
        self._period_s = 1.0 / most_hz
        self._pending: dict[BlockKey, Patch] = {}
        self._pending_bytes = 0
        self._path: list[F32] = []
        self._unsent = memoryview(b"")
        self._sent_s = -np.inf
        self._viewer: socket.socket | None = None
        self._listener = _listen(path)

    def publish(self, delta: MeshDelta, T_world_lidar: F64 | None = None) -> None:
        """Offer a frame's delta; returns at once."""
        self._welcome()
        if self._viewer is None:
            return
        for key, patch in patches(delta):
            before = self._pending.pop(key, None)  # to the end: what waits longest goes first
            self._pending_bytes += patch.nbytes - (before.nbytes if before is not None else 0)
            self._pending[key] = patch
        if T_world_lidar is not None:
            self._path.append(T_world_lidar[:3, 3].astype(np.float32))
        if self._pending_bytes > _MOST_PENDING:
            self.let_go += 1
            self._dismiss()
            return
        self.pump()

    def pump(self) -> None:
        """Write what the socket takes now."""
        now = time.monotonic()
        if not self._unsent and (self._pending or self._path) and now - self._sent_s >= self._period_s:
            self._unsent = memoryview(self._message())
            self._sent_s = now
        try:
            while self._unsent and self._viewer is not None:
                self._unsent = self._unsent[self._viewer.send(self._unsent) :]
        except BlockingIOError:
            pass
        except OSError:
            self._dismiss()

    @property
    def waiting(self) -> int:
        """Blocks and bytes that are still to be sent, 0 when the viewer knows all."""
        return len(self._pending) + len(self._unsent)

    def drain(self, most_s: float) -> None:
        """Wait until the viewer knows all, but not longer than ``most_s``."""
        end = time.monotonic() + most_s
        while self._viewer is not None and self.waiting and time.monotonic() < end:
            self.pump()
            time.sleep(_DRAIN_EVERY_S)

    def close(self) -> None:
        """End the connection and remove the socket."""
        self._dismiss()
        self._listener.close()
        self.path.unlink(missing_ok=True)

    def _welcome(self) -> None:
        with contextlib.suppress(BlockingIOError):
            viewer, _ = self._listener.accept()
            viewer.setblocking(False)
            viewer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
            self._dismiss()
            self._viewer, self.attached = viewer, True

    def _dismiss(self) -> None:
        if self._viewer is not None:
            self._viewer.close()
        self._viewer, self._unsent = None, memoryview(b"")
        self._pending, self._pending_bytes, self._path = {}, 0, []

    def _message(self) -> bytes:
        taken: dict[BlockKey, Patch] = {}
        size = 0
        for key, patch in self._pending.items():
            if taken and size + patch.nbytes > _MESSAGE_BYTES:
                break
            taken[key], size = patch, size + patch.nbytes
        for key in taken:
            self._pending_bytes -= self._pending.pop(key).nbytes
        path = np.array(self._path, np.float32).reshape(-1, 3)
        self._path = []
        return encode(Update(path, taken))


def encode(update: Update) -> bytes:
    """An update as it goes over the wire."""
    parts = list(update.blocks.values())
    keys = np.array(list(update.blocks), np.int32).reshape(-1, 3)
    counts = np.array([(len(p.vertex_id), len(p.triangles)) for p in parts], np.int64).reshape(-1, 2)
    names = ("vertex_id", "position", "colour", "label", "confidence", "triangles")
    body = b"".join(
        [update.path.tobytes(), keys.tobytes(), counts.tobytes()]
        + [np.ascontiguousarray(getattr(part, name)).tobytes() for name in names for part in parts]
    )
    vertices = int(counts[:, 0].sum())
    return _HEADER.pack(_MAGIC, len(body), len(update.path), len(parts), vertices) + body


def decode(header: bytes, body: bytes) -> Update:
    """The update of a message's header and body."""
    _, _, poses, blocks, vertices = _HEADER.unpack(header)
    offset = 0

    def take(dtype: str, count: int, width: int = 1) -> np.ndarray:
        nonlocal offset
        array = np.frombuffer(body, dtype, count * width, offset)
        offset += array.nbytes
        return array.reshape(count, width) if width > 1 else array

    path = take("<f4", poses, 3)
    keys: I32 = take("<i4", blocks, 3)
    counts = take("<i8", blocks, 2)
    vertex_id, position = take("<i8", vertices), take("<f4", vertices, 3)
    colour, label, confidence = take("u1", vertices, 3), take("u1", vertices), take("<f4", vertices)
    triangles = take("<i8", int(counts[:, 1].sum()), 3)
    ends = np.concatenate([np.zeros((1, 2), np.int64), np.cumsum(counts, axis=0)])
    found: dict[BlockKey, Patch] = {}
    for k, key in enumerate(keys.tolist()):
        v, t = slice(ends[k, 0], ends[k + 1, 0]), slice(ends[k, 1], ends[k + 1, 1])
        found[(key[0], key[1], key[2])] = Patch(
            vertex_id[v], position[v], colour[v], label[v], confidence[v], triangles[t]
        )
    return Update(path, found)


def receive(path: Path) -> Iterator[Update]:
    """The viewer's end: updates as they come, until the pipeline ends; InputError if nobody serves ``path``."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        try:
            connection.connect(str(path))
        except OSError as error:
            raise InputError(
                f"no map is growing at {path} ({error.strerror}); start one with --set view.socket={path}"
            ) from None
        while (header := _read(connection, _HEADER.size)) is not None:
            if not header.startswith(_MAGIC):
                raise InputError(f"{path} is not a feed of this program; give the socket of a run")
            body = _read(connection, _HEADER.unpack(header)[1])
            if body is None:
                return
            yield decode(header, body)


def _read(connection: socket.socket, count: int) -> bytes | None:
    content = bytearray()
    while len(content) < count:
        try:
            part = connection.recv(min(count - len(content), 1 << 20))
        except ConnectionError:
            return None
        if not part:
            return None
        content += part
    return bytes(content)


def _listen(path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_socket() and not _answers(path):
            path.unlink()  # left by a run that was killed
        before = os.umask(0o177)  # only this user may look
        try:
            listener.bind(str(path))
        finally:
            os.umask(before)
        listener.listen(1)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise InputError(
            f"cannot open the feed {path}: {error.strerror or error}; choose another view.socket"
        ) from None
    return listener


def _answers(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            return False
    return True
