"""Control frames of the Livox SDK 1 protocol as bytes, both ways.

Source: Livox SDK v2.3.0 (livox_def.h, comm_port, sdk_protocol) and frames published by owners of the devices.
A frame: 0xAA, version 1, u16 length of the whole, u8 type, u16 sequence number, CRC-16 of these seven bytes,
u8 command set, u8 command, payload, CRC-32 of everything before it. Little-endian; IP addresses in network order.
"""

from __future__ import annotations

import enum
import struct
import zlib
from typing import NamedTuple

from artemis_drivers.livox_frames import MAX_FRAME, START, require_short, split

VERSION = 1
OVERHEAD = 15  # bytes of a frame without payload
_HEADER = struct.Struct("<BBHBHHBB")
_CRC16_START = 0x4C49  # register at the start, bits reflected
_CRC32_SEED = 0x564F580A

DISCOVERY_PORT = 55000
COMMAND_PORT = 65000
AVIA = 7
DEVICE_NAMES = {0: "Hub", 1: "Mid-40", 2: "Tele-15", 3: "Horizon", 6: "Mid-70", AVIA: "Avia"}


class Kind(enum.IntEnum):
    """Frame type: a command that wants an answer, the answer, an unsolicited message."""

    CMD = 0
    ACK = 1
    MSG = 2


class General(enum.IntEnum):
    """Commands of set 0."""

    BROADCAST = 0
    HANDSHAKE = 1
    DEVICE_INFO = 2
    HEARTBEAT = 3
    SAMPLING = 4
    COORDINATE = 5
    DISCONNECT = 6
    ABNORMAL = 7
    SET_IP = 8
    GET_IP = 9
    REBOOT = 0x0A
    SET_PARAMS = 0x0B
    GET_PARAMS = 0x0C
    RESET_PARAMS = 0x0D


class Lidar(enum.IntEnum):
    """Commands of set 1."""

    MODE = 0
    SET_EXTRINSIC = 1
    GET_EXTRINSIC = 2
    RAIN_FOG = 3
    SET_FAN = 4
    GET_FAN = 5
    SET_RETURN_MODE = 6
    GET_RETURN_MODE = 7
    SET_IMU_RATE = 8
    GET_IMU_RATE = 9
    UTC = 0x0A


class WorkState(enum.IntEnum):
    """What the device is doing."""

    INIT = 0
    NORMAL = 1
    POWER_SAVING = 2
    STANDBY = 3
    ERROR = 4


class Param(enum.IntEnum):
    """Keys of the stored parameters (Avia firmware 11.06 or newer)."""

    HIGH_SENSITIVITY = 1
    SCAN_PATTERN = 2
    SLOT = 3


class Ret(enum.IntEnum):
    """First byte of an answer."""

    OK = 0
    FAIL = 1
    SWITCHING = 2


class Frame(NamedTuple):
    """One control frame, checksums left out."""

    kind: int
    seq: int
    cmd_set: int
    cmd_id: int
    payload: bytes = b""


def _crc16_table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0x8408 if value & 1 else 0)
        table.append(value)
    return tuple(table)


_CRC16_TABLE = _crc16_table()


def crc16(data: bytes) -> int:
    """CRC-16/MCRF4XX with Livox's start value; 0 over a header that ends with its own checksum."""
    register = _CRC16_START
    for byte in data:
        register = register >> 8 ^ _CRC16_TABLE[(register ^ byte) & 0xFF]
    return register


def crc32(data: bytes) -> int:
    """CRC-32 with Livox's seed."""
    return zlib.crc32(data, _CRC32_SEED)


def encode(frame: Frame) -> bytes:
    """Frame as bytes with both checksums. Raises ValueError when the payload is too long."""
    length = OVERHEAD + len(frame.payload)
    require_short(length)
    head = struct.pack("<BBHBH", START, VERSION, length, frame.kind, frame.seq)
    body = head + struct.pack("<HBB", crc16(head), frame.cmd_set, frame.cmd_id) + frame.payload
    return body + struct.pack("<I", crc32(body))


def decode(datagram: bytes) -> tuple[list[Frame], int]:
    """All frames of a datagram (devices may pack several into one), and how many bytes were not understood."""
    return split(datagram, OVERHEAD, _frame_at)


def _frame_at(data: bytes, at: int) -> tuple[Frame, int] | None:
    start, version, length, kind, seq, _, cmd_set, cmd_id = _HEADER.unpack_from(data, at)
    if start != START or version != VERSION or not OVERHEAD <= length <= min(MAX_FRAME, len(data) - at):
        return None
    if crc16(data[at : at + 9]) != 0:
        return None
    end = at + length
    if crc32(data[at : end - 4]) != int.from_bytes(data[end - 4 : end], "little"):
        return None
    return Frame(kind, seq, cmd_set, cmd_id, data[at + 11 : end - 4]), length
