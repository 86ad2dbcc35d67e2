"""The file of ``artemis-edge run --config FILE``: the devices of the rig, how they are mounted, and the service."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import tomli_w
from artemis_drivers.camera.settings import CameraSettings
from artemis_drivers.imu_serial.settings import ImuSettings
from artemis_drivers.livox_avia.settings import AviaConfig
from artemis_drivers.livox_mid360.settings import Mid360Config
from artemis_drivers.trigger.settings import TriggerSettings
from msgspec import Meta, Struct

from artemis_edge.config import Config, read_toml, without_none
from artemis_edge.devices.calibration import Matrix
from artemis_edge.devices.rig_file import RigFile, load_rig
from artemis_edge.errors import InputError
from artemis_edge.frames import F64, CameraModel
from artemis_edge.trajectory import inverse, matrix_from_quaternion, quaternion_from_matrix

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Mount(Struct, frozen=True, forbid_unknown_fields=True):
    """Where a sensor sits: maps its coordinates to those of what it is mounted to."""

    translation_m: Triple = (0.0, 0.0, 0.0)
    quaternion: Annotated[Quaternion, Meta(description="x, y, z, w.")] = (0.0, 0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """ValueError for a quaternion that is no rotation; who reads the file names the sensor."""
        if not 0.0 < sum(q * q for q in self.quaternion) < math.inf:
            raise ValueError("the quaternion must not be zero")

    def matrix(self) -> F64:
        """T_parent_sensor (4, 4)."""
        return matrix_from_quaternion(np.array(self.translation_m), np.array(self.quaternion))


class LidarEntry(Struct, frozen=True, forbid_unknown_fields=True):
    """A LiDAR: one of the two models. The first one of the file is the primary."""

    avia: AviaConfig | None = None
    mid360: Mid360Config | None = None
    mount: Annotated[Mount, Meta(description="To the primary LiDAR (T_lidar_sensor).")] = Mount()


class ImuEntry(Struct, frozen=True, forbid_unknown_fields=True):
    """A serial IMU."""

    device: ImuSettings
    mount: Annotated[Mount, Meta(description="To the primary LiDAR (T_lidar_imu).")] = Mount()
    latency_us: Annotated[
        int, Meta(description="Least time from sampling to arrival, less that of the board's messages.")
    ] = 0
    time_offset_us: Annotated[int, Meta(description="Added to its stamps (calibrated).")] = 0


class CameraEntry(Struct, frozen=True, forbid_unknown_fields=True):
    """A camera with its calibration."""

    device: CameraSettings
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    mount: Annotated[Mount, Meta(description="To the primary LiDAR (T_lidar_cam).")] = Mount()
    delay_us: Annotated[int, Meta(description="From trigger edge to start of exposure.", ge=0)] = 0
    latency_us: Annotated[
        int | None, Meta(description="Least time from end of exposure to arrival; none: not known.")
    ] = None
    strobe: Annotated[int, Meta(description="Number of its strobe input on the board.", ge=0, le=7)] = 0
    time_offset_us: Annotated[int, Meta(description="Added to its stamps (calibrated).")] = 0

    def model(self) -> CameraModel:
        """The lens."""
        return CameraModel(self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.distortion)


class ServiceSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """Recording and control."""

    sessions: Annotated[str, Meta(description="Folder of the recordings.")] = "sessions"
    socket: Annotated[
        str, Meta(description="Control socket; empty: artemis.sock in the runtime directory.")
    ] = ""
    socket_mode: Annotated[
        str, Meta(description="Who may use it, octal file mode; its owner always.", pattern="^[67][0-7]{2}$")
    ] = "660"
    record_at_start: Annotated[bool, Meta(description="Record as soon as the devices run.")] = True
    start_patience_s: Annotated[
        float, Meta(description="After which recording begins with the devices that run.", ge=0.0, le=600.0)
    ] = 10.0
    raw_packets: Annotated[bool, Meta(description="Record what devices sent, byte for byte, as well.")] = True
    ring_mb: Annotated[float, Meta(description="Messages in memory, for a slow disk.", ge=8.0, le=4096.0)] = (
        96.0
    )
    split_mb: Annotated[int, Meta(description="Size of a file of a recording.", ge=1, le=100_000)] = 1024
    reserve_mb: Annotated[int, Meta(description="Disk that is left free.", ge=0, le=1_000_000)] = 1000
    checkpoint_s: Annotated[float, Meta(description="Between checkpoints of the map.", ge=1.0, le=30.0)] = (
        20.0
    )
    mapping: Annotated[bool, Meta(description="Map while recording.")] = True
    overload: Annotated[
        bool,
        Meta(description="Map less, in a fixed order, when the mapping is behind or the machine too warm."),
    ] = True
    hot_c: Annotated[float, Meta(description="Too warm: from here on less is mapped.", ge=40.0, le=120.0)] = (
        80.0
    )
    low_battery_percent: Annotated[
        float, Meta(description="Battery from which on less is mapped.", ge=0.0, le=100.0)
    ] = 15.0
    questions: Annotated[
        bool,
        Meta(description="Take questions while recording: the map has classes, a network looks for them."),
    ] = True


class RunConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    lidar: tuple[LidarEntry, ...] = (LidarEntry(avia=AviaConfig()),)
    imu: ImuEntry | None = None
    camera: tuple[CameraEntry, ...] = ()
    trigger: TriggerSettings | None = None
    lidar_imu: Annotated[
        bool, Meta(description="Use the LiDAR's own IMU where there is no other; mounted as lidar_imu_mount.")
    ] = True
    lidar_imu_mount: Mount = Mount()
    service: ServiceSettings = ServiceSettings()
    mapping: Config = Config()


def load(file: Path | str | None) -> RunConfig:
    """The settings in a file, those of a bare Avia without one; InputError naming the field.

    A rig profile (devices/rig_file.py), or all in one file, as every recording has it attached as ``run.toml``.
    """
    if file is None:
        return RunConfig()
    tree = read_toml(Path(file)) if Path(file).is_file() else {}
    where = str(file)
    if not any(isinstance(entry, dict) for entry in tree.get("lidar", [])):
        return _of_rig(load_rig(file), where)
    config: RunConfig = _convert(tree, RunConfig, where)
    _require_sense(config, where)
    return config


def _of_rig(rig: RigFile, where: str) -> RunConfig:
    calibration = rig.calibration
    imu_offset, T_lidar_imu = round(calibration.imu_time_offset_s * 1e6), _mount(calibration.T_imu_lidar)
    cameras = []
    for device in rig.cameras:
        c = calibration.cameras[device.name]
        delay = round(getattr(device, "trigger_delay_us", 0.0))
        offset = round(c.time_offset_s * 1e6)
        entry = CameraEntry(
            device, c.fx, c.fy, c.cx, c.cy, c.width, c.height, c.distortion, _mount(c.T_cam_lidar), delay,
            time_offset_us=offset,
        )  # fmt: skip
        cameras.append(entry)
    lidars = tuple(
        LidarEntry(avia=device) if isinstance(device, AviaConfig) else LidarEntry(mid360=device)
        for device in rig.lidars
    )
    imu = None if rig.imu is None else ImuEntry(rig.imu, T_lidar_imu, time_offset_us=imu_offset)
    service: ServiceSettings = _convert(rig.service, ServiceSettings, f"{where}: [service]")
    mapping: Config = _convert(rig.mapping, Config, f"{where}: [mapping]")
    config = RunConfig(
        lidars,
        imu,
        tuple(cameras),
        rig.trigger,
        True,
        T_lidar_imu if imu is None else Mount(),
        service,
        mapping,
    )
    _require_sense(config, where)
    return config


def _mount(T_sensor_lidar: Matrix) -> Mount:
    """The calibration maps LiDAR coordinates to the sensor's."""
    T = inverse(np.array(T_sensor_lidar, np.float64))
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_from_matrix(T).tolist()
    return Mount((x, y, z), (qx, qy, qz, qw))


def _convert(tree: dict[str, Any], kind: type[Any], where: str) -> Any:
    try:
        return msgspec.convert(tree, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: {error}; docs/hardware.md tells what the file may hold") from None


def to_toml(config: RunConfig) -> str:
    """The effective settings."""
    return tomli_w.dumps(without_none(msgspec.to_builtins(config)))


def _require_sense(config: RunConfig, file: str) -> None:
    for number, entry in enumerate(config.lidar):
        if (entry.avia is None) == (entry.mid360 is None):
            raise InputError(f"{file}: lidar[{number}] must have either avia or mid360")
    names = [device_name(entry) for entry in config.lidar] + [camera.device.name for camera in config.camera]
    names += [config.imu.device.name] if config.imu is not None else []
    names += [config.trigger.name] if config.trigger is not None else []
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{file}: {names.count(name)} devices are named {name}; give each its own name")
    if not config.lidar:
        raise InputError(f"{file}: there is no LiDAR; add a [[lidar]]")


def device_name(entry: LidarEntry) -> str:
    """The name of a LiDAR."""
    device = entry.avia or entry.mid360
    return "" if device is None else device.name
