"""Data packets of Livox SDK 1: the compiled decoder against plain Python, encoder and decoder inverse, losses."""

import datetime as dt
import math
import struct

import numpy as np
import pytest
from artemis_drivers.livox_avia import encode
from artemis_drivers.livox_avia.payloads import decode_utc
from artemis_drivers.livox_avia.points import HEADER_BYTES, RETURNS, SHOT_BYTES, SHOTS, Decoder
from artemis_drivers.livox_slots import (
    DUPLICATE,
    IMU_SLOT,
    LATE,
    NEW,
    POINT_SLOT,
    TRACK,
    collect,
    days_of,
    track,
)
from artemis_drivers.packing import joined_bytes
from artemis_drivers.ring import Ring, RingReader
from artemis_drivers.udp import PACKET, packet_bytes
from hypothesis import given, settings
from hypothesis import strategies as st

from artemis_edge.session.writer import POINT
from tests.livox_clouds import window

TYPES = [2, 3, 4, 5, 7, 8]
MS = 1_000_000
Slots = dict[str, np.ndarray]


def feed(packets: list[tuple[int, bytes]], decoder: Decoder | None = None) -> Decoder:
    """Packets with their times of arrival (ns) put into a raw ring and decoded in one go."""
    decoder = decoder or Decoder(Ring(PACKET, 512), Ring(POINT_SLOT, 512), Ring(IMU_SLOT, 512))
    first = decoder.packets.published
    for rx, data in packets:
        row = np.zeros(PACKET["data"].shape, np.uint8)
        row[: len(data)] = np.frombuffer(data, np.uint8)
        decoder.packets.append({"rx_ns": rx, "size": len(data), "data": row})
    decoder.decode(first, len(packets))
    return decoder


def slots(ring: Ring) -> Slots:
    return RingReader(ring, from_oldest=True).read()[1]


def plain_points(data: bytes) -> list[tuple[float, float, float, int, int]]:
    """The obvious twin: one struct a point, straight from the fact sheet."""
    kind, at, points = data[9], HEADER_BYTES, []
    for _ in range(SHOTS[kind]):
        if kind in (2, 4, 7):
            for _ in range(RETURNS[kind]):
                x, y, z, refl, tag = struct.unpack_from("<iiiBB", data, at)
                points.append((x / 1e3, y / 1e3, z / 1e3, refl, tag))
                at += 14
            continue
        echoes = []
        if kind == 3:
            depth, theta, phi, refl, tag = struct.unpack_from("<IHHBB", data, at)
            echoes.append((depth, refl, tag))
            at += 10
        else:
            theta, phi = struct.unpack_from("<HH", data, at)
            at += 4
            for _ in range(RETURNS[kind]):
                echoes.append(struct.unpack_from("<IBB", data, at))
                at += 6
        t, p = math.radians(theta / 100), math.radians(phi / 100)
        for depth, refl, tag in echoes:
            d = depth / 1e3
            points.append(
                (d * math.sin(t) * math.cos(p), d * math.sin(t) * math.sin(p), d * math.cos(t), refl, tag)
            )
    assert at == len(data)
    return points


def random_packet(kind: int, rng: np.random.Generator, time_ns: int = 0, clock: int = 0) -> bytes:
    size = int(SHOTS[kind] * SHOT_BYTES[kind])
    return encode.header(0x8200, clock, kind, time_ns) + rng.integers(0, 256, size).astype(np.uint8).tobytes()


@pytest.mark.parametrize("kind", TYPES)
def test_decoder_agrees_with_plain_python(kind: int) -> None:
    data = random_packet(kind, np.random.default_rng(kind), time_ns=77)
    assert len(data) == {2: 1362, 3: 978, 4: 1362, 5: 786, 7: 1278, 8: 678}[kind]
    got = slots(feed([(5, data)]).points)
    expected = np.array(plain_points(data))
    n = int(got["filled"][0])
    assert n == len(expected) == SHOTS[kind] * RETURNS[kind]
    np.testing.assert_allclose(got["xyz"][0, :n], expected[:, :3], rtol=3e-6, atol=0.3)
    np.testing.assert_array_equal(got["reflectivity"][0, :n], expected[:, 3])
    np.testing.assert_array_equal(got["tag"][0, :n], expected[:, 4])
    head = {
        k: int(got[k][0]) for k in ("stamp_ns", "rx_ns", "packet", "status", "returns", "data_type", "clock")
    }
    assert head == {
        **{"stamp_ns": 77, "rx_ns": 5, "packet": 0, "status": 0x8200},
        **{"returns": RETURNS[kind], "data_type": kind, "clock": 0},
    }


@given(st.sampled_from([2, 4, 7]), st.integers(0, 2**32 - 1), st.integers(0, 2**31 - 1))
@settings(max_examples=60, deadline=None)
def test_cartesian_is_inverse(kind: int, seed: int, largest: int) -> None:
    rng = np.random.default_rng(seed)
    shape = (int(SHOTS[kind]), int(RETURNS[kind]))
    xyz = rng.integers(-largest, largest + 1, (*shape, 3)).astype(np.int32)
    refl, tag = (rng.integers(0, 256, shape).astype(np.uint8) for _ in range(2))
    data = encode.header(0, 0, kind, 0) + encode.shots_mm(kind, xyz, refl, tag).tobytes()
    got, n = slots(feed([(0, data)]).points), shape[0] * shape[1]
    np.testing.assert_array_equal(got["xyz"][0, :n], (xyz.reshape(-1, 3) * 1e-3).astype(np.float32))
    np.testing.assert_array_equal(got["reflectivity"][0, :n], refl.ravel())
    np.testing.assert_array_equal(got["tag"][0, :n], tag.ravel())


@given(st.sampled_from([3, 5, 8]), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_spherical_is_inverse(kind: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, returns = int(SHOTS[kind]), int(RETURNS[kind])
    depth = rng.integers(1, 450_000, (n, returns)).astype(np.uint32)
    theta, phi = rng.integers(1, 18_000, n).astype(np.uint16), rng.integers(0, 36_000, n).astype(np.uint16)
    refl, tag = (rng.integers(0, 256, (n, returns)).astype(np.uint8) for _ in range(2))
    body = encode.shots_spherical(kind, depth, theta, phi, refl, tag)
    got = slots(feed([(0, encode.header(0, 0, kind, 0) + body.tobytes())]).points)
    xyz = got["xyz"][0, : n * returns].astype(float).reshape(n, returns, 3)
    d = np.linalg.norm(xyz, axis=2)
    np.testing.assert_allclose(d, depth * 1e-3, rtol=1e-6)
    np.testing.assert_allclose(np.degrees(np.arccos(xyz[:, 0, 2] / d[:, 0])), theta / 100, atol=0.03)
    np.testing.assert_allclose(
        xyz[..., 1] * np.cos(np.radians(phi / 100))[:, None],
        xyz[..., 0] * np.sin(np.radians(phi / 100))[:, None],
        atol=1e-1,
    )
    np.testing.assert_array_equal(got["tag"][0, : n * returns], tag.ravel())


def test_imu_packet() -> None:
    data = encode.imu_packet(0, 0, 123, (0.1, -0.2, 0.3), (0.0, 9.80665, -19.6133))
    assert len(data) == 42
    assert struct.unpack_from("<6f", data, 18) == pytest.approx((0.1, -0.2, 0.3, 0.0, 1.0, -2.0))
    got = slots(feed([(9, data)]).imu)
    np.testing.assert_allclose(got["gyro"][0], (0.1, -0.2, 0.3), rtol=1e-6)
    np.testing.assert_allclose(got["accel"][0], (0.0, 9.80665, -19.6133), rtol=1e-6)
    assert (got["stamp_ns"][0], got["rx_ns"][0]) == (123, 9)


@given(
    st.binary(max_size=1500)
    | st.builds(
        lambda head, kind, clock, rest: bytes([5, 1, 1, 0]) + head + bytes([clock, kind]) + rest,
        st.binary(min_size=4, max_size=4),
        st.integers(0, 9),
        st.integers(0, 5),
        st.binary(max_size=1400),
    )
)
@settings(max_examples=150, deadline=None)
def test_any_datagram_is_counted_or_decoded(data: bytes) -> None:
    decoder = feed([(0, data)])
    c = decoder.counters()
    refused = sum(v for k, v in c.items() if k.startswith("bad_"))
    assert refused + c["points_packets"] + c["imu_packets"] == 1
    assert decoder.points.published == c["points_packets"] and decoder.imu.published == c["imu_packets"]


def test_each_kind_of_bad_packet_has_its_counter() -> None:
    good = random_packet(2, np.random.default_rng(0))
    wrong_version, wrong_type = bytes([4]) + good[1:], good[:9] + bytes([9]) + good[10:]
    wrong_date = good[:8] + bytes([3, 2, 21, 2, 30]) + good[13:]
    c = feed(
        [(0, p) for p in (wrong_version, wrong_type, good[:-1], good + b"x", b"", wrong_date)]
    ).counters()
    assert [c[f"bad_{k}"] for k in ("version", "type", "length", "time")] == [2, 1, 2, 1]


# -- time -------------------------------------------------------------------------------------------------------


def test_every_day_of_the_livox_calendar() -> None:
    day = dt.date(2000, 1, 1)
    while day.year <= 2255:
        assert days_of(day.year, day.month, day.day) == (day - dt.date(1970, 1, 1)).days
        day += dt.timedelta(days=1)
    for wrong in (
        (2001, 2, 29),
        (2000, 2, 30),
        (2100, 2, 29),
        (2020, 4, 31),
        (2020, 0, 1),
        (2020, 13, 1),
        (2020, 1, 0),
    ):
        assert days_of(*wrong) == -1


@given(st.datetimes(dt.datetime(2000, 1, 1), dt.datetime(2200, 1, 1)))
@settings(max_examples=100, deadline=None)
def test_gps_time(moment: dt.datetime) -> None:
    ns = (moment - dt.datetime(1970, 1, 1)) // dt.timedelta(microseconds=1) * 1000
    data = encode.header(0, 3, 6, ns) + bytes(24)
    assert decode_utc(data[10:18]) == ns
    assert slots(feed([(0, data)]).imu)["stamp_ns"].tolist() == [ns]


@pytest.mark.parametrize("clock", [0, 1])
def test_plain_nanoseconds(clock: int) -> None:
    for ns in (0, 1, 2**40, 2**63 - 1):
        assert slots(feed([(0, encode.imu_packet(0, clock, ns, (0,) * 3, (0,) * 3))]).imu)[
            "stamp_ns"
        ].tolist() == [ns]
    assert feed([(0, encode.imu_packet(0, clock, 2**63, (0,) * 3, (0,) * 3))]).counters()["bad_time"] == 1


def test_midnight_and_the_full_hour_are_no_gap() -> None:
    midnight = int(dt.datetime(2024, 12, 31, 23, 59, 59, 990_000, tzinfo=dt.UTC).timestamp() * 1000) * MS
    packets = [
        (k * 5 * MS, encode.imu_packet(0, 3, midnight + k * 5 * MS, (0,) * 3, (0,) * 3)) for k in range(6)
    ]
    c = feed(packets).counters()
    assert (c["imu_packets"], c["imu_lost"], c["imu_clock_steps"]) == (6, 0, 0)


@given(
    st.integers(0, 10**9 - 1), st.integers(0, 2**31), st.lists(st.integers(5, 900), min_size=2, max_size=12)
)
@settings(max_examples=100, deadline=None)
def test_time_since_the_pulse_counts_on(phase: int, seed: int, steps_ms: list[int]) -> None:
    rng = np.random.default_rng(seed)
    true = phase + np.cumsum([0, *steps_ms]) * MS
    received = true + rng.integers(0, 200 * MS, len(true))  # less than half a second of jitter
    packets = [
        (int(rx), encode.imu_packet(0, 4, int(t % 10**9), (0,) * 3, (0,) * 3))
        for t, rx in zip(true, received, strict=True)
    ]
    assert slots(feed(packets).imu)["stamp_ns"].tolist() == true.tolist()


# -- loss -------------------------------------------------------------------------------------------------------


def stream(order: list[int], period: int = 5 * MS, start: int = 10**9) -> Decoder:
    """IMU packets of the given numbers, received in this order."""
    received = sorted(order)
    return feed(
        [
            (start + received[i] * period, encode.imu_packet(0, 0, start + n * period, (n, 0, 0), (0, 0, 0)))
            for i, n in enumerate(order)
        ]
    )


@given(st.integers(0, 2**31))
@settings(max_examples=100, deadline=None)
def test_loss_duplicates_and_order_are_told_apart(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sent = [n for n in range(60) if n in (0, 59) or rng.random() > 0.2]
    order = sent.copy()
    moved = 0
    for k in range(1, len(order) - 2, 2):
        if rng.random() < 0.2:
            order[k], order[k + 1] = order[k + 1], order[k]
            moved += 1
    twice = sorted(rng.choice(len(order), 5, replace=False), reverse=True)
    for k in twice:
        order.insert(int(k) + 1, order[k])
    c = stream(order).counters()
    assert c["imu_lost"] == 60 - len(sent) and c["imu_late"] == moved and c["imu_duplicates"] == 5
    assert c["imu_packets"] == len(sent) and c["imu_clock_steps"] == 0


def test_all_but_the_repeated_packets_arrive_in_the_order_received() -> None:
    got = slots(stream([0, 1, 3, 2, 2, 3, 4, 9]).imu)
    assert got["gyro"][:, 0].tolist() == [0, 1, 3, 2, 4, 9]
    assert got["packet"].tolist() == [0, 1, 2, 3, 6, 7]


def test_a_restarted_clock_is_a_step_and_no_loss() -> None:
    decoder = stream(list(range(5)))
    feed(
        [(2 * 10**9 + k * 5 * MS, encode.imu_packet(0, 0, k * 5 * MS, (0,) * 3, (0,) * 3)) for k in range(3)],
        decoder,
    )
    feed([(3 * 10**9, encode.imu_packet(0, 3, 1_700_000_000 * 10**9, (0,) * 3, (0,) * 3))], decoder)
    c = decoder.counters()
    assert (c["imu_clock_steps"], c["imu_clock_changes"], c["imu_lost"], c["imu_late"]) == (1, 1, 0, 0)


def test_a_cable_out_for_half_a_minute_is_loss() -> None:
    decoder = stream([0])
    later = 10**9 + 30 * 10**9
    feed([(later, encode.imu_packet(0, 0, later, (0,) * 3, (0,) * 3))], decoder)
    c = decoder.counters()
    assert (c["imu_lost"], c["imu_gaps"], c["imu_clock_steps"]) == (5999, 1, 0)


def test_gap_rule_follows_the_length_of_the_packet() -> None:
    rng = np.random.default_rng(3)
    at, packets = 0, []
    for kind, count in ((2, 3), (4, 4), (7, 5), (2, 2)):
        for _ in range(count):
            packets.append((at, random_packet(kind, rng, time_ns=at)))
            at += {2: 400_000, 4: 200_000, 7: 125_000}[kind]
    c = feed(packets).counters()
    assert (c["points_packets"], c["points_lost"], c["points_gaps"]) == (14, 0, 0)


def test_track_by_itself() -> None:
    t = np.zeros(1, TRACK)
    verdicts = [track(t, 0, s, 0, s, 10) for s in (100, 110, 130, 120, 120, 90, 140)]
    assert verdicts == [NEW, NEW, NEW, LATE, DUPLICATE, LATE, NEW]
    assert (t["lost"][0], t["late"][0], t["duplicates"][0], t["packets"][0]) == (0, 2, 1, 6)


# -- windows ----------------------------------------------------------------------------------------------------


def naive_window(batches: list[tuple[Slots, int]], start: int, end: int) -> list[tuple[float, ...]]:
    rows = []
    for got, offset in batches:
        for k in range(len(got["stamp_ns"])):
            for i in range(got["filled"][k]):
                shot = i // int(got["returns"][k])
                t = got["stamp_ns"][k] + offset - start + shot * float(got["shot_ns"][k])
                if 0 <= t < end - start and got["xyz"][k, i].any():
                    about = got["reflectivity"][k, i] / 255, got["tag"][k, i], shot % 6, round(t)
                    rows.append((*got["xyz"][k, i], *about))
    return rows


@pytest.mark.parametrize("kind", TYPES)
def test_window_of_points(kind: int) -> None:
    rng = np.random.default_rng(kind)
    period = int(SHOTS[kind] * 1e9 / 240_000)
    packets = []
    for k in range(6):
        body = (
            np.frombuffer(random_packet(kind, rng)[18:], np.uint8).reshape(-1, int(SHOT_BYTES[kind])).copy()
        )
        body[::5] = 0
        packets.append((k, encode.header(0, 0, kind, k * period) + body.tobytes()))
    got = slots(feed(packets).points)
    batches = [
        ({name: rows[:2] for name, rows in got.items()}, 0),
        ({n: rows[2:] for n, rows in got.items()}, 5000),
    ]
    for start, end in ((0, 6 * period), (period // 2, 4 * period + 777), (7 * period, 8 * period), (50, 50)):
        ours, plain = collect(batches, start, end, POINT), naive_window(batches, start, end)
        assert len(ours) == len(plain)
        np.testing.assert_allclose(
            np.array(ours.tolist()).reshape(-1, 7), np.array(plain).reshape(-1, 7), rtol=1e-6
        )
    both = [window(got, *w) for w in ((0, 3 * period + 999), (3 * period + 999, 6 * period))]
    assert sum(map(len, both)) == len(window(got, 0, 6 * period))


def test_window_of_nothing() -> None:
    nothing = slots(Ring(feed([]).points.dtype, 4))
    assert len(window(nothing, 0, 10**9)) == len(collect([], 0, 10**9, POINT)) == 0


def test_raw_packets_stay_readable() -> None:
    data = [random_packet(k, np.random.default_rng(k)) for k in TYPES]
    packets = slots(feed([(0, d) for d in data]).packets)
    assert packet_bytes(packets) == data and joined_bytes(packets) == b"".join(data)
    alike = slots(feed([(0, data[0]), (1, data[0])]).packets)
    assert joined_bytes(alike) == data[0] * 2
    assert joined_bytes({name: rows[:0] for name, rows in alike.items()}) == b""


def test_more_packets_than_slots_keep_the_newest() -> None:
    decoder = Decoder(Ring(PACKET, 64), Ring(POINT_SLOT, 8), Ring(IMU_SLOT, 8))
    feed([(k, encode.imu_packet(0, 0, k * 5 * MS, (k, 0, 0), (0,) * 3)) for k in range(20)], decoder)
    assert decoder.counters()["imu_packets"] == 20
    assert slots(decoder.imu)["gyro"][:, 0].tolist()[-4:] == [16, 17, 18, 19]


def test_recorded_packets_decode_to_the_same_bytes() -> None:
    rng = np.random.default_rng(11)
    packets = [
        (k * 400_000 + int(rng.integers(0, MS)), random_packet(2, rng, k * 400_000)) for k in range(60)
    ]
    packets += [
        (k * 5 * MS, encode.imu_packet(0, 4, k * 5 * MS % 10**9, (k, 0, 0), (0, 0, 9.8))) for k in range(60)
    ]
    order = rng.permutation(len(packets))
    live = feed([packets[k] for k in (*order, *order[:20])])
    raw = slots(live.packets)
    again = feed(list(zip(raw["rx_ns"].tolist(), packet_bytes(raw), strict=True)))
    for ring, copy in ((live.points, again.points), (live.imu, again.imu)):
        a, b = slots(ring), slots(copy)
        assert all(a[name].tobytes() == b[name].tobytes() for name in a)
    assert live.counters() == again.counters() and live.counters()["points_duplicates"] > 0
