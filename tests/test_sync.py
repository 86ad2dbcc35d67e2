"""Synchronisation: the clocks of a session one by one, and whole simulated runs against the truth.

The full study of 20 runs of a minute is tests/soak/sync_study.py.
"""

import dataclasses
import datetime as dt

import numpy as np
import pytest
from artemis_drivers.trigger.events import TRIGGER_EVENT, Kind
from artemis_drivers.trigger.messages import PPS_GENERATED

from artemis_edge.session_clocks import ClockState, LidarClock, LidarTime, PulseClock, epoch_of
from artemis_edge.sync import BoardEvent, CameraTiming, FrameStamp, Synchroniser
from tests.sync_rig import EPOCH_NS, Outcome, Run, Spec

SECOND = 10**9
SHORT = Spec(seconds=18.0)


def judge(outcome: Outcome, images: float = 0.2, samples: float = 0.2) -> None:
    assert outcome.wrong_pairs == 0
    assert outcome.p99_ms(outcome.image_ns) < images
    assert outcome.p99_ms(outcome.imu_ns) < samples
    assert np.all(np.diff(outcome.imu_stamps) > 0)


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"jitter": "exponential", "missed_exposures": 0.02, "lost_events": 0.03},
        {"camera_restarts_at": 20.0, "armed": False},
        {"latency_known": False},
    ],
    ids=["skew, jitter, loss", "more loss", "restart", "armed only"],
)
def test_times_are_right_and_no_pair_is_wrong(change: dict[str, object]) -> None:
    outcome = Run(dataclasses.replace(SHORT, **change), 2).run()  # type: ignore[arg-type]
    judge(outcome)
    assert outcome.sync is not None
    counts = outcome.sync.counts()["cam"]
    assert counts["paired"] >= 0.97 * outcome.frames
    assert counts["repeated"] > 0 and counts["lost"] > 0.5 * outcome.expected_lost
    if not change:
        assert counts["paired"] == outcome.frames and outcome.states == {ClockState.LOCKED}


def test_counters_clocks_and_the_date_wrap() -> None:
    """Every counter wraps between second 12 and 30, and midnight is passed at second 60."""
    spec = dataclasses.replace(
        SHORT,
        seconds=50.0,
        imu_hz=100.0,
        first_count=2**24 - 200,
        first_us=2**32 - 20_000_000,
        first_tick=2**32 - 200_000,
        first_sample=2**16 - 2000,
    )
    outcome = Run(spec, 1).run()
    judge(outcome)
    assert outcome.sync is not None and outcome.states == {ClockState.LOCKED}
    day = dt.date(2025, 12, 28)
    epoch = EPOCH_NS // SECOND - spec.first_count
    told = [outcome.sync.utc_of_pulse(spec.first_count + k) for k in (59, 60)]
    assert [dt.datetime.fromtimestamp(ns // SECOND, dt.UTC) for ns in told] == [
        dt.datetime(day.year, day.month, day.day, 23, 59, 59, tzinfo=dt.UTC),
        dt.datetime(day.year, day.month, day.day + 1, tzinfo=dt.UTC),
    ]
    assert outcome.sync.pulse.epoch_ns == epoch * SECOND


def test_a_pulse_that_is_missing_for_30_s_is_carried_and_told() -> None:
    spec = dataclasses.replace(SHORT, seconds=40.0, imu_hz=100.0, external_pps=True, pps_gap=(16.0, 46.0))
    outcome = Run(spec, 4).run()
    judge(outcome)
    assert np.max(np.abs(outcome.lidar_ns)) < 1_000_000
    assert outcome.states == {ClockState.LOCKED, ClockState.HOLDOVER}
    assert any("no pulse per second for 2" in text for text in outcome.messages["pps"])
    assert any("runs by its own clock" in text for text in outcome.messages["lidar"])
    assert outcome.messages["pps"][-1] == outcome.messages["lidar"][-1] == ""


def test_the_same_events_give_the_same_times() -> None:
    spec = Spec(seconds=3.0, start_s=2.0)
    first, second = Run(spec, 7).run(), Run(spec, 7).run()
    assert (first.image_ns, first.imu_ns) == (second.image_ns, second.imu_ns)
    assert first.image_ns and first.imu_ns


# --- the pulse ---


def pulses(clock: PulseClock, counts: range, rate: float = 1.0, first_ns: int = 500, **kind: bool) -> None:
    for k in counts:
        clock.add(k, first_ns + round(k * SECOND * rate), generated=kind.get("generated", True))


def test_pulses_of_the_board_define_the_second() -> None:
    clock = PulseClock(100 * SECOND)
    assert clock.session_ns(5) is None and clock.skew is None
    assert clock.report(0).state == ClockState.UNKNOWN
    pulses(clock, range(3))
    assert clock.session_ns(2 * SECOND + 750) == 102 * SECOND + 250
    assert clock.report(2 * SECOND).state == ClockState.LOCKED


def test_the_rate_of_pulses_from_outside_is_measured_and_carried() -> None:
    clock = PulseClock(0)
    pulses(clock, range(20), rate=1 + 80e-6, generated=False)
    at = 500 + round(50 * SECOND * (1 + 80e-6))
    assert abs(clock.session_ns(at) - 50 * SECOND) < 100  # type: ignore[operator]
    report = clock.report(at)
    assert report.state == ClockState.HOLDOVER and report.skew_ppm == pytest.approx(-80, abs=0.1)
    assert "for 31 s" in report.message and report.doubt_ns > 30_000


def test_the_epoch_makes_a_pulse_the_nearest_whole_second() -> None:
    assert epoch_of(7, 1000 * SECOND + 400_000_000) == 993 * SECOND
    assert epoch_of(7, 1000 * SECOND - 400_000_000) == 993 * SECOND


def test_a_glitch_is_no_pulse() -> None:
    clock = PulseClock(0)
    pulses(clock, range(5))
    clock.add(5, 4 * SECOND + 300_000_000, generated=True)
    pulses(clock, range(5, 8))
    assert clock.strange == 1 and clock.session_ns(7 * SECOND + 500) == 7 * SECOND


def test_a_pulse_that_comes_back_with_another_number() -> None:
    """A board that does not count while its input is missing: time is right, the number yields."""
    clock = PulseClock(0)
    pulses(clock, range(5))
    clock.add(5, 34 * SECOND + 500, generated=True)
    assert clock.session_ns(34 * SECOND + 500) == 34 * SECOND
    assert clock.renumbered == 1 and clock.epoch_ns == 29 * SECOND


def test_a_pulse_with_a_new_phase_is_believed_in_the_end() -> None:
    clock = PulseClock(0)
    pulses(clock, range(5))
    pulses(clock, range(5, 12), first_ns=400_000_000)
    assert clock.strange == 3 and clock.restarts == 1
    assert clock.session_ns(11 * SECOND + 400_000_000) == 12 * SECOND


# --- LiDARs ---


def test_a_lidar_without_utc_lacks_whole_seconds() -> None:
    lidar = LidarTime("avia")
    dated = lidar.stamp(3 * SECOND + 5, LidarClock.PULSE, 77 * SECOND + 900_000, pulse=True)
    assert (dated.stamp_ns, dated.state) == (77 * SECOND + 5, ClockState.LOCKED)
    late_utc = lidar.stamp(78 * SECOND, LidarClock.UTC, 78 * SECOND + 900_000, pulse=True)
    assert late_utc.stamp_ns == 78 * SECOND


def test_a_lidar_that_never_had_a_pulse_is_dated_by_arrival() -> None:
    lidar = LidarTime("avia")
    states = set()
    for k in range(2000):
        stamp = k * 10_000_000
        dated = lidar.stamp(stamp, LidarClock.FREE, stamp + 50 * SECOND, pulse=False)
        assert abs(dated.stamp_ns - stamp - 50 * SECOND) <= 1
        states.add(dated.state)
    assert states == {ClockState.SETTLING, ClockState.HOLDOVER}
    assert "check its pulse" in lidar.report().message


# --- the whole ---


def synchroniser() -> Synchroniser:
    return Synchroniser({"cam": CameraTiming(0, 20_000_000)}, {"imu": 0}, 1000 * SECOND)


def event(kind: Kind, count: int, board_ns: int, boot: int = 0, series: int = 0, **more: int) -> BoardEvent:
    rx = board_ns + 9000 * SECOND + boot * 100 * SECOND
    return BoardEvent(kind, count, series, boot, board_ns, rx, **({"flags": PPS_GENERATED} | more))


def test_before_the_first_pulse_nothing_is_dated_and_that_is_counted() -> None:
    sync = synchroniser()
    assert sync.imu("imu", 0, 0, 0) is None
    assert sync.lidar("avia", 0, LidarClock.UTC, 0) is None
    assert sync.session_of_host(0) is None
    sync.board_event(event(Kind.TRIGGER, 0, 0))
    assert sync.imu("imu", 0, 0, 0) is None
    assert sync.undated == {"imu": 2, "avia": 1}
    assert [report.state for report in sync.report(0)] == [
        ClockState.SETTLING,
        ClockState.UNKNOWN,
        ClockState.SETTLING,
    ]


def test_a_board_that_restarts_never_sets_time_back() -> None:
    sync = synchroniser()
    for k in range(20):
        sync.board_event(event(Kind.PPS, k, k * SECOND))
    before = sync.session_of_host(9019 * SECOND)
    assert before == 1019 * SECOND
    sync.board_event(event(Kind.TRIGGER, 0, 100_000_000, boot=1))
    assert sync.session_of_host(9100 * SECOND) == 1100 * SECOND  # carried on
    sample = sync.imu("imu", 0, 0, 9100 * SECOND + 150_000_000)
    assert sample is not None and sample.stamp_ns == 1100 * SECOND + 150_000_000
    assert sync.pulse.model is None and sync.undated == {}
    sync.board_event(event(Kind.PPS, 0, 200_000_000, boot=1))
    after = sync.session_of_host(9100 * SECOND + 200_000_000)
    assert after == 1101 * SECOND  # the first whole second that is not before 1100.1 s
    assert sync.pulse.restarts == 1 and sync.utc_of_pulse(0) == 1101 * SECOND


def test_a_trigger_on_its_way_while_arming_spoils_nothing() -> None:
    sync = Synchroniser({"cam": CameraTiming(0, None)}, {}, 1000 * SECOND)
    sync.board_event(event(Kind.PPS, 0, 0))
    for k in range(3):
        sync.board_event(event(Kind.TRIGGER, k, (k + 1) * 100_000_000))
    sync.arm({"cam": 0})
    sync.board_event(event(Kind.TRIGGER, 3, 400_000_000))
    assert sync.undated == {"trigger before arm": 1}
    images = []
    for k in range(4):
        edge = 900_000_000 + k * 100_000_000
        images += sync.board_event(event(Kind.TRIGGER, k, edge, series=1))
        frame = FrameStamp(k, edge + 2_000_000, 2_000_000, edge + 9000 * SECOND + 22_000_000)
        images += sync.image("cam", frame)
    assert [image.pair.count for image in images] == [0, 1, 2, 3]
    assert images[0].stamp_ns == 1000 * SECOND + 901_000_000
    sync.board_event(event(Kind.TRIGGER, 0, 2 * SECOND, series=2))  # nobody armed: which frame is next?
    assert sync.pairings["cam"].anchor is None


def test_strobes_and_rows_of_a_ring() -> None:
    sync = synchroniser()
    sync.arm({"cam": 0})
    rows = np.zeros(7, TRIGGER_EVENT)
    rows["kind"] = [
        Kind.PPS,
        Kind.TRIGGER,
        Kind.STROBE,
        Kind.TRIGGER,
        Kind.BUTTON,
        Kind.TRIGGER,
        Kind.TRIGGER,
    ]
    rows["count"] = [0, 0, 0, 1, 2, 2, 3]
    rows["board_ns"] = [0, 100_000_000, 0, 200_000_000, 0, 300_000_000, 400_000_000]
    rows["rx_ns"] = rows["board_ns"] + 9000 * SECOND
    rows["flags"] = PPS_GENERATED
    rows["delay_us"], rows["width_us"] = 30, 2000
    assert sync.board_rows({name: rows[name] for name in TRIGGER_EVENT.names or ()}) == []
    images = []
    for k in range(4):
        end = (k + 1) * 100_000_000 + 5_000_000
        images += sync.image("cam", FrameStamp(k, end + 7, 5_000_000, end + 9000 * SECOND + 20_000_000))
    assert [(image.pair.count, image.pair.measured) for image in images] == [
        (0, True),
        (1, False),
        (2, False),
        (3, False),
    ]
    assert images[0].stamp_ns == 1000 * SECOND + 100_000_000 + 30_000 + 1_000_000
    assert images[1].stamp_ns == 1000 * SECOND + 200_000_000 + 2_500_000


def test_an_epoch_is_a_whole_second() -> None:
    with pytest.raises(ValueError, match="whole second"):
        Synchroniser({}, {}, 5)
