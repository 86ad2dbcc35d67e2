"""The IMU's own time: what its counter and clock say, unwrapped, with gaps, repeats and restarts told apart.

Samples arrive in chunks, so arrival is no time. The device counts samples (u16) and ticks; both wrap.
"""

from __future__ import annotations

from dataclasses import dataclass

from artemis_drivers.unwrap import Unwrap, wrapped_step

_SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class ClockSpec:
    """``tick_ns`` and ``tick_modulus`` of the clock; ``counter_modulus`` of the counter, 0 if there is none."""

    tick_ns: int
    tick_modulus: int
    counter_modulus: int = 0


XSENS_CLOCK = ClockSpec(tick_ns=100_000, tick_modulus=2**32, counter_modulus=2**16)
VECTORNAV_CLOCK = ClockSpec(tick_ns=1, tick_modulus=2**64)


@dataclass(frozen=True, slots=True)
class Reading:
    """``count`` samples and ``device_ns`` since an arbitrary start; ``lost`` samples just before this one;
    ``boot`` counts restarts of the device: times of different boots cannot be compared.
    """

    count: int
    device_ns: int
    lost: int
    boot: int


@dataclass(slots=True)
class ClockCounts:
    """``lost`` samples, ``repeated`` ones, ``rejected``: their time was contradicted by the next sample."""

    lost: int = 0
    repeated: int = 0
    rejected: int = 0
    restarts: int = 0


class DeviceClock:
    """Follows the clock of one device that sends ``rate_hz`` samples a second.

    A checksum of 8 bits lets one of 256 corrupted frames pass. So a sample that jumps back, or by more than a
    second, is believed only when the next one agrees with it.
    """

    def __init__(self, spec: ClockSpec, rate_hz: float) -> None:
        if rate_hz <= 0:
            raise ValueError("the rate of an IMU must be positive")
        self.counts = ClockCounts()
        self._spec = spec
        self._period_ns = _SECOND_NS / rate_hz
        self._boot = 0
        self._count = 0
        self._last: tuple[int, int] | None = None
        self._ticks = Unwrap(spec.tick_modulus)
        self._doubtful: tuple[int, int] | None = None

    def read(self, ticks: int, counter: int = 0) -> Reading | None:
        """The reading of a sample; None for one that is repeated or not (yet) believed, which is counted."""
        raw = (ticks, counter)
        if self._last is None:
            return self._start(raw)
        if raw == self._last or raw == self._doubtful:
            self.counts.repeated += 1
            return None
        if (step := self._step(self._last, raw)) is not None:
            if self._doubtful is not None:
                self._reject()
            return self._advance(raw, step)
        if self._doubtful is not None and self._step(self._doubtful, raw) is not None:
            self._confirm(self._last, self._doubtful)
            return self.read(ticks, counter)
        if self._doubtful is not None:
            self._reject()
        self._doubtful = raw
        return None

    def _start(self, raw: tuple[int, int]) -> Reading:
        self._last = raw
        self._ticks.reset()
        return Reading(self._count, self._ticks(raw[0]) * self._spec.tick_ns, 0, self._boot)

    def _advance(self, raw: tuple[int, int], step: int) -> Reading:
        self._last = raw
        self._count += step
        self.counts.lost += step - 1
        return Reading(self._count, self._ticks(raw[0]) * self._spec.tick_ns, step - 1, self._boot)

    def _confirm(self, before: tuple[int, int], doubtful: tuple[int, int]) -> None:
        """The doubtful sample was right: a long gap or a restart. It is itself lost: not handed out."""
        self._doubtful = None
        self.counts.lost += 1
        if self._agree(before, doubtful):
            self._advance(doubtful, self._samples(before, doubtful))
            return
        self.counts.restarts += 1
        self._boot += 1
        self._count += 1
        self._start(doubtful)

    def _reject(self) -> None:
        self._doubtful = None
        self.counts.rejected += 1

    def _step(self, before: tuple[int, int], after: tuple[int, int]) -> int | None:
        """Samples from one to the other, or None where that is not believable at once."""
        if self._elapsed_ns(before, after) > _SECOND_NS or not self._agree(before, after):
            return None
        return self._samples(before, after)

    def _agree(self, before: tuple[int, int], after: tuple[int, int]) -> bool:
        """Time goes on, and the counter advanced by as many samples as the time has room for."""
        elapsed = self._elapsed_ns(before, after)
        expected = round(elapsed / self._period_ns)
        tolerance = 1 + expected // 50  # a rate that is off by 2 % is still this device
        samples = self._samples(before, after)
        return elapsed > 0 and samples > 0 and abs(samples - expected) <= tolerance

    def _samples(self, before: tuple[int, int], after: tuple[int, int]) -> int:
        expected = max(1, round(self._elapsed_ns(before, after) / self._period_ns))
        if not self._spec.counter_modulus:
            return expected
        return wrapped_step(before[1], after[1], self._spec.counter_modulus, expected)

    def _elapsed_ns(self, before: tuple[int, int], after: tuple[int, int]) -> int:
        return wrapped_step(before[0], after[0], self._spec.tick_modulus) * self._spec.tick_ns
