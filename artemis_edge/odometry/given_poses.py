"""Poses that came with the input (``--poses``, tf, a data set): no estimation, only time and motion."""

from __future__ import annotations

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import F64, SyncedFrame, TrackedFrame, Trajectory
from artemis_edge.odometry import se3
from artemis_edge.odometry.deskew import deskew_frame, window
from artemis_edge.odometry.scan_motion import ScanMotion, through, times, turning_or_steady
from artemis_edge.trajectory import interpolate

# Stamps this close belong together (the tolerance of ``evaluate trajectory``): printed times are rounded.
_PAIRING_NS = 10_000_000
# Poses in a scan, for each piece of its motion, from which on they tell it better than anything between them
_DENSE = 0.5
# Vertices are float32: 8 mm apart at this distance from the origin, 0.5 m apart at UTM's northings
_FARTHEST_M = 100_000.0


class GivenPoses:
    """Odometry that looks poses up: exactly at a pose's stamp, between two poses by constant velocity.

    The motion within a scan follows the poses themselves where they are denser than the scans, else the
    gyroscope between them, else the central difference over the neighbouring poses; with a single pose it is
    none. Raises InputError if the poses are unordered, do not cover a frame or lie more than 100 km from the
    origin.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        stamps = np.ascontiguousarray(trajectory.stamp_ns, np.int64)
        poses = np.asarray(trajectory.T_world_lidar, np.float64)
        if len(stamps) == 0:
            raise InputError(
                "the given poses are empty; give a file with at least one pose or use --no-poses"
            )
        if poses.shape != (len(stamps), 4, 4) or not np.isfinite(poses).all():
            raise InputError("the given poses are not finite 4 x 4 matrices, one a stamp; mend the pose file")
        farthest = float(np.abs(poses[:, :3, 3]).max())
        if farthest > _FARTHEST_M:
            raise InputError(
                f"the given poses reach {farthest / 1000:.6g} km from the origin; subtract one offset from all of "
                f"them: float32 vertices and block keys serve a map within {_FARTHEST_M / 1000:.0f} km"
            )
        if (np.diff(stamps) <= 0).any():
            raise InputError("the stamps of the given poses do not ascend; sort the pose file by time")
        self._stamps = stamps
        self._poses = np.stack([se3.orthonormal(np.ascontiguousarray(T)) for T in poses])

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        """Pose at the frame's stamp and the points moved there; InputError if no pose covers it."""
        T_world_lidar, twist = self.at(frame.stamp_ns)
        motion = self._during(frame, T_world_lidar, twist)
        scans = deskew_frame(frame, motion)
        return TrackedFrame(
            frame.index,
            frame.stamp_ns,
            T_world_lidar,
            scans,
            images=frame.images,
            image_poses=self._at_images(frame, T_world_lidar, twist),
            twist=twist,
        )

    def _at_images(self, frame: SyncedFrame, T_world_lidar: F64, twist: F64) -> tuple[F64, ...]:
        """T_world_lidar when each image was taken; beyond the given poses the motion goes on."""
        poses = []
        for image in frame.images:
            inside = self._stamps[0] <= image.stamp_ns <= self._stamps[-1]
            since_s = (image.stamp_ns - frame.stamp_ns) * 1e-9
            poses.append(self.at(image.stamp_ns)[0] if inside else T_world_lidar @ se3.exp(since_s * twist))
        return tuple(poses)

    def _during(self, frame: SyncedFrame, T_world_lidar: F64, twist: F64) -> ScanMotion:
        first_s, last_s = window(frame)
        ends = times(first_s, last_s)
        stamps = frame.stamp_ns + np.rint(ends * 1e9).astype(np.int64)
        inside = np.searchsorted(self._stamps, stamps[-1]) - np.searchsorted(self._stamps, stamps[0])
        if inside >= _DENSE * len(ends):
            T = interpolate(Trajectory(self._stamps, self._poses), stamps)
            return through(ends, se3.inverse(T_world_lidar) @ T)
        return turning_or_steady(frame.imu, frame.stamp_ns, twist, ends)

    def at(self, stamp_ns: int) -> tuple[F64, F64]:
        """``T_world_lidar`` (4, 4) and the body twist (6,) (m/s, rad/s) at a stamp."""
        first, last = int(self._stamps[0]), int(self._stamps[-1])
        if not first - _PAIRING_NS <= stamp_ns <= last + _PAIRING_NS:
            raise InputError(
                f"no given pose covers the frame at {stamp_ns * 1e-9:.3f} s: the poses run from "
                f"{first * 1e-9:.3f} to {last * 1e-9:.3f} s; use --frames or give poses for all of them"
            )
        n = len(self._stamps)
        right = int(np.searchsorted(self._stamps, stamp_ns))
        near = min(
            range(max(right - 1, 0), min(right + 1, n)), key=lambda k: abs(int(self._stamps[k]) - stamp_ns)
        )
        if self._stamps[near] == stamp_ns or not first < stamp_ns < last:
            twist = self._twist(max(near - 1, 0), min(near + 1, n - 1))
        else:
            near, twist = right - 1, self._twist(right - 1, right)
        elapsed_s = (stamp_ns - int(self._stamps[near])) * 1e-9
        return self._poses[near] @ se3.exp(elapsed_s * twist), twist

    def _twist(self, i: int, j: int) -> F64:
        """Mean body twist between poses i and j; zero if they are the same."""
        if i == j:
            return np.zeros(6)
        motion: F64 = se3.log(se3.inverse(self._poses[i]) @ self._poses[j])
        return motion / (int(self._stamps[j] - self._stamps[i]) * 1e-9)
