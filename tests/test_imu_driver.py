"""The serial IMU driver against the virtual MTi on a pseudo terminal, and VectorNav against a scripted port."""

import time
from pathlib import Path

import numpy as np
import pytest
from artemis_drivers.base import DriverError, State
from artemis_drivers.imu_serial import configure, vectornav
from artemis_drivers.imu_serial.configure import configure_mti, configure_vectornav
from artemis_drivers.imu_serial.driver import IMU_CHUNK, SerialImu
from artemis_drivers.imu_serial.link import SerialPort
from artemis_drivers.imu_serial.mtdata2 import Type
from artemis_drivers.imu_serial.samples import IMU_SAMPLE
from artemis_drivers.imu_serial.settings import MtiSettings, SyncSetting, VectorNavSettings
from artemis_drivers.ring import Ring, RingReader
from artemis_drivers.virtual.wire_imu import MtiFaults, WireMti

from tests.waiting import until

Vector = tuple[float, float, float]


def still(truth_ns: int) -> tuple[Vector, Vector]:
    return (0.25, -0.5, 0.125), (0.0, 0.5, 9.75)


def rings() -> tuple[Ring, Ring]:
    return Ring(IMU_SAMPLE, 4096), Ring(IMU_CHUNK, 512)


def test_a_faulty_line_loses_only_what_was_lost(tmp_path: Path) -> None:
    """Drops, corruption, repeats and noise; counter and clock wrap in the first second; factory baud rate."""
    faults = MtiFaults(
        drop=0.02, corrupt=0.02, duplicate=0.02, noise=0.05, first_counter=65_500, first_tick=2**32 - 1000
    )
    rig = WireMti(tmp_path / "mti", still, faults)
    samples, chunks = rings()
    driver = SerialImu(MtiSettings(str(tmp_path / "mti")), samples, chunks)
    rig.start()
    driver.start()
    try:
        assert until(lambda: samples.published > 400)
    finally:
        driver.stop()
        rig.stop()
    (health,) = driver.health()
    _, rows = RingReader(samples, from_oldest=True).read()
    counters = health.counters
    np.testing.assert_array_equal(rows["gyro"], np.tile([0.25, -0.5, 0.125], (len(rows["gyro"]), 1)))
    np.testing.assert_array_equal(rows["accel"], np.tile([0.0, 0.5, 9.75], (len(rows["gyro"]), 1)))
    np.testing.assert_array_equal(np.diff(rows["device_ns"]), np.diff(rows["count"]) * 2_500_000)
    assert counters["lost"] == rows["count"][-1] + 1 - len(rows["count"]) == rows["lost"].sum()
    assert 0 < counters["lost"] <= rig.dropped
    assert counters["repeated"] > 0 and counters["skipped_bytes"] > 0 and counters["restarts"] == 0
    assert {item.item: item.status for item in health.applied} == dict.fromkeys(
        ("baud", "device id", "outputs", "mode"), "ok"
    )
    assert health.identity == {"device id": "03800123"}
    # the bytes as they came, decoded again, give the same samples
    again, _ = rings()
    second = SerialImu(driver.settings, again)
    _, raw = RingReader(chunks, from_oldest=True).read()
    for rx_ns, size, data in zip(raw["rx_ns"], raw["size"], raw["data"], strict=True):
        second.take(data[:size].tobytes(), int(rx_ns))
    _, repeated = RingReader(again, from_oldest=True).read()
    np.testing.assert_array_equal(repeated["device_ns"], rows["device_ns"])
    np.testing.assert_array_equal(repeated["rx_ns"], rows["rx_ns"])


def test_unplugged_and_plugged_in_again(tmp_path: Path) -> None:
    rig = WireMti(tmp_path / "mti", still)
    samples, _ = rings()
    driver = SerialImu(MtiSettings(str(tmp_path / "mti")), samples)
    driver.start()
    try:
        assert until(lambda: "is not there" in driver.health()[0].message)
        rig.start()
        assert until(lambda: samples.published > 20)
        rig.unplug()
        assert until(lambda: driver.health()[0].state == State.SEARCHING)
        seen = samples.published
        rig.replug()
        assert until(lambda: samples.published > seen + 20)
        counters = driver.health()[0].counters
        assert (counters["unplugged"], counters["restarts"]) == (1, 1)
        with pytest.raises(DriverError, match="runs already"):
            driver.start()
    finally:
        driver.stop()
        rig.stop()
    assert driver.health()[0].state == State.STOPPED
    driver.stop()


def test_silence_is_noticed(tmp_path: Path) -> None:
    rig = WireMti(tmp_path / "mti", still)
    samples, _ = rings()
    driver = SerialImu(MtiSettings(str(tmp_path / "mti")), samples)
    rig.start()
    driver.start()
    try:
        assert until(lambda: samples.published > 20)
        rig.device.measuring = False
        assert until(lambda: driver.health()[0].counters["silent"] == 1)
        seen = samples.published
        assert until(lambda: samples.published > seen)
    finally:
        driver.stop()
        rig.stop()


def test_configuration_is_read_back(tmp_path: Path) -> None:
    rig = WireMti(tmp_path / "mti", still)
    rig.start()
    try:
        path = str(tmp_path / "mti")
        port = SerialPort(path, 115_200)
        with pytest.raises(DriverError, match="used by another program"):
            SerialPort(path, 115_200)
        rounded = MtiSettings(path, baud=2_000_000, rate_hz=1000, sync=(SyncSetting(9, 2),))
        status = {item.item: item.status for item in configure_mti(port, rounded)}
        assert status == {"baud": "ok", "device id": "ok", "outputs": "rounded", "sync": "ok", "mode": "ok"}
        unknown = MtiSettings(path, baud=2_000_000, extra_outputs=((Type.LAT_LON, 4),))
        items = {item.item: item for item in configure_mti(port, unknown)}
        assert items["outputs"].status == "refused" and "parameter invalid" in items["outputs"].read_back
        port.close()
    finally:
        rig.stop()


def test_outputs_that_do_not_fit_the_line_are_refused() -> None:
    with pytest.raises(DriverError, match="raise the baud rate"):
        MtiSettings("x", baud=115_200, rate_hz=400).require_room()
    MtiSettings("x", baud=921_600, rate_hz=400).require_room()
    with pytest.raises(DriverError, match="whole fractions"):
        VectorNavSettings("x", rate_hz=300).divisor()


def test_a_port_that_is_not_there_is_named() -> None:
    with pytest.raises(DriverError, match=r"/dev/nowhere is not there"):
        SerialPort("/dev/nowhere", 115_200)


class ScriptedVectorNav:
    """A port with a VectorNav's registers behind it, at one baud rate."""

    def __init__(self, baud: int) -> None:
        self.baudrate = 0
        self.baud = baud
        self.registers = {3: "0100012345", 5: str(baud), 6: "14", 75: "0,0,0"}
        self._out = bytearray(bytes.fromhex("fa01080093502e42833ef13f48b504bb9288"))

    def chunk(self, timeout_s: float = 0.0) -> bytes:
        if not self._out:
            time.sleep(0.001)
        data = bytes(self._out)
        self._out.clear()
        return data

    def write(self, data: bytes) -> None:
        if self.baudrate == self.baud:
            command, number, *values = vectornav.line_text(data).split(",")
            register = int(number)
            if command == "VNWRG":
                self.registers[register] = ",".join(values if register == 75 else values[:1])
            answer = vectornav.line(f"{command},{number},{self.registers[register]}")
            self.baud = int(self.registers[5])
            self._out += answer

    def close(self) -> None:
        self.baudrate = 0


def test_vectornav_is_configured_at_another_baud_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(configure, "_FIND_S", 0.01)
    port = ScriptedVectorNav(115_200)
    applied = configure_vectornav(port, VectorNavSettings("x", rate_hz=200))
    assert {item.item: item.status for item in applied} == {
        "baud": "ok",
        "ascii output": "ok",
        "binary output": "ok",
    }
    assert port.registers[75] == f"1,4,01,{configure.VECTORNAV_FIELDS:04X}"
    assert (port.baudrate, port.registers[6]) == (921_600, "0")


def test_a_silent_port_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(configure, "_FIND_S", 0.002)
    for settings, function in (
        (VectorNavSettings("tty", name="imu_0"), configure_vectornav),
        (MtiSettings("tty", name="imu_0"), configure_mti),
    ):
        with pytest.raises(DriverError, match="imu_0: nothing answers at tty"):
            function(ScriptedVectorNav(1), settings)  # type: ignore[operator]


def test_vectornav_samples_carry_the_sync_input() -> None:
    samples, _ = rings()
    driver = SerialImu(VectorNavSettings("x", rate_hz=200), samples)
    masks = (configure.VECTORNAV_FIELDS, 0, 0)
    for k in range(3):
        fields = {
            "common.time_startup_ns": (10**9 + 5_000_000 * k,),
            "common.time_sync_in_ns": (1_000_000 + 5_000_000 * k,),
            "common.angular_rate": (1.0, 2.0, 3.0),
            "common.acceleration": (4.0, 5.0, 6.0),
            "common.sync_in_count": (7,),
        }
        driver.take(vectornav.encode(vectornav.BinaryMessage(masks, fields)), 123 + k)
    _, rows = RingReader(samples, from_oldest=True).read()
    assert rows["sync_in_ns"].tolist() == [999_000_000] * 3
    assert rows["sync_in_count"].tolist() == [7] * 3 and rows["count"].tolist() == [0, 1, 2]


def test_samples_that_are_no_numbers_are_counted() -> None:
    samples, _ = rings()
    driver = SerialImu(VectorNavSettings("x", rate_hz=200), samples)
    masks = (configure.VECTORNAV_FIELDS, 0, 0)
    for startup, rate in ((2**63, 0.0), (5, float("nan")), (5, float("inf")), (10, 1.0)):
        fields = {
            "common.time_startup_ns": (startup,),
            "common.time_sync_in_ns": (2**64 - 1,),
            "common.angular_rate": (rate, 0.0, 0.0),
            "common.acceleration": (0.0, 0.0, 0.0),
            "common.sync_in_count": (2**32 - 1,),
        }
        driver.take(vectornav.encode(vectornav.BinaryMessage(masks, fields)), 1)
    assert samples.published == 1 and driver.health()[0].counters["malformed_frames"] == 3
    assert samples.field["sync_in_ns"][0] == -1
