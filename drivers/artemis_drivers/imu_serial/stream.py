"""Frames out of a stream of bytes that may begin anywhere and hold noise."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Protocol

NEED_MORE = 0  # the header is not complete yet
NO_FRAME = -1  # no frame begins here


class Framing(Protocol):
    """How a protocol delimits frames. ``starts``: the bytes that may begin one; ``longest``: bytes."""

    starts: bytes
    longest: int

    def length(self, buffer: bytearray, start: int) -> int:
        """Bytes of the frame that begins at ``start``, or NEED_MORE, or NO_FRAME. Never above ``longest``."""
        ...

    def valid(self, frame: bytes) -> bool:
        """Whether the frame's own check (sum, CRC) holds."""
        ...


@dataclass(slots=True)
class StreamCounts:
    """What was in the stream: whole frames, bytes that belong to none, and frames whose check failed."""

    frames: int = 0
    skipped_bytes: int = 0
    bad_checks: int = 0


class FrameSplitter:
    """Cuts a stream into frames. Memory is bounded by the longest frame plus one chunk.

    After a failed check the search goes on one byte later, not behind the frame: a start byte in noise claims
    a length, and true frames may lie inside it. So noise delays a frame, and never costs one.
    """

    def __init__(self, framing: Framing) -> None:
        self.counts = StreamCounts()
        self._framing = framing
        self._start = re.compile(b"[" + re.escape(framing.starts) + b"]")
        self._buffer = bytearray()

    def feed(self, chunk: bytes) -> list[bytes]:
        """Frames completed by ``chunk``, in order."""
        self._buffer += chunk
        return self._cut()

    def abandon(self) -> list[bytes]:
        """The line fell silent: what waits for its end is noise; frames that lie inside it.

        Without this, a false start could hold back the last frame before a pause.
        """
        found: list[bytes] = []
        while self._buffer:
            self.counts.skipped_bytes += 1
            del self._buffer[0]
            found += self._cut()
        return found

    def _cut(self) -> list[bytes]:
        buffer, framing, counts = self._buffer, self._framing, self.counts
        found: list[bytes] = []
        at = 0
        while match := self._start.search(buffer, at):
            counts.skipped_bytes += match.start() - at
            at = match.start()
            size = framing.length(buffer, at)
            if size == NEED_MORE or size > len(buffer) - at:
                break
            if size != NO_FRAME:
                frame = bytes(buffer[at : at + size])
                if framing.valid(frame):
                    found.append(frame)
                    counts.frames += 1
                    at += size
                    continue
                counts.bad_checks += 1
            counts.skipped_bytes += 1
            at += 1
        else:
            counts.skipped_bytes += len(buffer) - at
            at = len(buffer)
        del buffer[:at]
        return found
