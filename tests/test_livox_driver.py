"""Avia driver against the virtual Avia on loopback: sessions, configuration, loss, faults of network and device."""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from ipaddress import IPv4Address, IPv4Network

import numpy as np
import pytest
from artemis_drivers.base import DriverError, Health, State
from artemis_drivers.livox import livox_driver
from artemis_drivers.livox_avia.control import AviaSession
from artemis_drivers.livox_avia.driver import spread_ports
from artemis_drivers.livox_avia.items import command
from artemis_drivers.livox_avia.payloads import Broadcast, encode_utc
from artemis_drivers.livox_avia.protocol import Frame, General, Kind, Lidar, WorkState, decode, encode
from artemis_drivers.livox_avia.settings import AviaConfig, StoredExtrinsic
from artemis_drivers.livox_host import LivoxHost
from artemis_drivers.ring import Ring, RingReader
from artemis_drivers.udp import Interface, interfaces, open_udp, port_holder, receive_buffer_warning
from artemis_drivers.virtual.wire_avia import Faults, VirtualAvia
from artemis_drivers.virtual.wire_clock import DeviceClock
from artemis_drivers.virtual.wire_stream import steady_imu, steady_shots
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import livox_ports
from tests.livox_clouds import window, xyz
from tests.waiting import until

MS = 1_000_000
SECOND = 1_000 * MS


@pytest.fixture(scope="module", autouse=True)
def ports() -> Iterator[None]:
    with livox_ports.reserved():
        yield


@contextmanager
def rig(device: VirtualAvia, config: AviaConfig | None = None) -> Iterator[LivoxHost]:
    """A virtual device and a driver that has reached RUNNING."""
    driver = livox_driver([config or AviaConfig()])
    with device:
        driver.start()
        try:
            assert until(lambda: driver.health()[0].state == State.RUNNING), driver.health()[0]
            yield driver
        finally:
            driver.stop()


def quick(**options: object) -> VirtualAvia:
    """A virtual Avia that announces itself often, to save time."""
    return VirtualAvia(**{"announce_every_s": 0.1, **options})  # type: ignore[arg-type]


def one(driver: LivoxHost) -> Health:
    return driver.health()[0]


def stream(device: VirtualAvia, seconds: float, returns: int = 1) -> None:
    now = time.monotonic_ns()
    device.play(steady_shots(now, seconds, returns), steady_imu(now, seconds))


def settled(driver: LivoxHost, device: VirtualAvia, packets: int) -> Health:
    """Health after the device has made so many packets and the driver has taken in what was sent."""
    assert until(lambda: device.counters["packets_made"] >= packets), device.counters
    time.sleep(0.1)
    return one(driver)


def test_session_configuration_and_data() -> None:
    config = AviaConfig(
        return_mode="dual",
        rain_fog=True,
        high_sensitivity=False,
        scan_pattern="repetitive",
        extrinsic=StoredExtrinsic(1.5, -2.0, 90.0, 10, -20, 30),
    )
    device = quick()
    with rig(device, config) as driver:
        points, imu = (RingReader(r) for r in (driver.lidars[0].points, driver.lidars[0].imu))
        start = time.monotonic_ns()
        stream(device, 0.2, returns=2)
        health = settled(driver, device, 1000 + 40)
        assert (health.counters["points_packets"], health.counters["imu_packets"]) == (1000, 40)
        assert (
            health.counters["points_lost"]
            == health.counters["imu_lost"]
            == health.counters["kernel_drops"]
            == 0
        )
        assert until(lambda: {a.status for a in one(driver).applied} == {"ok"}), one(driver).applied
        assert {a.item for a in health.applied} == {
            *("coordinate", "return_mode", "imu", "rain_fog", "high_sensitivity", "scan_pattern", "extrinsic")
        }
        assert health.identity["serial"] == "3JEDK1E001F6361" and health.identity["firmware"] == "11.08.00.06"
        got = points.read()[1]
        assert set(got["data_type"].tolist()) == {4} and points.lost == imu.lost == 0
        assert (got["rx_ns"] > start).all() and (np.diff(got["rx_ns"]) >= 0).all()
        cloud = window(got, 0, int(got["stamp_ns"][-1]) + SECOND)
        sent = next(steady_shots(start, 0.01, 2))
        np.testing.assert_allclose(xyz(cloud)[:4800], sent.xyz.reshape(-1, 3), atol=6e-4)
        np.testing.assert_allclose(cloud["intensity"][:4800] * 255, sent.reflectivity.ravel(), rtol=1e-6)
        samples = imu.read()[1]
        np.testing.assert_allclose(samples["accel"], [[0, 0, 9.80665]] * 40, rtol=1e-6)
        assert np.diff(samples["stamp_ns"]).tolist() == [5 * MS] * 39
    assert one(driver).state == State.STOPPED
    assert device.counters["sessions_expired"] == 0 and device._host is None  # the driver took leave


@pytest.mark.parametrize(
    ("mode", "coordinate", "data_type"), [("triple", "cartesian", 7), ("triple", "spherical", 8)]
)
def test_other_data_types_on_the_wire(mode: str, coordinate: str, data_type: int) -> None:
    device = quick()
    with rig(device, AviaConfig(return_mode=mode, coordinate=coordinate)) as driver:  # type: ignore[arg-type]
        points = RingReader(driver.lidars[0].points)
        stream(device, 0.05, returns=3)
        settled(driver, device, 410)
        assert until(lambda: {a.status for a in one(driver).applied} == {"ok"}), one(driver)
        got = points.read()[1]
        assert set(got["data_type"].tolist()) == {data_type}
        sent = next(steady_shots(0, 0.01, 3)).xyz.reshape(-1, 3)
        np.testing.assert_allclose(
            xyz(window(got, 0, 10**12 + int(got["stamp_ns"][0])))[:7200], sent, atol=2e-3
        )


def test_device_that_streams_while_it_is_configured() -> None:
    device = quick()
    with device:
        stream(device, 4.0, returns=3)
        driver = livox_driver([AviaConfig(return_mode="triple")])
        driver.start()
        try:
            assert until(lambda: one(driver).counters["points_packets"] > 1000)
            got = RingReader(driver.lidars[0].points, from_oldest=True).read()[1]
            assert set(got["data_type"].tolist()) == {7} and one(driver).counters["points_lost"] == 0
        finally:
            driver.stop()


def test_lost_doubled_and_packed_replies() -> None:
    device = quick(faults=Faults(seed=3, lose_replies=0.2, duplicate_replies=0.3))
    driver = livox_driver([AviaConfig()])
    with device:
        driver.start()
        try:
            assert until(lambda: one(driver).state == State.RUNNING, 15)
            assert {a.status for a in one(driver).applied} <= {"ok", "unreadable"}
            counters = one(driver).counters
            assert counters["commands_resent"] > 0 and counters["answers_unexpected"] > 0
        finally:
            driver.stop()


def test_two_replies_in_one_datagram() -> None:
    device = quick(faults=Faults(seed=2, pack_replies=0.4))
    driver = livox_driver([AviaConfig(imu=False)])
    with device:
        driver.start()
        try:
            assert until(lambda: one(driver).state == State.RUNNING, 15), one(driver)
            assert device.counters["replies_packed"] > 0 and one(driver).counters["control_bad_bytes"] == 0
        finally:
            driver.stop()


def test_lost_doubled_and_reordered_data_are_counted_exactly() -> None:
    device = quick(faults=Faults(seed=1, lose_data=0.05, duplicate_data=0.05, reorder_data=0.05))
    with rig(device) as driver:
        stream(device, 0.5)
        health = settled(driver, device, 1250 + 100)
        made = device.counters
        seen = {
            k: health.counters[f"points_{k}"] + health.counters[f"imu_{k}"]
            for k in ("lost", "duplicates", "packets")
        }
        assert (
            made["packets_lost"] > 20 and made["packets_duplicated"] > 20 and made["packets_reordered"] > 20
        )
        # the last packets of a stream can be lost without anything coming after them that would tell
        assert made["packets_lost"] - 2 <= seen["lost"] <= made["packets_lost"]
        assert seen["duplicates"] == made["packets_duplicated"]
        assert seen["packets"] == made["packets_made"] - made["packets_lost"]
        assert health.counters["points_late"] + health.counters["imu_late"] > 10
        assert driver.lidars[0].points.published == health.counters["points_packets"]


def test_refused_setting_is_reported() -> None:
    device = quick(faults=Faults(refuse=frozenset({(1, Lidar.SET_RETURN_MODE)})))
    with rig(device, AviaConfig(return_mode="triple")) as driver:
        health = one(driver)
        refused = {a.item: a for a in health.applied}["return_mode"]
        assert (refused.status, refused.tries) == ("refused", 5)
        assert "return_mode = triple refused" in health.message


def test_start_up_progress_and_standby() -> None:
    device = quick(boot_s=1.2)
    driver = livox_driver([AviaConfig()])
    with device:
        device._mode = WorkState.STANDBY
        driver.start()
        try:
            assert until(lambda: "starting up" in one(driver).message)
            assert one(driver).state == State.CONFIGURING
            assert until(lambda: one(driver).state == State.RUNNING, 8)
            assert device.work_state == WorkState.NORMAL
        finally:
            driver.stop()


def test_reboot_is_noticed_and_recovered() -> None:
    device = quick(heartbeat_timeout_s=60)
    device.device_time = DeviceClock(time.monotonic_ns() - 60 * SECOND, 0)
    with rig(device) as driver:
        stream(device, 3.0)
        assert until(lambda: one(driver).counters["points_packets"] > 100)
        device.reboot()
        assert until(lambda: one(driver).state == State.SILENT)
        assert "no data" in one(driver).message
        before = one(driver).counters["points_packets"]
        assert until(lambda: one(driver).counters["points_packets"] > before)
        health = one(driver)
        assert health.counters["sessions"] == 2 and health.state == State.RUNNING and health.message == ""
        assert health.counters["points_clock_steps"] == 1 and health.counters["points_lost"] == 0


@pytest.mark.parametrize("out_s", [1.0, 3.8])
def test_cable_out_and_in_again(out_s: float) -> None:
    device = quick()
    with rig(device) as driver:
        stream(device, out_s + 3)
        assert until(lambda: one(driver).counters["points_packets"] > 100)
        device.faults.unplugged = True
        assert until(lambda: one(driver).state == State.SILENT)
        time.sleep(out_s - 0.6)
        assert one(driver).state == (State.SILENT if out_s < 3 else State.SEARCHING)
        assert "cable" in one(driver).message
        device.faults.unplugged = False
        assert until(lambda: one(driver).state == State.RUNNING)

        def missed() -> int:
            return one(driver).counters["points_lost"] + one(driver).counters["imu_lost"]

        # every packet that was not sent is missed, and no other
        assert until(lambda: missed() == device.counters["packets_unplugged"] > 1000)
        assert one(driver).counters["points_clock_steps"] == 0


def test_device_that_forgot_the_session() -> None:
    device = quick(heartbeat_timeout_s=0.5)  # shorter than the heartbeat: it drops us again and again
    with rig(device) as driver:
        stream(device, 10)
        assert until(lambda: one(driver).counters["sessions"] >= 2, 6)
        assert device.counters["sessions_expired"] >= 1


def test_utc_makes_gps_time() -> None:
    device = quick()
    with rig(device) as driver:
        stream(device, 4.0)
        epoch = 1_700_000_000
        assert until(
            lambda: one(driver).status["clock"] == "free" and one(driver).counters["points_packets"] > 0
        )
        edge = time.monotonic_ns()
        device.pulse(edge)
        assert until(lambda: one(driver).status["clock"] == "pps" and one(driver).status["sync"] == "pps")
        time.sleep(0.03)
        driver.lidars[0].send_utc(epoch * SECOND)
        assert until(lambda: one(driver).status["clock"] == "gps" and one(driver).status["sync"] == "gps")
        health = one(driver)
        assert (health.counters["utc_sent"], health.counters["utc_accepted"]) == (1, 1)
        got = RingReader(driver.lidars[0].points, from_oldest=True).read()[1]
        gps = got["clock"] == 3
        wall = got["stamp_ns"][gps] - epoch * SECOND + edge
        assert ((got["rx_ns"][gps] - wall) < 100 * MS).all() and ((got["rx_ns"][gps] - wall) > 0).all()
        assert set(got["clock"].tolist()) == {0, 3, 4} and health.counters["points_clock_changes"] == 2
        assert until(lambda: one(driver).status["sync"] == "abnormal", 3)  # no further pulse comes
        assert "synchronisation abnormal" in one(driver).message or until(
            lambda: "abnormal" in one(driver).message, 1
        )


def test_late_utc_leaves_the_device_on_pps() -> None:
    device = quick()
    with rig(device) as driver:
        stream(device, 1.5)
        device.pulse(time.monotonic_ns())
        time.sleep(0.6)
        driver.lidars[0].send_utc(1_700_000_000 * SECOND)
        assert until(lambda: one(driver).counters.get("utc_accepted") == 1)
        time.sleep(0.1)
        assert one(driver).status["clock"] == "pps" and device.device_time.utc_late == 1
        assert one(driver).counters["points_lost"] == 0  # time since the pulse counts on


def test_abnormal_message() -> None:
    device = quick()
    with rig(device) as driver:
        stream(device, 4.0)
        device.set_status(2 << 4)
        assert until(lambda: one(driver).counters.get("abnormal_messages", 0) > 0)
        assert "motor error" in one(driver).message and one(driver).status["motor"] == "error"
        device.set_status(0)
        assert until(lambda: one(driver).message == "", 2)


def test_two_lidars_by_configuration() -> None:
    with ExitStack() as stack:
        devices = [
            stack.enter_context(
                quick(code=f"3JEDK1E00{k}F6361", ip=f"127.0.0.{10 + k}", faults=Faults(seed=k))
            )
            for k in range(2)
        ]
        driver = livox_driver(
            [AviaConfig(name="any"), AviaConfig(name="front", broadcast_code="3JEDK1E000F636")]
        )
        driver.start()
        stack.callback(driver.stop)
        assert until(lambda: all(h.state == State.RUNNING for h in driver.health())), driver.health()
        assert [h.identity["serial"] for h in driver.health()] == ["3JEDK1E001F6361", "3JEDK1E000F6361"]
        for device in devices:
            stream(device, 0.1)
        assert until(lambda: all(h.counters["points_packets"] == 250 for h in driver.health()))
        assert all(
            h.counters["points_lost"] == 0 and h.counters["packets_foreign"] == 0 for h in driver.health()
        )


def test_packets_of_a_stranger_are_not_taken() -> None:
    device = quick()
    with rig(device) as driver, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind(("127.0.0.77", 0))
        stranger.sendto(bytes(1362), ("127.0.0.1", 56001))
        stranger.sendto(b"\xaa" * 40, ("127.0.0.1", 55501))
        assert until(lambda: one(driver).counters["packets_foreign"] == 1)
        assert until(lambda: one(driver).counters.get("control_foreign") == 1)
        assert one(driver).counters["bad_version"] == 0


# -- what the user is told --------------------------------------------------------------------------------------


def test_port_in_use_names_the_holder() -> None:
    with open_udp(55000), pytest.raises(DriverError) as caught:
        livox_driver([AviaConfig()]).start()
    text = str(caught.value)
    assert "UDP port 55000" in text and f"process {os.getpid()}" in text and "stop that program" in text
    with open_udp(56001), pytest.raises(DriverError, match="56001"):
        livox_driver([AviaConfig()]).start()
    with open_udp(55000):  # the failed start has left nothing open
        pass
    assert port_holder(1) == "an unknown process"


def test_wrong_subnet() -> None:
    other = [Interface("eth0", IPv4Address("192.168.7.2"), IPv4Network("192.168.7.0/24"))]
    driver = livox_driver([AviaConfig()], own_addresses=lambda: other)
    with quick():
        driver.start()
        try:
            assert until(lambda: "no address in its network" in one(driver).message)
            assert "127.0.0.50/24" in one(driver).message and one(driver).state == State.SEARCHING
        finally:
            driver.stop()


def test_wrong_host_address_and_wrong_serial() -> None:
    with pytest.raises(DriverError, match="no address of this computer"):
        open_udp(0, "203.0.113.9")
    with pytest.raises(DriverError, match="same name"):
        livox_driver([AviaConfig(), AviaConfig()])
    session = AviaSession(AviaConfig(broadcast_code="OTHER"))
    session.start(0)
    session.tick(6 * SECOND)
    assert "no Livox Avia is heard" in session.message
    assert not session.hear_broadcast(Broadcast("3JEDK1E001F6361", 7), "192.168.1.10", 6 * SECOND)
    assert "OTHER is not heard, but 3JEDK1E001F6361 at 192.168.1.10 is" in session.message
    free = AviaSession(AviaConfig())
    free.start(0)
    assert not free.hear_broadcast(Broadcast("1PQDL5H001UL991", 2), "192.168.1.10", 0)
    assert "Tele-15" in free.message and "connect an Avia" in free.message


def test_handshake_without_answer() -> None:
    here = [Interface("eth0", IPv4Address("192.168.1.50"), IPv4Network("192.168.1.0/24"))]
    session = AviaSession(AviaConfig(), lambda: here)
    session.start(0)
    assert session.hear_broadcast(Broadcast("3JEDK1E001F6361", 7), "192.168.1.10", 0)
    sent = 0
    for ms in range(0, 2000, 10):
        session.tick(ms * MS)
        sent += len(session.outbox)
        session.outbox.clear()
    assert sent == 3 and session.state == State.SEARCHING
    assert "does not answer the handshake" in session.message and "firewall" in session.message


def test_small_receive_buffer_is_told() -> None:
    with open_udp(0, receive_buffer=100_000) as sock:
        assert "net.core.rmem_max" in receive_buffer_warning(sock)
    with open_udp(0, receive_buffer=8 << 20) as sock:
        roomy = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2 >= 4 << 20
        assert (receive_buffer_warning(sock) == "") == roomy


def test_kernel_drops_are_counted() -> None:
    device = quick()
    with rig(device) as driver:
        receiver = driver.lidars[0]._receivers[0]
        receiver.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        receiver.sender = "127.0.0.1"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as flood:
            flood.bind(("127.0.0.1", 0))

            def dropped() -> bool:
                for _ in range(200):
                    flood.sendto(bytes(1362), ("127.0.0.1", 56001))
                return one(driver).counters["kernel_drops"] > 0

            assert until(dropped)
        stream(device, 0.5)  # the complaint about missing data goes before
        assert until(lambda: "came faster than this computer" in one(driver).message)


def test_own_interfaces() -> None:
    loopback = [i for i in interfaces() if i.name == "lo"]
    assert loopback and IPv4Address("127.0.0.5") in loopback[0].network


def test_ports_of_several_lidars() -> None:
    spread = spread_ports([AviaConfig(name=str(k)) for k in range(3)])
    assert [(c.command_port, c.data_port) for c in spread] == [(55501, 56001), (55502, 56002), (55503, 56003)]


def test_rings_of_the_callers_making() -> None:
    made: dict[str, Ring] = {}

    def make(name: str, dtype: np.dtype[np.void], slots: int) -> Ring:
        made[name] = Ring(dtype, slots, memoryview(bytearray(Ring.nbytes(dtype, slots))))
        return made[name]

    lidar = livox_driver([AviaConfig(name="front")], make_ring=make).lidars[0]
    assert made == {"front.packets": lidar.packets, "front.points": lidar.points, "front.imu": lidar.imu}


def test_stop_without_device_and_twice() -> None:
    driver = livox_driver([AviaConfig()])
    driver.start()
    assert one(driver).state == State.SEARCHING
    driver.stop()
    driver.stop()
    assert one(driver).state == State.STOPPED
    for wrong in (0, 946_684_800 * SECOND - 1, 9_025_257_600 * SECOND):
        with pytest.raises(ValueError, match="2000 to 2255"):
            driver.lidars[0].send_utc(wrong)
    assert encode_utc(946_684_800 * SECOND)[:4] == bytes([0, 1, 1, 0])
    assert encode_utc(9_025_257_600 * SECOND - 1)[:4] == bytes([255, 12, 31, 23])


# -- the session alone, in simulated time -----------------------------------------------------------------------

ANSWERS = st.tuples(
    st.integers(0, 40), st.sampled_from([*General, *Lidar]), st.binary(max_size=8), st.booleans()
)
EVENTS = st.one_of(
    st.tuples(st.just("wait"), st.integers(1, 1500)),
    st.tuples(st.just("broadcast"), st.sampled_from(["3JEDK1E001F6361", "OTHER"])),
    st.tuples(st.just("answer"), ANSWERS),
    st.tuples(st.just("obey"), st.integers(0, 1)),
    st.tuples(st.just("noise"), st.binary(max_size=40)),
    st.tuples(st.just("data"), st.integers(0, 8)),
    st.tuples(st.just("utc"), st.integers(0, 10**9)),
    st.tuples(st.just("stop"), st.just(0)),
)


def test_unplugging_is_noticed_within_a_second_and_mended_within_three() -> None:
    here = [Interface("eth0", IPv4Address("192.168.1.50"), IPv4Network("192.168.1.0/24"))]
    session = AviaSession(AviaConfig(), lambda: here)
    out, back = 20_000, 24_000  # ms
    states: dict[int, State] = {}
    session.start(0)
    for ms in range(0, 30_000, 5):
        now, plugged = ms * MS, not out <= ms < back
        if plugged and ms % 1000 == 0 and session.counters["sessions"] == 0:
            session.hear_broadcast(Broadcast("3JEDK1E001F6361", 7), "192.168.1.10", now)
        if plugged and session.state in (State.RUNNING, State.SILENT):
            session.data_seen(now, 2, 0)
        session.tick(now)
        for datagram in session.outbox if plugged else ():
            frame = decode(datagram.data)[0][0]
            answer = frame._replace(kind=Kind.ACK, payload=bytes([0, 1, 0, 0, 0, 0, 0]))
            session.hear(encode(answer), "192.168.1.10", now)
        session.outbox.clear()
        states[ms] = session.state
    assert states[out - 5] == State.RUNNING and states[out + 1000] == State.SILENT
    assert states[back - 5] == State.SEARCHING and states[back + 3000] == State.RUNNING


@given(st.lists(EVENTS, max_size=60))
@settings(max_examples=200, deadline=None)
def test_session_survives_any_course_of_events(events: list[tuple[str, object]]) -> None:
    here = [Interface("eth0", IPv4Address("192.168.1.50"), IPv4Network("192.168.1.0/24"))]
    session, now, asked = AviaSession(AviaConfig(), lambda: here), 0, list[Frame]()
    session.start(now)
    for what, value in events:
        match what, value:
            case "wait", int(ms):
                now += ms * MS
            case "broadcast", str(code):
                session.hear_broadcast(Broadcast(code, 7), "192.168.1.10", now)
            case "answer", (seq, cmd, payload, is_answer):
                frame = Frame(
                    Kind.ACK if is_answer else Kind.MSG, seq, command(cmd) >> 8, command(cmd) & 255, payload
                )
                session.hear(encode(frame), "192.168.1.10", now)
            case "obey", int(ret):
                for frame in asked[-1:]:
                    answer = frame._replace(kind=Kind.ACK, payload=bytes([ret, 1, 0, 0, 0, 0, 0]))
                    session.hear(encode(answer), "192.168.1.10", now)
            case "noise", bytes(data):
                session.hear(data, "192.168.1.10", now)
            case "data", int(kind):
                session.data_seen(now, kind, 0)
            case "utc", int(ns):
                session.send_utc(1_700_000_000 * SECOND + ns)
            case _:
                session.begin_stop(now)
        session.tick(now)
        for datagram in session.outbox:
            frames, skipped = decode(datagram.data)
            assert skipped == 0 and len(frames) == 1 and datagram.address == ("192.168.1.10", 65000)
            asked += frames
        assert len(session.outbox) <= 6  # never a flood
        session.outbox.clear()
        if session.state in (State.SILENT, State.FAILED):
            assert session.message
    session.begin_stop(now)
    for _ in range(8):
        now += 600 * MS
        session.tick(now)
    assert session.state == State.STOPPED  # silence cannot hold it up
