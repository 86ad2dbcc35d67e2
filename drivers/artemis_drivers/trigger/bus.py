"""The CAN bus: opening it with a sentence when that fails, and host monotonic time for what arrives."""

from __future__ import annotations

import time
from typing import Any, Protocol

import can
import serial
from can.interfaces.slcan import slcanBus

from artemis_drivers.base import DriverError
from artemis_drivers.trigger.settings import TriggerSettings

_READ_TIMEOUT_S = 0.05
_SECOND_NS = 1_000_000_000


class Bus(Protocol):
    """What is used of can.BusABC."""

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame."""
        ...

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Queue a frame."""
        ...

    def shutdown(self) -> None:
        """Close."""
        ...


def open_bus(settings: TriggerSettings) -> Bus:
    """The bus; DriverError if it cannot be opened."""
    options: dict[str, Any] = {}
    if settings.interface == "slcan":
        options = {"sleep_after_open": settings.open_delay_s, "timeout": _READ_TIMEOUT_S}
    try:
        bus = can.Bus(
            interface=settings.interface, channel=settings.channel, bitrate=settings.bitrate, **options
        )
        if isinstance(bus, slcanBus):
            bus.serialPortOrig = BufferedPort(bus.serialPortOrig)
        return bus
    except (can.CanError, OSError, ValueError, ImportError) as fault:
        raise DriverError(_why_not(settings, fault)) from fault


class BufferedPort:
    """A pyserial port that is read in pieces and handed out byte by byte.

    python-can reads a serial adapter one byte a call, which costs two calls of the system each: a third of a
    millisecond a frame.
    """

    def __init__(self, port: serial.SerialBase) -> None:
        self._port = port
        self._held = bytearray()

    def __getattr__(self, name: str) -> Any:
        """Everything else is the port's."""
        return getattr(self._port, name)

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read without waiting."""
        return len(self._held) or int(self._port.in_waiting)

    @property
    def write_timeout(self) -> float | None:
        """Seconds that a write may take."""
        timeout: float | None = self._port.write_timeout
        return timeout

    @write_timeout.setter
    def write_timeout(self, seconds: float | None) -> None:
        self._port.write_timeout = seconds

    def read(self, size: int = 1) -> bytes:
        """Up to ``size`` bytes; waits for the first one as long as the port does."""
        if not self._held:
            self._held += self._port.read(1)
            if self._held and (more := int(self._port.in_waiting)):
                self._held += self._port.read(more)
        found = bytes(self._held[:size])
        del self._held[:size]
        return found

    def reset_input_buffer(self) -> None:
        """Forget what has arrived."""
        self._held.clear()
        self._port.reset_input_buffer()


def arrival_ns(message: can.Message) -> int:
    """Host monotonic time of a frame: the kernel's stamp where there is one, else now.

    python-can stamps by the wall clock, which may be set meanwhile: an age that cannot be is not used.
    """
    now = time.monotonic_ns()
    age_ns = round((time.time() - message.timestamp) * _SECOND_NS)
    return now - age_ns if 0 <= age_ns < _SECOND_NS else now


def is_noise(fault: Exception) -> bool:
    """Whether bytes of a serial adapter could not be decoded, as opposed to the adapter being gone."""
    decoding = (ValueError, IndexError)
    return isinstance(fault, decoding) or isinstance(fault.__cause__, decoding)


def recover(bus: Bus) -> None:
    """Drop half a frame: python-can's slcan keeps undecodable bytes, and fails on them again and again."""
    flush = getattr(bus, "flush", None)
    if flush is not None:
        flush()


def _why_not(settings: TriggerSettings, fault: Exception) -> str:
    where, text = f"{settings.interface} {settings.channel}", str(fault)
    if "No such device" in text or "No such file" in text:
        cure = "plug the CAN adapter in, or correct channel"
    elif "Permission denied" in text:
        cure = "add this user to the group dialout, log out and in"
    elif "Network is down" in text:
        cure = f"run 'ip link set {settings.channel} up type can bitrate {settings.bitrate}'"
    elif "not supported" in text:
        cure = "this kernel has no CAN: use an slcan adapter"
    else:
        cure = "check interface and channel"
    return f"CAN bus {where} cannot be opened ({text}): {cure}"
