"""LiDAR odometry without an IMU (or with a slow one): scan to map with constant velocity as the prior."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import F64, ImuSamples, SyncedFrame, TrackedFrame
from artemis_edge.odometry import imu as inertial
from artemis_edge.odometry import se3
from artemis_edge.odometry.aligner import Aligner
from artemis_edge.odometry.deskew import deskew_frame, window
from artemis_edge.odometry.known_map import Start
from artemis_edge.odometry.local_map import LocalMap
from artemis_edge.odometry.motion import Motion, Prediction
from artemis_edge.odometry.registration import DEGENERATE, Registration
from artemis_edge.odometry.scan_motion import ScanMotion, times, turning_or_steady
from artemis_edge.odometry.thin import Thinner, ThinScan, TimedPoints

_START_FRAMES = 2  # what it takes to know a velocity
_START_ROUNDS = 2  # the first scan is corrected with the motion found and the second registered again
_GIVE_UP = 10  # frames lost in a row after which the map is begun anew at the predicted pose


class _First(NamedTuple):
    """The scan that began the map: pose at its frame's stamp, its middle time after that (s), its points."""

    T_world_lidar: F64
    lead_s: float
    dense: TimedPoints

    def at_middle(self, twist: F64) -> F64:
        """T_world_lidar (4, 4) at the middle of the scan if this was the body twist (6,)."""
        pose: F64 = self.T_world_lidar @ se3.exp(self.lead_s * twist)
        return pose


class LidarOdometry:
    """Pose of every frame from its scans; world is the first LiDAR frame, levelled (z up) if there is an IMU.

    ``lost`` counts by reason the frames that could not be registered and got the predicted pose, and restarts
    of the map. ``instruction``: as of ``InertialOdometry``; here nothing needs to be at rest.
    """

    instruction: str | None = None

    def __init__(
        self, config: OdometryConfig, start_twist: F64 | None = None, start: Start | None = None
    ) -> None:
        """``start_twist`` (6,): how the sensor moves during the first scan, where that is known; ``start`` to go
        on in a known map.
        """
        self.lost: dict[str, int] = {}
        self._config = config
        self._thinner = Thinner(config)
        self._T_world_first = np.eye(4) if start is None else start.T_map_world
        self._map = LocalMap(config, None if start is None else start.known)
        self._aligner = Aligner(config, self._map.planes)
        self._motion: Motion | None = None
        self._first: _First | None = None  # until its motion is known
        self._imu = ImuSamples.empty()
        self._lost_in_a_row = 0
        self._start_twist: F64 = np.zeros(6) if start_twist is None else start_twist

    @classmethod
    def looking_ahead(
        cls, config: OdometryConfig, frames: Iterable[SyncedFrame], start: Start | None = None
    ) -> LidarOdometry:
        """For a recording: two frames are tried, so that the first is corrected for the motion already.

        Without this the first frame goes out as it was measured: its motion is known only after the second.
        """
        trial = cls(config)
        for frame in islice(frames, _START_FRAMES):
            trial.track(frame)
        return cls(config, trial.twist, start)

    @property
    def twist(self) -> F64:
        """Body twist (6,) at the last registered frame, m/s and rad/s."""
        return np.zeros(6) if self._motion is None else self._motion.twist.copy()

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        """Register a frame and add it to the local map; a frame without scans gets the predicted pose."""
        self._imu = inertial.join(self._imu, frame.imu)
        if not frame.scans:
            return self._tracked(frame)
        scan = self._thinner.thin(frame)
        if self._motion is None:
            return self._begin(frame, scan)
        prediction = self._motion.predict(scan.stamp_ns, self._config, self._imu)
        found = self._aligner.align(scan.sparse, prediction)
        if found is not None and self._first is not None:
            prediction, found = self._correct_first(self._first, scan, prediction, found)
        if found is None:
            return self._fall_back(frame, scan)
        self._accept(scan, found.T_world_lidar, prediction.twist(found.T_world_lidar))
        return self._tracked(frame, _unobserved(found))

    def _begin(self, frame: SyncedFrame, scan: ThinScan) -> TrackedFrame:
        """The first scan makes the map; an empty one waits for the next."""
        if len(scan.dense.points) == 0:
            self._count("no points")
            return self._tracked(frame)
        T = np.eye(4)
        T[:3, :3] = inertial.levelling(self._imu)
        self._seed(self._T_world_first @ T, frame.stamp_ns, scan)
        return self._tracked(frame)

    def _seed(self, T_world_lidar: F64, stamp_ns: int, scan: ThinScan) -> None:
        """Begin the map with a scan, at a pose that holds at the frame's stamp."""
        rate = inertial.rate_during(self._imu, scan.stamp_ns)
        twist = self._start_twist.copy()
        if rate is not None:
            twist[3:] = rate
        self._first = _First(T_world_lidar, (scan.stamp_ns - stamp_ns) * 1e-9, scan.dense)
        self._motion = Motion(self._first.at_middle(twist), scan.stamp_ns, twist)
        self._map.begin(scan.dense.at_one_time(twist), self._motion.T_world_lidar)

    def _correct_first(
        self, first: _First, scan: ThinScan, prediction: Prediction, found: Registration
    ) -> tuple[Prediction, Registration | None]:
        """Make the map anew from the first scan with the motion now known, and register the second again."""
        refined: Registration | None = found
        prediction = replace(prediction, assumed=None)
        for _ in range(_START_ROUNDS):
            if refined is None:
                break
            twist = prediction.twist(refined.T_world_lidar)
            T_old_new = se3.inverse(prediction.T_world_start) @ refined.T_world_lidar
            prediction = prediction.rebased(first.at_middle(twist))
            self._map.begin(first.dense.at_one_time(twist), prediction.T_world_start)
            refined = self._aligner.refine(scan.sparse, prediction, prediction.T_world_start @ T_old_new)
        return prediction, refined

    def _accept(self, scan: ThinScan, T_world_lidar: F64, twist: F64) -> None:
        self._motion = Motion(se3.orthonormal(T_world_lidar), scan.stamp_ns, twist, known=True)
        self._first, self._lost_in_a_row = None, 0
        self._imu = inertial.since(self._imu, scan.stamp_ns)
        if refused := self._map.add(scan.dense.at_one_time(twist), T_world_lidar):
            self._count("points without room in the local map", refused)

    def _fall_back(self, frame: SyncedFrame, scan: ThinScan) -> TrackedFrame:
        """The frame could not be registered: the predicted pose, and after many in a row a new map there."""
        self._count("no points" if len(scan.dense.points) == 0 else "not registered")
        self._lost_in_a_row += 1
        tracked = self._tracked(frame)
        if self._lost_in_a_row >= _GIVE_UP and len(scan.dense.points):
            self._count("restarts")
            self._start_twist = np.zeros(6)
            self._seed(tracked.T_world_lidar, frame.stamp_ns, scan)
            self._lost_in_a_row = 0
        return tracked

    def _tracked(self, frame: SyncedFrame, unobserved: F64 | None = None) -> TrackedFrame:
        """The frame with the pose that the present motion has at its stamp.

        ``unobserved`` (3,) is the direction in world of which its planes say nothing, where there is one.
        """
        known = self._motion or Motion(self._T_world_first, frame.stamp_ns, np.zeros(6))
        since_s = (frame.stamp_ns - known.stamp_ns) * 1e-9
        images_s = [(image.stamp_ns - known.stamp_ns) * 1e-9 for image in frame.images]
        moved = self._during(frame, known, since_s, images_s)
        scans = deskew_frame(frame, moved.referred_to(since_s))
        T = known.T_world_lidar @ moved.at(since_s)
        at_images = tuple(known.T_world_lidar @ moved.at(t) for t in images_s)
        return TrackedFrame(
            frame.index,
            frame.stamp_ns,
            T,
            scans,
            unobserved is not None,
            frame.images,
            at_images,
            known.twist,
            unobserved,
        )

    @staticmethod
    def _during(frame: SyncedFrame, known: Motion, since_s: float, images_s: list[float]) -> ScanMotion:
        """Motion relative to the last registered scan: turns by the gyroscope where it covers the frame."""
        first_s, last_s = window(frame)
        ends = times(min(first_s + since_s, 0.0, *images_s), max(last_s + since_s, 0.0, *images_s))
        return turning_or_steady(frame.imu, known.stamp_ns, known.twist, ends)

    def _count(self, reason: str, number: int = 1) -> None:
        self.lost[reason] = self.lost.get(reason, 0) + number


def _unobserved(found: Registration) -> F64 | None:
    """Unit vector (3,) in world along which the planes hardly tell the place, or None."""
    values, vectors = np.linalg.eigh(found.N)
    if values[0] >= DEGENERATE:
        return None
    direction: F64 = found.T_world_lidar[:3, :3] @ vectors[:, 0]
    return direction
