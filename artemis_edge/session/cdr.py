"""CDR, the byte layout of ROS 2 messages (OMG DDS-XTypes 7.4.1, plain CDR version 1).

Four bytes of header (0, kind, two options: kind 0 big-endian, 1 little-endian), then primitives aligned to
their own size, counted from the end of the header. Strings carry a uint32 length that includes a closing NUL,
sequences a uint32 count.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

Buffer = bytes | bytearray | memoryview

_LITTLE_HEADER = b"\x00\x01\x00\x00"
_HEADER_SIZE = len(_LITTLE_HEADER)
_ALIGNMENT = {"b": 1, "B": 1, "?": 1, "h": 2, "H": 2, "i": 4, "I": 4, "q": 8, "Q": 8, "f": 4, "d": 8}


class CdrError(ValueError):
    """The bytes are not a message of the expected type: too short, or of an unknown encoding."""


class CdrReader:
    """Reads primitives in the order they were written; arrays are views of the message, not copies."""

    def __init__(self, data: Buffer) -> None:
        view = memoryview(data)
        if len(view) < _HEADER_SIZE or view[0] != 0 or view[1] > 1:
            raise CdrError(
                f"not plain CDR: the message starts with {bytes(view[:_HEADER_SIZE]).hex() or 'nothing'}"
            )
        self._order = "<" if view[1] else ">"
        self._body = view[_HEADER_SIZE:]
        self._at = 0

    @property
    def little(self) -> bool:
        """Whether the message is little-endian."""
        return self._order == "<"

    @property
    def remaining(self) -> int:
        """Bytes not yet read."""
        return len(self._body) - self._at

    def read(self, code: str) -> Any:
        """One primitive by its ``struct`` code (``I`` uint32, ``d`` float64, ...)."""
        at = self._take(_ALIGNMENT[code], struct.calcsize("=" + code))
        return struct.unpack_from(self._order + code, self._body, at)[0]

    def string(self) -> str:
        """A string; bytes that are not UTF-8 are replaced."""
        count = int(self.read("I"))
        at = self._take(1, count)
        return str(self._body[at : at + count], "utf-8", "replace").rstrip("\0")

    def array(self, code: str, count: int) -> NDArray[Any]:
        """``count`` primitives as a read-only view with the byte order of the message."""
        dtype = np.dtype(self._order + code)
        at = self._take(dtype.itemsize if count else 1, count * dtype.itemsize)
        return np.frombuffer(self._body, dtype, count, at)

    def sequence(self, code: str) -> NDArray[Any]:
        """A counted array."""
        return self.array(code, int(self.read("I")))

    def octets(self, count: int) -> memoryview:
        """``count`` bytes as a view."""
        at = self._take(1, count)
        return self._body[at : at + count]

    def count(self, smallest_item: int) -> int:
        """Length of a sequence of structures of at least ``smallest_item`` bytes each."""
        count = int(self.read("I"))
        if count * smallest_item > self.remaining:
            raise CdrError(f"{count} items are announced where {self.remaining} bytes remain")
        return count

    def align(self, size: int) -> None:
        """Skip padding before a structure aligned to ``size``."""
        self._take(size, 0)

    def _take(self, alignment: int, size: int) -> int:
        start = -(-self._at // alignment) * alignment
        if start + size > len(self._body):
            raise CdrError(f"the message ends after {len(self._body)} bytes where {start + size} are needed")
        self._at = start + size
        return start


class CdrWriter:
    """Writes primitives, little-endian."""

    def __init__(self) -> None:
        self._body = bytearray()

    def write(self, code: str, value: float | bool) -> None:
        """One primitive by its ``struct`` code."""
        self._pad(_ALIGNMENT[code])
        self._body += struct.pack("<" + code, value)

    def string(self, text: str) -> None:
        """A string."""
        encoded = text.encode()
        self.write("I", len(encoded) + 1)
        self._body += encoded + b"\0"

    def array(self, code: str, values: NDArray[Any]) -> None:
        """Primitives without a count."""
        if values.size:
            self._pad(_ALIGNMENT[code])
            self._body += np.ascontiguousarray(values, "<" + code).tobytes()

    def sequence(self, code: str, values: NDArray[Any]) -> None:
        """A counted array."""
        self.write("I", values.size)
        self.array(code, values)

    def octets(self, data: Buffer) -> None:
        """Bytes without a count."""
        self._body += data

    def finish(self) -> bytes:
        """The message with its header."""
        return _LITTLE_HEADER + self._body

    def _pad(self, alignment: int) -> None:
        self._body += bytes(-len(self._body) % alignment)
