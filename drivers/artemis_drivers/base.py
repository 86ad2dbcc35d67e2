"""What every driver offers: start, stop, health; and what it tells when a device does not obey.

A driver owns one kind of device, reads it in a thread of its own and puts what arrives into rings (ring.py).
Nothing is dropped silently: every loss has a counter in ``Health.counters``.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from typing import Protocol

import msgspec


class DriverError(Exception):
    """A fault the user can mend: one sentence that says what is wrong and what to do."""


class State(enum.StrEnum):
    """Where a device is on its way to delivering data."""

    STOPPED = "stopped"
    SEARCHING = "searching"
    CONNECTING = "connecting"
    CONFIGURING = "configuring"
    RUNNING = "running"
    SILENT = "silent"  # connected, but no data for longer than the device may pause
    FAILED = "failed"


class Applied(msgspec.Struct, frozen=True):
    """One configuration item as asked for and as the device reports it back."""

    item: str
    requested: str
    read_back: str
    status: str
    """``ok``, ``rounded`` (device chose a near value), ``refused`` or ``unreadable`` (cannot be read back)."""
    tries: int
    ms: float


class Health(msgspec.Struct, frozen=True):
    """A device at one moment. ``message`` is a sentence for the user, empty when all is well."""

    name: str
    state: State
    message: str
    counters: Mapping[str, int]
    last_data_ns: int
    """Host monotonic time of the last data packet, 0 when there was none."""
    identity: Mapping[str, str]
    """Serial number, firmware, address: what identifies the device."""
    applied: tuple[Applied, ...] = ()
    status: Mapping[str, str] = {}
    """What the device says of itself: temperature, synchronisation ..."""


class Driver(Protocol):
    """The interface of every driver; a third party registers one under ``artemis_edge.drivers``."""

    def start(self) -> None:
        """Open the devices and begin. Raises DriverError when that cannot work."""
        ...

    def stop(self) -> None:
        """Stop the devices, join the thread and close everything; may be called twice."""
        ...

    def health(self) -> tuple[Health, ...]:
        """Health of each device, callable from any thread."""
        ...
