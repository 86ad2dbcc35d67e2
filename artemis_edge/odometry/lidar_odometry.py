"""LiDAR odometry: scan to map with constant velocity as the prior (section III-A without the filter).

The filter (IMU, images) of a later version takes this place and keeps ``Odometry.track``.
"""

from __future__ import annotations

import numpy as np

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import F64, ImuSamples, SyncedFrame, TrackedFrame
from artemis_edge.odometry import imu as inertial
from artemis_edge.odometry.aligner import Aligner
from artemis_edge.odometry.deskew import deskew_frame
from artemis_edge.odometry.motion import Motion, Prediction
from artemis_edge.odometry.plane_map import PlaneMap
from artemis_edge.odometry.registration import DEGENERATE, Registration
from artemis_edge.odometry.thin import Thinner, TimedPoints

_START_ROUNDS = 2  # the first scan is corrected with the motion found and the second registered again
_GIVE_UP = 10  # frames lost in a row after which the map is begun anew at the predicted pose
_EVICT_TRAVEL = 0.25  # share of the range travelled after which far voxels are looked for
_FULL = 0.8  # share of the voxels in use from which room is made


class LidarOdometry:
    """Pose of every frame from its scans; world is the first LiDAR frame, levelled (z up) if there is an IMU.

    ``T_imu_lidar`` (4, 4) is the mounting of the IMU. ``lost`` counts by reason the frames that could not be
    registered and got the predicted pose, and the ``restarts`` of the map.
    """

    def __init__(self, config: OdometryConfig, T_imu_lidar: F64 | None = None) -> None:
        self.lost: dict[str, int] = {}
        self._config = config
        self._R_lidar_imu: F64 = np.eye(3) if T_imu_lidar is None else T_imu_lidar[:3, :3].T
        self._thinner = Thinner(config)
        self._map = PlaneMap(config.voxel_m, config.levels, config.max_voxels)
        self._aligner = Aligner(config, self._map)
        self._motion: Motion | None = None
        self._first: TimedPoints | None = None  # the scan that began the map, until its motion is known
        self._imu = ImuSamples.empty()
        self._lost_in_a_row = 0
        self._evicted_at = np.zeros(3)

    @property
    def twist(self) -> F64:
        """Body twist (6,) at the last registered frame, m/s and rad/s."""
        return np.zeros(6) if self._motion is None else self._motion.twist.copy()

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        """Register a frame and add it to the local map; a frame without scans gets the predicted pose."""
        self._imu = inertial.join(self._imu, frame.imu)
        if not frame.scans:
            return self._as_predicted(frame)
        dense, sparse = self._thinner.thin(frame)
        if self._motion is None:
            return self._begin(frame, dense)
        prediction = self._predict(self._motion, frame.stamp_ns)
        found = self._aligner.align(sparse, self._motion, prediction)
        if found is not None and self._first is not None:
            found = self._correct_first(self._first, sparse, self._motion, prediction, found)
        if found is None:
            return self._fall_back(frame, dense)
        return self._accept(frame, dense, self._motion, found)

    def _begin(self, frame: SyncedFrame, dense: TimedPoints) -> TrackedFrame:
        """The first scan makes the map; an empty one waits for the next."""
        T = np.eye(4)
        if len(dense.points) == 0:
            self._count("no points")
        else:
            T[:3, :3] = inertial.levelling(self._imu, self._R_lidar_imu)
            self._seed(T, frame.stamp_ns, dense)
        return _tracked(frame, T, np.zeros(6))

    def _seed(self, T_world_lidar: F64, stamp_ns: int, dense: TimedPoints) -> None:
        self._motion = Motion(T_world_lidar, stamp_ns, np.zeros(6))
        self._first = dense
        self._map.clear()
        self._map.insert(dense.points, T_world_lidar)
        self._evicted_at = T_world_lidar[:3, 3]

    def _predict(self, motion: Motion, stamp_ns: int) -> Prediction:
        rate = inertial.mean_rate(self._imu, motion.stamp_ns, stamp_ns)
        return motion.predict(stamp_ns, self._config, None if rate is None else self._R_lidar_imu @ rate)

    def _correct_first(
        self,
        first: TimedPoints,
        scan: TimedPoints,
        motion: Motion,
        prediction: Prediction,
        found: Registration,
    ) -> Registration | None:
        """Rebuild the map from the first scan with the motion now known, and register the second again."""
        refined: Registration | None = found
        for _ in range(_START_ROUNDS):
            if refined is None:
                break
            self._map.clear()
            twist = motion.twist_to(refined.T_world_lidar, prediction.elapsed_s)
            self._map.insert(first.at_stamp(twist), motion.T_world_lidar)
            refined = self._aligner.refine(scan, motion, prediction, refined.T_world_lidar)
        return refined

    def _accept(
        self, frame: SyncedFrame, dense: TimedPoints, motion: Motion, found: Registration
    ) -> TrackedFrame:
        motion = motion.reached(found.T_world_lidar, frame.stamp_ns)
        self._motion, self._first, self._lost_in_a_row = motion, None, 0
        self._imu = ImuSamples.empty() if len(self._imu.stamp_ns) == 0 else _latest(self._imu, frame.stamp_ns)
        self._make_room(motion.T_world_lidar[:3, 3])
        if refused := self._map.insert(dense.at_stamp(motion.twist), motion.T_world_lidar):
            self._count("points without room in the local map", refused)
        degenerate = bool(np.linalg.eigvalsh(found.N)[0] < DEGENERATE)
        return _tracked(frame, motion.T_world_lidar, motion.twist, degenerate)

    def _make_room(self, place: F64) -> None:
        travelled = float(np.linalg.norm(place - self._evicted_at))
        far = travelled > _EVICT_TRAVEL * self._config.max_range_m
        if far or len(self._map) > _FULL * self._config.max_voxels:
            self._map.evict(place, self._config.max_range_m)
            self._evicted_at = place

    def _fall_back(self, frame: SyncedFrame, dense: TimedPoints) -> TrackedFrame:
        """The frame could not be registered: the predicted pose, and after many in a row a new map there."""
        self._count("no points" if len(dense.points) == 0 else "not registered")
        self._lost_in_a_row += 1
        tracked = self._as_predicted(frame)
        if self._lost_in_a_row >= _GIVE_UP and len(dense.points):
            self._count("restarts")
            self._seed(tracked.T_world_lidar, frame.stamp_ns, dense)
            self._lost_in_a_row = 0
        return tracked

    def _as_predicted(self, frame: SyncedFrame) -> TrackedFrame:
        if self._motion is None:
            return _tracked(frame, np.eye(4), np.zeros(6))
        return _tracked(frame, self._predict(self._motion, frame.stamp_ns).T_world_lidar, self._motion.twist)

    def _count(self, reason: str, number: int = 1) -> None:
        self.lost[reason] = self.lost.get(reason, 0) + number


def _latest(imu: ImuSamples, stamp_ns: int) -> ImuSamples:
    keep = imu.stamp_ns > stamp_ns
    return ImuSamples(imu.stamp_ns[keep], imu.gyro[keep], imu.accel[keep])


def _tracked(frame: SyncedFrame, T_world_lidar: F64, twist: F64, degenerate: bool = False) -> TrackedFrame:
    scans = deskew_frame(frame, twist)
    return TrackedFrame(frame.index, frame.stamp_ns, T_world_lidar, scans, degenerate, frame.images)
