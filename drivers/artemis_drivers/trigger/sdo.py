"""Expedited SDO transfers (CiA 301, section 7.2.4): one object of up to four bytes, little-endian.

The command byte: bits 7-5 say what it is, bits 3-2 how many of the four data bytes are unused, bit 1
expedited, bit 0 that the size is given.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

from artemis_drivers.trigger.messages import SdoRequest, SdoResponse

_READ, _READ_ANSWER = 0x40, 0x40
_WRITE, _WRITE_ANSWER = 0x20, 0x60
_ABORT = 0x80
_KIND_BITS, _EXPEDITED, _SIZED = 0xE0, 0x02, 0x01


class Abort(IntEnum):
    """Abort codes."""

    READ_ONLY = 0x06010002
    MISSING = 0x06020000
    WRONG_LENGTH = 0x06070010
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    UNKNOWN_COMMAND = 0x05040001


class SdoError(Exception):
    """The node refused: ``code`` is one of Abort, or another of CiA 301."""

    def __init__(self, code: int) -> None:
        known = code in set(Abort)
        text = Abort(code).name.lower().replace("_", " ") if known else "see CiA 301"
        super().__init__(f"abort {code:#010x} ({text})")
        self.code = code


def read_request(index: int, subindex: int = 0) -> SdoRequest:
    """Ask for an object."""
    return SdoRequest(_READ, index, subindex, 0)


def write_request(index: int, value: int, size: int, subindex: int = 0) -> SdoRequest:
    """Set an object of ``size`` bytes; a negative value in two's complement."""
    return SdoRequest(_WRITE | _size_bits(size), index, subindex, value & ((1 << 8 * size) - 1))


def answers(request: SdoRequest, response: SdoResponse) -> bool:
    """Whether a response belongs to a request."""
    return (request.sdo_index, request.sdo_subindex) == (response.sdo_index, response.sdo_subindex)


def value_of(response: SdoResponse, *, signed: bool = False) -> int:
    """The value read (0 for the answer to a write); SdoError if the node refused."""
    kind = response.sdo_command & _KIND_BITS
    if kind == _ABORT:
        raise SdoError(response.sdo_data)
    if kind == _WRITE_ANSWER:
        return 0
    size = _size_of(response.sdo_command)
    if kind != _READ_ANSWER or size is None:
        raise SdoError(Abort.UNKNOWN_COMMAND)
    return int.from_bytes(response.sdo_data.to_bytes(4, "little")[:size], "little", signed=signed)


def serve(
    request: SdoRequest,
    read: Callable[[int, int], tuple[int, int]],
    write: Callable[[int, int, int, int], None],
) -> SdoResponse:
    """The node's side. ``read(index, subindex)`` gives value and size, ``write(index, subindex, value, size)``
    sets; both raise SdoError to refuse.
    """
    index, sub = request.sdo_index, request.sdo_subindex
    kind, size = request.sdo_command & _KIND_BITS, _size_of(request.sdo_command)
    try:
        if kind == _READ:
            value, length = read(index, sub)
            masked = value & ((1 << 8 * length) - 1)
            return SdoResponse(_READ_ANSWER | _size_bits(length), index, sub, masked)
        if kind == _WRITE and size is not None:
            write(index, sub, request.sdo_data & ((1 << 8 * size) - 1), size)
            return SdoResponse(_WRITE_ANSWER, index, sub, 0)
        raise SdoError(Abort.UNKNOWN_COMMAND)
    except SdoError as refusal:
        return SdoResponse(_ABORT, index, sub, refusal.code)


def _size_bits(size: int) -> int:
    if not 1 <= size <= 4:
        raise ValueError(f"an expedited SDO holds 1 to 4 bytes, not {size}")
    return (4 - size) << 2 | _EXPEDITED | _SIZED


def _size_of(command: int) -> int | None:
    """Bytes given, or None for a transfer that is not expedited."""
    if not command & _EXPEDITED:
        return None
    return 4 - (command >> 2 & 3) if command & _SIZED else 4
