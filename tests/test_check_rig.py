"""The pre-flight looks at a rig: made-up systems, real sockets and ports."""

import os
import pty
import socket
from ipaddress import IPv4Address, IPv4Network
from pathlib import Path

import pytest
from artemis_drivers.camera.settings import FilesSettings, OakSettings
from artemis_drivers.livox_avia.settings import AviaConfig
from artemis_drivers.udp import Interface

from artemis_edge import check, check_rig
from artemis_edge.errors import InputError
from artemis_edge.service.settings import LidarEntry, RunConfig, ServiceSettings, load

HOME = Interface("lo", IPv4Address("127.0.0.1"), IPv4Network("127.0.0.0/8"))
LAN = Interface("eth0", IPv4Address("192.168.1.50"), IPv4Network("192.168.1.0/24"))


def avia(**fields: object) -> LidarEntry:
    return LidarEntry(avia=AviaConfig(command_port=47_501, data_port=47_502, **fields))  # type: ignore[arg-type]


def test_the_lidars_network_is_named() -> None:
    assert check_rig.lidar(avia(), [HOME, LAN])[0].status == "ok"
    missing = check_rig.lidar(avia(), [HOME])[0]
    assert missing.status == "fail" and "192.168.1.50/24" in missing.detail
    wrong = check_rig.lidar(avia(host_ip="10.0.0.1"), [HOME, LAN])[0]
    assert wrong.status == "fail" and "10.0.0.1" in wrong.detail


def test_who_holds_the_port_is_named() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("", 47_502))
        found = check_rig.lidar(avia(), [LAN])
    assert [f.status for f in found] == ["ok", "fail"] and "47502" in found[1].detail
    assert len(check_rig.lidar(avia(), [LAN])) == 1


def test_small_socket_buffers_say_what_they_cost(tmp_path: Path) -> None:
    for text, status in (("212992", "warn"), ("33554432", "ok"), ("what", "warn")):
        (tmp_path / "rmem").write_text(text)
        assert check_rig.receive_buffer(tmp_path / "rmem").status == status
    assert check_rig.receive_buffer(tmp_path / "nothing").status == "warn"


def test_serial_ports(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    try:
        assert check_rig.serial_port("imu", os.ttyname(theirs)).status == "ok"
    finally:
        os.close(ours)
        os.close(theirs)
    assert "not there" in check_rig.serial_port("imu", str(tmp_path / "no")).detail
    (tmp_path / "file").touch()
    assert "no serial port" in check_rig.serial_port("imu", str(tmp_path / "file")).detail


@pytest.mark.parametrize(("state", "status"), [("up", "ok"), ("down", "fail"), (None, "fail")])
def test_can_bus(state: str | None, status: str, tmp_path: Path) -> None:
    if state is not None:
        (tmp_path / "can0").mkdir()
        (tmp_path / "can0" / "operstate").write_text(state + "\n")
    assert check_rig.can_bus("socketcan", "can0", tmp_path).status == status


def test_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert check_rig.camera(FilesSettings(str(tmp_path))).status == "ok"
    assert check_rig.camera(FilesSettings(str(tmp_path / "no"))).status == "fail"
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "[oak]" in check_rig.camera(OakSettings()).detail
    monkeypatch.setattr("importlib.util.find_spec", lambda name: object())
    assert "no OAK" in check_rig.camera(OakSettings(), tmp_path).detail
    (tmp_path / "1-1").mkdir()
    (tmp_path / "1-1" / "idVendor").write_text("03e7\n")
    assert check_rig.camera(OakSettings(), tmp_path).status == "ok"


def test_the_disk_is_measured_and_counted_in_minutes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    service = ServiceSettings(sessions=str(tmp_path / "not" / "yet"))
    monkeypatch.setattr(check_rig, "write_speed", lambda folder: 25.0)
    monkeypatch.setattr(check_rig.health, "free_disk_mb", lambda folder: 1000 + 10 * 60 * 20.0)
    space, place, speed = check_rig.recording_disk(service, 10.0)
    assert place.status == "warn" and "is not there yet" in place.detail and str(tmp_path) in place.detail
    assert space.status == "warn" and space.detail.startswith("20 minutes")
    assert speed.status == "warn" and "25 MB/s" in speed.detail
    (tmp_path / "not" / "yet").mkdir(parents=True)
    assert check_rig.recording_disk(service, 30.0)[1].status == "fail"
    assert check_rig.recording_disk(service, 5.0)[1].status == "ok"


def test_the_speed_of_a_real_disk_is_some(tmp_path: Path) -> None:
    assert check_rig.write_speed(tmp_path) > 0.1


def test_battery_and_temperature(tmp_path: Path) -> None:
    assert check_rig.battery(tmp_path).status == "ok"
    supply = tmp_path / "BAT0"
    supply.mkdir()
    for name, text in (
        ("type", "Battery"),
        ("capacity", "15"),
        ("energy_now", "10000"),
        ("power_now", "20000"),
    ):
        (supply / name).write_text(text + "\n")
    low = check_rig.battery(tmp_path)
    assert low.status == "warn" and "15 %" in low.detail and "30 minutes" in low.detail
    zone = tmp_path / "thermal_zone0"
    zone.mkdir()
    (zone / "temp").write_text("91000\n")
    assert check_rig.temperature(tmp_path).status == "warn"


def test_data_rate_grows_with_what_is_plugged_in() -> None:
    plain, triple = RunConfig((avia(),)), RunConfig((avia(return_mode="triple"),))
    assert check_rig.data_rate(plain) == pytest.approx(9.6)
    assert check_rig.data_rate(triple) == pytest.approx(28.8)
    assert check_rig.data_rate(load("field")) > check_rig.data_rate(plain) + 3.0


def test_check_with_a_rigs_profile_looks_at_its_devices(tmp_path: Path) -> None:
    names = {f.name for f in check.check(Path("field"))}
    assert {
        "python",
        "lidar_0 network",
        "imu",
        "trigger",
        "cam_0",
        "disk speed",
        "battery",
        "clock",
        "model",
    } <= names
    wrong = tmp_path / "rig.toml"
    wrong.write_text("lidar = ['nobody']\n")
    assert any(f.status == "fail" and "nobody" in f.detail for f in check.check(wrong))


def test_a_mount_that_is_no_rotation_is_refused_by_the_name_of_its_sensor(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text("[[lidar]]\navia = {}\nmount = {quaternion = [0.0, 0.0, 0.0, 0.0]}\n")
    with pytest.raises(
        InputError, match=r"lidar.*mount.*quaternion must not be zero|quaternion must not be zero.*lidar"
    ):
        load(path)
