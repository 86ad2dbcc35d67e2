"""What is known of the motion before a scan is looked at: constant velocity, and how far it may be wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import F64
from artemis_edge.odometry import se3

_SAME_TIME_S = 1e-3  # frames that share a stamp are taken to be a millisecond apart


@dataclass(frozen=True, slots=True)
class Prediction:
    """Guess of a frame's pose, and one deviation of its place (m) and of its attitude (rad)."""

    T_world_lidar: F64
    elapsed_s: float
    sigma_m: float
    sigma_rad: float

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
    """Pose, body twist (6,) and stamp of the last registered frame; ``known``: it was measured."""

    T_world_lidar: F64
    stamp_ns: int
    twist: F64
    known: bool = False

    def predict(self, stamp_ns: int, config: OdometryConfig, turn_rate: F64 | None = None) -> Prediction:
        """Constant velocity to a later stamp; a measured ``turn_rate`` (3,) rad/s (lidar frame) wins.

        The deviation is what the stated accelerations can do in the time; while the velocity is not known
        (the second frame), what the stated starting speeds can do.
        """
        elapsed = max((stamp_ns - self.stamp_ns) * 1e-9, _SAME_TIME_S)
        twist = self.twist.copy()
        sigma_m = 0.5 * config.acceleration * elapsed**2
        sigma_rad = 0.5 * config.angular_acceleration * elapsed**2
        if not self.known:
            sigma_m += config.start_speed * elapsed
            sigma_rad += config.start_turn * elapsed
        if turn_rate is not None:
            twist[3:] = turn_rate
            sigma_rad = config.gyro_sigma * elapsed
        return Prediction(self.T_world_lidar @ se3.exp(elapsed * twist), elapsed, sigma_m, sigma_rad)

    def reached(self, T_world_lidar: F64, stamp_ns: int) -> Motion:
        """The motion after a frame was registered at this pose."""
        elapsed = (stamp_ns - self.stamp_ns) * 1e-9
        if elapsed <= 0.0:
            return replace(self, T_world_lidar=T_world_lidar)
        return Motion(se3.orthonormal(T_world_lidar), stamp_ns, self.twist_to(T_world_lidar, elapsed), True)

    def twist_to(self, T_world_lidar: F64, elapsed_s: float) -> F64:
        """Body twist (6,) that leads from here to a pose in the given time."""
        motion: F64 = se3.log(se3.inverse(self.T_world_lidar) @ T_world_lidar)
        return motion / elapsed_s
