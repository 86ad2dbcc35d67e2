"""What the sessions with Livox LiDARs of both protocols have in common: state, silence, and what is said of it.

Without input or output of its own: datagrams go in by ``hear``, time by ``tick``, datagrams to be sent come out in
``outbox``.
"""

from __future__ import annotations

import ipaddress
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from typing import ClassVar

from artemis_drivers.base import Applied, State
from artemis_drivers.livox_dialogue import MS, Ask, Datagram, Dialogue
from artemis_drivers.udp import Interface, address_facing, interfaces

LOST_NS = 3000 * MS
SILENT_NS = 600 * MS  # 120 IMU periods without any data packet
UNHEARD_NS = 5000 * MS


class LivoxSession(ABC):
    """State of one device as the host sees it. ``serial`` is what the device calls itself."""

    model: ClassVar[str]
    seq_mask: ClassVar[int]

    def __init__(self, host_ip: str, own_addresses: Callable[[], list[Interface]] = interfaces) -> None:
        """``host_ip``: this computer's address, empty to find it out among ``own_addresses``."""
        self.state = State.STOPPED
        self.message = ""
        self.outbox: list[Datagram] = []
        self.counters: Counter[str] = Counter()
        self.applied: dict[str, Applied] = {}
        self.serial = self.device_ip = self.firmware = ""
        self._host_ip, self._own_addresses = host_ip, own_addresses
        self._dialogue = Dialogue(self._put_ask, self._next_seq)
        self._seq = 0
        self._leaving = False
        self._began = self._heard = self._last_data = self._running_since = 0

    @abstractmethod
    def _put_ask(self, ask: Ask, seq: int) -> None:
        """Put a question into the outbox."""

    @abstractmethod
    def _faults(self) -> list[str]:
        """What the device says is wrong with itself."""

    def start(self, now: int) -> None:
        """Begin to look for the device."""
        self._leaving = False
        self._search("", now)

    def data_seen(self, now: int, data_type: int, status_code: int) -> None:
        """Data packets have arrived; ``data_type`` of the latest points (0: none yet)."""
        self._last_data = now
        if self.state == State.SILENT:
            self.state, self.message = State.RUNNING, self._advice()

    def identity(self) -> dict[str, str]:
        """Serial number, address, firmware."""
        return {"serial": self.serial, "address": self.device_ip, "firmware": self.firmware}

    def resent(self) -> int:
        """Commands that had to be repeated."""
        return self._dialogue.resent

    def _search(self, message: str, now: int) -> None:
        """Go back to looking for the device."""
        self._dialogue.cancel()
        self.state, self.message, self._began = State.SEARCHING, message, now

    def _host_facing(self, serial: str, ip: str) -> str | None:
        """This computer's address for a device; None, with a message, when it has none in its network."""
        host = self._host_ip or address_facing(ip, self._own_addresses())
        if host is None:
            network = ipaddress.IPv4Network(f"{ip}/24", strict=False)
            self.message = (
                f"the Livox {self.model} {serial} is heard at {ip}, but this computer has no address in its "
                f"network: give the network port one, such as {network[50]}/24"
            )
        return host

    def _watch_data(self, now: int) -> int:
        """Notice that data no longer come; for how many ns they have not."""
        quiet = now - max(self._last_data, self._running_since)
        if quiet > SILENT_NS and self.state == State.RUNNING:
            self.counters["silences"] += 1
            self.state = State.SILENT
        if self.state == State.SILENT:
            missing = f"no data from the Livox {self.model} {self.serial} for {quiet / 1e9:.1f} s"
            self.message = f"{missing}: check its cable and power"
        return quiet

    def _gone(self) -> str:
        """Count that the device was lost; what to tell."""
        self.counters["device_lost"] += 1
        return f"the Livox {self.model} {self.serial} does not answer any more: check its power and cable"

    def _count_utc(self, answer: bytes) -> None:
        self.counters["utc_accepted" if answer[:1] == b"\0" else "utc_refused"] += 1

    def _advice(self) -> str:
        """What is wrong while data flow: faults of the device, settings it did not take."""
        faults = self._faults()
        faults += [
            f"{a.item} = {a.requested} refused" for a in self.applied.values() if a.status == "refused"
        ]
        return f"Livox {self.model} {self.serial}: {', '.join(faults)}" if faults else ""

    def _next_seq(self) -> int:
        self._seq = (self._seq + 1) & self.seq_mask
        return self._seq
