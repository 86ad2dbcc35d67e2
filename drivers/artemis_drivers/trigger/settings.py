"""What is configured on the trigger board, and in which SDO object each value lives."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta, Struct


class TriggerSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """The board and the bus it is on. ``interface`` and ``channel`` as python-can names them."""

    interface: str = "socketcan"
    channel: str = "can0"
    bitrate: Annotated[int, Meta(ge=10_000, le=1_000_000)] = 500_000
    dbc: Annotated[str, Meta(description="DBC file; empty for the board's own")] = ""
    rate_hz: Annotated[float, Meta(description="Camera trigger", ge=0.1, le=120.0)] = 10.0
    pulse_us: Annotated[int, Meta(description="Length of the camera trigger", ge=1, le=65_535)] = 500
    phase_us: Annotated[int, Meta(description="Trigger after the PPS edge", ge=-32_768, le=32_767)] = 0
    pps_width_ms: Annotated[
        int, Meta(description="High time of the PPS; the Avia accepts 20 to 200 ms", ge=21, le=199)
    ] = 100
    camera_mask: Annotated[int, Meta(description="Bit per camera output", ge=0, le=255)] = 1
    open_delay_s: Annotated[
        float, Meta(description="Pause after opening a serial CAN stick; some boot then", ge=0.0, le=5.0)
    ] = 0.0
    name: str = "trigger"


@dataclass(frozen=True, slots=True)
class Entry:
    """An object of the board's dictionary."""

    name: str
    index: int
    size: int
    low: int
    high: int
    writable: bool = True

    @property
    def signed(self) -> bool:
        """Whether the value may be negative."""
        return self.low < 0


RATE = Entry("rate_mhz", 0x2000, 4, 100, 120_000)
PULSE = Entry("pulse_us", 0x2001, 4, 1, 65_535)
PHASE = Entry("phase_us", 0x2002, 4, -32_768, 32_767)
PPS_WIDTH = Entry("pps_width_ms", 0x2003, 2, 0, 200)
CAMERA_MASK = Entry("camera_mask", 0x2004, 1, 0, 255)
FIRMWARE = Entry("firmware", 0x2010, 4, 0, 2**32 - 1, writable=False)
SERIAL = Entry("serial", 0x2011, 4, 0, 2**32 - 1, writable=False)
CONFIG_CRC = Entry("config_crc", 0x2020, 4, 0, 2**32 - 1, writable=False)
DICTIONARY = (RATE, PULSE, PHASE, PPS_WIDTH, CAMERA_MASK, FIRMWARE, SERIAL, CONFIG_CRC)


def wanted(settings: TriggerSettings) -> dict[Entry, int]:
    """The value of each object that is written."""
    return {
        RATE: round(settings.rate_hz * 1000),
        PULSE: settings.pulse_us,
        PHASE: settings.phase_us,
        PPS_WIDTH: settings.pps_width_ms,
        CAMERA_MASK: settings.camera_mask,
    }


def config_crc(values: dict[Entry, int]) -> int:
    """CRC-32 of what is configured: rate, pulse, phase, PPS width, mask, little-endian, in this order."""
    packed = struct.pack(
        "<IIiHB", values[RATE], values[PULSE], values[PHASE], values[PPS_WIDTH], values[CAMERA_MASK]
    )
    return zlib.crc32(packed)
