"""What is configured on a serial IMU."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

from artemis_drivers.base import DriverError
from artemis_drivers.imu_serial import mtdata2
from artemis_drivers.imu_serial.mtdata2 import EVERY_PACKET, Type

XSENS_BAUD_IDS = {115_200: 0x02, 230_400: 0x01, 460_800: 0x00, 921_600: 0x80, 2_000_000: 0x0C}
_BITS_PER_BYTE = 10  # start bit, eight bits, stop bit
_FULLEST = 0.9  # share of the line that may be used
_MTDATA2_OVERHEAD = 5
VECTORNAV_RATE_HZ = 800  # its inner loop; outputs are whole divisors of it


class SyncSetting(Struct, frozen=True, forbid_unknown_fields=True):
    """One entry of SetSyncSettings, 12 bytes (MT0101P; not tried on a device)."""

    function: Annotated[
        int, Meta(description="3 trigger, 8 send latest, 9 clock bias, 11 start", ge=0, le=255)
    ]
    line: Annotated[int, Meta(description="Which pin: 2 ClockIn, 4 SyncIn1, 5 SyncIn2 ...", ge=0, le=255)]
    polarity: Annotated[int, Meta(description="1 rising, 2 falling, 3 both", ge=1, le=3)] = 1
    ignore_first: Annotated[int, Meta(description="1: only the first pulse counts", ge=0, le=1)] = 0
    skip_first: Annotated[int, Meta(description="Pulses ignored at the start", ge=0, le=65535)] = 0
    skip_factor: Annotated[int, Meta(description="Pulses ignored between two used", ge=0, le=65535)] = 0
    pulse_width: Annotated[int, Meta(description="Unit 100 us (outputs)", ge=0, le=65535)] = 0
    delay: Annotated[int, Meta(description="Unit 100 us, or the clock's period in ms", ge=0, le=65535)] = 0


class MtiSettings(Struct, frozen=True, forbid_unknown_fields=True, tag="xsens", tag_field="kind"):
    """An Xsens MTi. ``outputs`` are pairs of item id and rate in Hz, 65535 for "with every packet"."""

    port: str
    baud: Literal[115_200, 230_400, 460_800, 921_600, 2_000_000] = 921_600
    rate_hz: Annotated[int, Meta(ge=1, le=2000)] = 400
    extra_outputs: tuple[tuple[int, int], ...] = ()
    sync: tuple[SyncSetting, ...] = ()
    name: str = "imu"

    @property
    def outputs(self) -> tuple[tuple[int, int], ...]:
        """All items: counter, time, acceleration, rate of turn, status, and the extra ones."""
        return (
            (Type.PACKET_COUNTER, EVERY_PACKET),
            (Type.SAMPLE_TIME_FINE, EVERY_PACKET),
            (Type.ACCELERATION, self.rate_hz),
            (Type.RATE_OF_TURN, self.rate_hz),
            (Type.STATUS_WORD, EVERY_PACKET),
            *self.extra_outputs,
        )

    def require_room(self) -> None:
        """DriverError if the items do not fit through the line."""
        items = sum(
            (3 + mtdata2.item_bytes(data_id)) * min(rate, self.rate_hz) for data_id, rate in self.outputs
        )
        needed = (items + _MTDATA2_OVERHEAD * self.rate_hz) * _BITS_PER_BYTE
        if needed > _FULLEST * self.baud:
            raise DriverError(
                f"{self.name}: the outputs need {needed / 1000:.0f} kbit/s, more than {self.baud} baud carries: "
                f"raise the baud rate or lower rate_hz"
            )


class VectorNavSettings(Struct, frozen=True, forbid_unknown_fields=True, tag="vectornav", tag_field="kind"):
    """A VectorNav VN-100. ``rate_hz`` must divide 800."""

    port: str
    baud: Literal[115_200, 230_400, 460_800, 921_600] = 921_600
    rate_hz: Annotated[int, Meta(ge=1, le=800)] = 400
    serial_port: Literal[1, 2] = 1
    name: str = "imu"

    def divisor(self) -> int:
        """The device's own setting for the rate; DriverError if there is none."""
        if VECTORNAV_RATE_HZ % self.rate_hz:
            raise DriverError(
                f"{self.name}: a VectorNav sends at whole fractions of 800 Hz, not at {self.rate_hz} Hz: "
                f"set rate_hz to 400 or 200"
            )
        return VECTORNAV_RATE_HZ // self.rate_hz


ImuSettings = MtiSettings | VectorNavSettings
