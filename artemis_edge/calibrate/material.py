"""What calibration works on: the poses, clouds, photographs and IMU samples of a recording, in memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from artemis_edge.calibrate.photographs import Developer, Photograph
from artemis_edge.calibrate.poses import SmoothPoses
from artemis_edge.frames import F32, F64, CameraModel, FrameSource, ImuSamples, Odometry, Trajectory
from artemis_edge.trajectory import inverse

_COARSEST_PX = 40  # width of the smallest level: an error of some degrees is about two of its pixels
_MOST_PHOTOGRAPHS = 240  # of a camera; more of a long recording tell little more
_MOST_POINTS = 1_200_000  # around a photograph
_NEAR_M, _NEAR_S = (
    2.0,
    0.75,
)  # clouds taken this near, and on a moving rig this soon, show what a photograph shows
_RARE_HZ = 3.0  # frames rarer than this are stations: nothing is known between them


@dataclass(slots=True)
class Camera:
    """One camera: its photographs, size (h, w), and the mount that the source states."""

    name: str
    size: tuple[int, int]
    T_cam_lidar: F64
    model: CameraModel
    developer: Developer
    photographs: list[Photograph] = field(default_factory=list)


@dataclass(slots=True)
class Material:
    """``clouds`` float32 (n, 3) in world, one a frame, at ``trajectory``; ``stations``: the rig stood still."""

    trajectory: Trajectory
    clouds: list[F32]
    imu: ImuSamples
    cameras: dict[str, Camera]
    smooth: SmoothPoses
    stations: bool

    def around(self, stamp_ns: int) -> F64:
        """Points (n, 3) in world of the clouds taken near to where and when a photograph was taken."""
        place = self.smooth.at(np.array([stamp_ns]))[0, :3, 3]
        apart = np.linalg.norm(self.trajectory.T_world_lidar[:, :3, 3] - place, axis=1)
        near = apart < _NEAR_M
        if not self.stations:
            near &= np.abs(self.trajectory.stamp_ns - stamp_ns) < _NEAR_S * 1e9
        chosen = [self.clouds[k] for k in np.flatnonzero(near)]
        points = np.concatenate(chosen) if chosen else np.empty((0, 3), np.float32)
        every = max(len(points) // _MOST_POINTS, 1)
        return points[::every].astype(np.float64)

    def views_of(self, camera: Camera, time_offset_s: float) -> tuple[F64, F64, list[int]]:
        """T_lidar_world (n, 4, 4), body twists (n, 6) and indices of the photographs whose pose is known."""
        shift = round(time_offset_s * 1e9)
        stamps = np.array([p.stamp_ns + shift for p in camera.photographs], np.int64)
        known = [k for k, stamp in enumerate(stamps) if self.smooth.covers(int(stamp))]
        T = self.smooth.at(stamps[known])
        T_lidar_world = inverse(T)
        still = np.zeros((len(known), 6))
        return T_lidar_world, still if self.stations else self.smooth.twist(stamps[known]), known


def collect(
    source: FrameSource, odometry: Odometry, photographs: bool, report: Callable[[int, int], None]
) -> Material:
    """Read a recording; ``photographs``: those too."""
    stamps, poses, clouds, samples = [], [], [], []
    cameras: dict[str, Camera] = {}
    every = max(len(source) // _MOST_PHOTOGRAPHS, 1)
    for done, frame in enumerate(source.frames()):
        tracked = odometry.track(frame)
        T = tracked.T_world_lidar
        points = [scan.points for scan in tracked.scans]
        cloud = np.concatenate(points) if points else np.empty((0, 3), np.float32)
        stamps.append(tracked.stamp_ns)
        poses.append(T)
        clouds.append((cloud @ T[:3, :3].T + T[:3, 3]).astype(np.float32) if photographs else cloud[:0])
        samples.append(frame.imu)
        for image in frame.images if photographs and frame.index % every == 0 else ():
            if image.name not in cameras:
                model = image.model
                levels = max(int(np.log2(model.width / _COARSEST_PX)), 1)
                cameras[image.name] = Camera(
                    image.name,
                    (model.height, model.width),
                    image.T_cam_lidar,
                    model,
                    Developer(model, levels),
                )
            made = cameras[image.name].developer.develop(image, frame.index)
            if made is not None:
                cameras[image.name].photographs.append(made)
        report(done + 1, len(source))
    trajectory = Trajectory(np.array(stamps, np.int64), np.array(poses).reshape(-1, 4, 4))
    imu = _joined(samples)
    stations = source.input_hz < _RARE_HZ
    return Material(trajectory, clouds, imu, cameras, SmoothPoses(trajectory, imu), stations)


def _joined(samples: list[ImuSamples]) -> ImuSamples:
    if not samples:
        return ImuSamples.empty()
    stamp = np.concatenate([s.stamp_ns for s in samples])
    order = np.argsort(stamp, kind="stable")
    order = order[np.r_[True, np.diff(stamp[order]) > 0]] if len(order) else order
    gyro, accel = (np.concatenate([getattr(s, name) for s in samples])[order] for name in ("gyro", "accel"))
    return ImuSamples(stamp[order], gyro, accel, samples[0].origin)
