"""A rig of clocks in simulated time: what each device would say, when it would arrive, and what is true.

Only times are simulated, on one truth clock. The messages are real: CAN frames go through the trigger
board's driver, IMU stamps through the IMU's device clock, so that all counters and clocks wrap as they do there.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from artemis_drivers.imu_serial.clock import XSENS_CLOCK, DeviceClock
from artemis_drivers.imu_serial.driver import COLLECT_S
from artemis_drivers.ring import Ring, RingReader
from artemis_drivers.trigger.board import TriggerBoard
from artemis_drivers.trigger.events import TRIGGER_EVENT
from artemis_drivers.trigger.messages import PPS_EXTERNAL_VALID, PPS_GENERATED, PpsEvent, Record, TrigEvent
from artemis_drivers.trigger.settings import TriggerSettings

from artemis_edge.session_clocks import ClockState, LidarClock
from artemis_edge.sync import CameraTiming, FrameStamp, Synchroniser

SECOND = 10**9
EPOCH_NS = 1_766_966_340 * SECOND  # 28 December 2025, 23:59:00 UTC: midnight passes on the way
BOARD_LATENCY_NS, IMU_LATENCY_NS, LIDAR_LATENCY_NS, CAMERA_LATENCY_NS = (
    400_000,
    1_100_000,
    300_000,
    24_000_000,
)
DELAY_NS = 12_000
Jitter = Callable[[np.random.Generator, int, float], np.ndarray]

JITTERS: dict[str, Jitter] = {
    "uniform": lambda rng, n, scale: rng.uniform(0, scale, n),
    "exponential": lambda rng, n, scale: rng.exponential(scale, n),
    "half-normal": lambda rng, n, scale: np.abs(rng.normal(0, scale, n)),
}


@dataclass(frozen=True)
class Spec:
    """``start_s``: the rig runs before what counts begins. Skews are drawn within +-``skew_ppm``; shares are
    of frames and events. ``pps_gap``: session seconds between which the pulse is missing.
    """

    seconds: float = 60.0
    start_s: float = 12.0
    rate_hz: float = 10.0
    imu_hz: float = 400.0
    skew_ppm: float = 100.0
    jitter_ns: float = 2e6
    jitter: str = "uniform"
    lost_frames: float = 0.05
    missed_exposures: float = 0.0
    repeated_frames: float = 0.01
    lost_events: float = 0.0
    external_pps: bool = False
    pps_gap: tuple[float, float] | None = None
    camera_restarts_at: float | None = None
    first_count: int = 0
    first_us: int = 0
    first_tick: int = 0
    first_sample: int = 0
    armed: bool = True
    latency_known: bool = True


@dataclass
class Outcome:
    """Errors in ns of what was dated after the start, and what the synchroniser says at the end."""

    image_ns: list[int] = field(default_factory=list)
    imu_ns: list[int] = field(default_factory=list)
    lidar_ns: list[int] = field(default_factory=list)
    wrong_pairs: int = 0
    frames: int = 0
    expected_lost: int = 0
    states: set[ClockState] = field(default_factory=set)
    messages: dict[str, list[str]] = field(default_factory=dict)
    sync: Synchroniser | None = None
    imu_stamps: list[int] = field(default_factory=list)

    def p99_ms(self, errors: list[int]) -> float:
        return float(np.percentile(np.abs(errors), 99)) / 1e6


class Rig:
    """The clocks: readings of each at a truth time in seconds (float64 arrays) as int64 nanoseconds."""

    def __init__(self, spec: Spec, seed: int) -> None:
        self.spec, self.rng = spec, np.random.default_rng(seed)
        self.board, self.host, self.camera, self.imu, self.lidar = (
            self.rng.uniform(-1, 1, 5) * spec.skew_ppm * 1e-6
        )
        self.stop_s = spec.start_s + spec.seconds

    def host_ns(self, truth_s: np.ndarray) -> np.ndarray:
        return np.round((truth_s + 5000.0) * (1 + self.host) * 1e9).astype(np.int64)

    def board_us(self, truth_s: np.ndarray) -> np.ndarray:
        return np.floor(truth_s * (1 + self.board) * 1e6).astype(np.int64)

    def session_ns(self, truth_s: np.ndarray) -> np.ndarray:
        """By pulses at whole seconds, of truth or of the board; pulse 0 is at second 0."""
        seconds = truth_s if self.spec.external_pps else truth_s * (1 + self.board)
        return EPOCH_NS + np.round(seconds * 1e9).astype(np.int64)

    def truth_of_session(self, session_s: np.ndarray) -> np.ndarray:
        return session_s if self.spec.external_pps else session_s / (1 + self.board)

    def arrivals(self, truth_s: np.ndarray, latency_ns: float) -> np.ndarray:
        """Host times; a stream keeps its order."""
        jitter = JITTERS[self.spec.jitter](self.rng, len(truth_s), self.spec.jitter_ns)
        return np.maximum.accumulate(self.host_ns(truth_s + (latency_ns + jitter) * 1e-9))

    def collected(self, arrivals: np.ndarray) -> np.ndarray:
        """As the IMU's driver takes samples in: one that it waits for, then all that came in a pause."""
        taken, k = arrivals.copy(), 0
        while k < len(taken):
            end = taken[k] + round(COLLECT_S * 1e9)
            after = int(np.searchsorted(arrivals, end, "right"))
            taken[k + 1 : after] = end
            k = max(after, k + 1)
        return taken

    def kept(self, count: int, share_lost: float) -> np.ndarray:
        return self.rng.uniform(size=count) >= share_lost


Event = tuple[int, int, Callable[[], None]]


class Run:
    """One run: all events in order of arrival, fed to the drivers' counters and the synchroniser."""

    def __init__(self, spec: Spec, seed: int) -> None:
        self.spec, self.rig, self.outcome = spec, Rig(spec, seed), Outcome()
        latency = CAMERA_LATENCY_NS if spec.latency_known else None
        cameras = {"cam": CameraTiming(DELAY_NS, latency)}
        self.sync = Synchroniser(
            cameras, {"imu": IMU_LATENCY_NS - BOARD_LATENCY_NS}, EPOCH_NS - spec.first_count * SECOND
        )
        self.ring = Ring(TRIGGER_EVENT, 64)
        self.reader = RingReader(self.ring)
        self.driver = TriggerBoard(TriggerSettings(), self.ring)
        self.imu_clock = DeviceClock(XSENS_CLOCK, spec.imu_hz)
        self.truth_of_frame: dict[tuple[int, int], tuple[int, int]] = {}
        if spec.armed:
            self.sync.arm({"cam": 0}, spec.first_count)

    def run(self) -> Outcome:
        events = sorted([*self._board(), *self._camera(), *self._imu(), *self._lidar()], key=lambda e: e[:2])
        reported = 0
        for rx_ns, _, act in events:
            act()
            if rx_ns - reported > SECOND:
                reported = rx_ns
                for report in self.sync.report(rx_ns):
                    self.outcome.messages.setdefault(report.name, []).append(report.message)
        self.outcome.sync = self.sync
        return self.outcome

    def _counts(self, session_ns: int) -> bool:
        return session_ns >= EPOCH_NS + self.spec.start_s * SECOND

    # --- board ---

    def _board(self) -> Iterator[Event]:
        spec, rig = self.spec, self.rig
        pulse_s = rig.truth_of_session(np.arange(0, int(rig.stop_s) + 1, dtype=float))
        trigger_s = self._trigger_times()
        times = np.concatenate([pulse_s, trigger_s])
        order = np.argsort(times, kind="stable")
        arrivals = rig.arrivals(times[order], BOARD_LATENCY_NS)
        captures = rig.board_us(times[order])
        kept = rig.kept(len(order), spec.lost_events)
        for row, which in enumerate(order):
            us = int(captures[row] + spec.first_us) % 2**32
            if which < len(pulse_s):
                if spec.pps_gap and spec.pps_gap[0] <= which < spec.pps_gap[1]:
                    continue
                flags = PPS_EXTERNAL_VALID if spec.external_pps else PPS_GENERATED
                record: Record = PpsEvent((int(which) + spec.first_count) % 2**24, flags, us)
            else:
                record = TrigEvent((int(which) - len(pulse_s) + spec.first_count) % 2**24, 1, us)
            if kept[row]:
                yield (
                    int(arrivals[row]),
                    0,
                    lambda record=record, rx=int(arrivals[row]): self._hear(record, rx),
                )

    def _hear(self, record: Record, rx_ns: int) -> None:
        self.driver.take(*self.driver.messages.encode(record), rx_ns)
        _, rows = self.reader.read()
        self._judge(self.sync.board_rows(rows))

    def _trigger_times(self) -> np.ndarray:
        count = int((self.rig.stop_s - 1.0) * self.spec.rate_hz)
        return self.rig.truth_of_session(1.0 + np.arange(count) / self.spec.rate_hz + 0.02)

    # --- camera ---

    def _camera(self) -> Iterator[Event]:
        spec, rig = self.spec, self.rig
        edges = self._trigger_times()
        taken = rig.kept(len(edges), spec.missed_exposures)
        exposures = rig.rng.uniform(0.5e-3, 5e-3, len(edges))
        arrivals = rig.arrivals(edges + DELAY_NS * 1e-9 + exposures, CAMERA_LATENCY_NS)
        arrived = rig.kept(len(edges), spec.lost_frames)
        repeated = ~rig.kept(len(edges), spec.repeated_frames)
        sequence, offset_s, life = 0, 77.0, 0
        for k in np.flatnonzero(taken):
            end_s = edges[k] + DELAY_NS * 1e-9 + exposures[k]
            if spec.camera_restarts_at is not None and life == 0 and edges[k] > spec.camera_restarts_at:
                sequence, offset_s, life = 0, -edges[k] + 0.5, 1
            device_ns = round((end_s + offset_s) * (1 + rig.camera) * 1e9 + rig.rng.normal(0, 30e3))
            frame = FrameStamp(sequence, device_ns, round(exposures[k] * 1e9), int(arrivals[k]))
            truth_s = edges[k] + DELAY_NS * 1e-9 + exposures[k] / 2
            truth = (int(k) + spec.first_count, int(rig.session_ns(np.array(truth_s))))
            self.truth_of_frame[sequence, device_ns] = truth
            sequence += 1
            self.outcome.frames += bool(arrived[k])
            self.outcome.expected_lost += not arrived[k]
            if arrived[k]:
                for _ in range(1 + bool(repeated[k])):
                    yield frame.rx_ns, 1, lambda frame=frame: self._judge(self.sync.image("cam", frame))

    def _judge(self, images: list) -> None:
        for image in images:
            count, session_ns = self.truth_of_frame[image.pair.frame.sequence, image.pair.frame.device_ns]
            self.outcome.wrong_pairs += image.pair.count != count
            if self._counts(session_ns):
                self.outcome.image_ns.append(image.stamp_ns - session_ns)
                self.outcome.states.add(image.state)

    # --- IMU and LiDAR ---

    def _imu(self) -> Iterator[Event]:
        spec, rig = self.spec, self.rig
        count = int((rig.stop_s - 0.5) * spec.imu_hz)
        device_s = np.arange(count) / spec.imu_hz
        truth_s = 0.3 + device_s / (1 + rig.imu)
        arrivals = rig.collected(rig.arrivals(truth_s, IMU_LATENCY_NS))
        sessions = rig.session_ns(truth_s)
        for k in range(count):
            ticks = (spec.first_tick + int(k * 10_000 / spec.imu_hz)) % 2**32
            number = (spec.first_sample + k) % 2**16
            act = lambda t=ticks, n=number, rx=int(arrivals[k]), s=int(sessions[k]): self._sample(t, n, rx, s)  # noqa: E731
            yield int(arrivals[k]), 2, act

    def _sample(self, ticks: int, number: int, rx_ns: int, session_ns: int) -> None:
        reading = self.imu_clock.read(ticks, number)
        assert reading is not None
        dated = self.sync.imu("imu", reading.device_ns, reading.boot, rx_ns)
        if dated is not None:
            self.outcome.imu_stamps.append(dated.stamp_ns)
            if self._counts(session_ns):
                self.outcome.imu_ns.append(dated.stamp_ns - session_ns)

    def _lidar(self) -> Iterator[Event]:
        """One stamp every 10 ms: right while the pulse comes, drifting while it does not."""
        spec, rig = self.spec, self.rig
        truth_s = np.arange(2.0, rig.stop_s - 0.5, 0.01)
        arrivals, sessions = rig.arrivals(truth_s, LIDAR_LATENCY_NS), rig.session_ns(truth_s)
        relative = (sessions - EPOCH_NS) * 1e-9
        drift = np.zeros(len(truth_s), np.int64)
        if spec.pps_gap:
            held = (relative > spec.pps_gap[0]) & (relative < spec.pps_gap[1])
            drift = np.where(held, np.round((relative - spec.pps_gap[0]) * rig.lidar * 1e9), 0).astype(
                np.int64
            )
        for k in range(len(truth_s)):
            act = lambda rx=int(arrivals[k]), s=int(sessions[k]), d=int(drift[k]): self._packet(s + d, rx, s)  # noqa: E731
            yield int(arrivals[k]), 3, act

    def _packet(self, stamp_ns: int, rx_ns: int, session_ns: int) -> None:
        dated = self.sync.lidar("lidar", stamp_ns, LidarClock.UTC, rx_ns)
        if dated is not None and self._counts(session_ns):
            self.outcome.lidar_ns.append(dated.stamp_ns - session_ns)
            self.outcome.states.add(dated.state)
