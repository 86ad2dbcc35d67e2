"""``artemis-edge replay --wire``: a session sent by virtual devices on the wire, for ``artemis-edge run``.

An Avia on UDP of the loopback address, an MTi and the trigger board on pseudo terminals, a camera in shared memory, all
driven by one clock. Until somebody has connected, and some seconds longer, the rig stands still at its start.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from artemis_drivers.camera.frames import CameraFrame
from artemis_drivers.camera.settings import SharedSettings
from artemis_drivers.camera.shared import SharedCamera
from artemis_drivers.imu_serial.settings import MtiSettings
from artemis_drivers.livox_avia.settings import AviaConfig
from artemis_drivers.trigger.messages import RunState
from artemis_drivers.trigger.settings import TriggerSettings
from artemis_drivers.virtual.wire_avia import VirtualAvia
from artemis_drivers.virtual.wire_imu import WireMti
from artemis_drivers.virtual.wire_stream import SHOTS_PER_S, Shots
from artemis_drivers.virtual.wire_trigger import WireTrigger

from artemis_edge.datasets.bag_index import IMAGES
from artemis_edge.datasets.cameras import exposure_s
from artemis_edge.datasets.clouds import point_records
from artemis_edge.errors import InputError, RunError
from artemis_edge.export.atomic import write_bytes
from artemis_edge.frames import F64, I64, CameraModel
from artemis_edge.progress import say
from artemis_edge.service import settings
from artemis_edge.service.settings import CameraEntry, ImuEntry, LidarEntry, Mount, RunConfig
from artemis_edge.session.assembly import FrameAssembler
from artemis_edge.session.feed import messages
from artemis_edge.session.messages import CameraExposure, CompressedImage, Image, Imu, PointCloud2
from artemis_edge.trajectory import quaternion_from_matrix

_WINDOW_NS = 100_000_000
_SHOTS = round(SHOTS_PER_S * _WINDOW_NS / 1e9)
_PACKET_SHOTS = 96
_PACKET_NS = round(_PACKET_SHOTS * 1e9 / SHOTS_PER_S)
_RETURNS = 3
_LEAD_S = 12.0  # clocks settle in ten
_TRIGGER_NS = 100_000_000
_READOUT_NS = 20_000_000
_NEAR_NS = 60_000_000
_EXPOSURE_NS = 4_000_000
_MOST_IMAGE_BYTES = 2_000_000


@dataclass(slots=True)
class Played:
    """What a session holds, in order of its stamps: points by window, photographs, samples."""

    start_ns: int = 0
    windows: list[PointCloud2] = field(default_factory=list)
    photos: list[tuple[int, int, CompressedImage | Image]] = field(default_factory=list)
    imu_ns: I64 = field(default_factory=lambda: np.empty(0, np.int64))
    imu: F64 = field(default_factory=lambda: np.empty((0, 6)))
    model: CameraModel | None = None
    T_lidar_cam: F64 = field(default_factory=lambda: np.eye(4))
    T_lidar_imu: F64 = field(default_factory=lambda: np.eye(4))


def read(session: Path) -> Played:
    """The primary LiDAR, the first camera and the IMU of a session; InputError if it has no clouds."""
    played, assembler = Played(), FrameAssembler()
    exposures: dict[int, int] = {}
    samples: list[tuple[int, F64]] = []
    imu_frame = lidar_frame = ""
    for sent in messages(session):
        kind = sent.ros_type
        if kind == PointCloud2.ROS_TYPE and sent.topic == assembler.rig.lidars[0]:
            played.windows.append(PointCloud2.decode(sent.data))
            lidar_frame = played.windows[-1].header.frame_id
        elif kind == Imu.ROS_TYPE and sent.topic == assembler.rig.imu:
            sample = Imu.decode(sent.data)
            imu_frame = sample.header.frame_id
            samples.append((sample.header.stamp_ns, np.concatenate([sample.gyro, sample.accel])))
        elif kind in IMAGES:
            photo = IMAGES[kind].decode(sent.data)
            played.photos.append((photo.header.stamp_ns, _EXPOSURE_NS, photo))
        elif kind == CameraExposure.ROS_TYPE:
            exposure = CameraExposure.decode(sent.data)
            if known := exposure_s(exposure):
                exposures[exposure.header.stamp_ns] = round(known * 1e9)
        else:
            assembler.take(sent)
    if not played.windows:
        raise InputError(f"{session} has no LiDAR clouds; give a session of the rig or of simulate")
    played.start_ns = played.windows[0].header.stamp_ns
    played.photos = [(at, exposures.get(at, _EXPOSURE_NS), photo) for at, _, photo in played.photos]
    if samples:
        played.imu_ns, played.imu = (
            np.array([at for at, _ in samples]),
            np.array([value for _, value in samples]),
        )
    _mounts(played, assembler, lidar_frame, imu_frame)
    return played


def _mounts(played: Played, assembler: FrameAssembler, lidar_frame: str, imu_frame: str) -> None:
    played.model = next(iter(assembler.models.values()), None)
    if played.photos:
        T = assembler.mounting(lidar_frame, played.photos[0][2].header.frame_id)
        played.T_lidar_cam = np.eye(4) if T is None else T
    if imu_frame and (T := assembler.mounting(lidar_frame, imu_frame)) is not None:
        played.T_lidar_imu = T


class WireRig:
    """The devices in ``folder``: ``rig.toml`` there is the file for ``run --config``. One of others is not replaced.

    ``begin`` starts the session ``lead_s`` after it was called; ``over`` is set when all was played.
    """

    def __init__(self, played: Played, folder: Path, ip: str = "127.0.0.1") -> None:
        self.played, self.folder = played, folder
        self.start_ns: int | None = None
        self.over = threading.Event()
        self.counts = {"photos": 0, "photos_unseen": 0}
        self._sequence = self._camera_boot_ns = 0
        self.avia = VirtualAvia(ip=ip, announce_to=ip)
        self.board = WireTrigger(
            folder / "can", on_trigger=self._trigger, on_pps=lambda _, at: self.avia.pulse(at)
        )
        self.imu = WireMti(folder / "imu", self._motion) if len(played.imu_ns) else None
        self.camera = (
            SharedCamera(folder / "cam", _MOST_IMAGE_BYTES) if played.photos and played.model else None
        )
        self._outgoing: queue.SimpleQueue[tuple[int, CameraFrame] | None] = queue.SimpleQueue()
        self._delivery = threading.Thread(target=self._deliver, name="virtual camera", daemon=True)
        self._photo_ns = np.array([at for at, _, _ in played.photos], np.int64)

    def __enter__(self) -> WireRig:
        for port in (self.folder / name for name in ("can", "imu")):
            if port.exists() and not port.is_symlink():
                raise InputError(
                    f"{port} is there and is no virtual device; choose another folder with --rig"
                )
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            _write_rig(self.folder / "rig.toml", settings.to_toml(self.config()).encode())
        except OSError as error:
            raise InputError(
                f"cannot write to {self.folder}: {error.strerror}; choose another folder with --rig"
            ) from None
        try:
            self.avia.start()
        except OSError as error:
            raise RunError(f"another virtual Avia runs here ({error.strerror}); stop that one") from None
        self.board.start()
        if self.imu is not None:
            self.imu.start()
        if self.camera is not None:
            self.camera.plug()
            self._delivery.start()
        self.avia.play(self._shots())
        return self

    def __exit__(self, *_: object) -> None:
        self.board.stop()
        if self.imu is not None:
            self.imu.stop()
        if self.camera is not None:
            self._outgoing.put(None)
            self._delivery.join()
            self.camera.unplug()
        self.avia.stop()

    @property
    def connected(self) -> bool:
        """Whether somebody listens to every device."""
        imu = self.imu is None or self.imu.device.measuring
        return (
            self.avia.counters["packets_sent"] > 0
            and imu
            and self.board.firmware.run_state == RunState.RUNNING
        )

    def begin(self, lead_s: float = _LEAD_S) -> None:
        """Walk off. The photographs of the session were taken at times of their own: triggers fall on these."""
        earliest = time.monotonic_ns() + round(lead_s * 1e9)
        every = _TRIGGER_NS if self.played.photos else _PACKET_NS
        self.start_ns = earliest + (self._phase_ns() - earliest) % every

    def _phase_ns(self) -> int:
        """The walk begins whole periods of the triggers after this time, and packets begin whole packets after it.

        A LiDAR never stops in the middle of a packet: what was shown while the rig stood still ends where the walk
        begins.
        """
        if not self.played.photos:
            return 0
        mid, exposure, _ = self.played.photos[0]
        edge = mid - self.played.start_ns - exposure // 2  # after the start
        return self.board.firmware.boot_ns - edge

    def unplug_camera(self) -> None:
        """Pull its cable, which is its power as well."""
        if self.camera is not None:
            self.camera.unplug()

    def replug_camera(self) -> None:
        """A camera that starts counts from 0, and so does its clock."""
        if self.camera is not None:
            self._sequence, self._camera_boot_ns = 0, time.monotonic_ns()
            self.camera.plug()

    def config(self) -> RunConfig:
        """Settings of ``run`` for these devices."""
        played, imu = self.played, None
        camera: tuple[CameraEntry, ...] = ()
        if self.camera is not None and played.model is not None:
            m = played.model
            entry = CameraEntry(
                SharedSettings(str(self.folder / "cam"), most_bytes=_MOST_IMAGE_BYTES),
                m.fx, m.fy, m.cx, m.cy, m.width, m.height, m.distortion, _mount(played.T_lidar_cam),
            )  # fmt: skip
            camera = (entry,)
        if self.imu is not None:
            imu = ImuEntry(MtiSettings(str(self.folder / "imu")), _mount(played.T_lidar_imu))
        service = settings.ServiceSettings(
            sessions=str(self.folder / "sessions"), socket=str(self.folder / "control")
        )
        trigger = TriggerSettings("slcan", str(self.folder / "can"))
        lidar = LidarEntry(avia=AviaConfig(broadcast_code=self.avia.code))
        return RunConfig((lidar,), imu, camera, trigger, imu is None, service=service)

    def _shots(self) -> Iterator[Shots]:
        """The first window again and again, then all of them."""
        still, at = _placed(self.played.windows[0]), time.monotonic_ns()
        at -= (at - self._phase_ns()) % _PACKET_NS
        while self.start_ns is None or self.start_ns - at > _WINDOW_NS:
            yield Shots(at, *still)
            at += _WINDOW_NS
        left = (self.start_ns - at) // _PACKET_NS * _PACKET_SHOTS
        if left > 0:
            yield Shots(at, *(part[:left] for part in still))
        for window in self.played.windows:
            since = window.header.stamp_ns - self.played.start_ns
            yield Shots(self.start_ns + since, *_placed(window))
        self.over.set()

    def _motion(self, truth_ns: int) -> tuple[Any, Any]:
        """Samples in between are interpolated."""
        start = self.start_ns
        stamp = self.played.start_ns if start is None else truth_ns - start + self.played.start_ns
        at, values = self.played.imu_ns, self.played.imu
        right = int(np.clip(np.searchsorted(at, stamp), 1, len(at) - 1)) if len(at) > 1 else 0
        left = max(right - 1, 0)
        span = int(at[right] - at[left])
        share = float(np.clip((stamp - int(at[left])) / span, 0.0, 1.0)) if span else 0.0
        value = (1 - share) * values[left] + share * values[right]
        return value[:3].tolist(), value[3:].tolist()

    def _trigger(self, count: int, truth_ns: int) -> None:
        """An edge at the camera: the photograph of that time arrives after exposure and readout."""
        if self.camera is None:
            return
        photo = self._photo_at(truth_ns)
        if photo is None:
            self._sequence += 1  # it takes a picture that the session does not have
            self.counts["photos_unseen"] += 1
            return
        exposure, frame = photo
        self._outgoing.put((truth_ns + exposure + _READOUT_NS, frame))

    def _photo_at(self, edge_ns: int) -> tuple[int, CameraFrame] | None:
        start = self.start_ns
        stamp = self.played.start_ns if start is None else edge_ns - start + self.played.start_ns
        nearest = int(np.argmin(np.abs(self._photo_ns - stamp)))
        if start is not None and edge_ns > start and abs(int(self._photo_ns[nearest]) - stamp) > _NEAR_NS:
            return None
        _, exposure, message = self.played.photos[nearest]
        model = self.played.model
        assert model is not None
        encoding = message.format if isinstance(message, CompressedImage) else message.encoding
        frame = CameraFrame(
            self._sequence,
            edge_ns + exposure - self._camera_boot_ns,
            exposure,
            model.width,
            model.height,
            encoding,
            bytes(message.data),
        )
        self._sequence += 1
        return exposure, frame

    def _deliver(self) -> None:
        """One photograph after the other, each when it is read out."""
        while (waiting := self._outgoing.get()) is not None:
            due_ns, frame = waiting
            time.sleep(max(0.0, (due_ns - time.monotonic_ns()) * 1e-9))
            if self.camera is not None and self.camera.put(frame):
                self.counts["photos"] += 1


def _write_rig(path: Path, content: bytes) -> None:
    """The file for ``run``, which says what it held when it was written: one that somebody changed is not replaced."""
    if path.exists():
        first, _, rest = path.read_bytes().partition(b"\n")
        if first != _signed(rest):
            raise InputError(
                f"{path} was not written by replay --wire, or was changed since; choose another folder with --rig"
            )
    write_bytes(path, _signed(content) + b"\n" + content)


def _signed(content: bytes) -> bytes:
    return (
        f"# by replay --wire, which replaces it unless it was changed: {sha256(content).hexdigest()}".encode()
    )


def _placed(window: PointCloud2) -> tuple[Any, Any, Any]:
    """Points of a window at the shots that made them: xyz (n, returns, 3), reflectivity, tag (n, returns)."""
    points = point_records(window)
    full = np.frombuffer(window.data, _layout(window))
    shot = np.minimum(np.rint(full["t"] * (SHOTS_PER_S / 1e9)).astype(np.int64), _SHOTS - 1)
    order = np.argsort(shot, kind="stable")
    shot, points, full = shot[order], points[order], full[order]
    first = np.searchsorted(shot, shot)
    rank = np.arange(len(shot)) - first
    keep = rank < _RETURNS
    shot, rank, points, full = shot[keep], rank[keep], points[keep], full[keep]
    xyz = np.zeros((_SHOTS, _RETURNS, 3), np.float32)
    reflectivity, tag = np.zeros((_SHOTS, _RETURNS), np.uint8), np.zeros((_SHOTS, _RETURNS), np.uint8)
    for axis, name in enumerate("xyz"):
        xyz[shot, rank, axis] = points[name]
    reflectivity[shot, rank] = np.rint(np.clip(full["intensity"], 0, 1) * 255)
    tag[shot, rank] = full["tag"]
    return xyz, reflectivity, tag


def _layout(window: PointCloud2) -> Any:
    """The whole of a point of our own sessions."""
    from artemis_edge.session.writer import POINT

    if window.point_step != POINT.itemsize:
        raise InputError("its clouds are not those of a session of this program")
    return POINT


def _mount(T_lidar_sensor: F64) -> Mount:
    x, y, z = T_lidar_sensor[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_from_matrix(T_lidar_sensor).tolist()
    return Mount((x, y, z), (qx, qy, qz, qw))


def play(session: Path, folder: Path, lead_s: float = _LEAD_S, patience_s: float = 600.0) -> int:
    """Play a session to whoever connects; returns an exit code. Raises UserError."""
    with WireRig(read(session), folder) as rig:
        say(
            f"virtual devices are ready; in other terminals: artemis-edge run --config {folder / 'rig.toml'}, and "
            f"artemis-edge tui --socket {folder / 'control'}"
        )
        end = time.monotonic() + patience_s
        while not rig.connected:
            if time.monotonic() > end:
                raise RunError(f"nobody connected within {patience_s:g} s")
            time.sleep(0.1)
        say(f"connected; the walk begins in {lead_s:g} s")
        rig.begin(lead_s)
        rig.over.wait()
        time.sleep(1.0)
        say(f"played: {dict(rig.avia.counters)}, {rig.counts}")
    return 0
