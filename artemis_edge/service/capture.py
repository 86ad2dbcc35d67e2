"""From what the drivers deliver to the messages of a session: dated, cut into windows, in order.

One thread, a few milliseconds of work every 25. The cloud of a window goes out after what belongs to it has: the
samples and the photographs of its time, for which it waits a little. Whoever assembles frames relies on that.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from artemis_drivers.base import Health, State
from artemis_drivers.camera.driver import Camera
from artemis_drivers.camera.frames import CameraFrame, take
from artemis_drivers.livox_host import LivoxLidar
from artemis_drivers.packing import joined_bytes
from artemis_drivers.ring import RingReader
from artemis_drivers.trigger.events import Kind
from artemis_drivers.trigger.messages import Opcode
from numpy.typing import NDArray

from artemis_edge import topics
from artemis_edge.frame_pairing import CameraTiming, FrameStamp
from artemis_edge.service.host_pulse import HostPulse
from artemis_edge.service.outlet import Outlet, camera_prefixes, lidar_frame, lidar_topic
from artemis_edge.service.rig import Rig
from artemis_edge.service.scans import WINDOW_NS, ScanCutter
from artemis_edge.service.watch import DeviceWatch
from artemis_edge.session.messages import CameraExposure, CompressedImage, Header, Image, Imu, ImuTemplate
from artemis_edge.session.writer import structured_cloud
from artemis_edge.session_clocks import epoch_of
from artemis_edge.sync import BoardEvent, ImageTime, Synchroniser

_TURN_S = 0.03  # devices date what they hear themselves; a turn costs as much for one sample as for ten
_SECOND_NS = 1_000_000_000
_RAW_EVERY_NS = 100_000_000
_IMAGE_PATIENCE_NS = 150_000_000  # after the end of a window
_SAMPLE_PATIENCE_NS = 30_000_000
_GAP_NS = 500_000_000  # a LiDAR behind by more is not waited for
_LISTEN_S = 0.3
_STILL_S = 0.3  # photographs that were on their way when the triggers stopped have arrived then
# The Avia takes the time of a pulse 10 to 500 ms after it (user manual); the message of a pulse takes some ms.
_NAMED_AFTER_NS, _NAMED_WITHIN_NS = 50_000_000, 400_000_000
_ARM_AFTER_S = 5.0  # for cameras that do not come
_HELD = 32  # photographs that wait for their time
_STEPS = {"mono8": 1, "bgr8": 3, "rgb8": 3, "bayer_rggb8": 1}
_FILES = ("jpeg", "png")


def warm_up(lidars: Sequence[LivoxLidar]) -> None:
    """Have the kernels compiled that take in what these deliver."""
    for lidar in lidars:
        lidar.decoder.warm_up()
        ScanCutter(lidar).cut(0)
    joined_bytes({"size": np.empty(0), "data": np.empty((0, 1))})


class Capture:
    """The thread. ``sync`` is None until the first pulse; ``turn_s`` is when the last turn was, for the watchdog."""

    def __init__(self, rig: Rig, outlet: Outlet) -> None:
        self.rig, self.outlet = rig, outlet
        self.sync: Synchroniser | None = None
        self.watch = DeviceWatch()
        self.lost: Counter[str] = Counter()
        self.windows = 0
        self.turn_s = time.monotonic()
        self.buttons: list[int] = []
        self.fault: BaseException | None = None
        config = rig.config
        warm_up(rig.livox.lidars)
        self._cutters = [ScanCutter(lidar) for lidar in rig.livox.lidars]
        self._imu = RingReader(rig.imu_samples) if rig.imu_samples is not None else None
        self._events = RingReader(rig.events) if rig.events is not None else None
        self._host_pulse = HostPulse() if rig.board is None else None
        self._cameras = [
            _CameraFeed(camera, prefix, entry.time_offset_us * 1000)
            for camera, prefix, entry in zip(rig.cameras, camera_prefixes(config), config.camera, strict=True)
        ]
        self._raw = _RawFeeds(rig, outlet)
        self._imu_bytes, self._lidar_imu_bytes = ImuTemplate("imu"), ImuTemplate("lidar_imu")
        self._window_ns: int | None = None
        self._imu_latest_ns = 0
        self._lost_before: Counter[str] = Counter()
        self._started_s = self._synced_s = self._health_s = 0.0
        self._restarts, self._pulse_boot = 0, -1
        self._still_s: float | None = None  # since when triggers are stopped
        self._unnamed: tuple[int, int] | None = None  # when a pulse was heard of, and its time
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin; the drivers run."""
        self._started_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End after what has arrived was sent."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def health(self) -> list[Health]:
        """Every device."""
        return self.watch.latest

    def clocks(self) -> list[dict[str, Any]]:
        """The measures of all clocks."""
        if self.sync is None:
            return [
                {"name": "board", "state": "unknown", "message": "no pulse per second has been heard yet"}
            ]
        reports = self.sync.report(time.monotonic_ns())
        return [
            {
                "name": r.name,
                "state": str(r.state),
                "skew_ppm": round(r.skew_ppm, 3),
                "offset_ns": r.offset_ns,
                "doubt_ns": r.doubt_ns,
                "events": r.events,
                "message": r.message,
            }
            for r in reports
        ]

    def counts(self) -> dict[str, dict[str, int]]:
        """Of the cameras: paired, lost ..."""
        return {} if self.sync is None else self.sync.counts()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                time.sleep(_TURN_S)  # to wait for the event with a limit costs three times as much
                self._turn()
            self._turn()
        except BaseException as fault:
            self.fault = fault
            raise

    def _turn(self) -> None:
        self.turn_s = time.monotonic()
        now = time.monotonic_ns()
        self._board(now)
        self._name_pulse(now)
        self._arm()
        for cutter in self._cutters:
            cutter.read(self.sync)
        self._serial_imu()
        self._lidar_imu()
        self._photographs(now)
        self._cut(now)
        self._raw.turn(now)
        self._look(now)

    # --- the board and the pulse ---

    def _board(self, now: int) -> None:
        if self._host_pulse is not None:
            for event in self._host_pulse.due(now):
                self._event(event)
            return
        assert self._events is not None
        _, rows = self._events.read()
        names = BoardEvent.__dataclass_fields__
        for row in zip(*(rows[name].tolist() for name in names), strict=True):
            self._event(BoardEvent(*row))

    def _event(self, event: BoardEvent) -> None:
        if event.kind == Kind.BUTTON:
            self.outlet.say(
                topics.EVENTS.name, {"kind": "button", "button": event.count, "down": event.flags}
            )
            if event.flags:
                self.buttons.append(event.count)
            return
        if self.sync is None:
            if event.kind != Kind.PPS:
                self.lost["events_before_pulse"] += 1
                return
            self.sync = self._synchroniser(event)
            self._synced_s = time.monotonic()
        self._dated(self.sync.board_event(event))
        if event.kind == Kind.PPS:
            self._pulse_boot = event.boot
            if self._host_pulse is None:
                self._unnamed = (event.rx_ns, self.sync.utc_of_pulse(event.count))

    def _name_pulse(self, now: int) -> None:
        """Tell the LiDARs the time of the latest pulse: not too soon and not too late after it, or not at all."""
        if self._unnamed is None or now - self._unnamed[0] < _NAMED_AFTER_NS:
            return
        (heard_ns, utc_ns), self._unnamed = self._unnamed, None
        if now - heard_ns > _NAMED_WITHIN_NS:
            self.lost["pulses_not_named"] += 1
            return
        for lidar in self.rig.livox.lidars:
            lidar.send_utc(utc_ns)

    def _synchroniser(self, event: BoardEvent) -> Synchroniser:
        config = self.rig.config
        timing = {
            entry.device.name: CameraTiming(
                entry.delay_us * 1000,
                None if entry.latency_us is None else entry.latency_us * 1000,
                entry.strobe,
            )
            for entry in config.camera
        }
        latency = {} if config.imu is None else {config.imu.device.name: config.imu.latency_us * 1000}
        epoch = epoch_of(event.count, event.rx_ns + self.outlet.wall_ns)
        return Synchroniser(timing, latency, epoch)

    def _arm(self) -> None:
        """Once cameras and board run, triggers are begun from 0, so that frames are counted from there.

        A board that has lost its power stands still when it is back: then once more.
        """
        board = self.rig.board
        if board is None or (health := board.health()[0]).state != State.RUNNING:
            return
        if self.rig.armed and health.counters["board_restarts"] != self._restarts:
            self.rig.armed = False
            self._synced_s = time.monotonic()
        if self.rig.armed:
            return
        # photographs are dated by a pulse of this boot; a board that was running already has told a trigger by then
        pulse = self._pulse_boot == health.counters["board_restarts"]
        if self.sync is None or not pulse or time.monotonic() - self._synced_s < _LISTEN_S:
            return
        there = (State.RUNNING, State.SILENT)
        ready = all(camera.health()[0].state in there for camera in self.rig.cameras)
        if not ready and time.monotonic() - self._started_s < _ARM_AFTER_S:
            return
        if self._still_s is None:
            board.command(Opcode.ARM)
            self._still_s = time.monotonic()
        if time.monotonic() - self._still_s < _STILL_S:
            return
        self._still_s = None
        self.sync.arm({feed.name: feed.camera.last_sequence + 1 for feed in self._cameras})
        board.command(Opcode.RUN)
        self.rig.armed, self._restarts = True, health.counters["board_restarts"]

    # --- samples ---

    def _serial_imu(self) -> None:
        if self._imu is None or self.rig.config.imu is None:
            return
        name, offset_ns = self.rig.config.imu.device.name, self.rig.config.imu.time_offset_us * 1000
        _, rows = self._imu.read()
        columns = (rows[column].tolist() for column in ("device_ns", "boot", "rx_ns", "gyro", "accel"))
        for device_ns, boot, rx_ns, gyro, accel in zip(*columns, strict=True):
            dated = None if self.sync is None else self.sync.imu(name, device_ns, boot, rx_ns)
            if dated is None:
                self.lost["imu_undated"] += 1
                continue
            stamp_ns = self._imu_latest_ns = dated.stamp_ns + offset_ns
            data = self._imu_bytes.encode(stamp_ns, gyro, accel)
            self.outlet.send_encoded(topics.IMU.name, Imu.ROS_TYPE, data, stamp_ns, rx_ns)

    def _lidar_imu(self) -> None:
        for number, cutter in enumerate(self._cutters):
            samples = cutter.read_imu()
            if number or not self.rig.config.lidar_imu:
                continue
            for stamp_ns, rx_ns, gyro, accel in samples:
                if self._imu is None:
                    self._imu_latest_ns = stamp_ns
                data = self._lidar_imu_bytes.encode(stamp_ns, gyro, accel)
                self.outlet.send_encoded(topics.LIDAR_IMU.name, Imu.ROS_TYPE, data, stamp_ns, rx_ns)

    # --- photographs ---

    def _photographs(self, now: int) -> None:
        for feed in self._cameras:
            for rx_ns, frame in feed.arrived():
                if self.sync is None:
                    self.lost["images_undated"] += 1
                elif self._host_pulse is not None:
                    self._untriggered(feed, rx_ns, frame)
                else:
                    feed.hold(rx_ns, frame)
                    stamp = FrameStamp(frame.sequence, frame.device_ns, frame.exposure_ns, rx_ns)
                    self._dated(self.sync.image(feed.name, stamp))
        if self.sync is not None:
            self._dated(self.sync.advance(now))

    def _untriggered(self, feed: _CameraFeed, rx_ns: int, frame: CameraFrame) -> None:
        """Without a board the time of a photograph is that of its arrival, less what is known of its way."""
        assert self.sync is not None
        entry = next(e for e in self.rig.config.camera if e.device.name == feed.name)
        latency = (entry.latency_us or 0) * 1000
        stamp = self.sync.session_of_host(rx_ns - latency - frame.exposure_ns // 2)
        if stamp is not None:
            self._publish(feed, stamp, rx_ns, frame)

    def _dated(self, images: list[ImageTime]) -> None:
        for image in images:
            feed = next(f for f in self._cameras if f.name == image.camera)
            stamp = image.pair.frame
            held = feed.release(stamp.sequence)
            if held is None:
                self.lost["images_overwritten"] += 1
                continue
            about = {
                "camera": image.camera,
                "sequence": stamp.sequence,
                "device_ns": stamp.device_ns,
                "exposure_ns": stamp.exposure_ns,
                "rx_ns": stamp.rx_ns,
                "trigger": image.pair.count,
                "edge_ns": image.pair.edge_ns,
                "stamp_ns": image.stamp_ns,
                "state": str(image.state),
            }
            self.outlet.say(topics.CAMERA_STAMP.name, about, held[0])
            self._publish(feed, image.stamp_ns, *held)

    def _publish(self, feed: _CameraFeed, stamp_ns: int, rx_ns: int, frame: CameraFrame) -> None:
        stamp_ns += feed.offset_ns
        feed.latest_ns = max(feed.latest_ns, stamp_ns)
        header = Header(stamp_ns, feed.name)
        exposure = CameraExposure(header, frame.exposure_ns / _SECOND_NS, frame.gain)
        self.outlet.send(f"{feed.prefix}/exposure", exposure, stamp_ns, rx_ns)
        if frame.encoding in _FILES:
            photo = CompressedImage(header, frame.encoding, frame.data)
            self.outlet.send(f"{feed.prefix}/image/compressed", photo, stamp_ns, rx_ns)
        else:
            step = frame.width * _STEPS[frame.encoding]
            raw = Image(header, frame.height, frame.width, frame.encoding, step, frame.data)
            self.outlet.send(f"{feed.prefix}/image", raw, stamp_ns, rx_ns)

    # --- windows ---

    def _cut(self, now: int) -> None:
        if self.sync is None:
            return
        here = self.sync.session_of_host(now)
        latest = max((cutter.latest_ns for cutter in self._cutters), default=0)
        if here is None or latest == 0:
            return
        if self._window_ns is None or latest - self._window_ns > _SECOND_NS * 3 or latest < self._window_ns:
            self._window_ns = latest // WINDOW_NS * WINDOW_NS
        while self._complete(self._window_ns, here, latest):
            self._send_window(self._window_ns)
            self._window_ns += WINDOW_NS

    def _complete(self, start: int, here: int, latest: int) -> bool:
        """Whether everything of a window is here, or has been waited for long enough."""
        end = start + WINDOW_NS
        if latest < end:
            return False
        late = here - end
        if any(end > c.latest_ns > end - _GAP_NS for c in self._cutters) and late < _GAP_NS:
            return False
        if self._imu_latest_ns < end and late < _SAMPLE_PATIENCE_NS and self._imu_latest_ns:
            return False
        return late > _IMAGE_PATIENCE_NS or all(
            feed.complete(end, self._period_ns()) for feed in self._cameras
        )

    def _period_ns(self) -> int:
        """Between two photographs."""
        if self.sync is None or self._host_pulse is not None:
            return WINDOW_NS
        return self.sync.history.period_ns() or WINDOW_NS

    def _send_window(self, start: int) -> None:
        clouds = [cutter.cut(start) for cutter in self._cutters]
        self.windows += 1
        if not self.outlet.is_open:
            self._lost_before = self._losses()
            return
        losses = self._losses()
        lost = {name: count for name, count in (losses - self._lost_before).items() if count}
        self._lost_before = losses
        if lost:
            self.outlet.say(topics.LOST.name, lost)
        for number in reversed(range(len(clouds))):  # the primary last: it completes the frame
            if number == 0 or len(clouds[number]):
                self._send_cloud(number, start, clouds[number])

    def _send_cloud(self, number: int, start: int, cloud: NDArray[np.void]) -> None:
        message = structured_cloud(start, cloud, lidar_frame(self.rig.config, number))
        self.outlet.send(lidar_topic(number), message, start)

    def _losses(self) -> Counter[str]:
        """What devices and this thread have lost so far."""
        total = Counter(self.lost)
        for health in self.watch.latest:
            for name in ("points_lost", "imu_lost", "kernel_drops", "lost", "triggers_lost", "missing"):
                if count := health.counters.get(name, 0):
                    total[f"{health.name}_{name}"] += count
        for cutter in self._cutters:
            total[f"{cutter.name}_overwritten"] += cutter.overwritten
        return total

    # --- once in a while ---

    def _look(self, now: int) -> None:
        second = time.monotonic()
        if second - self._health_s < 0.1:
            return
        whole = int(second) != int(self._health_s)
        self._health_s = second
        for event in self.watch.look(self.rig.health(), now):
            self.outlet.say(topics.EVENTS.name, event)
        if whole:
            self.outlet.say(topics.CLOCKS.name, self.clocks())
            devices = [_brief(health) for health in self.watch.latest]
            self.outlet.say(
                topics.HEALTH.name, {"devices": devices, "pairing": self.counts(), "lost": self.lost}
            )


def _brief(health: Health) -> dict[str, Any]:
    return {
        "name": health.name,
        "state": str(health.state),
        "message": health.message,
        "counters": dict(health.counters),
        "status": dict(health.status),
    }


class _CameraFeed:
    """The photographs of one camera that wait for their time."""

    def __init__(self, camera: Camera, prefix: str, offset_ns: int) -> None:
        self.camera, self.prefix, self.name = camera, prefix, camera.settings.name
        self.offset_ns = offset_ns
        self.latest_ns = 0
        self._next = camera.frames.published
        self._held: dict[int, tuple[int, CameraFrame]] = {}

    def arrived(self) -> list[tuple[int, CameraFrame]]:
        """Host time and photograph of each that is new."""
        ring = self.camera.frames
        self._next = max(self._next, ring.oldest())
        found = []
        while self._next < ring.published:
            frame = take(ring, self._next)
            self._next += 1
            if frame is not None:
                found.append(frame)
        return found

    def hold(self, rx_ns: int, frame: CameraFrame) -> None:
        """Keep it until its trigger is known."""
        self._held[frame.sequence] = (rx_ns, frame)
        while len(self._held) > _HELD:
            del self._held[next(iter(self._held))]

    def release(self, sequence: int) -> tuple[int, CameraFrame] | None:
        """Host time and photograph."""
        return self._held.pop(sequence, None)

    def complete(self, end_ns: int, period_ns: int) -> bool:
        """Whether no more photograph from before ``end_ns`` is expected."""
        return self.camera.health()[0].state != State.RUNNING or self.latest_ns + period_ns > end_ns


class _RawFeeds:
    """What devices sent, byte for byte, ten times a second."""

    def __init__(self, rig: Rig, outlet: Outlet) -> None:
        self._outlet, self._on = outlet, rig.config.service.raw_packets
        self._due = 0
        self._lidars = [(lidar.name, RingReader(lidar.packets)) for lidar in rig.livox.lidars]
        self._imu = RingReader(rig.imu_chunks) if rig.imu_chunks is not None else None
        self._can = RingReader(rig.frames) if rig.frames is not None else None
        self._imu_name = "" if rig.config.imu is None else rig.config.imu.device.name
        self._can_name = "" if rig.config.trigger is None else rig.config.trigger.name

    def turn(self, now: int) -> None:
        """Send what has come, if it is time."""
        if now < self._due:
            return
        self._due = now + _RAW_EVERY_NS
        for number, (name, reader) in enumerate(self._lidars):
            topic = topics.LIDAR_PACKETS.name if number == 0 else f"/lidar_{number}/packets"
            self._send(topic, name, reader)
        if self._imu is not None:
            self._send(topics.IMU_BYTES.name, self._imu_name, self._imu)
        if self._can is not None:
            self._send(topics.CAN_FRAMES.name, self._can_name, self._can)

    def _send(self, topic: str, name: str, reader: RingReader) -> None:
        if not (self._on and self._outlet.is_open):
            reader.next = reader.ring.published
            return
        _, rows = reader.read()
        ids = rows["id"] if "id" in rows else np.zeros(len(rows["rx_ns"]), np.uint32)
        self._outlet.raw(topic, name, rows["rx_ns"], ids, rows["size"], joined_bytes(rows))
