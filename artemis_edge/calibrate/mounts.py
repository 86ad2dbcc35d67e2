"""A recording seen through a calibration: other mounts and times than it states itself."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from artemis_edge.changed_source import ChangedSource
from artemis_edge.devices.calibration import Calibration
from artemis_edge.frames import F64, CameraModel, FrameSource, ImuSamples, SyncedFrame
from artemis_edge.trajectory import inverse


@dataclass(frozen=True, slots=True)
class CameraMount:
    """``T_cam_lidar`` (4, 4); ``time_offset_s`` is added to stamps; ``model`` replaces the lens unless None."""

    T_cam_lidar: F64
    time_offset_s: float = 0.0
    model: CameraModel | None = None


@dataclass(frozen=True, slots=True)
class ImuMount:
    """How samples are put right that the source gives in the axes of the LiDAR.

    ``R`` (3, 3) turns them to the true axes, ``time_offset_s`` is added to the stamps; ``origin`` (3,) is where
    the IMU is in the LiDAR frame, None: where the source says.
    """

    R: F64 = field(default_factory=lambda: np.eye(3))
    time_offset_s: float = 0.0
    origin: F64 | None = None

    def corrected(self, imu: ImuSamples) -> ImuSamples:
        """Samples with the right axes and times."""
        shift = np.int64(round(self.time_offset_s * 1e9))
        origin = imu.origin if self.origin is None else self.origin
        return replace(
            imu,
            stamp_ns=imu.stamp_ns + shift,
            gyro=imu.gyro @ self.R.T,
            accel=imu.accel @ self.R.T,
            origin=origin,
        )

    def then(self, rotation: F64, time_offset_s: float) -> ImuMount:
        """With a further rotation vector (3,) and offset found on samples that are already corrected."""
        R: F64 = Rotation.from_rotvec(rotation).as_matrix() @ self.R
        return ImuMount(R, self.time_offset_s + time_offset_s, self.origin)


@dataclass(frozen=True, slots=True)
class Mounts:
    """What replaces the mounts of a source; a sensor that is not named keeps its own."""

    cameras: dict[str, CameraMount] = field(default_factory=dict)
    imu: ImuMount = field(default_factory=ImuMount)

    def applied(self, frame: SyncedFrame) -> SyncedFrame:
        """The frame with these mounts and times."""
        images = tuple(
            replace(
                image,
                stamp_ns=image.stamp_ns + round(mount.time_offset_s * 1e9),
                T_cam_lidar=mount.T_cam_lidar,
                model=mount.model or image.model,
            )
            if (mount := self.cameras.get(image.name)) is not None
            else image
            for image in frame.images
        )
        return replace(frame, images=images, imu=self.imu.corrected(frame.imu))

    @classmethod
    def of(cls, calibration: Calibration, source: FrameSource) -> Mounts:
        """Those of a rig's calibration file, for a source that turns its samples by its own T_lidar_imu."""
        cameras = {
            name: CameraMount(np.array(camera.T_cam_lidar), camera.time_offset_s, camera.model())
            for name, camera in calibration.cameras.items()
        }
        T = inverse(np.array(calibration.T_imu_lidar))
        R = T[:3, :3] @ T_lidar_imu(source)[:3, :3].T
        return cls(cameras, ImuMount(R, calibration.imu_time_offset_s, T[:3, 3]))


def T_lidar_imu(source: FrameSource) -> F64:
    """How the source has mounted its IMU; identity where it does not say."""
    T: F64 = np.asarray(getattr(source, "T_lidar_imu", np.eye(4)), np.float64)
    return T


class CalibratedSource(ChangedSource):
    """A FrameSource seen through mounts."""

    def __init__(self, source: FrameSource, mounts: Mounts) -> None:
        super().__init__(source, mounts.applied)
