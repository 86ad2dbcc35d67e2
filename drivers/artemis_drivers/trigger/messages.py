"""The board's CAN messages as typed records; their layout is in the DBC (firmware_cfg/trigger)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, cast

import cantools
from cantools.database.can import Database as Dbc

from artemis_drivers.base import DriverError

COUNT_MODULUS = 2**24
CLOCK_MODULUS = 2**32  # of t_us: 71.6 minutes

PPS_LOCKED, CAPTURE_OVERRUN, RATE_CHANGED = 1, 2, 4  # bits of TrigEvent.pulse_flags
PPS_GENERATED, PPS_EXTERNAL_VALID = 1, 2  # bits of PpsEvent.pps_flags


class Opcode(IntEnum):
    """Commands. ARM stops the triggers and sets their count to 0, so that frames can be counted from there."""

    NOTHING = 0
    ARM = 1
    RUN = 2
    STOP = 3
    INDICATE = 4


class RunState(IntEnum):
    """Health.run_state."""

    BOOT = 0
    IDLE = 1
    ARMED = 2
    RUNNING = 3
    FAULT = 4


class NodeState(IntEnum):
    """Heartbeat.state (CiA 301)."""

    BOOT = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class NmtCommand(IntEnum):
    """Nmt.nmt_command (CiA 301)."""

    START = 1
    STOP = 2
    PRE_OPERATIONAL = 128
    RESET = 129


@dataclass(frozen=True, slots=True)
class TrigEvent:
    """A rising edge of the camera trigger; count and microseconds wrap."""

    trig_count: int
    pulse_flags: int
    t_us: int


@dataclass(frozen=True, slots=True)
class PpsEvent:
    """A rising edge of the pulse per second."""

    pps_count: int
    pps_flags: int
    t_us: int


@dataclass(frozen=True, slots=True)
class Strobe:
    """A measured exposure: start after the trigger edge, and length, microseconds."""

    trig_count: int
    cam_index: int
    strobe_delay_us: int
    strobe_width_us: int


@dataclass(frozen=True, slots=True)
class BoardHealth:
    """Degrees Celsius, volts, amperes; bits of buttons, LEDs and faults; see RunState."""

    temp_board: float
    v_batt: float
    i_batt: float
    buttons: int
    led_state: int
    run_state: int
    fault_bits: int


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """The node lives; see NodeState."""

    state: int


@dataclass(frozen=True, slots=True)
class Emcy:
    """A fault; code 0 means that it is over (CiA 301)."""

    error_code: int
    error_register: int
    mfr_counter: int
    mfr_detail: int


@dataclass(frozen=True, slots=True)
class Command:
    """See Opcode; Hz, microseconds; LED pattern in bits 0-3 of ``led``, buzzer pattern in bits 4-7."""

    opcode: int
    trig_rate: float = 0.0
    pulse_us: int = 0
    phase_us: int = 0
    led: int = 0


@dataclass(frozen=True, slots=True)
class Nmt:
    """Start, stop or reset a node; see NmtCommand."""

    nmt_command: int
    nmt_node: int


@dataclass(frozen=True, slots=True)
class SdoRequest:
    """Expedited SDO from the host (sdo.py)."""

    sdo_command: int
    sdo_index: int
    sdo_subindex: int
    sdo_data: int


@dataclass(frozen=True, slots=True)
class SdoResponse:
    """Expedited SDO from the board (sdo.py)."""

    sdo_command: int
    sdo_index: int
    sdo_subindex: int
    sdo_data: int


Record = (
    TrigEvent | PpsEvent | Strobe | BoardHealth | Heartbeat | Emcy | Command | Nmt | SdoRequest | SdoResponse
)
_NAMES: dict[str, type[Record]] = {
    "TrigEvent": TrigEvent,
    "PpsEvent": PpsEvent,
    "Strobe": Strobe,
    "Health": BoardHealth,
    "Heartbeat": Heartbeat,
    "Emcy": Emcy,
    "Command": Command,
    "Nmt": Nmt,
    "SdoRequest": SdoRequest,
    "SdoResponse": SdoResponse,
}
_NODE_BITS = 0x7F


class BadFrameError(ValueError):
    """A CAN frame with an id of the board that does not fit its layout."""


class Messages:
    """Encodes and decodes by a DBC file; DriverError if that lacks a message or signal we need."""

    def __init__(self, dbc: Path) -> None:
        try:
            database = cantools.database.load_file(dbc, strict=True)
        except (OSError, cantools.Error, UnicodeDecodeError) as fault:
            raise DriverError(f"{dbc} cannot be read as a DBC file: {fault}") from fault
        self._by_name = {message.name: message for message in cast(Dbc, database).messages}
        for name, record in _NAMES.items():
            signals = set(self._by_name[name].signal_tree) if name in self._by_name else set()
            missing = [field for field in record.__dataclass_fields__ if field not in signals]
            if missing:
                raise DriverError(
                    f"{dbc} has no signal {missing[0]} in a message {name}: use artemis_trigger.dbc"
                )
        self._name_of_id = {self._by_name[name].frame_id: name for name in _NAMES}

    @property
    def node(self) -> int:
        """The board's CANopen node."""
        return self._by_name["Heartbeat"].frame_id & _NODE_BITS

    def decode(self, frame_id: int, data: bytes) -> Record | None:
        """The record in a frame; None for an id that is not the board's; BadFrameError if it does not fit."""
        name = self._name_of_id.get(frame_id)
        if name is None:
            return None
        message = self._by_name[name]
        if len(data) != message.length:
            raise BadFrameError(f"{name} of {len(data)} bytes")
        values = cast(dict[str, Any], message.decode(data, decode_choices=False))
        return _NAMES[name](**values)

    def encode(self, record: Record) -> tuple[int, bytes]:
        """Id and data of a frame; BadFrameError if a value does not fit."""
        name = "Health" if isinstance(record, BoardHealth) else type(record).__name__
        message = self._by_name[name]
        try:
            return message.frame_id, bytes(message.encode(asdict(record), strict=True))
        except cantools.Error as fault:
            raise BadFrameError(str(fault)) from fault


def default_dbc() -> Path:
    """The board's own DBC: beside the package in a checkout, inside it when installed."""
    here = Path(__file__).resolve()
    places = [here.parents[1] / "firmware_cfg", here.parents[3] / "firmware_cfg"]
    for place in places:
        if (file := place / "trigger" / "artemis_trigger.dbc").is_file():
            return file
    raise DriverError(
        "artemis_trigger.dbc is not installed: name the DBC file in the trigger board's settings"
    )
