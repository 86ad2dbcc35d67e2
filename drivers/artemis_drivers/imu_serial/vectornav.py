"""VectorNav binary output and register commands (VN-100 User Manual UM001, sections 3 and 5).

A binary message is FA, groups u8, a u16 field mask for each group, the fields, CRC-16/XMODEM; little-endian,
but the CRC is big-endian. Register commands and their answers are ASCII lines, ``$VNRRG,75*XX``, in between.
"""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass

from artemis_drivers.imu_serial.mtdata2 import MalformedError
from artemis_drivers.imu_serial.stream import NEED_MORE, NO_FRAME

SYNC = 0xFA
_LINE = ord("$")
_LONGEST_LINE = 256
_MASK_BYTES = 2

# Name and layout of each field, from bit 0 of the mask. Vectors are x, y, z; the quaternion is x, y, z, w.
_COMMON = (
    ("time_startup_ns", "Q"),
    ("time_gps_ns", "Q"),
    ("time_sync_in_ns", "Q"),
    ("yaw_pitch_roll_deg", "3f"),
    ("quaternion", "4f"),
    ("angular_rate", "3f"),
    ("position", "3d"),
    ("velocity", "3f"),
    ("acceleration", "3f"),
    ("raw_imu", "6f"),
    ("magnetic_temperature_pressure", "5f"),
    ("delta_theta_velocity", "7f"),
    ("ins_status", "H"),
    ("sync_in_count", "I"),
    ("time_gps_pps_ns", "Q"),
)
_TIME = (
    ("time_startup_ns", "Q"),
    ("time_gps_ns", "Q"),
    ("gps_tow_ns", "Q"),
    ("gps_week", "H"),
    ("time_sync_in_ns", "Q"),
    ("time_gps_pps_ns", "Q"),
    ("time_utc", "b5BH"),
    ("sync_in_count", "I"),
    ("sync_out_count", "I"),
    ("time_status", "B"),
)
_IMU = (
    ("imu_status", "H"),
    ("raw_magnetic", "3f"),
    ("raw_acceleration", "3f"),
    ("raw_angular_rate", "3f"),
    ("temperature", "f"),
    ("pressure", "f"),
    ("delta_theta", "4f"),
    ("delta_velocity", "3f"),
    ("magnetic", "3f"),
    ("acceleration", "3f"),
    ("angular_rate", "3f"),
    ("saturation", "H"),
    ("raw", "10f"),
)
GROUPS = (_COMMON, _TIME, _IMU)
GROUP_NAMES = ("common", "time", "imu")
_LAYOUTS = tuple(tuple(struct.Struct("<" + code) for _, code in group) for group in GROUPS)
_LONGEST = 2 + 2 * len(GROUPS) + sum(layout.size for group in _LAYOUTS for layout in group) + 2


@dataclass(frozen=True, slots=True)
class BinaryMessage:
    """``fields`` by ``group.name`` (common.acceleration), each a tuple of numbers, in the order on the wire."""

    masks: tuple[int, int, int]
    fields: dict[str, tuple[float, ...]]


class VectorNavFraming:
    """Delimits binary messages and ASCII lines."""

    starts = bytes([SYNC, _LINE])
    longest = max(_LONGEST, _LONGEST_LINE)

    def length(self, buffer: bytearray, start: int) -> int:
        """See stream.Framing."""
        if buffer[start] == _LINE:
            return _line_length(buffer, start)
        if len(buffer) < start + 2:
            return NEED_MORE
        groups = buffer[start + 1]
        if groups == 0 or groups >= 1 << len(GROUPS):
            return NO_FRAME
        header = 2 + _MASK_BYTES * groups.bit_count()
        if len(buffer) < start + header:
            return NEED_MORE
        masks = _masks(buffer[start : start + header])
        payload = _payload_size(masks)
        return NO_FRAME if payload is None else header + payload + 2

    def valid(self, frame: bytes) -> bool:
        """The CRC over everything after the sync byte, CRC included, is 0; of a line, the xor of its bytes."""
        if frame[0] == _LINE:
            return _line_valid(frame)
        return binascii.crc_hqx(frame[1:], 0) == 0


def decode(frame: bytes) -> BinaryMessage:
    """A whole binary frame; MalformedError if it is none."""
    size = VectorNavFraming().length(bytearray(frame), 0) if frame[:1] == bytes([SYNC]) else NO_FRAME
    if size != len(frame) or binascii.crc_hqx(frame[1:], 0):
        raise MalformedError("not a VectorNav binary message")
    masks = _masks(frame)
    at = 2 + _MASK_BYTES * frame[1].bit_count()
    fields = {}
    for group, mask in enumerate(masks):
        for bit in _bits(mask):
            layout = _LAYOUTS[group][bit]
            fields[f"{GROUP_NAMES[group]}.{GROUPS[group][bit][0]}"] = layout.unpack_from(frame, at)
            at += layout.size
    return BinaryMessage(masks, fields)


def encode(message: BinaryMessage) -> bytes:
    """The bytes on the wire; inverse of decode."""
    used = [group for group, mask in enumerate(message.masks) if mask]
    body = bytes([sum(1 << group for group in used)])
    body += b"".join(struct.pack("<H", message.masks[group]) for group in used)
    for group in used:
        for bit in _bits(message.masks[group]):
            name, code = GROUPS[group][bit]
            body += struct.pack("<" + code, *message.fields[f"{GROUP_NAMES[group]}.{name}"])
    return bytes([SYNC]) + body + struct.pack(">H", binascii.crc_hqx(body, 0))


def field_mask(*names: str) -> int:
    """Mask of fields of the common group by name; ValueError for an unknown one."""
    known = [name for name, _ in _COMMON]
    return sum(1 << known.index(name) for name in names)


def line(text: str) -> bytes:
    """A command such as ``VNRRG,75`` as a line with its check."""
    check = 0
    for octet in text.encode("ascii"):
        check ^= octet
    return f"${text}*{check:02X}\r\n".encode("ascii")


def line_text(frame: bytes) -> str:
    """The command or answer in a line, without $ and check; MalformedError if the frame is no line."""
    if frame[:1] != b"$" or b"*" not in frame:
        raise MalformedError("not a VectorNav line")
    return frame[1 : frame.rindex(b"*")].decode("ascii", "replace")


def _masks(frame: bytes | bytearray) -> tuple[int, int, int]:
    masks, at = [0, 0, 0], 2
    for group in range(len(GROUPS)):
        if frame[1] >> group & 1:
            masks[group] = frame[at] | frame[at + 1] << 8
            at += _MASK_BYTES
    return masks[0], masks[1], masks[2]


def _payload_size(masks: tuple[int, int, int]) -> int | None:
    """Bytes of all fields, or None where a mask names a field that this group does not have."""
    size = 0
    for layouts, mask in zip(_LAYOUTS, masks, strict=True):
        if mask >> len(layouts):
            return None
        size += sum(layouts[bit].size for bit in _bits(mask))
    return size


def _bits(mask: int) -> list[int]:
    return [bit for bit in range(mask.bit_length()) if mask >> bit & 1]


def _line_length(buffer: bytearray, start: int) -> int:
    if len(buffer) >= start + 3 and buffer[start : start + 3] != b"$VN":
        return NO_FRAME
    end = buffer.find(b"\n", start, start + _LONGEST_LINE)
    if end >= 0:
        return end + 1 - start
    return NEED_MORE if len(buffer) - start < _LONGEST_LINE else NO_FRAME


def _line_valid(frame: bytes) -> bool:
    star = frame.rfind(b"*")
    if star < 0:
        return False
    given, check = frame[star + 1 :].strip(), 0
    for octet in frame[1:star]:
        check ^= octet
    return given.upper() in (b"XX", f"{check:02X}".encode())
