"""The board's counters and clock without their wraps, and its restarts."""

from __future__ import annotations

from dataclasses import dataclass

from artemis_drivers.trigger.messages import CLOCK_MODULUS, COUNT_MODULUS
from artemis_drivers.unwrap import Unwrap, wrapped_step

_US_NS = 1000
_BACK_NS = 1_000_000_000  # events may be reordered, but not by a second
_ASTRAY_NS = 5_000_000_000  # and host and board may differ by a stalled reader, but not by this
_MOST_LOST = 1_000_000  # 28 hours of triggers at 10 Hz


class BoardClock:
    """Microseconds of 32 bits become nanoseconds that go on; a restart of the board begins a new ``boot``.

    The host's elapsed time says how many turns of 71.6 minutes have passed in a silence.
    """

    def __init__(self) -> None:
        self.boot = 0
        self._unwrap = Unwrap(CLOCK_MODULUS)
        self._last: tuple[int, int] | None = None

    def restart(self) -> None:
        """The board says that it has booted: what follows is another time."""
        if self._last is not None:
            self.boot += 1
        self._last = None
        self._unwrap.reset()

    def read(self, t_us: int, rx_ns: int) -> int:
        """Board time in ns of an edge captured at ``t_us`` and received at host time ``rx_ns``."""
        if self._last is not None:
            last_us, last_rx = self._last
            elapsed_us = (rx_ns - last_rx) // _US_NS
            step_us = wrapped_step(last_us, t_us, CLOCK_MODULUS, elapsed_us)
            if step_us * _US_NS < -_BACK_NS or abs(step_us - elapsed_us) * _US_NS > _ASTRAY_NS:
                self.restart()
            else:
                self._last = (t_us, rx_ns)
                return self._unwrap(t_us, elapsed_us) * _US_NS
        self._last = (t_us, rx_ns)
        return self._unwrap(t_us) * _US_NS


@dataclass(slots=True)
class EventCounter:
    """Counts on beyond 24 bits. ``lost`` events never arrived, ``repeated`` ones came twice.

    Frames of one CAN id are never reordered, so a count that goes back (or by more than a day) is not a late
    event: the board was armed again and counts from 0, which begins a new ``series``.
    """

    lost: int = 0
    repeated: int = 0
    series: int = 0
    _last: int | None = None
    _stamp: int | None = None

    def read(self, raw: int, stamp: int) -> int | None:
        """The unwrapped count within the series, or None for an event that has come already.

        ``stamp``: its capture; an event with the same count and another capture is another one.
        """
        step = 1 if self._last is None else wrapped_step(self._last, raw, COUNT_MODULUS)
        if step == 0 and stamp == self._stamp:
            self.repeated += 1
            return None
        self._stamp = stamp
        if step <= 0 or step > _MOST_LOST:
            self.restart()
        if self._last is None:
            self._last = raw
            return raw
        self.lost += step - 1
        self._last += step
        return self._last

    def near(self, raw: int) -> int:
        """The unwrapped count of an event that is told of beside its own message."""
        return raw if self._last is None else self._last + wrapped_step(self._last, raw, COUNT_MODULUS)

    def restart(self) -> None:
        """The board counts from 0 again."""
        if self._last is not None:
            self.series += 1
        self._last = None
