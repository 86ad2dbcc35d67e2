"""The virtual clocks: their readings, inverses, jitter and delays."""

from __future__ import annotations

import numpy as np
import pytest
from artemis_drivers.virtual.clocks import Clock, Delay, event_times, normal, rig_clocks, uniform
from hypothesis import given
from hypothesis import strategies as st

HOUR = 3_600_000_000_000
CLOCKS = [
    Clock(1),
    Clock(2, 123_456_789_012, 100.0),
    Clock(3, -5, -100.0, 2.0),
    Clock(4, 10**18, 37.5, 5.0, 1000, 0.0, 10**12),
]


@pytest.mark.parametrize("clock", CLOCKS)
@given(st.lists(st.integers(0, 100 * HOUR), min_size=1, max_size=20))
def test_inverse_of_reading(clock: Clock, times: list[int]) -> None:
    truth = np.array(sorted(times), np.int64)
    shown = clock.read(truth)
    assert shown.dtype == np.int64 and (np.diff(shown) >= 0).all()
    assert np.abs(clock.truth(shown) - truth).max() <= 1
    assert np.abs(clock.read(clock.truth(shown)) - shown).max() <= 1


def test_skew_and_offset_are_as_stated() -> None:
    clock = Clock(0, offset_ns=7_000, skew_ppm=50.0, epoch_ns=HOUR)
    assert clock.read(HOUR) == HOUR + 7_000
    assert clock.read(2 * HOUR) - clock.read(HOUR) == HOUR + 180_000_000  # 50 us a second for an hour
    assert Clock(0).read(12_345) == 12_345


def test_wander_bends_the_rate_within_its_limit() -> None:
    clock = Clock(5, wander_ppm=2.0)
    second = np.arange(0, 3600) * 1_000_000_000
    rate = np.diff(clock.read(second)) - 1_000_000_000
    assert 1.0e3 < np.abs(rate).max() <= 2.0e3 + 2
    assert np.abs(rate).min() < 200
    assert (Clock(6, wander_ppm=2.0).read(second) != clock.read(second)).mean() > 0.9


def test_stamps_have_ticks_and_a_jitter_that_belongs_to_the_event() -> None:
    clock = Clock(7, tick_ns=1_000, jitter_ns=20_000.0)
    truth = np.arange(20_000) * 10_000_000
    stamp = clock.stamp(truth, np.arange(20_000))
    assert (stamp % 1_000 == 0).all()
    assert (stamp - truth).std() == pytest.approx(20_000, rel=0.03)
    assert (stamp - truth).mean() == pytest.approx(-500, abs=500)  # a tick begins before what it names
    np.testing.assert_array_equal(stamp[500:510], clock.stamp(truth[500:510], np.arange(500, 510)))


def test_counter_wraps() -> None:
    clock = Clock(0, tick_ns=1_000)
    assert clock.counter(4_294_967_295_000, 32) == 2**32 - 1
    assert clock.counter(4_294_967_296_000, 32) == 0


def test_devices_that_pace_themselves() -> None:
    clock = Clock(0, offset_ns=3_000_000, skew_ppm=-80.0)
    at = event_times(clock, 5_000_000, 0, 10_000_000_000)
    np.testing.assert_array_equal(np.abs(clock.read(at) % 5_000_000 + 1) % 5_000_000 <= 2, True)
    assert len(at) == 2000 and (np.diff(at) > 5_000_000).all()  # slow: its period lasts longer
    assert np.diff(at).mean() == pytest.approx(5_000_400, abs=0.1)
    joined = np.concatenate([event_times(clock, 5_000_000, a, a + 10**9) for a in range(0, 10**10, 10**9)])
    np.testing.assert_array_equal(joined, at)


def test_delays() -> None:
    delay = Delay(3, 200_000, 50_000.0, 0.01, 30_000_000)
    d = delay.of(np.arange(50_000))
    assert d.min() >= 200_000
    stalled = d > 20_000_000
    assert stalled.mean() == pytest.approx(0.01, rel=0.15)
    assert (d[~stalled] - 200_000).mean() == pytest.approx(50_000, rel=0.03)
    assert delay.of(17) == d[17]


def test_hashed_numbers_are_random() -> None:
    u = uniform(1, np.arange(100_000))
    assert u.min() >= 0 and u.max() < 1
    assert np.histogram(u, 20)[0].std() < 3 * np.sqrt(5000)
    assert abs(np.corrcoef(u[1:], u[:-1])[0, 1]) < 0.01
    assert abs(np.corrcoef(u, uniform(2, np.arange(100_000)))[0, 1]) < 0.01
    n = normal(1, np.arange(100_000))
    assert n.mean() == pytest.approx(0, abs=0.01) and n.std() == pytest.approx(1, abs=0.01)


def test_the_clocks_of_a_rig_differ_and_follow_the_seed() -> None:
    rig = rig_clocks(4)
    skews = [c.skew_ppm for c in (rig.host, rig.trigger, rig.lidar, rig.imu, rig.camera)]
    assert len(set(skews)) == 5 and max(map(abs, skews)) <= 50
    assert rig_clocks(4) == rig and rig_clocks(5) != rig
    started = rig_clocks(4, start_ns=10**12)
    assert started.trigger.read(10**12) == rig.trigger.read(0) >= 0


@pytest.mark.parametrize("wrong", [{"tick_ns": 0}, {"skew_ppm": 2e4}, {"skew_ppm": float("nan")}])
def test_impossible_clocks_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError):
        Clock(0, **wrong)  # type: ignore[arg-type]
