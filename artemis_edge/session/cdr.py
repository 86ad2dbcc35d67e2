"""CDR, the byte layout of ROS 2 messages (OMG DDS-XTypes 7.4.1, plain CDR version 1), and that of ROS 1.

Four bytes of header (0, kind, two options: kind 0 big-endian, 1 little-endian), then primitives aligned to
their own size, counted from the end of the header. Strings carry a uint32 length that includes a closing NUL,
sequences a uint32 count. ROS 1 writes the same fields little-endian without header, alignment and NUL.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

Buffer = bytes | bytearray | memoryview

_LITTLE_HEADER = b"\x00\x01\x00\x00"
_HEADER_SIZE = len(_LITTLE_HEADER)
_CODES = "bB?hHiIqQfd"
_LITTLE = {code: struct.Struct("<" + code) for code in _CODES}
_BIG = {code: struct.Struct(">" + code) for code in _CODES}


class CdrError(ValueError):
    """The bytes are not a message of the expected type: too short, or of an unknown encoding."""


class CdrReader:
    """Reads primitives in the order they were written; arrays are views of the message, not copies."""

    def __init__(self, data: Buffer) -> None:
        view = memoryview(data)
        if len(view) < _HEADER_SIZE or view[0] != 0 or view[1] > 1:
            start = bytes(view[:_HEADER_SIZE]).hex() or "nothing"
            raise CdrError(f"not plain CDR: the message starts with {start}")
        self._order = "<" if view[1] else ">"
        self._structs = _LITTLE if view[1] else _BIG
        self._body = view[_HEADER_SIZE:]
        self._at = 0

    def read(self, code: str) -> Any:
        """One primitive by its ``struct`` code (``I`` uint32, ``d`` float64, ...)."""
        layout = self._structs[code]
        return layout.unpack_from(self._body, self._take(layout.size, layout.size))[0]

    def string(self) -> str:
        """A string; bytes that are not UTF-8 are replaced."""
        return str(self.octets(int(self.read("I"))), "utf-8", "replace").rstrip("\0")

    def stamp(self) -> tuple[int, int]:
        """Seconds and nanoseconds of a std_msgs/Header, at its start."""
        return self.read("i"), self.read("I")

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

    def structures(self, dtype: np.dtype[Any], count: int, last_size: int) -> NDArray[Any]:
        """``count`` structures of a little-endian ``dtype``, the last of only ``last_size`` bytes."""
        if count == 0:
            return np.empty(0, dtype)
        at = self._take(4, (count - 1) * dtype.itemsize + last_size)
        raw = bytes(self._body[at : self._at]) + bytes(dtype.itemsize - last_size)
        return np.frombuffer(raw, dtype if self._order == "<" else dtype.newbyteorder(">"))

    def count(self, smallest_item: int) -> int:
        """Length of a sequence of structures of at least ``smallest_item`` bytes each."""
        count, remaining = int(self.read("I")), len(self._body) - self._at
        if count * smallest_item > remaining:
            raise CdrError(f"{count} items are announced where {remaining} bytes remain")
        return count

    def _take(self, alignment: int, size: int) -> int:
        start = -(-self._at // alignment) * alignment
        if start + size > len(self._body):
            raise CdrError(f"the message ends after {len(self._body)} bytes where {start + size} are needed")
        self._at = start + size
        return start


class Ros1Reader(CdrReader):
    """Reads the same fields from ROS 1 bytes: packed, and a header begins with a sequence number."""

    def __init__(self, data: Buffer) -> None:
        self._order = "<"
        self._structs = _LITTLE
        self._body = memoryview(data)
        self._at = 0

    def stamp(self) -> tuple[int, int]:
        """Seconds and nanoseconds of a std_msgs/Header, at its start."""
        self.read("I")
        return self.read("I"), self.read("I")

    def structures(self, dtype: np.dtype[Any], count: int, last_size: int) -> NDArray[Any]:
        """``count`` structures of ``last_size`` bytes each: ROS 1 does not pad between them."""
        fields = {name: place[:2] for name, place in (dtype.fields or {}).items()}
        formats, offsets = [place[0] for place in fields.values()], [place[1] for place in fields.values()]
        packed = np.dtype(
            {"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": last_size}
        )
        return np.frombuffer(self.octets(count * last_size), packed)

    def _take(self, alignment: int, size: int) -> int:
        return super()._take(1, size)


class CdrWriter:
    """Writes primitives, little-endian. Large parts are copied once, when the message is finished."""

    def __init__(self) -> None:
        self._parts: list[Buffer] = [_LITTLE_HEADER]
        self._size = 0

    def write(self, code: str, value: float | bool) -> None:
        """One primitive by its ``struct`` code."""
        layout = _LITTLE[code]
        self._pad(layout.size)
        self.octets(layout.pack(value))

    def string(self, text: str) -> None:
        """A string."""
        encoded = text.encode()
        self.write("I", len(encoded) + 1)
        self.octets(encoded + b"\0")

    def array(self, code: str, values: NDArray[Any]) -> None:
        """Primitives without a count."""
        if values.size:
            self._pad(_LITTLE[code].size)
            self.octets(np.ascontiguousarray(values, "<" + code).reshape(-1).view(np.uint8).data)

    def sequence(self, code: str, values: NDArray[Any]) -> None:
        """A counted array."""
        self.write("I", values.size)
        self.array(code, values)

    def octets(self, data: Buffer) -> None:
        """Bytes without a count; they must not change before ``finish``."""
        self._parts.append(data)
        self._size += len(data)

    def finish(self) -> bytes:
        """The message with its header."""
        return b"".join(self._parts)

    def _pad(self, alignment: int) -> None:
        if missing := -self._size % alignment:
            self.octets(bytes(missing))
