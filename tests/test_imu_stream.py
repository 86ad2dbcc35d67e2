"""Frames out of noisy streams: nothing true is lost, memory is bounded, nothing hangs."""

import random

import pytest
from artemis_drivers.imu_serial import mtdata2, vectornav
from artemis_drivers.imu_serial.mtdata2 import Message, Mid, XbusFraming
from artemis_drivers.imu_serial.stream import FrameSplitter, Framing
from artemis_drivers.imu_serial.vectornav import BinaryMessage, VectorNavFraming
from hypothesis import given
from hypothesis import strategies as st

FRAME = bytes.fromhex(
    "faff3631102002dfc510600400459da040200cbedc9afa3f549f37411cbb7080200cbbaa5c803b8c5501bb813300e020040000008145"
)
FRAMINGS = [XbusFraming(), VectorNavFraming()]


def frames_of(framing: Framing, count: int, rng: random.Random) -> list[bytes]:
    if isinstance(framing, XbusFraming):
        return [mtdata2.encode(Message(Mid.MTDATA2, rng.randbytes(rng.randrange(300)))) for _ in range(count)]
    ypr = [(float(rng.randrange(360)), 0.0, 1.0) for _ in range(count)]
    return [vectornav.encode(BinaryMessage((8, 0, 0), {"common.yaw_pitch_roll_deg": v})) for v in ypr]


@pytest.mark.parametrize("framing", FRAMINGS)
@pytest.mark.parametrize("seed", range(10))
def test_every_frame_is_found_between_noise(framing: Framing, seed: int) -> None:
    rng = random.Random(seed)
    frames = frames_of(framing, 50, rng)
    noise = [rng.randbytes(rng.randrange(40)) for _ in frames]
    stream = b"".join(part for pair in zip(noise, frames, strict=True) for part in pair)
    splitter = FrameSplitter(framing)
    found, at = [], 0
    while at < len(stream):
        size = rng.randrange(1, 100)
        found += splitter.feed(stream[at : at + size])
        at += size
    found += splitter.abandon()
    # noise may imitate a frame (a sum of 8 bits passes now and then), which may hide the true one behind it
    false = [frame for frame in found if frame not in frames]
    missing = [frame for frame in frames if frame not in found]
    assert len(missing) <= len(false)
    assert splitter.counts.frames == len(found)
    assert splitter.counts.skipped_bytes == len(stream) - sum(map(len, found))


@pytest.mark.parametrize("cut", range(1, len(FRAME)))
def test_a_cut_frame_costs_only_itself(cut: int) -> None:
    splitter = FrameSplitter(XbusFraming())
    assert (splitter.feed(FRAME[:cut] + FRAME + FRAME) + splitter.abandon())[-2:] == [FRAME, FRAME]


def test_a_false_start_does_not_hold_back_the_last_frame() -> None:
    splitter = FrameSplitter(XbusFraming())
    assert splitter.feed(bytes.fromhex("faff36fe") + FRAME) == []
    assert splitter.abandon() == [FRAME]
    assert splitter.counts.skipped_bytes == 4


def test_a_corrupted_frame_is_counted() -> None:
    broken = bytearray(FRAME)
    broken[20] ^= 1
    splitter = FrameSplitter(XbusFraming())
    assert splitter.feed(bytes(broken) + FRAME) == [FRAME]
    assert (splitter.counts.bad_checks, splitter.counts.skipped_bytes) == (1, len(FRAME))


@pytest.mark.parametrize("framing", FRAMINGS)
@given(chunks=st.lists(st.binary(max_size=300), max_size=20))
def test_any_bytes_are_either_frames_or_counted(framing: Framing, chunks: list[bytes]) -> None:
    splitter = FrameSplitter(framing)
    found = [frame for chunk in chunks for frame in splitter.feed(chunk)] + splitter.abandon()
    assert sum(map(len, found)) + splitter.counts.skipped_bytes == sum(map(len, chunks))


@pytest.mark.parametrize("framing", FRAMINGS)
@pytest.mark.parametrize(
    "pattern", ["fa", "faff", "faff36fe", "faff36ff0800", "24564e", "fa07ff7fff03ff1f", "fa04ff1f"]
)
def test_hostile_patterns_stay_bounded(framing: Framing, pattern: str) -> None:
    splitter = FrameSplitter(framing)
    for _ in range(20):
        splitter.feed(bytes.fromhex(pattern) * 50)
        assert len(splitter._buffer) <= framing.longest
