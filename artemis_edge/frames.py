"""The data that flows through the pipeline, and the frames it is expressed in.

``T_target_source`` maps coordinates of ``source`` to ``target`` as a float64 4 x 4 matrix. ``lidar`` is the
primary LiDAR, ``sensor`` any LiDAR of the rig, ``world`` the frame of the map. Lengths are metres, times
int64 nanoseconds of session time or float seconds relative to a stamp.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
U32 = NDArray[np.uint32]
U8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]


def identity() -> F64:
    """A fresh 4 x 4 identity transform."""
    return np.eye(4)


@dataclass(frozen=True, slots=True)
class LidarScan:
    """One window of one LiDAR, as measured: not yet corrected for the motion of the sensor.

    ``points`` float32 (n, 3) in the sensor's frame; ``offset_s`` float32 (n,) time of each point relative to
    ``stamp_ns`` (None: all points are at the stamp, e.g. already motion-corrected); ``intensity`` float32 (n,)
    0..1 or None; ``T_lidar_sensor`` the mounting.
    """

    points: F32
    stamp_ns: int
    offset_s: F32 | None = None
    intensity: F32 | None = None
    T_lidar_sensor: F64 = field(default_factory=identity)
    name: str = "lidar_0"


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Pinhole with Brown-Conrady distortion (k1, k2, p1, p2, k3), the ROS ``plumb_bob`` order; pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class CameraImage:
    """One photograph: still encoded (jpeg, png), so that only a stage that looks at it pays for decoding.

    ``stamp_ns`` is the middle of the exposure. ``T_cam_lidar`` maps LiDAR to camera (z forward, y down).
    """

    name: str
    stamp_ns: int
    encoded: bytes
    model: CameraModel
    T_cam_lidar: F64
    exposure_s: float = 0.0


@dataclass(frozen=True, slots=True)
class ImuSamples:
    """Samples covering a frame: ``stamp_ns`` int64 (m,), ``gyro`` rad/s and ``accel`` m/s2 float64 (m, 3).

    They are in the axes of the lidar frame; ``origin`` (3,) is where in that frame the IMU sits, m.
    """

    stamp_ns: I64
    gyro: F64
    accel: F64
    origin: F64 = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def empty(cls) -> ImuSamples:
        """No samples (a rig without an IMU)."""
        return cls(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))


@dataclass(frozen=True, slots=True)
class SyncedFrame:
    """Everything one 100 ms window brought: LiDAR scans, IMU, images, and what was lost on the way.

    ``lost`` counts by reason (``"nan_points"``, ``"packets"`` ...), so that nothing is dropped silently.
    """

    index: int
    stamp_ns: int
    scans: tuple[LidarScan, ...]
    images: tuple[CameraImage, ...] = ()
    imu: ImuSamples = field(default_factory=ImuSamples.empty)
    lost: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DeskewedScan:
    """Points moved to the frame's stamp: ``points`` float32 (n, 3) and ``origin`` (3,) in the lidar frame."""

    points: F32
    origin: F64


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """A frame with its pose: what odometry hands to the mapping.

    ``image_poses`` are T_world_lidar (4, 4) at the stamps of ``images``, one each; ``twist`` (6,) is the body's
    (m/s, rad/s) at the frame's stamp. ``degenerate_direction`` is the unit vector in world along which the scan
    tells least, where ``degenerate``.
    """

    index: int
    stamp_ns: int
    T_world_lidar: F64
    scans: tuple[DeskewedScan, ...]
    degenerate: bool = False
    images: tuple[CameraImage, ...] = ()
    image_poses: tuple[F64, ...] = ()
    twist: F64 = field(default_factory=lambda: np.zeros(6))
    degenerate_direction: F64 | None = None


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses in time: ``stamp_ns`` int64 (n,) ascending, ``T_world_lidar`` float64 (n, 4, 4)."""

    stamp_ns: I64
    T_world_lidar: F64

    def __len__(self) -> int:
        return len(self.stamp_ns)


class FrameSource(Protocol):
    """A recording, a foreign data set or the live rig: the pipeline cannot tell which.

    ``stamp_ns`` (n,) are the stamps of all frames. ``poses`` are those the input itself carries (tf, poses of a
    data set), or None. ``input_hz`` is the frame rate of the recording. ``lost`` counts what could not be read,
    by reason; ``warnings`` are sentences for the user about what is unusual.
    """

    name: str
    stamp_ns: I64
    poses: Trajectory | None
    input_hz: float
    lost: dict[str, int]
    warnings: list[str]

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[SyncedFrame]:
        """Frames ``start <= index < stop`` in order of time."""
        ...


class Odometry(Protocol):
    """Gives each frame its pose and moves its points to the frame's stamp."""

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        """Pose of the frame at its stamp, and its de-skewed points."""
        ...


@dataclass(frozen=True, slots=True)
class MeshDelta:
    """Blocks changed by one frame; applying all deltas in order gives the map.

    A block's entry replaces what was known of it. ``block`` int32 (b, 3) block indices; rows
    ``vertex_start[k]:vertex_start[k + 1]`` of the vertex arrays belong to block k, and likewise triangles.
    ``triangles`` int64 (t, 3) holds global vertex ids (a triangle may use a neighbour block's vertex);
    ``vertex_id`` int64 (v,), ``position`` and ``normal`` float32 (v, 3) in world, ``colour`` uint8 (v, 3),
    ``label`` uint8 (v,), ``confidence`` float32 (v,) 0..1. ``probability`` uint8 (v,) is that of the label, 255 is 1,
    0 for background; empty where the map has no classes.
    """

    index: int
    block: I32
    vertex_start: I64
    triangle_start: I64
    vertex_id: I64
    position: F32
    normal: F32
    colour: U8
    label: U8
    confidence: F32
    triangles: I64
    probability: U8 = field(default_factory=lambda: np.empty(0, np.uint8))
