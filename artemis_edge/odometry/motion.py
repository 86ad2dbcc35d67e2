"""What is known of the motion before a scan is looked at: constant velocity, and how far it may be wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import F64
from artemis_edge.odometry import se3


@dataclass(frozen=True, slots=True)
class Prediction:
    """Guess of a frame's pose: ``T_world_lidar``, and one deviation of its place (m) and its attitude (rad)."""

    T_world_lidar: F64
    elapsed_s: float
    sigma_m: float
    sigma_rad: float

    def information(self) -> F64:
        """Inverse covariance (6, 6) of a right perturbation of the pose."""
        return np.diag([self.sigma_m**-2] * 3 + [self.sigma_rad**-2] * 3)


@dataclass(frozen=True, slots=True)
class Motion:
    """Pose, body twist (6,) and stamp of the last registered frame; ``moving`` tells that the twist is known."""

    T_world_lidar: F64
    stamp_ns: int
    twist: F64
    known: bool = False

    def predict(self, stamp_ns: int, config: OdometryConfig) -> Prediction:
        """Constant velocity to a later stamp.

        The deviation is what the stated accelerations can do in the time; while the velocity is not known yet
        (the second frame, or after the odometry was lost), what the stated starting speeds can do.
        """
        elapsed = max((stamp_ns - self.stamp_ns) * 1e-9, _SAME_TIME_S)
        half = 0.5 * elapsed**2
        sigma_m, sigma_rad = config.acceleration * half, config.angular_acceleration * half
        if not self.known:
            sigma_m += config.start_speed * elapsed
            sigma_rad += config.start_turn * elapsed
        return Prediction(self.T_world_lidar @ se3.exp(elapsed * self.twist), elapsed, sigma_m, sigma_rad)

    def reached(self, T_world_lidar: F64, stamp_ns: int) -> Motion:
        """The motion after a frame was registered at this pose."""
        elapsed = (stamp_ns - self.stamp_ns) * 1e-9
        if elapsed <= 0.0:
            return replace(self, T_world_lidar=T_world_lidar)
        twist = self.twist_to(T_world_lidar, elapsed)
        return Motion(se3.orthonormal(T_world_lidar), stamp_ns, twist, known=True)

    def twist_to(self, T_world_lidar: F64, elapsed_s: float) -> F64:
        """Body twist (6,) that leads from here to a pose in the given time."""
        motion: F64 = se3.log(se3.inverse(self.T_world_lidar) @ T_world_lidar)
        return motion / elapsed_s


_SAME_TIME_S = 1e-3  # frames that share a stamp are compared as if a millisecond apart
