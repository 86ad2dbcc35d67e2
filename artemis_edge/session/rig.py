"""The virtual rig: what ``simulate`` can be told, and the sensors and the walk that follow from it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from artemis_drivers.virtual.camera import CameraSpec, VirtualCamera
from artemis_drivers.virtual.catalogue import build_world
from artemis_drivers.virtual.imu import ImuRecord, ImuSpec, measure
from artemis_drivers.virtual.lidar import Sensor
from artemis_drivers.virtual.lidars import LIDARS
from artemis_drivers.virtual.motion import Motion
from artemis_drivers.virtual.recorded_motion import Recording, along, recorded_motion
from artemis_drivers.virtual.scene import Window
from artemis_drivers.virtual.walk import Gait, path_needed_m, walk
from artemis_drivers.virtual.world import World
from msgspec import Meta, Struct
from scipy.spatial.transform import Rotation

from artemis_edge.errors import InputError
from artemis_edge.frames import F64, CameraModel
from artemis_edge.trajectory import inverse

START_NS = 1_000_000_000_000  # session time of the first frame: not 0, so that "absent" is not taken for it
FRAME_NS = 100_000_000
FRAME_S = FRAME_NS / 1e9
_AFTER_S = 0.2  # the walk goes on a little: spots and exposures reach beyond the last frame
_SAMPLED_S = 0.5  # spacing at which the length of a recorded motion is measured

# FAST-LIVO2 avia.yaml: position of the LiDAR in the axes of the Avia's own IMU, metres.
T_IMU_LIDAR = np.array([[1, 0, 0, 0.04165], [0, 1, 0, 0.02326], [0, 0, 1, -0.0284], [0, 0, 0, 1.0]])


def _camera_mount() -> F64:
    """T_lidar_cam: optical axes (z forward, y down), 6 cm below the LiDAR, half a degree off square."""
    T = np.eye(4)
    axes = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    T[:3, :3] = Rotation.from_euler("zyx", [0.5, 0.8, -0.4], degrees=True).as_matrix() @ axes
    T[:3, 3] = 0.03, -0.01, -0.06
    return T


T_LIDAR_CAM = _camera_mount()


_Noise = Annotated[float, Meta(ge=0)]


class Settings(Struct, frozen=True, forbid_unknown_fields=True):
    """What ``--set key=value`` can change."""

    density: Annotated[float, Meta(gt=0, le=1, description="Share of the LiDAR's points that are kept.")] = (
        1.0
    )
    returns: Annotated[
        Annotated[int, Meta(ge=1, le=3)] | None,
        Meta(description="Returns a beam (default: the sensor's own, 1)."),
    ] = None
    range_noise_m: Annotated[
        _Noise | None, Meta(description="Range noise, 1 sigma (default: the sensor's own).")
    ] = None
    angular_noise_deg: Annotated[
        _Noise | None, Meta(description="Direction noise, 1 sigma (default: the sensor's own).")
    ] = None
    camera: Annotated[bool, Meta(description="Write photographs.")] = True
    camera_every: Annotated[int, Meta(ge=1, description="A photograph every so many LiDAR frames.")] = 1
    image_width: Annotated[int, Meta(ge=64, le=4096, description="Pixels; the height is 0.8 of it.")] = 1280
    image_output: Annotated[
        Literal["jpeg", "bayer"], Meta(description="jpeg, or bayer: the mosaic, linear, 8 bits.")
    ] = "jpeg"
    jpeg_quality: Annotated[int, Meta(ge=1, le=100, description="JPEG quality.")] = 92
    image_noise: Annotated[float, Meta(ge=0, description="Factor on the camera's noise.")] = 1.0
    imu: Annotated[bool, Meta(description="Write IMU samples.")] = True
    imu_noise: Annotated[float, Meta(ge=0, description="Factor on all noise and bias of the IMU.")] = 1.0
    speed: Annotated[float, Meta(gt=0, le=3, description="Walking speed, m/s.")] = 1.2
    motion: Annotated[
        str, Meta(description="POSES.tum,IMU.txt: recorded motion that drives the rig along the path.")
    ] = ""
    length: Annotated[float, Meta(ge=0, description="Length of path, m; 0: as the walk needs.")] = 0.0
    reach_m: Annotated[
        float, Meta(ge=20, le=450, description="How far along x the world is built around the rig.")
    ] = 160.0
    mesh: Annotated[bool, Meta(description="Write truth/mesh.ply.")] = True
    reference: Annotated[
        bool | None, Meta(description="Write truth/reference.ply (default: walks up to 300 s).")
    ] = None
    reference_spacing_m: Annotated[float, Meta(gt=0, description="Spacing of the reference's points.")] = 0.02
    point_truth: Annotated[
        bool | None, Meta(description="Write truth/points.mcap (default: walks up to 300 s).")
    ] = None
    truth_images: Annotated[int, Meta(ge=0, description="Number of held-out true views to write.")] = 0


@dataclass(slots=True)
class Rig:
    """Everything that moves through the world; ``world_name`` is what it was asked for by."""

    world_name: str
    world: World
    motion: Motion
    sensor: Sensor
    sensor_name: str
    imu: ImuRecord | None
    camera: CameraSpec
    settings: Settings
    seed: int
    window: Window = field(init=False)

    def __post_init__(self) -> None:
        self.window = Window(self.world, self.settings.reach_m)

    def camera_pose(self, time_s: float) -> F64:
        """T_world_cam at a time of the walk."""
        pose: F64 = self.motion.pose(time_s)[0] @ T_IMU_LIDAR @ T_LIDAR_CAM
        return pose

    def x_at(self, time_s: float) -> float:
        """Where along x the rig is."""
        return float(self.motion.position(time_s)[0])

    def new_camera(self) -> VirtualCamera:
        """A camera that has taken no photograph yet."""
        return VirtualCamera(self.camera, self.seed)

    def T_session_world(self) -> F64:
        """The session's frame is the first LiDAR frame, levelled, with its yaw."""
        T_world_lidar = self.motion.pose(0.0)[0] @ T_IMU_LIDAR
        x = T_world_lidar[:3, 0]
        yaw = np.arctan2(x[1], x[0])
        T = np.eye(4)
        T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T[:3, 3] = T_world_lidar[:3, 3]
        return inverse(T)


def camera_model(spec: CameraSpec) -> CameraModel:
    """What a session says of the camera."""
    return CameraModel(spec.width, spec.height, spec.fx, spec.fy, spec.cx, spec.cy, spec.distortion)


def read_settings(texts: dict[str, str]) -> Settings:
    """Settings of ``key=value`` texts; InputError for what cannot be set."""
    words: dict[str, Any] = {"on": True, "off": False, "yes": True, "no": False}
    values = {key: words.get(value.lower(), value) for key, value in texts.items()}
    try:
        return msgspec.convert(values, Settings, strict=False)
    except msgspec.ValidationError as error:
        known = ", ".join(Settings.__struct_fields__)
        raise InputError(f"--set of simulate: {error}; there are: {known}") from None


def texts(settings: Settings) -> dict[str, str]:
    """The settings as ``key=value`` texts."""
    return {name: str(getattr(settings, name)) for name in settings.__struct_fields__}


def build_rig(world_name: str, seed: int, seconds: float, lidar: str, s: Settings) -> Rig:
    """The rig for a walk of ``seconds``; InputError, one sentence, for what cannot be."""
    if lidar not in LIDARS:
        raise InputError(f"no virtual LiDAR named '{lidar}'; there are: {', '.join(LIDARS)}")
    if seed < 0:
        raise InputError(f"--seed {seed} is negative; give 0 or more")
    try:
        world, motion = _world_and_motion(world_name, seed, seconds, s)
    except ValueError as error:
        raise InputError(str(error)) from None
    imu = measure(motion, ImuSpec().scaled(s.imu_noise), seed, seconds) if s.imu else None
    return Rig(world_name, world, motion, _sensor(lidar, s), lidar, imu, _camera(s), s, seed)


def _world_and_motion(name: str, seed: int, seconds: float, s: Settings) -> tuple[World, Motion]:
    """ValueError for what cannot be. Without a recording, the walk begins level: it is the IMU's, and the
    LiDAR's axes are parallel to them, so that it begins level, too.
    """
    gait = Gait(speed=s.speed)
    recording = _recording(s.motion, seconds) if s.motion else None
    needed = path_needed_m(seconds + _AFTER_S, gait) if recording is None else _path_of(recording)
    if 0 < s.length < needed:
        raise InputError(
            f"a path of {s.length:g} m is too short for this walk; give length={np.ceil(needed):.0f}"
        )
    world = build_world(name, seed, max(needed, s.length))
    if recording is not None:
        return world, along(recording, world.path)
    return world, walk(world.path, seconds + _AFTER_S, seed, gait, world.looks_at)


def _recording(files: str, seconds: float) -> Recording:
    names = files.split(",")
    if len(names) != 2:
        raise InputError(f"--set motion={files}: give two files, poses and IMU samples: POSES.tum,IMU.txt")
    recording = recorded_motion(Path(names[0]), Path(names[1]))
    longest = recording.motion.duration_s - _AFTER_S
    if seconds > longest:
        raise InputError(
            f"the recorded motion lasts {longest:.1f} s; give --seconds {np.floor(longest * 10) / 10:g} or less"
        )
    return recording


def _path_of(recording: Recording) -> float:
    """Length of path that a recorded motion needs at most, metres."""
    times = np.arange(0.0, recording.motion.duration_s, _SAMPLED_S)
    steps = np.diff(recording.motion.position(times), axis=0)
    return float(np.linalg.norm(steps, axis=1).sum()) + 2.0


def _sensor(name: str, s: Settings) -> Sensor:
    angular = None if s.angular_noise_deg is None else float(np.radians(s.angular_noise_deg))
    wanted: dict[str, Any] = {
        "range_noise_m": s.range_noise_m,
        "angular_noise": angular,
        "returns": s.returns,
    }
    sensor = LIDARS[name]
    changes = {key: value for key, value in wanted.items() if value is not None}
    return replace(sensor, spec=replace(sensor.spec, **changes))


def _camera(s: Settings) -> CameraSpec:
    spec = CameraSpec(jpeg_quality=s.jpeg_quality, output=s.image_output)
    return replace(spec, sensor=replace(spec.sensor, noise=s.image_noise)).scaled(s.image_width)
