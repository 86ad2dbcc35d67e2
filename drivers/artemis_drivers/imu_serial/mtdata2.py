"""Xsens Xbus messages and MTData2 items (Xsens MT Low Level Communication Protocol, document MT0101P).

A message is FA BID MID LEN data CS, big-endian; LEN FF is followed by a u16 length. The sum of all bytes from
BID to CS is 0 modulo 256. MTData2 holds items: id u16, length u8, data. The id says what it is, in which
coordinates (bits 2-3) and in which precision (bits 0-1). ``encode`` and ``decode`` are inverse.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

from artemis_drivers.imu_serial.stream import NEED_MORE, NO_FRAME

PREAMBLE = 0xFA
MASTER = 0xFF  # bus id of the device itself
_EXTENDED = 0xFF
_LONGEST_DATA = 2048  # MT0101P: the longest data of an extended message
EVERY_PACKET = 0xFFFF  # output rate: with every packet


class Mid(IntEnum):
    """Message ids; the answer to a request has the id one above."""

    REQ_DID = 0x00
    DEVICE_ID = 0x01
    GOTO_MEASUREMENT = 0x10
    SET_BAUDRATE = 0x18
    SET_SYNC_SETTINGS = 0x2C
    GOTO_CONFIG = 0x30
    MTDATA2 = 0x36
    WAKE_UP = 0x3E
    WAKE_UP_ACK = 0x3F
    RESET = 0x40
    ERROR = 0x42
    SET_OPTION_FLAGS = 0x48
    SET_UTC_TIME = 0x60
    SET_OUTPUT_CONFIGURATION = 0xC0


class Precision(IntEnum):
    """Number formats of the items: bits 0-1 of the id."""

    FLOAT32 = 0
    FP12_20 = 1
    FP16_32 = 2
    FLOAT64 = 3


class Coordinates(IntEnum):
    """Coordinate systems of the items: bits 2-3 of the id."""

    ENU = 0
    NED = 4
    NWU = 8


class Type(IntEnum):
    """What an item is: the id without coordinates and precision."""

    TEMPERATURE = 0x0810
    UTC = 0x1010
    PACKET_COUNTER = 0x1020
    SAMPLE_TIME_FINE = 0x1060
    SAMPLE_TIME_COARSE = 0x1070
    QUATERNION = 0x2010
    MATRIX = 0x2020
    EULER = 0x2030
    PRESSURE = 0x3010
    DELTA_V = 0x4010
    ACCELERATION = 0x4020
    FREE_ACCELERATION = 0x4030
    ACCELERATION_HR = 0x4040
    ALTITUDE = 0x5020
    LAT_LON = 0x5040
    GNSS_PVT = 0x7010
    RATE_OF_TURN = 0x8020
    DELTA_Q = 0x8030
    RATE_OF_TURN_HR = 0x8040
    MAGNETIC_FIELD = 0xC020
    VELOCITY = 0xD010
    STATUS_BYTE = 0xE010
    STATUS_WORD = 0xE020


_TYPE_BITS, _COORDINATE_BITS, _PRECISION_BITS = 0xF8F0, 0x000C, 0x0003

# how many real numbers an item holds
_REALS: dict[int, int] = {
    Type.TEMPERATURE: 1,
    Type.QUATERNION: 4,
    Type.MATRIX: 9,
    Type.EULER: 3,
    Type.DELTA_V: 3,
    Type.ACCELERATION: 3,
    Type.FREE_ACCELERATION: 3,
    Type.ACCELERATION_HR: 3,
    Type.ALTITUDE: 1,
    Type.LAT_LON: 2,
    Type.RATE_OF_TURN: 3,
    Type.DELTA_Q: 4,
    Type.RATE_OF_TURN_HR: 3,
    Type.MAGNETIC_FIELD: 3,
    Type.VELOCITY: 3,
}
# whole numbers; UTC: ns, year, month, day, hour, minute, second, flags
_WHOLE: dict[int, struct.Struct] = {
    Type.UTC: struct.Struct(">IHBBBBBB"),
    Type.PACKET_COUNTER: struct.Struct(">H"),
    Type.SAMPLE_TIME_FINE: struct.Struct(">I"),
    Type.SAMPLE_TIME_COARSE: struct.Struct(">I"),
    Type.PRESSURE: struct.Struct(">I"),
    # itow, date and time, valid, accuracy, ns, fix, flags, satellites, reserved, lon, lat, heights,
    # accuracies, velocity, speed, heading, accuracies, heading of vehicle, seven dilutions of precision
    Type.GNSS_PVT: struct.Struct(">IHBBBBBBIiBBBBiiiiIIiiiiiIIi7H"),
    Type.STATUS_BYTE: struct.Struct(">B"),
    Type.STATUS_WORD: struct.Struct(">I"),
}
_CODES = {int(Precision.FLOAT32): "f", int(Precision.FLOAT64): "d"}
_BYTES_OF_REAL = {
    Precision.FLOAT32: 4,
    Precision.FP12_20: 4,
    Precision.FP16_32: 6,
    Precision.FLOAT64: 8,
}
_FP12_20 = 2.0**20
_FP16_32 = 2**32


class MalformedError(ValueError):
    """Bytes with a good checksum that are nonetheless no such message."""


@dataclass(frozen=True, slots=True)
class Message:
    """An Xbus message: id (see Mid), data, and the bus id of who is meant or who speaks."""

    mid: int
    data: bytes = b""
    bid: int = MASTER


@dataclass(frozen=True, slots=True)
class Item:
    """An item of MTData2. ``values`` are numbers in the units of the protocol (m/s2, rad/s, degrees, ticks of
    0.1 ms); for an item unknown here they are empty, and ``raw`` holds the bytes.
    """

    data_id: int
    values: tuple[float, ...] = ()
    raw: bytes = b""

    @property
    def type(self) -> int:
        """What it is: compare with Type."""
        return self.data_id & _TYPE_BITS

    @property
    def coordinates(self) -> int:
        """Compare with Coordinates."""
        return self.data_id & _COORDINATE_BITS

    @property
    def precision(self) -> int:
        """Compare with Precision."""
        return self.data_id & _PRECISION_BITS


class XbusFraming:
    """Delimits Xbus messages of the device (bus id FF)."""

    starts = bytes([PREAMBLE])
    longest = _LONGEST_DATA + 7

    def length(self, buffer: bytearray, start: int) -> int:
        """See stream.Framing."""
        header = buffer[start + 1 : start + 6]
        if header and header[0] != MASTER:
            return NO_FRAME
        if len(header) < 3:
            return NEED_MORE
        if header[2] != _EXTENDED:
            return 5 + header[2]
        if len(header) < 5:
            return NEED_MORE
        size = header[3] << 8 | header[4]
        return 7 + size if size <= _LONGEST_DATA else NO_FRAME

    def valid(self, frame: bytes) -> bool:
        """The sum of all bytes after the preamble is 0."""
        return sum(frame[1:]) & 0xFF == 0


def encode(message: Message) -> bytes:
    """The bytes on the wire; ValueError if the data is too long."""
    size = len(message.data)
    if size > _LONGEST_DATA:
        raise ValueError(f"{size} bytes do not fit into an Xbus message")
    length = bytes([size]) if size < _EXTENDED else struct.pack(">BH", _EXTENDED, size)
    body = bytes([message.bid, message.mid]) + length + message.data
    return bytes([PREAMBLE]) + body + bytes([-sum(body) & 0xFF])


def decode(frame: bytes) -> Message:
    """A whole frame as FrameSplitter hands it out; MalformedError if it is none."""
    if len(frame) < 5 or frame[0] != PREAMBLE or sum(frame[1:]) & 0xFF:
        raise MalformedError("not an Xbus frame")
    head = 4 if frame[3] != _EXTENDED else 6
    size = frame[3] if frame[3] != _EXTENDED else frame[4] << 8 | frame[5]
    if head + size + 1 != len(frame):
        raise MalformedError(f"an Xbus frame of {len(frame)} bytes claims {size} bytes of data")
    return Message(frame[2], frame[head:-1], frame[1])


def decode_items(data: bytes) -> tuple[Item, ...]:
    """The items of an MTData2 message; MalformedError if they do not fill ``data`` exactly."""
    items: list[Item] = []
    at = 0
    while at < len(data):
        if at + 3 > len(data):
            raise MalformedError("an MTData2 item without its header")
        data_id, size = data[at] << 8 | data[at + 1], data[at + 2]
        content = data[at + 3 : at + 3 + size]
        if len(content) != size:
            raise MalformedError(f"MTData2 item {data_id:04X} is cut off")
        items.append(_decode_item(data_id, content))
        at += 3 + size
    return tuple(items)


def item_layouts(data: bytes) -> list[tuple[bytes, struct.Struct]] | None:
    """Header and layout of each item of an MTData2 message that ``decode_items`` accepts, an unknown one as bytes.

    None where an item holds fixed-point numbers, which ``struct`` cannot read.
    """
    found, at = [], 0
    while at < len(data):
        head = data[at : at + 3]
        layout = _layout(head[0] << 8 | head[1])
        if layout is None and type_of(head) in _REALS:
            return None
        found.append((head, layout or struct.Struct(f">{head[2]}s")))
        at += 3 + head[2]
    return found


def type_of(head: bytes) -> int:
    """What an item with this header is: compare with Type."""
    return (head[0] << 8 | head[1]) & _TYPE_BITS


def encode_items(items: Sequence[Item]) -> bytes:
    """The data of an MTData2 message; ValueError or struct.error if a value does not fit its format."""
    parts = []
    for item in items:
        content = _encode_item(item)
        parts.append(struct.pack(">HB", item.data_id, len(content)) + content)
    return b"".join(parts)


def _decode_item(data_id: int, content: bytes) -> Item:
    if layout := _layout(data_id):
        if layout.size != len(content):
            raise MalformedError(f"MTData2 item {data_id:04X} of {len(content)} bytes")
        return Item(data_id, layout.unpack(content))
    if count := _REALS.get(data_id & _TYPE_BITS):
        precision = Precision(data_id & _PRECISION_BITS)
        if len(content) != count * _BYTES_OF_REAL[precision]:
            raise MalformedError(f"MTData2 item {data_id:04X} of {len(content)} bytes")
        return Item(data_id, decode_reals(content, precision))
    return Item(data_id, raw=content)


@lru_cache(256)  # a stream repeats some ten items hundreds of times a second
def _layout(data_id: int) -> struct.Struct | None:
    """Of items that ``struct`` can read; None for fixed-point numbers and unknown items."""
    kind = data_id & _TYPE_BITS
    code = _CODES.get(data_id & _PRECISION_BITS)
    if kind in _REALS:
        return None if code is None else struct.Struct(f">{_REALS[kind]}{code}")
    return _WHOLE.get(kind)


def _encode_item(item: Item) -> bytes:
    if layout := _WHOLE.get(item.type):
        return bytes(layout.pack(*(int(value) for value in item.values)))
    if item.type in _REALS:
        return encode_reals(item.values, Precision(item.precision))
    return item.raw


def item_bytes(data_id: int) -> int:
    """Bytes of the data of an item; ValueError for one that is not known."""
    kind = data_id & _TYPE_BITS
    if kind in _WHOLE:
        return _WHOLE[kind].size
    if kind in _REALS:
        return _REALS[kind] * _BYTES_OF_REAL[Precision(data_id & _PRECISION_BITS)]
    raise ValueError(f"MTData2 item {data_id:04X} is not known")


def decode_reals(content: bytes, precision: Precision) -> tuple[float, ...]:
    """Big-endian real numbers. FP16.32 puts the u32 fraction before the i16 integer."""
    size = _BYTES_OF_REAL[precision]
    count = len(content) // size
    if precision == Precision.FLOAT32:
        return struct.unpack(f">{count}f", content)
    if precision == Precision.FLOAT64:
        return struct.unpack(f">{count}d", content)
    if precision == Precision.FP12_20:
        return tuple(whole / _FP12_20 for whole in struct.unpack(f">{count}i", content))
    parts = struct.unpack(">" + "Ih" * count, content)
    return tuple(whole + fraction / _FP16_32 for fraction, whole in zip(parts[::2], parts[1::2], strict=True))


def encode_reals(values: Sequence[float], precision: Precision) -> bytes:
    """Inverse of decode_reals; values are rounded to the format; struct.error if one does not fit."""
    if precision == Precision.FLOAT32:
        return struct.pack(f">{len(values)}f", *values)
    if precision == Precision.FLOAT64:
        return struct.pack(f">{len(values)}d", *values)
    if precision == Precision.FP12_20:
        return struct.pack(f">{len(values)}i", *(round(value * _FP12_20) for value in values))
    content = b""
    for value in values:
        whole, fraction = divmod(round(value * _FP16_32), _FP16_32)
        content += struct.pack(">Ih", fraction, whole)
    return content
