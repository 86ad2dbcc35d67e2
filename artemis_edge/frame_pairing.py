"""Which trigger made which photograph: by counting, checked by intervals, anchored anew after loss.

Frame k of a camera belongs to trigger k + anchor. The camera's own clock need not be related to anything: it
only has to agree that the time between two frames is the time between their triggers, to a quarter of a
period. Where it does not (an exposure was missed, and the camera did not count it), the neighbouring triggers
are tried; a frame that fits none is dropped and counted, never guessed.

A board that is not heard for a while (its cable is out) goes on with its triggers: a frame whose trigger is overdue
belongs to the one that the rate foretells, where the camera's interval confirms it.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field

_HISTORY = 1200  # triggers: two minutes at 10 Hz
_REACH = 50  # triggers searched on either side after a mismatch
_STRAY_FRAMES = 5  # frames in a row that fit no trigger: the anchor is wrong
_PENDING = 100  # frames that may wait for their trigger
_RECENT = 32  # frames back in which a repeated one is recognised
_REORDERED = 4  # numbers that a late frame may be behind
_AGREEING = 3  # frames whose arrival must name the same anchor
_SKEW = 400e-6  # most that two quartz clocks differ, with a margin
_PATIENCE_NS = 1_000_000_000
_OVERDUE_NS = 100_000_000  # the message of a trigger takes some ms, on a bad USB stick some ten
_UNHEARD = 600  # triggers in a row that may not be told: the rate of _REACH, of edges to 1 us, is then good for 25 us


@dataclass(frozen=True, slots=True)
class FrameStamp:
    """What a camera says of a frame: its number, end of exposure by its own clock, exposure, arrival (ns)."""

    sequence: int
    device_ns: int
    exposure_ns: int
    rx_ns: int

    @property
    def start_ns(self) -> int:
        """Start of exposure by the camera's clock."""
        return self.device_ns - self.exposure_ns


@dataclass(frozen=True, slots=True)
class Pair:
    """A frame with its trigger; times of the board in ns. ``interpolated``: the trigger's own message was
    lost and its edge follows from its neighbours; ``measured``: delay and exposure come from a strobe.
    """

    frame: FrameStamp
    count: int
    edge_ns: int
    mid_ns: int
    interpolated: bool
    measured: bool


@dataclass(frozen=True, slots=True)
class CameraTiming:
    """Calibration of a camera: ``delay_ns`` from trigger edge to start of exposure; ``index`` of its strobe.

    ``latency_ns``, the least time from the end of exposure to arrival at the host, lets a camera that starts
    while triggers run be anchored; without it, that needs ``arm``, and what was seen then serves for a restart.
    """

    delay_ns: int = 0
    latency_ns: int | None = None
    index: int = 0


class TriggerHistory:
    """The latest triggers of one series, by count."""

    def __init__(self) -> None:
        self.latest = -1
        self._edges: OrderedDict[int, int] = OrderedDict()
        self._strobes: OrderedDict[tuple[int, int], tuple[int, int]] = OrderedDict()

    def add(self, count: int, edge_ns: int) -> None:
        """A trigger at board time ``edge_ns``."""
        self._edges[count] = edge_ns
        self.latest = max(self.latest, count)
        while len(self._edges) > _HISTORY:
            self._edges.popitem(last=False)

    def add_strobe(self, count: int, camera: int, delay_ns: int, width_ns: int) -> None:
        """A measured exposure."""
        self._strobes[count, camera] = (delay_ns, width_ns)
        while len(self._strobes) > _HISTORY:
            self._strobes.popitem(last=False)

    def strobe(self, count: int, camera: int) -> tuple[int, int] | None:
        """Delay and width, if they were measured and have arrived."""
        return self._strobes.get((count, camera))

    def clear(self) -> None:
        """A new series: counts begin anew."""
        self._edges.clear()
        self._strobes.clear()
        self.latest = -1

    def edge(self, count: int) -> tuple[int, bool] | None:
        """Board time of a trigger, and whether it lies between known ones; None if that is not known."""
        if (known := self._edges.get(count)) is not None:
            return known, False
        before, after = self._known(count, -1), self._known(count, 1)
        period = self.period_ns()
        if before is None or after is None or period is None:
            return None
        steps, elapsed = after - before, self._edges[after] - self._edges[before]
        if abs(elapsed - steps * period) > period // 100:
            return None  # the rate has changed just here
        return self._edges[before] + elapsed * (count - before) // steps, True

    def _known(self, count: int, direction: int) -> int | None:
        """The nearest trigger that was told."""
        most = _UNHEARD if direction < 0 else min(_UNHEARD, self.latest - count)
        return next((n for k in range(1, most + 1) if (n := count + direction * k) in self._edges), None)

    def period_ns(self) -> int | None:
        """Time between the latest neighbouring triggers."""
        for count in range(self.latest, self.latest - _REACH, -1):
            if count in self._edges and count - 1 in self._edges:
                return self._edges[count] - self._edges[count - 1]
        return None

    def estimate(self, count: int) -> int | None:
        """Board time of a trigger that was never told, by the next one that was, and the period."""
        period = self.period_ns()
        after = next((c for c in range(count + 1, count + _REACH) if c in self._edges), None)
        if period is None or after is None:
            return None
        return self._edges[after] - (after - count) * period

    def foretold(self, count: int) -> int | None:
        """Board time of a trigger after the latest one that was told, if the board goes on at its rate."""
        period = self.period_ns()
        if period is None or not 0 < count - self.latest <= _UNHEARD:
            return None
        near = range(self.latest - _REACH, self.latest)
        first = next((c for c in near if self._in_step(c, period)), None)
        if first is None:
            return None  # the rate has just changed
        latest, elapsed = self._edges[self.latest], self._edges[self.latest] - self._edges[first]
        return latest + elapsed * (count - self.latest) // (self.latest - first)

    def _in_step(self, count: int, period: int) -> bool:
        """Whether the triggers from one that was told to the latest came at one rate."""
        edge = self._edges.get(count)
        if edge is None:
            return False
        return abs(self._edges[self.latest] - edge - (self.latest - count) * period) <= period // 100

    def nearest(self, board_ns: int) -> int | None:
        """Count of the trigger nearest to a time, by the latest one and the period; None if unknown."""
        period = self.period_ns()
        if not period:
            return None
        steps = (board_ns - self._edges[self.latest]) / period
        return self.latest + round(steps)


@dataclass(slots=True)
class _Last:
    count: int
    edge_ns: int
    start_ns: int


@dataclass(slots=True)
class FramePairing:
    """Pairs the frames of one camera. ``board_of_host`` turns host time into board time (None: not yet known).

    ``counts``: paired, lost (missing numbers), repeated, restarts, anchored, arm_corrected, reanchored,
    unpaired_mismatch, unpaired_no_trigger, unpaired_no_anchor.
    """

    timing: CameraTiming
    history: TriggerHistory
    board_of_host: Callable[[int], int | None]
    counts: Counter[str] = field(default_factory=Counter)
    anchor: int | None = None
    _pending: deque[FrameStamp] = field(default_factory=deque)
    _recent: dict[int, int] = field(default_factory=dict)
    _highest: FrameStamp | None = None
    _armed: int | None = None
    _last: _Last | None = None
    _stray: int = 0
    _least_ns: int | None = None  # from the end of exposure to arrival, as seen

    def arm(self, count: int, sequence: int) -> None:
        """Frame ``sequence`` will belong to trigger ``count``: both stood still when this was said."""
        self.unanchor()
        self._armed, self._least_ns = count - sequence, None

    def unanchor(self) -> None:
        """The counts of triggers or frames began anew."""
        self.anchor = self._armed = self._last = None
        self._stray = 0
        self.counts["unpaired_no_anchor"] += len(self._pending)
        self._pending.clear()

    def add(self, frame: FrameStamp) -> list[Pair]:
        """A frame has arrived; pairs that are complete now."""
        if self._recent.get(frame.sequence) == frame.device_ns:
            self.counts["repeated"] += 1
            return []
        if self._began_anew(frame):
            self.counts["restarts"] += 1
            self._restarted()
        self._recent[frame.sequence] = frame.device_ns
        while len(self._recent) > _RECENT:
            del self._recent[next(iter(self._recent))]
        self._count(frame)
        self._pending.append(frame)
        return self.advance(frame.rx_ns)

    def _began_anew(self, frame: FrameStamp) -> bool:
        """Number and clock contradict each other, unless the frame is one that comes late."""
        if self._highest is None:
            return False
        ahead = frame.sequence - self._highest.sequence
        later = frame.device_ns - self._highest.device_ns
        if ahead > 0:
            return later <= 0
        return frame.sequence in self._recent or later >= 0 or ahead < -_REORDERED

    def _restarted(self) -> None:
        self.unanchor()
        self._recent.clear()
        self._highest = None

    def _count(self, frame: FrameStamp) -> None:
        """Numbers that are missing, less those that came late."""
        if self._highest is None:
            self._highest = frame
        elif frame.sequence > self._highest.sequence:
            self.counts["lost"] += frame.sequence - self._highest.sequence - 1
            self._highest = frame
        else:
            self.counts["lost"] = max(0, self.counts["lost"] - 1)

    def advance(self, now_ns: int) -> list[Pair]:
        """Pairs that have become complete by news of triggers; drops what has waited too long."""
        if self.anchor is None and not self._find_anchor(now_ns):
            return []
        pairs = []
        while self._pending and self.anchor is not None:
            frame = self._pending[0]
            outcome = self._match(frame, overdue=now_ns - frame.rx_ns > _OVERDUE_NS)
            if outcome is None and now_ns - frame.rx_ns <= _PATIENCE_NS and len(self._pending) < _PENDING:
                break
            self._pending.popleft()
            if isinstance(outcome, Pair):
                pairs.append(outcome)
                self.counts["paired"] += 1
            else:
                self.counts[outcome or "unpaired_no_trigger"] += 1
        return pairs

    def _match(self, frame: FrameStamp, *, overdue: bool) -> Pair | str | None:
        """The frame's pair; or why there is none; or None while its trigger may still arrive."""
        assert self.anchor is not None
        count = frame.sequence + self.anchor
        edge = self._edge(count, overdue=overdue)
        slip = self._slip(frame, edge)
        if slip is None or edge is None:
            return None if count >= self.history.latest else self._give_up(frame, count)
        if slip == 0:
            return self._accept(frame, count, edge)
        count += slip
        edge = self._edge(count, overdue=overdue) if abs(slip) <= _REACH else None
        if edge is None or self._slip(frame, edge) != 0:
            return None if abs(slip) <= _REACH and count > self.history.latest else self._reject()
        self.anchor += slip
        self.counts["reanchored"] += 1
        return self._accept(frame, count, edge)

    def _edge(self, count: int, *, overdue: bool) -> tuple[int, bool] | None:
        """Board time of a trigger, and whether it follows from others; None if it is not known."""
        known = self.history.edge(count)
        if known is None and overdue and (foretold := self.history.foretold(count)) is not None:
            return foretold, True
        return known

    def _give_up(self, frame: FrameStamp, count: int) -> str:
        """Its trigger was never told. The interval from it still tells whether the next frame slipped."""
        edge = self.history.estimate(count)
        if self._last is None and edge is not None:
            self._last = _Last(count, edge, frame.start_ns)
        return "unpaired_no_trigger"

    def _slip(self, frame: FrameStamp, edge: tuple[int, bool] | None) -> int | None:
        """By how many triggers the interval since the last pair says that ``edge`` is wrong; None: unknown.

        0 also where there is nothing to compare with.
        """
        period = self.history.period_ns()
        if edge is None or period is None:
            return None
        if self._last is None:
            return 0
        by_camera = frame.start_ns - self._last.start_ns
        by_trigger = edge[0] - self._last.edge_ns
        difference = by_camera - by_trigger
        if abs(difference) < period / 4 + abs(by_camera) * _SKEW:
            return 0
        return round(difference / period) or (1 if difference > 0 else -1)

    def _accept(self, frame: FrameStamp, count: int, edge: tuple[int, bool]) -> Pair | str:
        edge_ns, interpolated = edge
        if self._contradicted(frame, edge_ns):
            return self._reject()
        self._stray = 0
        self._last = _Last(count, edge_ns, frame.start_ns)
        strobe = self.history.strobe(count, self.timing.index)
        delay, exposure = strobe or (self.timing.delay_ns, frame.exposure_ns)
        self._learn_latency(frame, edge_ns)
        mid_ns = edge_ns + delay + exposure // 2
        return Pair(frame, count, edge_ns, mid_ns, interpolated, strobe is not None)

    def _contradicted(self, frame: FrameStamp, edge_ns: int) -> bool:
        """Arrival cannot pair, but it can refute: nothing arrives before it was triggered, or seconds later."""
        arrival, period = self.board_of_host(frame.rx_ns), self.history.period_ns()
        if arrival is None or period is None:
            return False
        return not -period // 4 <= arrival - edge_ns <= frame.exposure_ns + _PATIENCE_NS

    def _learn_latency(self, frame: FrameStamp, edge_ns: int) -> None:
        """For a camera whose latency is not known: it tells the trigger when the camera begins anew."""
        arrival = self.board_of_host(frame.rx_ns)
        if arrival is not None:
            least = arrival - edge_ns - self.timing.delay_ns - frame.exposure_ns
            self._least_ns = least if self._least_ns is None else min(least, self._least_ns)

    def _reject(self) -> str:
        self._stray += 1
        if self._stray >= _STRAY_FRAMES:
            self.anchor, self._last, self._stray = None, None, 0
        return "unpaired_mismatch"

    def _find_anchor(self, now_ns: int) -> bool:
        """Anchor by what was armed, or by arrival, which is possible where the latency is known.

        A late frame names a later trigger, never an earlier one: so the earliest named counts, and several
        frames have to agree on it. It overrules what was armed: a camera may miss a trigger without counting
        it. What waits in vain is dropped and counted.
        """
        if self._armed is not None and self.timing.latency_ns is None:
            self.anchor, self._armed = self._armed, None
            return True
        votes = Counter(vote for frame in self._pending if (vote := self._vote(frame)) is not None)
        if votes and votes[anchor := min(votes)] >= _AGREEING:
            self.counts["arm_corrected"] += self._armed is not None and self._armed != anchor
            self.anchor, self._armed = anchor, None
            self.counts["anchored"] += 1
            return True
        while self._pending and (
            now_ns - self._pending[0].rx_ns > 2 * _PATIENCE_NS or len(self._pending) >= _PENDING
        ):
            self._pending.popleft()
            self.counts["unpaired_no_anchor"] += 1
        return False

    def _vote(self, frame: FrameStamp) -> int | None:
        latency = self._least_ns if self.timing.latency_ns is None else self.timing.latency_ns
        arrival = self.board_of_host(frame.rx_ns)
        if latency is None or arrival is None:
            return None
        start = arrival - latency - frame.exposure_ns - self.timing.delay_ns
        count = self.history.nearest(start)
        return None if count is None else count - frame.sequence
