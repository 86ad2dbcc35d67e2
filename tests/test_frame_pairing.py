"""Frames and triggers: counted, checked by intervals, anchored anew, and never guessed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from artemis_edge.frame_pairing import CameraTiming, FramePairing, FrameStamp, Pair, TriggerHistory

PERIOD = 100_000_000
EXPOSURE, DELAY, LATENCY = 4_000_000, 20_000, 30_000_000
CAMERA_OFFSET = 5_000_000_000


class Bench:
    """A camera and a trigger whose board clock is also the host's."""

    def __init__(self, latency: int | None = LATENCY) -> None:
        self.history = TriggerHistory()
        self.pairing = FramePairing(CameraTiming(DELAY, latency), self.history, lambda host_ns: host_ns)
        self.pairs: list[Pair] = []

    def trigger(self, count: int) -> None:
        self.history.add(count, count * PERIOD)
        self.pairs += self.pairing.advance(count * PERIOD + 1_000_000)

    def frame(self, count: int, sequence: int, offset: int = CAMERA_OFFSET, late: int = 0) -> FrameStamp:
        end = count * PERIOD + DELAY + EXPOSURE
        return FrameStamp(sequence, end + offset, EXPOSURE, end + LATENCY + late)

    def take(self, count: int, sequence: int, offset: int = CAMERA_OFFSET, late: int = 0) -> None:
        self.pairs += self.pairing.add(self.frame(count, sequence, offset, late))

    @property
    def paired(self) -> list[tuple[int, int]]:
        return [(pair.frame.sequence, pair.count) for pair in self.pairs]


def test_counting_from_a_known_start() -> None:
    bench = Bench(latency=None)
    bench.pairing.arm(0, 10)
    for k in range(5):
        bench.trigger(k)
        bench.take(k, 10 + k)
    assert bench.paired == [(10 + k, k) for k in range(5)]
    assert bench.pairs[2].mid_ns == 2 * PERIOD + DELAY + EXPOSURE // 2
    assert not bench.pairs[2].interpolated and not bench.pairs[2].measured


def test_a_lost_frame_shifts_nothing() -> None:
    bench = Bench(latency=None)
    bench.pairing.arm(0, 0)
    for k in range(10):
        bench.trigger(k)
        if k not in (0, 4, 5):
            bench.take(k, k)
    assert bench.paired == [(k, k) for k in range(10) if k not in (0, 4, 5)]
    assert bench.pairing.counts["lost"] == 2  # the first one is not known to have been


def test_an_exposure_that_the_camera_did_not_count() -> None:
    bench = Bench(latency=None)
    bench.pairing.arm(0, 0)
    for k in range(10):
        bench.trigger(k)
        if k != 4:
            bench.take(k, k if k < 4 else k - 1)
    assert bench.paired == [(k if k < 4 else k - 1, k) for k in range(10) if k != 4]
    assert bench.pairing.counts["reanchored"] == 1


def test_the_first_exposure_missed_is_noticed_by_arrival() -> None:
    bench = Bench()
    bench.pairing.arm(0, 0)
    for k in range(6):
        bench.trigger(k)
        if k > 0:
            bench.take(k, k - 1)
    assert bench.paired == [(k - 1, k) for k in range(1, 6)]
    assert bench.pairing.counts["arm_corrected"] == 1


def test_a_camera_that_starts_while_triggers_run() -> None:
    bench = Bench()
    for k in range(50):
        bench.trigger(k)
        if k >= 40:
            bench.take(k, k - 40, late=25_000_000 if k == 40 else 0)
    assert bench.paired == [(k - 40, k) for k in range(40, 50)]


def test_without_latency_it_waits_for_arm() -> None:
    bench = Bench(latency=None)
    for k in range(200):
        bench.trigger(k)
        bench.take(k, k)
    assert bench.paired == []
    assert bench.pairing.counts["unpaired_no_anchor"] + len(bench.pairing._pending) == 200


@pytest.mark.parametrize("offset", [CAMERA_OFFSET, -3 * 10**12])
def test_a_camera_that_restarts(offset: int) -> None:
    bench = Bench()
    for k in range(60):
        bench.trigger(k)
        if k < 20:
            bench.take(k, k)
        elif k >= 30:
            bench.take(k, k - 30, offset + k)
    assert bench.paired == [(k, k) for k in range(20)] + [(k - 30, k) for k in range(30, 60)]
    assert bench.pairing.counts["restarts"] == 1


def test_a_lost_trigger_message_is_bridged_by_its_neighbours() -> None:
    bench = Bench(latency=None)
    bench.pairing.arm(0, 0)
    for k in range(10):
        if k not in (4, 5):
            bench.trigger(k)
        bench.take(k, k)
    assert bench.paired == [(k, k) for k in range(10)]
    assert [pair.count for pair in bench.pairs if pair.interpolated] == [4, 5]
    assert bench.pairs[4].edge_ns == 4 * PERIOD


def test_a_trigger_that_is_never_told_costs_its_frame_only() -> None:
    """One trigger alone tells no rate."""
    bench = Bench(latency=None)
    bench.pairing.arm(0, 0)
    bench.trigger(0)
    for k in range(14):
        bench.take(k, k)
    for k in range(14, 30):
        bench.trigger(k)
        bench.take(k, k)
    assert set(range(14, 30)) <= {count for _, count in bench.paired}
    assert all(sequence == count for sequence, count in bench.paired)
    assert len(bench.paired) + bench.pairing.counts["unpaired_no_trigger"] == 30
    assert bench.pairing.counts["unpaired_no_trigger"] > 0


def test_while_the_board_is_not_heard_the_rate_foretells_its_triggers() -> None:
    """Also an exposure that the camera missed meanwhile is noticed, and nothing waits for the board's return."""
    bench = Bench(latency=None)
    bench.pairing.arm(0, 0)
    for k in range(60):
        if not 20 <= k < 45:
            bench.trigger(k)
        if k != 30:
            bench.take(k, k if k < 30 else k - 1)
        bench.pairs += bench.pairing.advance(bench.frame(k, k).rx_ns + 70_000_000)
        assert len(bench.pairing._pending) <= 1
    assert [count for _, count in bench.paired] == [k for k in range(60) if k != 30]
    assert all(pair.edge_ns == pair.count * PERIOD for pair in bench.pairs)
    assert [pair.count for pair in bench.pairs if pair.interpolated] == [k for k in range(20, 45) if k != 30]
    assert bench.pairing.counts["reanchored"] == 1


def test_a_board_that_is_silent_for_too_long_is_not_guessed() -> None:
    bench = Bench(latency=None)
    bench.pairing.arm(0, 0)
    for k in range(700):
        if k < 20:
            bench.trigger(k)
        bench.take(k, k)
    assert bench.paired == [(k, k) for k in range(620)]


def test_a_camera_of_unknown_latency_that_restarts() -> None:
    bench = Bench(latency=None)
    bench.pairing.arm(0, 0)
    for k in range(40):
        bench.trigger(k)
        if k < 20:
            bench.take(k, k, late=3_000_000 * (k % 7))
        elif k >= 27:
            bench.take(k, k - 27, CAMERA_OFFSET - 10**12, late=3_000_000 * (k % 7))
    assert bench.paired == [(k, k) for k in range(20)] + [(k - 27, k) for k in range(27, 40)]


def test_repeated_and_reordered_frames() -> None:
    bench = Bench()
    for k in range(10):
        bench.trigger(k)
    for k in (0, 1, 1, 2, 4, 3, 3, 5):
        bench.pairs += bench.pairing.add(bench.frame(k, k))
    assert bench.paired == [(k, k) for k in (0, 1, 2, 4, 3, 5)]
    assert bench.pairing.counts["repeated"] == 2 and bench.pairing.counts["lost"] == 0


def test_a_frame_between_triggers_is_dropped() -> None:
    bench = Bench()
    for k in range(10):
        bench.trigger(k)
        stray = PERIOD // 2 if k == 5 else 0
        bench.pairs += bench.pairing.add(
            FrameStamp(k, bench.frame(k, k).device_ns + stray, EXPOSURE, bench.frame(k, k).rx_ns)
        )
    assert bench.paired == [(k, k) for k in range(10) if k != 5]
    assert bench.pairing.counts["unpaired_mismatch"] == 1


def test_no_photograph_arrives_before_it_was_triggered() -> None:
    bench = Bench(latency=None)
    bench.pairing.arm(3, 0)  # wrong: the camera stood at trigger 0
    for k in range(20):
        bench.trigger(k)
        bench.take(k, k)
    assert bench.paired == []
    assert bench.pairing.counts["unpaired_mismatch"] == 5 and bench.pairing.anchor is None


def test_a_strobe_replaces_the_calibrated_delay() -> None:
    bench = Bench(latency=None)
    bench.pairing.arm(0, 0)
    bench.history.add_strobe(1, 0, 50_000, 2_000_000)
    bench.history.add_strobe(1, 1, 70_000, 9_000_000)
    for k in range(3):
        bench.trigger(k)
        bench.take(k, k)
    assert [pair.measured for pair in bench.pairs] == [False, True, False]
    assert bench.pairs[1].mid_ns == PERIOD + 50_000 + 1_000_000


def test_a_change_of_rate_is_not_interpolated_across() -> None:
    history = TriggerHistory()
    for count, edge in ((0, 0), (1, 100), (3, 250), (4, 300)):
        history.add(count, edge * 1_000_000)
    assert history.edge(2) is None
    history.clear()
    assert history.edge(0) is None and history.period_ns() is None and history.nearest(5) is None


@hypothesis_settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_wrong_pair_whatever_is_lost(seed: int) -> None:
    """Up to 30 % each of frames lost, exposures missed and triggers not told; repeats; the camera restarts."""
    rng = np.random.default_rng(seed)
    bench = Bench()
    truth: dict[tuple[int, int], int] = {}
    sequence, offset = 0, CAMERA_OFFSET
    restart = int(rng.integers(20, 100))
    lost, missed, untold = rng.uniform(0, 0.3, 3)
    for k in range(120):
        if rng.uniform() > untold:
            bench.trigger(k)
        if k == restart:
            sequence, offset = int(rng.integers(0, 3)), int(rng.integers(-(10**12), 10**12))
        if rng.uniform() < missed:
            continue
        stamp = bench.frame(k, sequence, offset + int(rng.normal(0, 50_000)), int(rng.exponential(2e6)))
        sequence += 1
        truth[stamp.sequence, stamp.device_ns] = k
        for _ in range(int(rng.uniform() > lost) + int(rng.uniform() < 0.05)):
            bench.pairs += bench.pairing.add(stamp)
    assert all(pair.count == truth[pair.frame.sequence, pair.frame.device_ns] for pair in bench.pairs)
    assert len(bench.pairs) > 20


@given(st.lists(st.builds(FrameStamp, *(st.integers(-(2**62), 2**62) for _ in range(4))), max_size=30))
def test_any_stamps_are_paired_or_counted(stamps: list[FrameStamp]) -> None:
    bench = Bench()
    for k in range(10):
        bench.trigger(k)
    for stamp in stamps:
        bench.pairs += bench.pairing.add(stamp)
    counts = bench.pairing.counts
    unpaired = sum(value for name, value in counts.items() if name.startswith("unpaired"))
    assert len(bench.pairs) + unpaired + len(bench.pairing._pending) + counts["repeated"] == len(stamps)
