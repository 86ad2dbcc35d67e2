"""LiDAR odometry: scan to map with constant velocity as the prior, the seed of the full filter of section III-A.

The filter (IMU, images) of a later version takes this place and keeps ``Odometry.track``.
"""

from __future__ import annotations

import numpy as np

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import F64, SyncedFrame, TrackedFrame
from artemis_edge.odometry import se3
from artemis_edge.odometry.deskew import deskew_frame
from artemis_edge.odometry.motion import Motion, Prediction
from artemis_edge.odometry.plane_map import PlaneMap
from artemis_edge.odometry.registration import DEGENERATE, Registration, arm_m, linearise, register
from artemis_edge.odometry.search import guesses
from artemis_edge.odometry.thin import Thinner, TimedPoints

_MIN_MATCHES = 50  # fewer planes do not fix six numbers against outliers
_GOOD = 0.85  # share of the usual score below which a better guess is sought
_LOST = 0.4  # share of the usual score below which the pose is not believed
_MEMORY = 0.1  # weight of a new frame in the usual score and the usual deviation
_START_ROUNDS = 2  # the first scan is corrected with the motion found, and the second registered again
_SEARCHED = 500  # points that judge a guess
_REFINED = 4  # best guesses that are registered
_GIVE_UP = 10  # frames lost in a row after which the map is begun anew at the predicted pose


class LidarOdometry:
    """Pose of every frame from its scans alone; world is the first LiDAR frame.

    ``lost`` counts frames that fell back to the prediction, by reason.
    """

    def __init__(self, config: OdometryConfig) -> None:
        self.lost: dict[str, int] = {}
        self._config = config
        self._thinner = Thinner(config)
        self._map = PlaneMap(config.voxel_m, config.levels, config.max_voxels)
        self._motion: Motion | None = None
        self._first: TimedPoints | None = None
        self._usual_score = 0.0
        self._usual_off_m2 = 0.0
        self._lost_in_a_row = 0

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        """Register a frame and add it to the local map; never raises for want of points (see ``lost``)."""
        if not frame.scans or self._motion is None and not frame.scans:
            return self._predicted(frame)
        dense, sparse = self._thinner.thin(frame)
        if self._motion is None:
            self._motion = Motion(np.eye(4), frame.stamp_ns, np.zeros(6))
            self._map.insert(dense.points, self._motion.T_world_lidar)
            self._first = dense
            return TrackedFrame(frame.index, frame.stamp_ns, np.eye(4), deskew_frame(frame, np.zeros(6)), images=frame.images)
        prediction = self._motion.predict(frame.stamp_ns, self._config)
        found = self._find(sparse, prediction)
        if self._first is not None:
            found = self._start(sparse, prediction, found)
        if found.matches < _MIN_MATCHES or found.score < _LOST * self._usual_score:
            return self._fail(frame, "few matches")
        off = arm_off(prediction, found.T_world_lidar, arm_m(sparse.points))
        self._usual_score += _MEMORY * (found.score - self._usual_score) if self._usual_score else found.score
        self._usual_off_m2 += _MEMORY * (off**2 - self._usual_off_m2)
        self._motion = self._motion.reached(found.T_world_lidar, frame.stamp_ns)
        m = self._motion
        if len(self._map) > 0.8 * self._map.capacity:
            self._map.evict(m.T_world_lidar[:3, 3], self._config.max_range_m)
        self._map.insert(dense.at_stamp(m.twist), m.T_world_lidar)
        lam = np.linalg.eigvalsh(found.N)[0]
        self.dbg.update(off=off, score=found.score, lam=lam, m=found.matches, n=len(sparse.points), usual=self._usual_score, tau=self._usual_off_m2**0.5)
        return TrackedFrame(frame.index, frame.stamp_ns, m.T_world_lidar, deskew_frame(frame, m.twist), bool(lam < DEGENERATE), frame.images)

    dbg: dict = {}

    def _find(self, scan: TimedPoints, prediction: Prediction) -> Registration:
        c, arm = self._config, arm_m(scan.points)
        bound = float(np.hypot(prediction.sigma_m, arm * prediction.sigma_rad))
        usual = self._usual_off_m2**0.5
        best = self._register(scan, prediction, prediction.T_world_lidar, min(usual, bound))
        self.dbg['rung'] = 0
        if best.score >= _GOOD * self._usual_score > 0.0:
            return best
        second = self._register(scan, prediction, prediction.T_world_lidar, bound)
        best = max(best, second, key=lambda r: r.score)
        self.dbg['rung'] = 1
        if best.score >= _GOOD * self._usual_score > 0.0:
            return best
        self.dbg['rung'] = 2
        basin = self._map.voxel_m * 2
        few = TimedPoints(*(a[:: max(len(scan.points) // _SEARCHED, 1)] for a in scan))
        tried = guesses(prediction.T_world_lidar, prediction.sigma_m, prediction.sigma_rad, arm, basin)
        tried.append(self._motion.T_world_lidar)
        scores = [self._score(few, prediction, T, basin) for T in tried]
        self.dbg['ntried'] = len(tried)
        for k in np.argsort(scores)[::-1][:_REFINED]:
            best = max(best, self._register(scan, prediction, tried[k], basin), key=lambda r: r.score)
        return best

    def _score(self, scan, prediction, T, tau):
        points = scan.at_stamp(self._motion.twist_to(T, prediction.elapsed_s))
        return linearise(*self._map.kernel_view(tau), points, T, self._config.sigma_m**2 + (tau / 2) ** 2).score

    def _register(self, scan: TimedPoints, prediction: Prediction, guess: F64, tau_m: float) -> Registration:
        return register(self._map, scan, self._motion, prediction, guess, tau_m, self._config.sigma_m)

    def _start(self, scan: TimedPoints, prediction: Prediction, found: Registration) -> Registration:
        for _ in range(_START_ROUNDS):
            twist = self._motion.twist_to(found.T_world_lidar, prediction.elapsed_s)
            self._map.clear()
            self._map.insert(self._first.at_stamp(twist), self._motion.T_world_lidar)
            found = self._register(scan, prediction, found.T_world_lidar, self._config.sigma_m)
        self._first = None
        return found

    def _fail(self, frame, reason):
        self.lost[reason] = self.lost.get(reason, 0) + 1
        return self._predicted(frame)

    def _predicted(self, frame: SyncedFrame) -> TrackedFrame:
        p = self._motion.predict(frame.stamp_ns, self._config)
        return TrackedFrame(frame.index, frame.stamp_ns, p.T_world_lidar, deskew_frame(frame, self._motion.twist), images=frame.images)


def arm_off(prediction: Prediction, T: F64, arm: float) -> float:
    off = se3.log(se3.inverse(prediction.T_world_lidar) @ T)
    return float(np.hypot(np.linalg.norm(off[:3]), arm * np.linalg.norm(off[3:])))
