"""What is known of the motion before a scan is looked at: constant velocity, and how far it may be wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import F64, ImuSamples
from artemis_edge.odometry import se3
from artemis_edge.odometry.imu import mean_rate, rate_during

_SAME_TIME_S = 1e-3  # frames that share a stamp are taken to be a millisecond apart


@dataclass(frozen=True, slots=True)
class Prediction:
    """Guess of a scan's pose, one deviation of its place (m) and attitude (rad), and where it came from.

    ``turn_rate`` (3,) rad/s is what a gyroscope measured during the scan, or None. ``assumed`` (6,) is a
    twist during the scan that is taken whatever the pose, or None.
    """

    T_world_start: F64
    T_world_lidar: F64
    elapsed_s: float
    sigma_m: float
    sigma_rad: float
    turn_rate: F64 | None = None
    assumed: F64 | None = None

    def twist(self, T_world_lidar: F64) -> F64:
        """Body twist (6,) during the scan if this is its pose: the mean on the way, its turn as measured."""
        if self.assumed is not None:
            return self.assumed
        twist: F64 = se3.log(se3.inverse(self.T_world_start) @ T_world_lidar) / self.elapsed_s
        if self.turn_rate is not None:
            twist[3:] = self.turn_rate
        return twist

    def rebased(self, T_world_start: F64) -> Prediction:
        """The same motion from another start."""
        T = T_world_start @ se3.inverse(self.T_world_start) @ self.T_world_lidar
        return replace(self, T_world_start=T_world_start, T_world_lidar=T)

    def information(self) -> F64:
        """Inverse covariance (6, 6) of a right perturbation of the pose."""
        return np.diag([self.sigma_m**-2] * 3 + [self.sigma_rad**-2] * 3)

    def reach_m(self, arm_m: float) -> float:
        """One deviation of a point at the distance ``arm_m``."""
        return float(np.hypot(self.sigma_m, arm_m * self.sigma_rad))

    def missed_by_m(self, T_world_lidar: F64, arm_m: float) -> float:
        """How far the guess was off at points at the distance ``arm_m``."""
        off = se3.log(se3.inverse(self.T_world_lidar) @ T_world_lidar)
        return float(np.hypot(np.linalg.norm(off[:3]), arm_m * np.linalg.norm(off[3:])))


@dataclass(frozen=True, slots=True)
class Motion:
    """Pose, body twist (6,) and time of the last registered scan; ``known``: the twist was measured."""

    T_world_lidar: F64
    stamp_ns: int
    twist: F64
    known: bool = False

    def pose_at(self, stamp_ns: int) -> F64:
        """T_world_lidar (4, 4) at a time near the scan's, by constant velocity."""
        pose: F64 = self.T_world_lidar @ se3.exp((stamp_ns - self.stamp_ns) * 1e-9 * self.twist)
        return pose

    def predict(self, stamp_ns: int, config: OdometryConfig, imu: ImuSamples) -> Prediction:
        """Constant velocity to a later scan; the turn as ``imu`` measured it, where it has samples.

        The deviation is what the stated accelerations can do in the time; while the velocity is not known
        (the second frame), what the stated starting speeds can do, and the scan is left as the first one was:
        two scans that are distorted alike tell the motion between them well.
        """
        elapsed = max((stamp_ns - self.stamp_ns) * 1e-9, _SAME_TIME_S)
        twist = self.twist.copy()
        sigma_m = 0.5 * config.acceleration * elapsed**2
        sigma_rad = 0.5 * config.angular_acceleration * elapsed**2
        if not self.known:
            sigma_m += config.start_speed * elapsed
            sigma_rad += config.start_turn * elapsed
        rate = mean_rate(imu, self.stamp_ns, stamp_ns)
        if rate is not None:
            twist[3:] = rate
            sigma_rad = config.gyro_sigma * elapsed
        T = self.T_world_lidar @ se3.exp(elapsed * twist)
        assumed = None if self.known else self.twist
        during = rate_during(imu, stamp_ns)
        return Prediction(self.T_world_lidar, T, elapsed, sigma_m, sigma_rad, during, assumed)
