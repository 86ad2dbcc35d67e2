"""One time for all sensors, from the trigger board's counts and clock.

Session time is the time of the pulses per second (PPS): pulse k happens at ``epoch_ns`` + k seconds, which is
also what the LiDAR is told. The board captures pulses and camera triggers with one timer, so photographs get
session time without any host clock. The host's clock is tied to the board's by the arrival of its messages,
and carries what only arrives at the host: the samples of a serial IMU, and the LiDAR while its pulse is
missing. All this is computed from the events alone: the same events give the same times.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from artemis_drivers.trigger.events import Kind
from artemis_drivers.trigger.messages import PPS_GENERATED
from numpy.typing import NDArray

from artemis_edge.clock_model import SECOND_NS, AffineClock, EnvelopeFit
from artemis_edge.frame_pairing import CameraTiming, FramePairing, FrameStamp, Pair, TriggerHistory
from artemis_edge.session_clocks import (
    SETTLED_S,
    ClockReport,
    ClockState,
    LidarClock,
    LidarTime,
    PulseClock,
    SampleTime,
)

_US_NS = 1000
_SLOPE_S = 3.0  # of LiDAR stamps that give a better slope than the board's messages


@dataclass(frozen=True, slots=True)
class BoardEvent:
    """A row of TRIGGER_EVENT that has a time; see there."""

    kind: int
    count: int
    series: int
    boot: int
    board_ns: int
    rx_ns: int
    flags: int = 0
    camera: int = 0
    delay_us: int = 0
    width_us: int = 0


@dataclass(frozen=True, slots=True)
class ImageTime:
    """Session time of the middle of an exposure, its pair, and the state of the pulse at that time."""

    camera: str
    stamp_ns: int
    pair: Pair
    state: ClockState


class Synchroniser:
    """Gives session time to what the devices deliver.

    ``imu_latency_ns``: by name, the least time from sampling to arrival, less that of the board's messages (a
    calibrated constant). ``epoch_ns``: nanoseconds since 1970 of pulse 0, whole seconds.
    """

    def __init__(
        self, cameras: Mapping[str, CameraTiming], imu_latency_ns: Mapping[str, int], epoch_ns: int = 0
    ) -> None:
        if epoch_ns % SECOND_NS:
            raise ValueError("the epoch of a session is a whole second")
        self.pulse = PulseClock(epoch_ns)
        self.history = TriggerHistory()
        self.pairings = {
            name: FramePairing(timing, self.history, self._board_of_host) for name, timing in cameras.items()
        }
        self._host = EnvelopeFit()  # x: board, y: host
        self._by_lidar = EnvelopeFit()  # x: session, y: host
        self._imus = {name: _Imu(latency) for name, latency in imu_latency_ns.items()}
        self._lidars: dict[str, LidarTime] = {}
        self._boot: int | None = None
        self._series: int | None = None
        self._armed = False
        self._triggered = False  # whether a trigger of this boot was told
        # of the boot before: board to host, and board to session
        self._carried: tuple[AffineClock, AffineClock] | None = None
        self.undated: Counter[str] = Counter()

    # --- what the devices say ---

    def board_event(self, event: BoardEvent) -> list[ImageTime]:
        """A trigger, pulse or strobe; photographs that were waiting for it."""
        if event.kind == Kind.STROBE:
            delay, width = event.delay_us * _US_NS, event.width_us * _US_NS
            self.history.add_strobe(event.count, event.camera, delay, width)
            return []
        if event.kind not in (Kind.TRIGGER, Kind.PPS):
            return []
        if event.boot != self._boot:
            self._board_restarted(event)
        self._host.add(event.board_ns, event.rx_ns)
        if event.kind == Kind.PPS:
            generated = bool(event.flags & PPS_GENERATED)
            self.pulse.add(event.count, event.board_ns, generated=generated)
            return []
        first, self._triggered = not self._triggered, True
        if event.series != self._series or (first and self._armed):
            self._new_series(event.series)
        elif self._armed:  # it was on its way when the board was armed
            self.undated["trigger before arm"] += 1
            return []
        self.history.add(event.count, event.board_ns)
        return self.advance(event.rx_ns)

    def board_rows(self, rows: Mapping[str, NDArray[Any]]) -> list[ImageTime]:
        """Rows of a ring of TRIGGER_EVENT, in order."""
        names = BoardEvent.__dataclass_fields__
        columns = [rows[name].tolist() for name in names]
        return [image for row in zip(*columns, strict=True) for image in self.board_event(BoardEvent(*row))]

    def image(self, camera: str, frame: FrameStamp) -> list[ImageTime]:
        """A photograph has arrived; those that can be dated now (perhaps earlier ones)."""
        return self._dated(camera, self.pairings[camera].add(frame))

    def advance(self, now_ns: int) -> list[ImageTime]:
        """Photographs that can be dated by host time ``now_ns``; gives up on those that waited too long."""
        return [
            image
            for name, pairing in self.pairings.items()
            for image in self._dated(name, pairing.advance(now_ns))
        ]

    def imu(self, name: str, device_ns: int, boot: int, rx_ns: int) -> SampleTime | None:
        """Session time of a sample; None while the board is unknown. Never goes back within a boot."""
        imu = self._imus[name]
        host_ns = imu.host_ns(device_ns, boot, rx_ns)
        board_ns = self._board_of_host(host_ns)
        session = self._session(board_ns, host_ns)
        if session is None:
            self.undated[name] += 1
            return None
        span = min(self._host.span_s, imu.fit.span_s)
        state = ClockState.LOCKED if span >= SETTLED_S else ClockState.SETTLING
        if state == ClockState.LOCKED and self._without_pulse(board_ns):
            state = ClockState.HOLDOVER
        return SampleTime(imu.ahead(session), state)

    def lidar(
        self, name: str, stamp_ns: int, clock: LidarClock, rx_ns: int, *, pulse: bool | None = None
    ) -> SampleTime | None:
        """Session time of a LiDAR stamp; None while the board is unknown.

        ``pulse``: whether its status says that it receives the pulse; None: as the board reports.
        """
        board_ns = self._board_of_host(rx_ns)
        arrival = self._session(board_ns, rx_ns)
        if arrival is None:
            self.undated[name] += 1
            return None
        present = pulse if pulse is not None else not self._without_pulse(board_ns)
        lidar = self._lidars.setdefault(name, LidarTime(name))
        dated = lidar.stamp(stamp_ns, clock, arrival, pulse=present)
        if dated.state == ClockState.LOCKED and name == next(iter(self._lidars)):
            self._by_lidar.add(dated.stamp_ns, rx_ns)
        return dated

    def arm(self, sequences: Mapping[str, int], count: int = 0) -> None:
        """Triggers stand still: trigger ``count`` of the next series belongs to these frames of the cameras."""
        self.history.clear()
        for name, sequence in sequences.items():
            self.pairings[name].arm(count, sequence)
        self._armed = True

    # --- what is known ---

    def session_of_host(self, host_ns: int) -> int | None:
        """Session time at a host time; until a board that has restarted gives its first pulse, as before."""
        return self._session(self._board_of_host(host_ns), host_ns)

    def _session(self, board_ns: int | None, host_ns: int) -> int | None:
        session = None if board_ns is None else self.pulse.session_ns(board_ns)
        if session is None and self._carried is not None:
            board, pulse = self._carried
            return pulse.to_y(board.to_x(host_ns))
        return session

    def utc_of_pulse(self, count: int) -> int:
        """What the LiDAR is told after a pulse (command UTC, 10 to 500 ms after it), ns since 1970."""
        return self.pulse.epoch_ns + count * SECOND_NS

    def report(self, now_ns: int) -> list[ClockReport]:
        """All clocks at host time ``now_ns``, the board first."""
        board_ns = self._board_of_host(now_ns)
        reports = [self._report_fit("board", self._host)]
        if board_ns is not None:
            reports.append(self.pulse.report(board_ns))
        reports += [self._report_fit(name, imu.fit) for name, imu in self._imus.items()]
        return reports + [lidar.report() for lidar in self._lidars.values()]

    def counts(self) -> dict[str, dict[str, int]]:
        """Per camera: paired, lost, repeated, reanchored, unpaired by reason."""
        return {name: dict(pairing.counts) for name, pairing in self.pairings.items()}

    def _dated(self, camera: str, pairs: list[Pair]) -> list[ImageTime]:
        images = []
        for pair in pairs:
            session = self.pulse.session_ns(pair.mid_ns)
            if session is None:
                self.pairings[camera].counts["undated_no_pulse"] += 1
                continue
            missing = self.pulse.missing_ns(pair.mid_ns)
            state = ClockState.HOLDOVER if missing else ClockState.LOCKED
            images.append(ImageTime(camera, session, pair, state))
        return images

    def _board_restarted(self, event: BoardEvent) -> None:
        """Nothing of the old board time holds; session time goes on with a later whole second."""
        if self._boot is not None:
            least, board = self.session_of_host(event.rx_ns), self._host.model(self._skew_by_lidar())
            if board is not None and self.pulse.model is not None:
                self._carried = board, self.pulse.model
            self.pulse.restart(least)
        self._boot = event.boot
        self._triggered = False
        self._host.restart()
        self._by_lidar.restart()
        self._new_series(event.series)

    def _new_series(self, series: int) -> None:
        self._series = series
        self.history.clear()
        if not self._armed:
            for pairing in self.pairings.values():
                pairing.unanchor()
        self._armed = False

    def _board_of_host(self, host_ns: int) -> int | None:
        model = self._host.model(self._skew_by_lidar())
        return None if model is None else model.to_x(host_ns)

    def _without_pulse(self, board_ns: int | None) -> bool:
        return board_ns is None or self.pulse.model is None or self.pulse.missing_ns(board_ns) > 0

    def _skew_by_lidar(self) -> float | None:
        """Host seconds a board second, minus one, by a LiDAR with pulse; None while there is none.

        Its stamps are session time and come by the hundred, the board's messages by the dozen a second: the
        slope is the LiDAR's, which leaves only the offset to the board's.
        """
        skew, model = self.pulse.skew, self._by_lidar.model()
        if skew is None or model is None or self._by_lidar.span_s < _SLOPE_S:
            return None
        return (1 + skew) * (1 + model.skew) - 1

    def _report_fit(self, name: str, fit: EnvelopeFit) -> ClockReport:
        model, quality = fit.model(), fit.quality()
        if model is None:
            return ClockReport(name, ClockState.UNKNOWN, 0.0, 0, 0, 0, f"{name} has not been heard yet")
        settled = quality.span_s >= SETTLED_S
        state = ClockState.LOCKED if settled else ClockState.SETTLING
        text = "" if settled else f"{name}: time settles for {SETTLED_S - quality.span_s:.0f} s more"
        offset = model.y0 - model.x0
        return ClockReport(name, state, model.skew_ppm, offset, quality.doubt_ns, quality.events, text)


class _Imu:
    """The clock of one IMU in host time."""

    def __init__(self, latency_ns: int) -> None:
        self.fit = EnvelopeFit()  # x: device, y: host
        self._latency_ns = latency_ns
        self._boot: int | None = None
        self._last_ns: int | None = None

    def host_ns(self, device_ns: int, boot: int, rx_ns: int) -> int:
        """Host time of the sampling."""
        if boot != self._boot:
            self._boot = boot
            self.fit.restart()
        self.fit.add(device_ns, rx_ns)
        model = self.fit.model()
        assert model is not None
        return model.to_y(device_ns) - self._latency_ns

    def ahead(self, session_ns: int) -> int:
        """A corrected line may step back a little; time does not."""
        if self._last_ns is not None and session_ns <= self._last_ns:
            session_ns = self._last_ns + 1
        self._last_ns = session_ns
        return session_ns
