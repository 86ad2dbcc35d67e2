"""Every device's own clock, related to the truth clock: offset, skew, slow wander, ticks, jitter of stamps.

All functions are pure: of the specification, the truth time in int64 nanoseconds and, for jitter, the number of the
event. They can be asked in any order and in pieces. A clock reads

    device = truth + offset + skew (truth - epoch) + wander(truth)

with the wander a sum of slow sines, as temperature drives a crystal. Differences are computed in float64 and stay
exact to a nanosecond for weeks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]
_INVERSE_STEPS = 6  # each divides the error by more than a thousand
_WANDER_S = (37.0, 151.0, 619.0)  # periods of the sines: warming up, draughts, the room
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


@dataclass(frozen=True, slots=True)
class Clock:
    """A device's clock; times in nanoseconds, ``seed`` decides phases of the wander and the jitter.

    ``wander_ppm`` is the largest deviation of the rate by wander; ``tick_ns`` the resolution of its counter;
    ``jitter_ns`` the standard deviation of a stamp about the event.
    """

    seed: int
    offset_ns: int = 0
    skew_ppm: float = 0.0
    wander_ppm: float = 0.0
    tick_ns: int = 1
    jitter_ns: float = 0.0
    epoch_ns: int = 0

    def __post_init__(self) -> None:
        if self.tick_ns < 1:
            raise ValueError(f"tick_ns {self.tick_ns} must be 1 or more")
        if not abs(self.skew_ppm) + abs(self.wander_ppm) < 10_000:
            raise ValueError("skew and wander of a clock must stay below 10 000 ppm")

    def read(self, truth_ns: ArrayLike) -> I64:
        """What the clock shows, without ticks and jitter, at truth times; never decreasing."""
        truth = np.asarray(truth_ns, np.int64)
        return np.asarray(truth + np.int64(self.offset_ns) + np.rint(self._gain(truth)).astype(np.int64))

    def truth(self, device_ns: ArrayLike) -> I64:
        """The truth times at which the clock shows ``device_ns``: inverse of :meth:`read` within 1 ns."""
        wanted = np.asarray(device_ns, np.int64) - np.int64(self.offset_ns)
        truth = wanted.copy()
        for _ in range(_INVERSE_STEPS):
            truth = np.asarray(wanted - np.rint(self._gain(truth)).astype(np.int64))
        return truth

    def stamp(self, truth_ns: ArrayLike, event: ArrayLike) -> I64:
        """Stamps that the device gives to events at truth times: jittered, in whole ticks.

        ``event`` are their numbers; the same number has the same jitter.
        """
        shown = self.read(truth_ns)
        if self.jitter_ns > 0:
            shown = shown + np.rint(self.jitter_ns * normal(self.seed, event)).astype(np.int64)
        return np.asarray(shown // self.tick_ns * self.tick_ns)

    def counter(self, truth_ns: ArrayLike, bits: int) -> I64:
        """The free-running counter of ``bits`` that counts ticks and wraps, int64."""
        return np.asarray(self.read(truth_ns) // self.tick_ns % (1 << bits))

    def _gain(self, truth: I64) -> F64:
        """Nanoseconds that the clock has gained since its epoch."""
        seconds = (truth - np.int64(self.epoch_ns)) * 1e-9
        gain = self.skew_ppm * 1e3 * seconds
        if self.wander_ppm != 0.0:
            phase = 2 * np.pi * uniform(self.seed, np.arange(len(_WANDER_S)) - len(_WANDER_S))
            share = self.wander_ppm * 1e3 / len(_WANDER_S)
            for period, p in zip(_WANDER_S, phase, strict=True):
                omega = 2 * np.pi / period
                gain = gain + share / omega * (np.sin(omega * seconds + p) - np.sin(p))
        return np.asarray(gain, np.float64)


@dataclass(frozen=True, slots=True)
class Delay:
    """How long something takes to arrive: at least ``least_ns``, longer by an exponential tail of mean
    ``tail_ns``; one in ``1 / stall`` waits ``stall_ns`` more (a busy host).
    """

    seed: int
    least_ns: int
    tail_ns: float = 0.0
    stall: float = 0.0
    stall_ns: int = 0

    def of(self, event: ArrayLike) -> I64:
        """Delays of events by number, nanoseconds."""
        tail = -self.tail_ns * np.log1p(-uniform(self.seed, event))
        stalled = uniform(self.seed + 0x5711, event) < self.stall
        return np.asarray(
            self.least_ns + tail.astype(np.int64) + np.where(stalled, self.stall_ns, 0), np.int64
        )


@dataclass(frozen=True, slots=True)
class RigClocks:
    """The clocks of a rig: ``host`` CLOCK_MONOTONIC, ``trigger`` board, ``lidar``, ``imu``, ``camera``."""

    host: Clock
    trigger: Clock
    lidar: Clock
    imu: Clock
    camera: Clock


def rig_clocks(seed: int, start_ns: int = 0, skew_ppm: float = 50.0, wander_ppm: float = 1.0) -> RigClocks:
    """Clocks that know nothing of each other: powered on within ten minutes, off by up to +-``skew_ppm`` each.

    50 ppm is the usual tolerance of a crystal without temperature compensation. Ticks: trigger board 1 us (32-bit
    counter), Avia 1 ns stamps in steps of its points, MTi 10 kHz (SampleTimeFine), camera 1 us.
    """
    rng = np.random.default_rng([seed, 51])

    def clock(number: int, tick_ns: int, jitter_ns: float) -> Clock:
        return Clock(
            seed=seed * 16 + number,
            offset_ns=int(rng.integers(0, 600_000_000_000)) - start_ns,
            skew_ppm=float(rng.uniform(-skew_ppm, skew_ppm)),
            wander_ppm=wander_ppm,
            tick_ns=tick_ns,
            jitter_ns=jitter_ns,
            epoch_ns=start_ns,
        )

    return RigClocks(
        host=clock(0, 1, 0.0),
        trigger=clock(1, 1_000, 0.0),
        lidar=clock(2, 1, 0.0),
        imu=clock(3, 100_000, 0.0),
        camera=clock(4, 1_000, 5_000.0),
    )


def event_times(clock: Clock, period_ns: int, start_ns: int, stop_ns: int) -> I64:
    """Truth times in ``start_ns`` .. ``stop_ns`` (exclusive) at which ``clock`` shows a multiple of a period:
    when a device that paces itself acts.
    """
    first, last = clock.read(start_ns), clock.read(stop_ns)
    at = clock.truth(np.arange(-(-int(first) // period_ns), int(last) // period_ns + 1) * np.int64(period_ns))
    return np.asarray(at[(at >= start_ns) & (at < stop_ns)])


def uniform(seed: int, number: ArrayLike) -> F64:
    """One value in [0, 1) for every number (SplitMix64 of Steele, Lea & Flood 2014 as a hash)."""
    with np.errstate(over="ignore"):
        z = np.asarray(number, np.int64).astype(np.uint64) * _GOLDEN + np.uint64(seed % 2**64) * np.uint64(
            0xD1342543DE82EF95
        )
        for _ in range(2):  # twice: neighbouring seeds share nothing, either
            z = z + _GOLDEN
            z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            z = z ^ (z >> np.uint64(31))
    return np.asarray((z >> np.uint64(11)).astype(np.float64) * 2.0**-53)


def normal(seed: int, number: ArrayLike) -> F64:
    """One standard normal value for every number (Box & Muller 1958)."""
    radius = np.sqrt(-2 * np.log1p(-uniform(seed, number)))
    return np.asarray(radius * np.cos(2 * np.pi * uniform(seed + 0x2B0F, number)))
