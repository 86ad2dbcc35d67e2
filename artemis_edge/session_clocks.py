"""The clocks of a session: the pulse per second as the board sees it, and a LiDAR with or without its pulse."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from itertools import pairwise

from artemis_edge.clock_model import SECOND_NS, AffineClock, EnvelopeFit

SETTLED_S = 10.0  # below that the slope of a line through jittering arrivals is not known
_US_NS = 1000
_MISSING_NS = 1_500_000_000
_WINDOW = 60  # pulses that measure the rate
_AWAY_NS = 500_000  # a pulse that is farther from where it should be is not that pulse
_QUARTZ = 100e-6  # how much farther for each second without
_NEW_PHASE = 3  # strange pulses in a row, a second apart, that are believed
_HELD_S = 2.0  # of arrivals without the pulse, before their line is followed
_HELD_RATE = 1e-6  # how well a rate that was measured over a minute holds
_DELAYS = 1000


def epoch_of(count: int, wall_ns: int) -> int:
    """Epoch of a session: time of pulse 0, so that pulse ``count``, seen at ``wall_ns`` since 1970, is at the
    nearest whole second. Taken once, and recorded: session time never follows the wall clock afterwards.
    """
    return ((wall_ns + SECOND_NS // 2) // SECOND_NS - count) * SECOND_NS


class ClockState(StrEnum):
    """How far a clock can be trusted."""

    UNKNOWN = "unknown"  # nothing was heard yet
    SETTLING = "settling"  # too short a time for its skew
    LOCKED = "locked"
    HOLDOVER = "holdover"  # its reference is missing: carried on by what was learnt before


class LidarClock(IntEnum):
    """What a LiDAR's stamps count from (timestamp types of Livox SDK 1)."""

    FREE = 0
    PTP = 1
    UTC = 3
    PULSE = 4


@dataclass(frozen=True, slots=True)
class SampleTime:
    """Session time of an IMU sample or a LiDAR packet, and how far to trust it."""

    stamp_ns: int
    state: ClockState


@dataclass(frozen=True, slots=True)
class ClockReport:
    """A live measure: ``skew_ppm`` against its reference, ``doubt_ns`` about how wrong it may be, events that
    carry it, and a sentence for the user where something is amiss.
    """

    name: str
    state: ClockState
    skew_ppm: float
    offset_ns: int
    doubt_ns: int
    events: int
    message: str = ""


class PulseClock:
    """Session time of board time, by the pulses per second.

    Pulses that the board makes come from the timer that captures: its seconds are session seconds. Pulses
    from outside are measured, and while they are missing the measured rate carries on. ``strange`` pulses
    came where none should be; ``renumbered``: their number did not fit their time. ``model``: board to session time.
    """

    def __init__(self, epoch_ns: int) -> None:
        self.epoch_ns = epoch_ns
        self.strange = self.renumbered = self.restarts = 0
        self._pulses: deque[tuple[int, int]] = deque(maxlen=_WINDOW)
        self._strangers: deque[int] = deque(maxlen=_NEW_PHASE)
        self._generated = False
        self.model: AffineClock | None = None
        self._least_ns: int | None = None

    def add(self, count: int, board_ns: int, *, generated: bool) -> None:
        """Pulse ``count`` at ``board_ns``."""
        if self._least_ns is not None or self.model is None:
            self._begin(count)
        elif not self._expected(count, board_ns):
            return
        if generated != self._generated:
            self._pulses.clear()
        self._generated = generated
        self._strangers.clear()
        session = self.epoch_ns + count * SECOND_NS
        self._pulses.append((board_ns, session))
        self.model = AffineClock(board_ns, session, 0.0 if generated else self._measured())

    def restart(self, least_ns: int | None) -> None:
        """The board began anew: the next pulse is the first whole second not before ``least_ns``."""
        self._least_ns = least_ns
        self._pulses.clear()
        self.model = None

    def session_ns(self, board_ns: int) -> int | None:
        """Session time at a board time; None before the first pulse."""
        return None if self.model is None else self.model.to_y(board_ns)

    @property
    def skew(self) -> float | None:
        """Session seconds a board second, minus one; None before the first pulse."""
        return None if self.model is None else self.model.skew

    def missing_ns(self, board_ns: int) -> int:
        """How long the pulse has been missing; 0 while it comes."""
        if not self._pulses:
            return 0
        silent = board_ns - self._pulses[-1][0]
        return silent if silent > _MISSING_NS else 0

    def report(self, board_ns: int) -> ClockReport:
        """The pulse at board time ``board_ns``."""
        skew = 0.0 if self.model is None else self.model.skew_ppm
        missing, pulses = self.missing_ns(board_ns), len(self._pulses)
        doubt = _US_NS + round(0 if self._generated else missing * _HELD_RATE)
        if not pulses:
            text = "no pulse per second yet: check the trigger board"
            return ClockReport("pps", ClockState.UNKNOWN, 0.0, 0, 0, 0, text)
        if missing:
            text = (
                f"no pulse per second for {missing / SECOND_NS:.0f} s: time is carried on by the board's clock; "
                "check the pulse's cable"
            )
            return ClockReport("pps", ClockState.HOLDOVER, skew, 0, doubt, pulses, text)
        return ClockReport("pps", ClockState.LOCKED, skew, 0, doubt, pulses)

    def _begin(self, count: int) -> None:
        """First pulse of a board time: where session time has gone on, it must not go back."""
        if self._least_ns is not None:
            whole = -(-(self._least_ns - self.epoch_ns) // SECOND_NS)
            self.epoch_ns += (whole - count) * SECOND_NS
            self.restarts += 1
            self._least_ns = None

    def _expected(self, count: int, board_ns: int) -> bool:
        """Whether the pulse is at a whole second; its number yields to that."""
        assert self.model is not None
        session = self.model.to_y(board_ns)
        whole = (session + SECOND_NS // 2) // SECOND_NS * SECOND_NS
        quiet = board_ns - self._pulses[-1][0] if self._pulses else 0
        if abs(session - whole) > _AWAY_NS + abs(quiet) * _QUARTZ:
            self.strange += 1
            return self._new_phase(count, board_ns, session)
        if whole != self.epoch_ns + count * SECOND_NS:
            self.renumbered += 1
            self.epoch_ns = whole - count * SECOND_NS
        return True

    def _new_phase(self, count: int, board_ns: int, session: int) -> bool:
        """Strange pulses that keep coming, a second apart, are the pulse now: session time leaps forward."""
        self._strangers.append(board_ns)
        steps = [b - a for a, b in pairwise(self._strangers)]
        if len(steps) < _NEW_PHASE - 1 or any(abs(step - SECOND_NS) > _AWAY_NS for step in steps):
            return False
        self.restart(session)
        self._begin(count)
        return True

    def _measured(self) -> float:
        """Session seconds a board second, minus one, over the pulses kept."""
        (board_0, session_0), (board_1, session_1) = self._pulses[0], self._pulses[-1]
        elapsed = board_1 - board_0
        return (session_1 - session_0 - elapsed) / elapsed if elapsed else 0.0


class LidarTime:
    """Session time of one LiDAR's stamps, also while its pulse is missing.

    With the pulse its stamps are session time, or lack whole seconds. Without, its quartz drifts: then the
    lower edge of (stamp, arrival) is followed, less the least delay seen while it was right.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._held: EnvelopeFit | None = None
        self._held_since = 0
        self._whole_ns = 0
        self._delays: deque[int] = deque(maxlen=_DELAYS)
        self._offset_ns = 0
        self._state = ClockState.UNKNOWN

    def stamp(self, stamp_ns: int, clock: LidarClock, arrival_ns: int, *, pulse: bool) -> SampleTime:
        """Session time of a stamp that arrived at session time ``arrival_ns``.

        ``pulse``: whether the LiDAR receives it.
        """
        if clock == LidarClock.FREE or not pulse:
            return self._carry(stamp_ns, arrival_ns)
        self._held = None
        self._whole_ns = 0
        if clock == LidarClock.PULSE:
            self._whole_ns = round((arrival_ns - stamp_ns) / SECOND_NS) * SECOND_NS
        self._delays.append(arrival_ns - stamp_ns - self._whole_ns)
        self._offset_ns, self._state = self._whole_ns, ClockState.LOCKED
        return SampleTime(stamp_ns + self._whole_ns, self._state)

    def report(self) -> ClockReport:
        """This LiDAR now."""
        if self._held is None or (model := self._held.model()) is None:
            return ClockReport(self.name, self._state, 0.0, self._offset_ns, 0, len(self._delays))
        quality = self._held.quality()
        text = f"{self.name} runs by its own clock ({-model.skew_ppm:+.0f} ppm), which is corrected: check its pulse"
        return ClockReport(
            self.name, self._state, model.skew_ppm, self._offset_ns, quality.doubt_ns, quality.events, text
        )

    def _carry(self, stamp_ns: int, arrival_ns: int) -> SampleTime:
        whole = stamp_ns + self._whole_ns
        if self._held is None:
            self._held, self._held_since = EnvelopeFit(), whole
        self._held.add(whole, arrival_ns)
        model = self._held.model()
        assert model is not None
        held_s = (whole - self._held_since) / SECOND_NS
        known = bool(self._delays)
        self._state = ClockState.HOLDOVER if known or held_s >= SETTLED_S else ClockState.SETTLING
        session = whole
        if held_s > _HELD_S or not known:
            session = model.to_y(whole) - min(self._delays, default=0)
        self._offset_ns = session - stamp_ns
        return SampleTime(session, self._state)
