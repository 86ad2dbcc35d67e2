"""Mid-360: published search frame, all data types, session on loopback, and beside an Avia."""

import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from artemis_drivers.base import DriverError, State
from artemis_drivers.livox import livox_driver
from artemis_drivers.livox_avia.settings import AviaConfig
from artemis_drivers.livox_host import LivoxHost
from artemis_drivers.livox_mid360 import encode, protocol
from artemis_drivers.livox_mid360.points import Decoder
from artemis_drivers.livox_mid360.protocol import Cmd, Found, Frame, HostAddress, Key
from artemis_drivers.livox_mid360.settings import Mid360Config
from artemis_drivers.livox_slots import IMU_SLOT, POINT_SLOT
from artemis_drivers.ring import Ring, RingReader
from artemis_drivers.udp import PACKET
from artemis_drivers.virtual.wire_avia import VirtualAvia
from artemis_drivers.virtual.wire_mid360 import VirtualMid360
from artemis_drivers.virtual.wire_stream import steady_imu, steady_shots
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import livox_ports
from tests.livox_clouds import window, xyz
from tests.waiting import until

MS = 1_000_000
PERIOD = 480_000  # 96 points at 200 kHz


@pytest.fixture(scope="module", autouse=True)
def ports() -> Iterator[None]:
    with livox_ports.reserved():
        yield


def feed(packets: list[tuple[int, bytes]]) -> Decoder:
    decoder = Decoder(Ring(PACKET, 512), Ring(POINT_SLOT, 512), Ring(IMU_SLOT, 512))
    for rx, data in packets:
        row = np.zeros(PACKET["data"].shape, np.uint8)
        row[: len(data)] = np.frombuffer(data, np.uint8)
        decoder.packets.append({"rx_ns": rx, "size": len(data), "data": row})
    decoder.decode(0, len(packets))
    return decoder


def records(kind: int, seed: int, n: int = 96) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = np.zeros(n, encode.POINT[kind])
    points["reflectivity"], points["tag"] = rng.integers(0, 256, n), rng.integers(0, 256, n)
    if kind == 3:
        points["depth"], points["zenith"] = rng.integers(0, 70_000, n), rng.integers(0, 18_001, n)
        points["azimuth"] = rng.integers(0, 36_000, n)
    else:
        points["xyz"] = rng.integers(-30_000, 30_001, (n, 3))
    return points


def metres(points: np.ndarray, kind: int) -> np.ndarray:
    if kind != 3:
        return points["xyz"] * {1: 1e-3, 2: 1e-2}[kind]
    t, p = np.radians(points["zenith"] / 100), np.radians(points["azimuth"] / 100)
    d = points["depth"] * 1e-3
    return np.column_stack([d * np.sin(t) * np.cos(p), d * np.sin(t) * np.sin(p), d * np.cos(t)])


def test_published_search_frame() -> None:
    text = "aa0018000100000000000000000000000000a91f00000000"
    frame = Frame(1, Cmd.SEARCH, is_answer=False, from_lidar=False)
    assert protocol.decode(bytes.fromhex(text)) == ([frame], 0)
    assert protocol.encode(frame).hex() == text


FRAMES = st.builds(
    Frame,
    st.integers(0, 2**32 - 1),
    st.integers(0, 0xFFFF),
    st.booleans(),
    st.booleans(),
    st.binary(max_size=60),
)


@given(st.lists(st.tuples(st.binary(max_size=20), FRAMES), max_size=4), st.binary(max_size=23))
@settings(max_examples=200, deadline=None)
def test_frames_are_found_between_noise(parts: list[tuple[bytes, Frame]], tail: bytes) -> None:
    datagram = b"".join(noise + protocol.encode(frame) for noise, frame in parts) + tail
    frames, skipped = protocol.decode(datagram)
    assert frames == [frame for _, frame in parts]
    assert skipped == sum(len(noise) for noise, _ in parts) + len(tail)


@given(st.binary(max_size=1500))
@settings(max_examples=100, deadline=None)
def test_any_datagram_is_survived(data: bytes) -> None:
    protocol.decode(data)
    for reader in (
        protocol.decode_values,
        protocol.decode_got,
        protocol.decode_keys,
        HostAddress.decode,
        Found.decode,
    ):
        reader(data)
    c = feed([(0, data)]).counters()
    assert sum(v for k, v in c.items() if k.startswith("bad_")) + c["points_packets"] + c["imu_packets"] == 1


@given(st.dictionaries(st.integers(0, 0xFFFF), st.binary(max_size=9), max_size=5))
@settings(max_examples=100, deadline=None)
def test_values_are_inverse(values: dict[int, bytes]) -> None:
    assert protocol.decode_values(protocol.encode_values(values)) == values
    assert protocol.decode_got(protocol.encode_got(0, values)) == values
    assert protocol.decode_got(protocol.encode_got(1, values)) is None
    assert protocol.decode_keys(protocol.encode_keys(list(values))) == list(values)


def test_addresses_are_inverse() -> None:
    host = HostAddress("192.168.1.5", 56301, 56300)
    assert host.encode().hex() == "c0a80105eddbecdb" and HostAddress.decode(host.encode()) == host
    found = Found(0, 9, "47MDK1E0013601", "192.168.1.160", 56100)
    assert Found.decode(found.encode()) == found and Found.decode(found.encode()[:23]) is None
    with pytest.raises(ValueError, match="1400"):
        protocol.encode(Frame(0, 0, is_answer=False, from_lidar=False, data=bytes(1377)))


@pytest.mark.parametrize("kind", [1, 2, 3])
@pytest.mark.parametrize("n", [96, 1])
def test_points_are_inverse(kind: int, n: int) -> None:
    points = records(kind, kind, n)
    data = encode.packet(kind, points, time_ns=2**40, duration_ns=PERIOD, clock=2)
    decoder = feed([(7, data)])
    got = RingReader(decoder.points, from_oldest=True).read()[1]
    np.testing.assert_allclose(got["xyz"][0, :n], metres(points, kind), rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(got["reflectivity"][0, :n], points["reflectivity"])
    np.testing.assert_array_equal(got["tag"][0, :n], points["tag"])
    assert (got["stamp_ns"][0], got["filled"][0], got["lines"][0], got["clock"][0]) == (2**40, n, 4, 3)
    assert got["shot_ns"][0] == pytest.approx(PERIOD / n)


def test_imu_and_loss_by_time() -> None:
    packets = [
        (k * 5 * MS, encode.imu_packet(k * 5 * MS, (k, 0, 0), (0, 0, 9.80665))) for k in (0, 1, 2, 6, 7)
    ]
    packets += [
        (k * PERIOD, encode.packet(1, records(1, k), time_ns=k * PERIOD, duration_ns=PERIOD))
        for k in (0, 1, 4)
    ]
    decoder = feed(packets)
    c = decoder.counters()
    assert (c["imu_packets"], c["imu_lost"], c["points_packets"], c["points_lost"]) == (5, 3, 3, 2)
    imu = RingReader(decoder.imu, from_oldest=True).read()[1]
    np.testing.assert_allclose(imu["accel"], [[0, 0, 9.80665]] * 5, rtol=1e-6)


def test_each_kind_of_bad_packet_has_its_counter() -> None:
    good = encode.packet(1, records(1, 0), time_ns=0, duration_ns=PERIOD)
    many = encode.packet(2, records(2, 0, 120), time_ns=0, duration_ns=PERIOD)
    none = encode.packet(1, records(1, 0, 0), time_ns=0, duration_ns=PERIOD)
    wrong = [
        b"\5" + good[1:],
        good[:10] + b"\x11" + good[11:],
        good[:-1],
        many,
        none,
        good[:11] + b"\7" + good[12:],
    ]
    c = feed([(0, p) for p in wrong]).counters()
    assert [c[f"bad_{k}"] for k in ("version", "type", "length", "time")] == [1, 1, 3, 1]


def packets(seconds: float) -> Iterator[tuple[int, bytes]]:
    start = time.monotonic_ns()
    for k in range(round(seconds * 1e9) // PERIOD):
        yield (
            start + k * PERIOD,
            encode.packet(1, records(1, k), time_ns=k * PERIOD, duration_ns=PERIOD, counter=k),
        )
        if k * PERIOD % (5 * MS) < PERIOD:
            t = k * PERIOD // (5 * MS) * 5 * MS
            yield start + k * PERIOD, encode.imu_packet(t, (0, 0, 0), (0, 0, 9.8))


@contextmanager
def listening(driver: LivoxHost) -> Iterator[LivoxHost]:
    """A started driver whose discovery socket lets the virtual device share its port number."""
    driver.start()
    try:
        yield driver
    finally:
        driver.stop()


@contextmanager
def mid360() -> Iterator[VirtualMid360]:
    with VirtualMid360() as device:
        yield device


def test_session(monkeypatch: pytest.MonkeyPatch) -> None:
    share_ports(monkeypatch)
    with mid360() as device:
        device.refuse = {Key.PATTERN}
        driver = livox_driver(mid360s=[Mid360Config()], search_address=device.ip)
        with listening(driver):
            assert until(lambda: driver.health()[0].state == State.RUNNING), driver.health()
            health = driver.health()[0]
            statuses = {a.item: a.status for a in health.applied}
            assert statuses.pop("pattern") == "refused" and set(statuses.values()) == {"ok"}
            assert "pattern = non_repetitive refused" in health.message
            device.play(packets(0.3))
            assert until(lambda: driver.health()[0].counters["points_packets"] == 625), driver.health()
            health = driver.health()[0]
            assert health.counters["points_lost"] == health.counters["imu_lost"] == 0
            assert health.counters["imu_packets"] == 60 and health.counters["packets_foreign"] == 0
            got = RingReader(driver.lidars[0].points, from_oldest=True).read()[1]
            np.testing.assert_allclose(xyz(window(got, 0, PERIOD)), metres(records(1, 0), 1), atol=1e-5)
            assert until(lambda: driver.health()[0].identity["firmware"] == "13.18.02.37")
            driver.lidars[0].send_utc(1_700_000_000 * 10**9)
            assert until(lambda: driver.health()[0].status["sync"] == "gps")
            assert driver.health()[0].counters["utc_accepted"] == 1
        assert device.values[Key.WORK_MODE] == b"\2" and driver.health()[0].state == State.STOPPED


def test_reboot_and_cable(monkeypatch: pytest.MonkeyPatch) -> None:
    share_ports(monkeypatch)
    with mid360() as device:
        driver = livox_driver(mid360s=[Mid360Config()], search_address=device.ip)
        with listening(driver):
            assert until(lambda: driver.health()[0].state == State.RUNNING), driver.health()
            device.play(packets(9))
            assert until(lambda: driver.health()[0].counters["points_packets"] > 50)
            device.reboot()
            assert until(lambda: driver.health()[0].state == State.SILENT)
            assert until(lambda: driver.health()[0].state == State.RUNNING)
            device.unplugged = True
            assert until(lambda: "does not answer any more" in driver.health()[0].message)
            device.unplugged = False
            assert until(lambda: driver.health()[0].state == State.RUNNING)
            assert driver.health()[0].counters["points_lost"] > 1000


def test_beside_an_avia(monkeypatch: pytest.MonkeyPatch) -> None:
    share_ports(monkeypatch)
    with mid360() as device, VirtualAvia(announce_every_s=0.1) as avia:
        driver = livox_driver([AviaConfig()], [Mid360Config()], search_address=device.ip)
        with listening(driver):
            assert until(lambda: all(h.state == State.RUNNING for h in driver.health())), driver.health()
            now = time.monotonic_ns()
            avia.play(steady_shots(now, 0.1), steady_imu(now, 0.1))
            device.play(packets(0.1))
            assert until(lambda: [h.counters["points_packets"] for h in driver.health()] == [250, 208])
            assert [h.counters["points_lost"] for h in driver.health()] == [0, 0]


def test_contradictions_are_refused() -> None:
    with pytest.raises(DriverError, match="same UDP port 56301"):
        livox_driver(
            mid360s=[Mid360Config(name="a"), Mid360Config(name="b", command_port=1, push_port=2, imu_port=3)]
        )
    with pytest.raises(DriverError, match="same name"):
        livox_driver([AviaConfig(name="x")], [Mid360Config(name="x")])


def test_nobody_answers_the_search() -> None:
    driver = livox_driver(mid360s=[Mid360Config()])
    session = driver.lidars[0].session
    session.start(0)
    session.tick(6000 * MS)
    assert "no Livox Mid-360 answers the search" in session.message
    assert session.status()["work_state"] == "unknown"


def share_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    """On one computer host and device both need port 56000: the host binds its own loopback address for it."""
    from artemis_drivers import livox_host

    def open_udp(port: int, address: str = "", *, receive_buffer: int = 0) -> socket.socket:
        return real(
            port, "127.0.0.1" if port == protocol.DISCOVERY_PORT else address, receive_buffer=receive_buffer
        )

    real = livox_host.open_udp
    monkeypatch.setattr(livox_host, "open_udp", open_udp)
