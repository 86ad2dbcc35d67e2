"""Control frames of the Livox SDK 2 protocol (Mid-360, HAP) as bytes, both ways.

Source: Livox SDK2 (livox_lidar_def.h, define.h). Header of 24 bytes: 0xAA, version 0, u16 length of the whole,
u32 sequence number, u16 command, u8 type (0 command, 1 answer), u8 sender (0 host, 1 LiDAR), 6 reserved, CRC-16
of these 18 bytes, CRC-32 of the data (0 when there is none); then data. Little-endian, IP in network order.
"""

from __future__ import annotations

import binascii
import enum
import ipaddress
import struct
import zlib
from typing import NamedTuple

from artemis_drivers.livox_frames import MAX_FRAME, START, require_short, split

HEADER_BYTES = 24
_HEADER = struct.Struct("<BBHIHBB6xHI")

DISCOVERY_PORT = 56000
MID360 = 9
DEVICE_NAMES = {MID360: "Mid-360", 10: "HAP", 15: "HAP", 35: "Mid-360s", 40: "Avia 2"}
COMMAND_PORT, PUSH_PORT, POINT_PORT, IMU_PORT = 56100, 56200, 56300, 56400  # the device's own


class Cmd(enum.IntEnum):
    """Commands."""

    SEARCH = 0x0000
    SET = 0x0100
    GET = 0x0101
    PUSH = 0x0102
    REBOOT = 0x0200
    RESET = 0x0201
    TIME = 0x0202


class Key(enum.IntEnum):
    """Settings and readings that this driver uses."""

    POINT_TYPE = 0x0000
    PATTERN = 0x0001
    STATE_HOST = 0x0005
    POINT_HOST = 0x0006
    IMU_HOST = 0x0007
    INSTALL = 0x0012
    WORK_MODE = 0x001A
    IMU_ON = 0x001C
    SERIAL = 0x8000
    FIRMWARE = 0x8002
    WORK_STATE = 0x8006
    TIME_SYNC = 0x800C
    FAULTS = 0x8011


class Work(enum.IntEnum):
    """Work modes and states."""

    SAMPLING = 1
    IDLE = 2
    SLEEP = 3
    ERROR = 4
    SELF_TEST = 5
    MOTOR_STARTING = 6
    MOTOR_STOPPING = 7
    UPGRADE = 8


class Frame(NamedTuple):
    """One control frame, checksums left out."""

    seq: int
    cmd: int
    is_answer: bool
    from_lidar: bool
    data: bytes = b""


def encode(frame: Frame) -> bytes:
    """Frame as bytes. Raises ValueError when the data is too long."""
    length = HEADER_BYTES + len(frame.data)
    require_short(length)
    head = struct.pack(
        "<BBHIHBB6x", START, 0, length, frame.seq, frame.cmd, frame.is_answer, frame.from_lidar
    )
    data_crc = zlib.crc32(frame.data) if frame.data else 0
    return head + struct.pack("<HI", binascii.crc_hqx(head, 0xFFFF), data_crc) + frame.data


def decode(datagram: bytes) -> tuple[list[Frame], int]:
    """All frames of a datagram, and how many bytes were not understood."""
    return split(datagram, HEADER_BYTES, _frame_at)


def _frame_at(b: bytes, at: int) -> tuple[Frame, int] | None:
    start, version, length, seq, cmd, kind, sender, crc16, crc32 = _HEADER.unpack_from(b, at)
    if start != START or version != 0 or not HEADER_BYTES <= length <= min(MAX_FRAME, len(b) - at):
        return None
    if kind > 1 or sender > 1 or binascii.crc_hqx(b[at : at + 18], 0xFFFF) != crc16:
        return None
    data = b[at + HEADER_BYTES : at + length]
    if crc32 != (zlib.crc32(data) if data else 0):
        return None
    return Frame(seq, cmd, kind == 1, sender == 1, data), length


def encode_values(values: dict[int, bytes]) -> bytes:
    """Count, reserved u16, then key, length, value."""
    body = b"".join(struct.pack("<HH", key, len(value)) + value for key, value in values.items())
    return struct.pack("<HH", len(values), 0) + body


def decode_values(data: bytes) -> dict[int, bytes]:
    """Inverse of ``encode_values`` (what a device pushes); what is cut off is left out."""
    return _pairs(data, 4, int.from_bytes(data[:2], "little"))


def encode_got(ret: int, values: dict[int, bytes]) -> bytes:
    """Answer to GET: return code, count, values."""
    return struct.pack("<BH", ret, len(values)) + encode_values(values)[4:]


def decode_got(data: bytes) -> dict[int, bytes] | None:
    """Values of an answer to GET; None when it reports an error or is too short."""
    if len(data) < 3 or data[0] != 0:
        return None
    return _pairs(data, 3, int.from_bytes(data[1:3], "little"))


def _pairs(data: bytes, at: int, count: int) -> dict[int, bytes]:
    values: dict[int, bytes] = {}
    for _ in range(count):
        if at + 4 > len(data):
            break
        key, length = struct.unpack_from("<HH", data, at)
        if at + 4 + length > len(data):
            break
        values[key] = data[at + 4 : at + 4 + length]
        at += 4 + length
    return values


def encode_keys(keys: list[int]) -> bytes:
    """Request of values: count, reserved u16, keys."""
    return struct.pack(f"<HH{len(keys)}H", len(keys), 0, *keys)


def decode_keys(data: bytes) -> list[int]:
    """Inverse of ``encode_keys``; never more keys than there are bytes for."""
    count = min(int.from_bytes(data[:2], "little"), max(0, (len(data) - 4) // 2))
    return list(struct.unpack_from(f"<{count}H", data, 4)) if count else []


class HostAddress(NamedTuple):
    """Where the device sends one kind of data, and from which of its ports."""

    ip: str
    port: int
    device_port: int

    def encode(self) -> bytes:
        """8 bytes."""
        return ipaddress.IPv4Address(self.ip).packed + struct.pack("<HH", self.port, self.device_port)

    @classmethod
    def decode(cls, value: bytes) -> HostAddress | None:
        """None when the value is too short."""
        if len(value) < 8:
            return None
        port, device_port = struct.unpack_from("<HH", value, 4)
        return cls(str(ipaddress.IPv4Address(value[:4])), port, device_port)


class Found(NamedTuple):
    """Answer to SEARCH."""

    ret: int
    device: int
    serial: str
    ip: str
    command_port: int

    def encode(self) -> bytes:
        """24 bytes."""
        head = struct.pack("<BB16s", self.ret, self.device, self.serial.encode("ascii"))
        return head + ipaddress.IPv4Address(self.ip).packed + struct.pack("<H", self.command_port)

    @classmethod
    def decode(cls, data: bytes) -> Found | None:
        """None when the answer is too short or its serial number is no text."""
        if len(data) < 24:
            return None
        ret, device, serial = struct.unpack_from("<BB16s", data)
        text = serial.split(b"\0")[0]
        if not text.isalnum():
            return None
        ip, port = str(ipaddress.IPv4Address(data[18:22])), int.from_bytes(data[22:24], "little")
        return cls(ret, device, text.decode("ascii"), ip, port)
