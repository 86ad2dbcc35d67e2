"""MCAP files, complete or cut off, read record by record with bounded memory.

The records are walked from the front and the index at the end is not used: a file whose recording was
interrupted has none, and its complete chunks read the same way. (https://mcap.dev/spec)
"""

from __future__ import annotations

import struct
import weakref
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, Protocol

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from artemis_edge.datasets.bag import WHOLE, ChunkCache, Connection, Entry, ros2_type
from artemis_edge.datasets.common import add_counts
from artemis_edge.errors import InputError
from artemis_edge.session.cdr import Buffer, CdrError

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
# message start and end time, uncompressed size and crc, length of the compression's name
_CHUNK = struct.Struct("<QQQII")
_LENGTH = struct.Struct("<Q")
# A chunk is a few MB; a length beyond this is a damaged one, not memory to reserve.
_CHUNK_LIMIT = 1 << 30
# Smaller than a cloud, larger than an IMU message: those come from the buffer, clouds are passed over.
_BUFFER_BYTES = 1 << 15


class _Bytes(Protocol):
    """Where records are: a file or a decompressed chunk."""

    def read(self, at: int, size: int) -> Buffer: ...


class _File:
    """Closed when nobody needs it any more: frames are read long after the recording was opened."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb", _BUFFER_BYTES)
        weakref.finalize(self, self._file.close)
        self.size = self._file.seek(0, 2)

    def read(self, at: int, size: int) -> Buffer:
        self._file.seek(at)
        return self._file.read(size)


class _Memory:
    def __init__(self, data: bytes) -> None:
        self._view = memoryview(data)
        self.size = len(data)

    def read(self, at: int, size: int) -> Buffer:
        return self._view[at : at + size]


class McapBag:
    """Bag of one ``.mcap`` file; InputError if it is none."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lost: dict[str, int] = {}
        self.warnings: list[str] = []
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Connection] = {}
        self._cache = ChunkCache()
        try:
            self._file = _File(path)
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror}") from None
        if bytes(self._file.read(0, len(MAGIC))) != MAGIC:
            raise InputError(
                f"{path} is not an MCAP file; give a recording that starts with the MCAP signature"
            )

    def scan(self, needed: Callable[[Connection], int]) -> Iterator[Entry]:
        """Every message once, in the order of the file."""
        for opcode, at, size in self._records(self._file, len(MAGIC), self._file.size):
            if opcode == Opcode.DATA_END:
                return
            if opcode == Opcode.CHUNK:
                yield from self._scan_chunk(at, size, needed)
            else:
                yield from self._scan_record(self._file, None, opcode, at, size, needed)
        add_counts(self.lost, {"truncated_file": 1})
        self.warnings.append(f"{self.path} is cut off; what was recorded up to there is used")

    def fetch(self, where: Any) -> Buffer:
        """The whole message at ``where``: its chunk (None: in the file itself), position and length."""
        chunk, at, size = where
        data = (self._file if chunk is None else self._chunk(chunk)).read(at, size)
        if len(data) < size:
            raise CdrError(f"{self.path} ends within a message")
        return data

    def _records(self, source: _Bytes, at: int, end: int) -> Iterator[tuple[int, int, int]]:
        """Opcode, position of the content and its length, of every complete record."""
        while at + _RECORD.size <= end:
            opcode, size = _RECORD.unpack(source.read(at, _RECORD.size))
            at += _RECORD.size
            if opcode == 0 or at + size > end:
                return
            yield opcode, at, size
            at += size

    def _scan_record(
        self,
        source: _Bytes,
        chunk: int | None,
        opcode: int,
        at: int,
        size: int,
        needed: Callable[[Connection], int],
    ) -> Iterator[Entry]:
        if opcode == Opcode.MESSAGE and size >= _MESSAGE.size:
            number, _sequence, log_ns, _publish_ns = _MESSAGE.unpack(source.read(at, _MESSAGE.size))
            connection = self._channels.get(number)
            if connection is None:
                add_counts(self.lost, {"messages_without_channel": 1})
                return
            count, length = needed(connection), size - _MESSAGE.size
            if count:
                start = at + _MESSAGE.size
                data = source.read(start, length if count == WHOLE else min(count, length))
                yield Entry(connection, log_ns, data, (chunk, start, length))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._declare(opcode, bytes(source.read(at, size)))

    def _declare(self, opcode: int, content: bytes) -> None:
        stream = ReadDataStream(BytesIO(content))
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self._schemas[schema.id] = ros2_type(schema.name)
            else:
                channel = Channel.read(stream)
                ros_type = self._schemas.get(channel.schema_id, "")
                self._channels[channel.id] = Connection(channel.topic, ros_type, channel.message_encoding)
        except (McapError, struct.error, ValueError):
            add_counts(self.lost, {"damaged_records": 1})

    def _scan_chunk(self, at: int, size: int, needed: Callable[[Connection], int]) -> Iterator[Entry]:
        try:
            compression, _, _, start, length = self._chunk_header(at, size)
            if compression == "":
                source: _Bytes = self._file
                chunk, end = None, start + length
            else:
                memory = self._chunk(at)
                source, chunk, start, end = memory, at, 0, memory.size
        except CdrError as error:
            add_counts(self.lost, {"damaged_chunks": 1})
            self.warnings.append(f"a chunk of {self.path} is left out: {error}")
            return
        reached = start
        for opcode, inner, inner_size in self._records(source, start, end):
            reached = inner + inner_size
            yield from self._scan_record(source, chunk, opcode, inner, inner_size, needed)
        if reached != end:
            add_counts(self.lost, {"damaged_chunks": 1})
            self.warnings.append(f"a chunk of {self.path} is damaged; its messages up to there are used")

    def _chunk_header(self, at: int, size: int) -> tuple[str, int, int, int, int]:
        """Compression, uncompressed size and crc of a chunk, and where its records are and how long."""
        head = self._file.read(at, _CHUNK.size)
        if len(head) < _CHUNK.size:
            raise CdrError("it is too short")
        _first, _last, plain_size, crc, name_size = _CHUNK.unpack(head)
        if _CHUNK.size + name_size + _LENGTH.size > size:
            raise CdrError("its header is damaged")
        rest = bytes(self._file.read(at + _CHUNK.size, name_size + _LENGTH.size))
        (length,) = _LENGTH.unpack(rest[name_size:])
        start = at + _CHUNK.size + name_size + _LENGTH.size
        if start + length > at + size or plain_size > _CHUNK_LIMIT:
            raise CdrError("its length is damaged")
        return rest[:name_size].decode("utf-8", "replace"), plain_size, crc, start, length

    def _chunk(self, at: int) -> _Memory:
        """The decompressed chunk whose content begins at ``at``."""
        return _Memory(self._cache.get(at, self._load))

    def _load(self, at: int) -> bytes:
        compression, plain_size, crc, start, length = self._chunk_header(at, self._file.size - at)
        data = _decompress(compression, bytes(self._file.read(start, length)), plain_size)
        if len(data) != plain_size or (crc and zlib.crc32(data) != crc):
            raise CdrError("its checksum is wrong")
        return data


def _decompress(compression: str, data: bytes, size: int) -> bytes:
    """Decompressed bytes, never more than ``size``, whatever the data claim."""
    try:
        if compression == "lz4":
            plain: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
            return plain
        if compression == "zstd":
            if zstandard.frame_content_size(data) > size:
                raise CdrError("its length is damaged")
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    except (RuntimeError, zstandard.ZstdError, EOFError):
        raise CdrError(f"its {compression} data are damaged") from None
    raise CdrError(f"it is compressed as '{compression}'")
