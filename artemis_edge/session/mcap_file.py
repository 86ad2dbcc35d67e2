"""An MCAP file record by record, however it ended: what is whole, what is torn, what is damaged.

Used to judge and to repair files; ``datasets/mcap_bag.py`` is how recordings are read. (https://mcap.dev/spec)
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema, Statistics
from mcap.stream_reader import CRCValidationError, breakup_chunk

from artemis_edge.errors import InputError
from artemis_edge.session.message_ring import Sent

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_RECORD_LIMIT = 1 << 30  # a chunk is a few MB: a length beyond this is a damaged one
_FAULTS = (
    McapError,
    CRCValidationError,
    struct.error,
    ValueError,
    KeyError,
    RuntimeError,
    EOFError,
    MemoryError,
    OverflowError,
    zstandard.ZstdError,
)
_CONTENT = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
    Opcode.CHUNK: Chunk,
    Opcode.STATISTICS: Statistics,
}

#: What stands in a file: a chunk's content is given after it.
# The library is untyped: Schema, Channel, Attachment, Metadata, Statistics or Message.
Content = Any


@dataclass(slots=True)
class McapFile:
    """A pass over a file. After it: ``finished`` whether it has its end, ``whole_bytes`` up to the last whole record,
    ``torn_bytes`` behind it, ``chunks`` that are whole, and of damaged ones a sentence each.
    """

    path: Path
    size: int = 0
    finished: bool = False
    whole_bytes: int = 0
    chunks: int = 0
    damaged: list[str] = field(default_factory=list)

    @property
    def torn_bytes(self) -> int:
        """Bytes of an incomplete record at the end."""
        return 0 if self.finished else self.size - self.whole_bytes

    def records(self) -> Iterator[tuple[int, Content]]:
        """Every whole record with the position of the top-level record it stands in; InputError if it is no MCAP file.

        Of a chunk whose content is damaged nothing is given. The summary at the end repeats schemas and channels.
        """
        try:
            with self.path.open("rb") as stream:
                self.size = stream.seek(0, 2)
                stream.seek(0)
                if stream.read(len(MAGIC)) != MAGIC:
                    raise InputError(
                        f"{self.path} is not an MCAP file; give one that starts with the MCAP signature"
                    )
                self.whole_bytes = len(MAGIC)
                yield from self._records(stream)
        except OSError as error:
            raise InputError(f"cannot read {self.path}: {error.strerror}") from None

    def _records(self, stream: IO[bytes]) -> Iterator[tuple[int, Content]]:
        while True:
            at, head = stream.tell(), stream.read(_RECORD.size)
            if len(head) < _RECORD.size:
                return
            opcode, size = _RECORD.unpack(head)
            if at + _RECORD.size + size > self.size or opcode == 0 or size > _RECORD_LIMIT:
                return
            if opcode in _CONTENT:
                yield from ((at, found) for found in self._content(opcode, at, stream.read(size)))
            else:
                stream.seek(size, 1)
            self.whole_bytes = at + _RECORD.size + size
            if opcode == Opcode.FOOTER:
                self.finished = stream.read(len(MAGIC)) == MAGIC
                self.whole_bytes += len(MAGIC) if self.finished else 0
                return

    def _content(self, opcode: int, at: int, data: bytes) -> list[Content]:
        try:
            record: Any = _CONTENT[Opcode(opcode)].read(ReadDataStream(BytesIO(data)))
            if not isinstance(record, Chunk):
                return [record]
            found = _broken_up(record)
        except _FAULTS as fault:
            what = " ".join(str(fault).split())[:120] or type(fault).__name__
            self.damaged.append(f"the record at byte {at} is damaged: {what}")
            return []
        self.chunks += 1
        return found


def _broken_up(chunk: Chunk) -> list[Content]:
    """What is in a chunk; one of _FAULTS if it is damaged."""
    if chunk.uncompressed_size > _RECORD_LIMIT:
        raise ValueError("its length is damaged")
    if chunk.compression == "lz4":
        # the library takes whatever the data claim to hold
        plain = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=chunk.uncompressed_size)
        chunk = Chunk(
            "", plain, chunk.message_end_time, chunk.message_start_time, chunk.uncompressed_crc, len(plain)
        )
    records: list[Any] = breakup_chunk(chunk, validate_crc=True)
    return records


@dataclass(slots=True)
class GrowingFile:
    """A file that our recorder is writing: its messages with the numbers that the recorder gave them."""

    path: Path

    def messages(self) -> Iterator[Sent]:
        """Those of all whole chunks, in order."""
        types: dict[int, str] = {}
        channels: dict[int, tuple[str, str]] = {}
        for _, record in McapFile(self.path).records():
            if isinstance(record, Schema):
                types[record.id] = record.name
            elif isinstance(record, Channel):
                channels[record.id] = record.topic, types.get(record.schema_id, "")
            elif isinstance(record, Message):
                topic, ros_type = channels[record.channel_id]
                yield Sent(
                    record.sequence, topic, ros_type, record.log_time, record.publish_time, record.data
                )

    def latest_number(self) -> int:
        """The highest number in the last whole chunk that has messages, -1 if there is none; the rest is not read.

        InputError if the file cannot be read.
        """
        try:
            with self.path.open("rb") as stream:
                for at, size in reversed(_chunks(stream)):
                    stream.seek(at)
                    found = McapFile(self.path)._content(Opcode.CHUNK, at, stream.read(size))
                    if numbers := [record.sequence for record in found if isinstance(record, Message)]:
                        return int(max(numbers))
        except OSError as error:
            raise InputError(f"cannot read {self.path}: {error.strerror}") from None
        return -1


def _chunks(stream: IO[bytes]) -> list[tuple[int, int]]:
    """Place and size of the content of every whole chunk."""
    end, found = stream.seek(0, 2), []
    at = stream.seek(len(MAGIC))
    while at + _RECORD.size <= end:
        opcode, size = _RECORD.unpack(stream.read(_RECORD.size))
        at += _RECORD.size + size
        if opcode == 0 or size > _RECORD_LIMIT:  # nothing was written here, or it is damaged
            break
        if opcode == Opcode.CHUNK and at <= end:
            found.append((at - size, size))
        stream.seek(at)
    return found
