"""Device time: wraps, gaps, repeats, corrupted stamps and restarts."""

from itertools import pairwise

import pytest
from artemis_drivers.imu_serial.clock import VECTORNAV_CLOCK, XSENS_CLOCK, DeviceClock, Reading
from artemis_drivers.unwrap import Unwrap, wrapped_step
from hypothesis import given
from hypothesis import strategies as st


@given(
    st.integers(2, 2**40),
    st.integers(-(2**50), 2**50),
    st.lists(st.tuples(st.integers(0, 2**50), st.floats(-0.49, 0.49)), max_size=30),
)
def test_unwrap_follows_any_walk(modulus: int, start: int, walk: list[tuple[int, float]]) -> None:
    """Whatever is expected, the truth within half a turn of it is found."""
    unwrap, truth = Unwrap(modulus), start
    offset = unwrap(start % modulus) - start
    for advance, doubt in walk:
        truth += advance + int(doubt * (modulus - 1))
        assert unwrap(truth % modulus, advance) == truth + offset


def test_unwrap_of_daily_time_passes_midnight() -> None:
    day = 86_400 * 10**9
    unwrap = Unwrap(day)
    times = [unwrap(raw) for raw in (day - 2, day - 1, 0, 1)]
    assert times == [day - 2, day - 1, day, day + 1]


def test_unwrap_bridges_many_turns_and_resets() -> None:
    unwrap = Unwrap(100)
    unwrap(5)
    assert unwrap(7, advance=1001) == 1007
    unwrap.reset()
    assert unwrap(3) == 3
    with pytest.raises(ValueError, match="cannot wrap"):
        Unwrap(1)
    assert wrapped_step(99, 1, 100) == 2


def clock(rate_hz: float = 400.0) -> DeviceClock:
    return DeviceClock(XSENS_CLOCK, rate_hz)


def feed(clock: DeviceClock, samples: range, first_tick: int = 0) -> list[Reading | None]:
    return [clock.read((first_tick + 25 * k) % 2**32, k % 2**16) for k in samples]


def test_counter_and_time_wrap() -> None:
    device = clock()
    readings = feed(device, range(65_000, 66_000), first_tick=2**32 - 25 * 65_500)
    assert all(reading is not None for reading in readings)
    assert [r.count for r in readings if r] == list(range(1000))
    steps = {b.device_ns - a.device_ns for a, b in pairwise(readings) if a and b}
    assert steps == {2_500_000}
    assert (device.counts.lost, device.counts.restarts) == (0, 0)


def test_short_gaps_are_counted() -> None:
    device = clock()
    feed(device, range(10))
    reading = device.read(25 * 15, 15)
    assert reading == Reading(15, 15 * 2_500_000, 5, 0)
    assert device.counts.lost == 5


def test_a_gap_longer_than_the_counter_is_believed_when_confirmed() -> None:
    device = clock()
    feed(device, range(10))
    assert feed(device, range(100_000, 100_002))[0] is None
    reading = device.read(25 * 100_002, 100_002 % 2**16)
    assert reading is not None and (reading.count, reading.boot) == (100_002, 0)
    assert device.counts.lost == 100_000 - 10 + 1  # the first sample after the gap was not handed out


def test_a_repeated_sample_is_counted() -> None:
    device = clock()
    feed(device, range(3))
    assert device.read(50, 2) is None
    assert device.counts.repeated == 1


@pytest.mark.parametrize(("ticks", "counter"), [(10**9, 10), (250, 9999), (0, 10), (2**31, 2**15)])
def test_a_corrupted_stamp_is_rejected(ticks: int, counter: int) -> None:
    device = clock()
    feed(device, range(10))
    assert device.read(ticks, counter) is None
    assert device.read(25 * 11, 11) == Reading(11, 11 * 2_500_000, 1, 0)
    assert (device.counts.rejected, device.counts.restarts) == (1, 0)


def test_a_restart_begins_a_new_time() -> None:
    device = clock()
    feed(device, range(1000, 1100))
    readings = feed(device, range(20))
    assert readings[0] is None
    last = readings[-1]
    assert last is not None and last.boot == 1 and last.device_ns == 19 * 2_500_000
    assert device.counts.restarts == 1


def test_a_clock_without_counter_counts_by_time() -> None:
    device = DeviceClock(VECTORNAV_CLOCK, 200.0)
    times = [0, 5_000_400, 9_999_800, 25_000_000]
    readings = [device.read(t) for t in times]
    assert [(r.count, r.lost) for r in readings if r] == [(0, 0), (1, 0), (2, 0), (5, 2)]


@given(st.lists(st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 2**16 - 1)), max_size=60))
def test_any_stamps_give_monotonic_times(stamps: list[tuple[int, int]]) -> None:
    device = clock()
    last: Reading | None = None
    for ticks, counter in stamps:
        reading = device.read(ticks, counter)
        if reading is None:
            continue
        if last is not None and last.boot == reading.boot:
            assert reading.device_ns > last.device_ns and reading.count > last.count
        last = reading


def test_a_rate_must_be_positive() -> None:
    with pytest.raises(ValueError, match="positive"):
        clock(0.0)
