"""The clock of a virtual LiDAR: free running, disciplined by pulses, named by UTC commands."""

from __future__ import annotations

from artemis_drivers.livox_avia.status import PPS_BIT, SYNC_SHIFT
from artemis_drivers.livox_slots import CLOCK_GPS, CLOCK_NONE, CLOCK_PPS

_S = 1_000_000_000
_UTC_EARLIEST, _UTC_LATEST = 10_000_000, 500_000_000  # after the edge, Avia user manual
_PPS_TIMEOUT = 1_500_000_000
_SYNC_GPS, _SYNC_PPS, _SYNC_ABNORMAL = 2, 3, 4


class DeviceClock:
    """The device's stamps of true time: skew, pulses, UTC commands."""

    def __init__(self, power_on_ns: int, skew_ppm: float) -> None:
        self._origin, self._skew = power_on_ns, skew_ppm * 1e-6
        self._edge: int | None = None
        self._utc_of_edge: int | None = None
        self.utc_named = self.utc_early = self.utc_late = 0

    def pulse(self, true_ns: int) -> None:
        """A rising PPS edge."""
        if self._edge is not None and self._utc_of_edge is not None:
            self._utc_of_edge += round((true_ns - self._edge) / _S) * _S
        self._edge = true_ns

    def name_edge(self, unix_ns: int, true_ns: int) -> None:
        """A UTC command arrived; too early or too late after the edge it means nothing."""
        since = _UTC_LATEST if self._edge is None else true_ns - self._edge
        if _UTC_EARLIEST < since < _UTC_LATEST:
            self._utc_of_edge = unix_ns
            self.utc_named += 1
        elif since <= _UTC_EARLIEST:
            self.utc_early += 1
        else:
            self.utc_late += 1

    def local(self, true_ns: int) -> int:
        """Nanoseconds since power on, by the device's oscillator."""
        elapsed = true_ns - self._origin
        return elapsed + round(elapsed * self._skew)

    def stamp(self, true_ns: int) -> tuple[int, int]:
        """Timestamp type and time."""
        if self._edge is None:
            return CLOCK_NONE, self.local(true_ns)
        since = self.local(true_ns) - self.local(self._edge)
        if self._utc_of_edge is None:
            return CLOCK_PPS, since % _S
        return CLOCK_GPS, self._utc_of_edge + since

    def status(self, true_ns: int) -> int:
        """Bits of the status code that tell of synchronisation."""
        if self._edge is None:
            return 0
        if true_ns - self._edge > _PPS_TIMEOUT:
            return _SYNC_ABNORMAL << SYNC_SHIFT
        return PPS_BIT | (_SYNC_PPS if self._utc_of_edge is None else _SYNC_GPS) << SYNC_SHIFT
