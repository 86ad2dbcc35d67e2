"""Encoded messages on their way from the capture process to the recorder and to the mapping, in shared memory.

One process publishes, any number of others read. The publisher never waits: when a reader is too slow the oldest
messages are overwritten, and that reader knows which. Messages are numbered from 0 without end; a table names the
place of each of the latest ones, so that a reader can ask for any number. A message is encoded once, and the bytes
that are recorded are the bytes that are mapped.
"""

from __future__ import annotations

import mmap
import os
import struct
import threading
from dataclasses import dataclass

from artemis_edge.session.cdr import Buffer

_HEAD = struct.Struct("<QqqHxxI")  # number, log time, sensor's time, bytes of the name, bytes of the message
_COUNTS = 64  # bytes, a cache line: messages published, bytes claimed, number of the oldest message
_PUBLISHED, _CLAIMED, _OLDEST = 0, 1, 2
_ALIGNMENT = 8
PLACES = 1 << 16  # messages a ring holds at most, however small they are


@dataclass(frozen=True, slots=True)
class Sent:
    """A message of a session: ``log_ns`` when the host received it, ``stamp_ns`` when it was measured."""

    number: int
    topic: str
    ros_type: str
    log_ns: int
    stamp_ns: int
    data: bytes


class OverwrittenError(Exception):
    """The message asked for was overwritten; ``oldest`` is the oldest one that is still there."""

    def __init__(self, oldest: int) -> None:
        super().__init__(f"overwritten up to message {oldest}")
        self.oldest = oldest


class MessageRing:
    """A ring over a file descriptor of shared memory (``create``), which other processes inherit."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        size = os.fstat(descriptor).st_size
        # All pages at once: 96 MB that are met page by page cost the first seconds of a recording a tenth of a core.
        self._memory = mmap.mmap(descriptor, size, mmap.MAP_SHARED | mmap.MAP_POPULATE)
        view = memoryview(self._memory)
        # single numbers are read and written faster in a memoryview than in an array
        self._count = view[: 3 * 8].cast("q")
        self._place = view[_COUNTS : _COUNTS + PLACES * 8].cast("q")
        self._bytes = view[_COUNTS + PLACES * 8 :]
        self._room = len(self._bytes)
        self._names: dict[bytes, tuple[str, str]] = {}
        self._encoded: dict[tuple[str, str], bytes] = {}
        # taking a lock orders memory on every CPU: bytes are written before the number that announces them
        self._fence = threading.Lock()

    @classmethod
    def create(cls, megabytes: float, first: int = 0) -> MessageRing:
        """A new ring with room for about so many MB of messages, the next of which has number ``first``."""
        descriptor = os.memfd_create("artemis-messages")
        room = max(1 << 16, int(megabytes * 1e6) // _ALIGNMENT * _ALIGNMENT)
        os.ftruncate(descriptor, _COUNTS + PLACES * 8 + room)
        ring = cls(descriptor)
        ring._count[_PUBLISHED] = ring._count[_OLDEST] = first
        return ring

    @property
    def published(self) -> int:
        """Number of the next message."""
        return int(self._count[_PUBLISHED])

    @property
    def oldest(self) -> int:
        """Number of the oldest message that is certainly intact."""
        return int(self._count[_OLDEST])

    def publish(self, topic: str, ros_type: str, log_ns: int, stamp_ns: int, data: Buffer) -> int:
        """Append a message (from one thread only); returns its number. ValueError if it can never fit."""
        name = self._encoded.get((topic, ros_type)) or self._encode(topic, ros_type)
        size = _HEAD.size + len(name) + len(data)
        if size > self._room // 2:
            raise ValueError(f"a message of {size} bytes is too large for a ring of {self._room}")
        number, at = self.published, int(self._count[_CLAIMED])
        if at % self._room + size > self._room:  # never across the end
            at += self._room - at % self._room
        self._claim(number, at + -(-size // _ALIGNMENT) * _ALIGNMENT)
        row = at % self._room
        _HEAD.pack_into(self._bytes, row, number, log_ns, stamp_ns, len(name), len(data))
        row += _HEAD.size
        self._bytes[row : row + len(name)] = name
        row += len(name)
        self._bytes[row : row + len(data)] = data
        self._place[number % PLACES] = at
        with self._fence:
            self._count[_PUBLISHED] = number + 1
        return number

    def read(self, number: int) -> Sent | None:
        """A message by its number; None if it was not published yet, OverwrittenError if it is gone."""
        if number >= self.published:
            return None
        if number < self.oldest:
            raise OverwrittenError(self.oldest)
        row = int(self._place[number % PLACES]) % self._room
        found, log_ns, stamp_ns, name_size, size = _HEAD.unpack_from(self._bytes, row)
        row += _HEAD.size
        name = bytes(self._bytes[row : row + name_size])
        data = bytes(self._bytes[row + name_size : row + name_size + size])
        with self._fence:
            oldest = self.oldest
        if found != number or number < oldest:
            raise OverwrittenError(oldest)
        topic, ros_type = self._name(name)
        return Sent(number, topic, ros_type, log_ns, stamp_ns, data)

    def latest_log_ns(self) -> int | None:
        """Log time of the newest message; None while there is none."""
        number = self.published - 1
        if number < self.oldest:
            return None
        row = int(self._place[number % PLACES]) % self._room
        found, log_ns, *_ = _HEAD.unpack_from(self._bytes, row)
        return int(log_ns) if found == number else None

    def close(self) -> None:
        """Give the memory back; it lives on while another process has it."""
        for view in (self._count, self._place, self._bytes):
            view.release()
        os.close(self.descriptor)

    def _claim(self, number: int, end: int) -> None:
        """Announce that bytes up to ``end`` are about to be written: what lies there is gone first."""
        oldest = self.oldest
        while oldest < number and (
            int(self._place[oldest % PLACES]) < end - self._room or number - oldest >= PLACES
        ):
            oldest += 1
        with self._fence:
            self._count[_OLDEST] = oldest
            self._count[_CLAIMED] = end

    def _encode(self, topic: str, ros_type: str) -> bytes:
        name = self._encoded[topic, ros_type] = f"{topic}\0{ros_type}".encode()
        return name

    def _name(self, raw: bytes) -> tuple[str, str]:
        if raw not in self._names:
            topic, _, ros_type = raw.decode().partition("\0")
            self._names[raw] = (topic, ros_type)
        return self._names[raw]


class RingReader:
    """A reader's place in a ring. ``lost`` counts messages that were overwritten before it came."""

    def __init__(self, ring: MessageRing, number: int = 0) -> None:
        self.ring = ring
        self.next = number
        self.lost = 0

    def waiting(self) -> int:
        """Messages published and not read."""
        return max(0, self.ring.published - self.next)

    def fill(self) -> float:
        """How much of the ring lies between this reader and the publisher, 0..1."""
        ring = self.ring
        if self.next >= ring.published or self.next < ring.oldest:
            return 0.0 if self.next >= ring.published else 1.0
        claimed, at = int(ring._count[_CLAIMED]), int(ring._place[self.next % PLACES])
        return max((claimed - at) / ring._room, self.waiting() / PLACES)

    def read(self) -> Sent | None:
        """The next message, None if there is none yet."""
        while True:
            try:
                sent = self.ring.read(self.next)
            except OverwrittenError as gone:
                self.lost += gone.oldest - self.next
                self.next = gone.oldest
                continue
            if sent is not None:
                self.next += 1
            return sent
