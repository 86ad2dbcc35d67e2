"""ROS 1 bags (``.bag``), through the package rosbags of the extra ``import``.

rosbags reads the index and finds the chunks; the messages are taken from the chunks here, each of which is
read once in a pass, whatever the order of the topics in it. (Format: wiki.ros.org/Bags/Format/2.0)
"""

from __future__ import annotations

import struct
import weakref
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from artemis_edge.datasets.bag import WHOLE, ChunkCache, Connection, Entry
from artemis_edge.datasets.common import add_counts, one_line
from artemis_edge.errors import InputError
from artemis_edge.session.cdr import Buffer, CdrError

MAGIC = b"#ROSBAG V"
_LENGTH = struct.Struct("<I")
# A connection may be described within a chunk, before its first message.
_CONNECTION_RECORD = b"\x04\0\0\0op=\x07"


class Ros1Bag:
    """Bag of one ``.bag`` file; InputError if it cannot be read or rosbags is not installed."""

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.rosbag1 import Reader
        except ImportError:
            raise InputError(f"reading {path} needs rosbags; pip install 'artemis-edge[import]'") from None
        self.path = path
        self.lost: dict[str, int] = {}
        self.warnings: list[str] = []
        self._cache = ChunkCache()
        try:
            self._reader = Reader(path)
            self._reader.open()
            weakref.finalize(self, self._reader.close)
        except Exception as error:  # rosbags asserts what a damaged index denies
            what = one_line(error) or type(error).__name__
            raise InputError(f"{path} cannot be read ({what}); repair it with 'rosbag reindex'") from None

    def scan(self, needed: Callable[[Connection], int]) -> Iterator[Entry]:
        """Every message once, chunk by chunk."""
        chosen = {c.id: Connection(c.topic, c.msgtype, "ros1") for c in self._reader.connections}
        wanted = {number: needed(connection) for number, connection in chosen.items()}
        chunks: dict[int, list[tuple[int, int, int]]] = defaultdict(list)
        for number, entries in self._reader.indexes.items():
            if wanted.get(number):
                for entry in entries:
                    chunks[entry.chunk_pos].append((entry.offset, entry.time, number))
        for chunk in sorted(chunks):
            for offset, log_ns, number in sorted(chunks[chunk]):
                try:
                    data, count = self.fetch((chunk, offset)), wanted[number]
                except CdrError:
                    add_counts(self.lost, {"undecodable_messages": 1})
                    continue
                yield Entry(chosen[number], log_ns, data if count == WHOLE else data[:count], (chunk, offset))

    def fetch(self, where: Any) -> Buffer:
        """The whole message in a chunk at an offset."""
        chunk, at = where
        content = memoryview(self._cache.get(chunk, self._load))
        try:
            while True:
                head, at = _field(content, at)
                data, at = _field(content, at)
                if _CONNECTION_RECORD not in bytes(head):
                    return data
        except struct.error:
            raise CdrError(f"{self.path} ends within a message") from None

    def _load(self, chunk: int) -> bytes:
        place, file = self._reader.chunks[chunk], self._reader.bio
        try:
            file.seek(place.datapos)
            data: bytes = place.decompressor(file.read(place.datasize))
        except (OSError, EOFError, RuntimeError, ValueError) as error:
            raise CdrError(f"a chunk of {self.path} is damaged: {error}") from None
        return data


def _field(content: memoryview, at: int) -> tuple[memoryview, int]:
    """The bytes behind a length, and where they end."""
    (length,) = _LENGTH.unpack_from(content, at)
    end = at + _LENGTH.size + length
    if end > len(content):
        raise struct.error
    return content[at + _LENGTH.size : end], end
