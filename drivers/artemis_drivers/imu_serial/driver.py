"""Reads a serial IMU in a thread of its own: opens, configures, reads, and starts over when it is unplugged."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np

from artemis_drivers.base import DriverError, State
from artemis_drivers.device_thread import DeviceThread
from artemis_drivers.imu_serial.link import READ_TIMEOUT_S, Port, SerialPort
from artemis_drivers.imu_serial.mtdata2 import MalformedError
from artemis_drivers.imu_serial.samples import IMU_SAMPLE, Sample, protocol
from artemis_drivers.imu_serial.settings import ImuSettings
from artemis_drivers.imu_serial.stream import FrameSplitter
from artemis_drivers.ring import Ring

CHUNK_BYTES = 4096
IMU_CHUNK = np.dtype([("rx_ns", "i8"), ("size", "i4"), ("data", "u1", (CHUNK_BYTES,))])
"""Bytes as they arrived: ``rx_ns`` is host monotonic time."""

_MOST_LOST = int(np.iinfo(np.int32).max)
COLLECT_S = 0.01  # 2 kB of a line of 2 Mbaud; longer, and the least delay is met too seldom (tests/soak/sync_study.py)
SILENT_S = 0.5  # a running IMU sends hundreds of samples a second


class SerialImu(DeviceThread):
    """Driver (base.Driver) of one IMU. ``samples`` is a ring of IMU_SAMPLE, ``chunks`` one of IMU_CHUNK."""

    def __init__(
        self,
        settings: ImuSettings,
        samples: Ring,
        chunks: Ring | None = None,
        open_port: Callable[[str, int], Port] = SerialPort,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        if samples.dtype != IMU_SAMPLE or (chunks is not None and chunks.dtype != IMU_CHUNK):
            raise ValueError("the rings of a serial IMU hold IMU_SAMPLE and IMU_CHUNK")
        super().__init__(settings.name)
        self.settings = settings
        self._samples, self._chunks = samples, chunks
        self._open, self._now = open_port, clock
        self._protocol = protocol(settings)
        self._splitter = FrameSplitter(self._protocol.framing)
        self._status_word = 0
        self._counts = {"unplugged": 0, "silent": 0, "malformed_frames": 0, "other_frames": 0}

    def take(self, chunk: bytes, rx_ns: int) -> int:
        """Decode bytes that arrived at ``rx_ns`` into the rings; returns the number of samples."""
        self._keep(chunk, rx_ns)
        return self._publish(self._splitter.feed(chunk), rx_ns)

    def _run(self) -> None:
        failures = 0
        while not self._stop.is_set():
            try:
                port = self._connect()
            except (DriverError, OSError) as fault:
                self._become(State.SEARCHING, str(fault))
                self._pause(failures)
                failures += 1
                continue
            failures = 0
            try:
                self._read(port)
            finally:
                port.close()

    def _connect(self) -> Port:
        self._become(State.CONNECTING)
        port = self._open(self.settings.port, self.settings.baud)
        try:
            self._become(State.CONFIGURING)
            self._applied = self._protocol.configure(port)
        except BaseException:
            port.close()
            raise
        self._splitter.abandon()
        self._become_running()
        return port

    def _read(self, port: Port) -> None:
        """Until the device is gone or has been silent for too long."""
        heard = time.monotonic()
        while not self._stop.is_set():
            try:
                taken = self._take_waiting(port, READ_TIMEOUT_S)
                # A sample that was waited for has told how early it can be here. Some more may collect before the next
                # one is waited for: a thread that wakes at each of 400 a second costs three times as much.
                if taken:
                    time.sleep(COLLECT_S)
                    self._take_waiting(port, 0.0)
            except OSError:
                self._counts["unplugged"] += 1
                self._become(State.SEARCHING, f"{self.settings.name} was unplugged: plug it in again")
                return
            if taken is not None:
                heard = time.monotonic()
            elif time.monotonic() - heard > SILENT_S:
                self._counts["silent"] += 1
                self._become(State.SILENT, f"{self.settings.name} sends nothing: check its cable and power")
                return
            elif held := self._splitter.abandon():
                self._publish(held, self._now())

    def _take_waiting(self, port: Port, timeout_s: float) -> int | None:
        """Samples in what arrives; None if nothing does."""
        chunk = port.chunk(timeout_s)
        return self.take(chunk, self._now()) if chunk else None

    def _keep(self, chunk: bytes, rx_ns: int) -> None:
        if self._chunks is None:
            return
        for at in range(0, len(chunk), CHUNK_BYTES):
            part = np.frombuffer(chunk[at : at + CHUNK_BYTES], np.uint8)
            row = self._chunks.claim(1) % self._chunks.slots
            self._chunks.field["rx_ns"][row] = rx_ns
            self._chunks.field["size"][row] = len(part)
            self._chunks.field["data"][row, : len(part)] = part
            self._chunks.publish(1)

    def _publish(self, frames: list[bytes], rx_ns: int) -> int:
        rows = []
        for frame in frames:
            try:
                sample = self._protocol.sample(frame)
            except MalformedError:
                self._counts["malformed_frames"] += 1
                continue
            if sample is None:
                self._counts["other_frames"] += 1
            elif (row := self._row(sample, rx_ns)) is not None:
                rows.append(row)
        self._samples.extend(rows)
        return len(rows)

    def _row(self, sample: Sample, rx_ns: int) -> tuple[object, ...] | None:
        """The slot of a sample, in the order of IMU_SAMPLE; None if its time is not believed."""
        reading = self._protocol.clock.read(sample.ticks, sample.counter)
        if reading is None:
            return None
        self._last_data_ns, self._status_word = rx_ns, sample.status
        since = sample.since_sync_in_ns
        return (
            rx_ns,
            reading.device_ns,
            reading.count,
            min(reading.lost, _MOST_LOST),
            reading.boot,
            sample.gyro,
            sample.accel,
            sample.status,
            sample.sync_in_count,
            reading.device_ns - since if 0 <= since <= reading.device_ns else -1,
        )

    def _counters(self) -> Mapping[str, int]:
        clock, stream = self._protocol.clock.counts, self._splitter.counts
        return {
            "samples": self._samples.published,
            "lost": clock.lost,
            "repeated": clock.repeated,
            "rejected": clock.rejected,
            "restarts": clock.restarts,
            "skipped_bytes": stream.skipped_bytes,
            "bad_checks": stream.bad_checks,
            **self._counts,
        }

    def _status(self) -> Mapping[str, str]:
        return {"status": f"{self._status_word:#010x}"}
