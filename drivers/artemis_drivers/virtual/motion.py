"""A trajectory as quintic splines: exact pose, velocity, acceleration and angular velocity at any time.

Position and the yaw, pitch and roll angles are interpolating splines of degree five, so everything an IMU
measures is an analytic derivative and continuous (positions and angles are C4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, make_interp_spline

from artemis_drivers.virtual.mesh_builder import F64

_DEGREE = 5


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of a body in the world over ``duration_s``.

    ``position`` and ``angles`` are splines of time (s): metres in world, and yaw, pitch, roll in radians with
    R_world_body = Rz(yaw) Ry(pitch) Rx(roll). Pitch must stay away from +-90 degrees.
    """

    position: BSpline
    angles: BSpline
    duration_s: float

    @classmethod
    def through(cls, time_s: F64, position: F64, angles: F64) -> Motion:
        """Interpolate samples (n, 3) of position and yaw, pitch, roll (unwrapped) at ascending times (n,)."""
        return cls(
            make_interp_spline(time_s, position, _DEGREE),
            make_interp_spline(time_s, angles, _DEGREE),
            float(time_s[-1]),
        )

    def pose(self, time_s: ArrayLike) -> F64:
        """T_world_body float64 (n, 4, 4)."""
        t = np.atleast_1d(np.asarray(time_s, np.float64))
        T = np.zeros((len(t), 4, 4))
        T[:, :3, :3] = rotation(self.angles(t))
        T[:, :3, 3] = self.position(t)
        T[:, 3, 3] = 1.0
        return T

    def velocity(self, time_s: ArrayLike) -> F64:
        """Velocity in world, m/s (n, 3)."""
        return np.asarray(self.position(np.atleast_1d(time_s), 1), np.float64)

    def acceleration(self, time_s: ArrayLike) -> F64:
        """Acceleration in world, m/s2 (n, 3), without gravity."""
        return np.asarray(self.position(np.atleast_1d(time_s), 2), np.float64)

    def angular_velocity(self, time_s: ArrayLike) -> F64:
        """Angular velocity in the body's axes, rad/s (n, 3)."""
        t = np.atleast_1d(np.asarray(time_s, np.float64))
        _, pitch, roll = np.moveaxis(self.angles(t), 1, 0)
        d_yaw, d_pitch, d_roll = np.moveaxis(self.angles(t, 1), 1, 0)
        sin_r, cos_r = np.sin(roll), np.cos(roll)
        return np.column_stack(
            [
                d_roll - d_yaw * np.sin(pitch),
                d_pitch * cos_r + d_yaw * np.cos(pitch) * sin_r,
                -d_pitch * sin_r + d_yaw * np.cos(pitch) * cos_r,
            ]
        )


def rotation(angles: F64) -> F64:
    """Rz(yaw) Ry(pitch) Rx(roll), float64 (n, 3, 3), of ``angles`` (n, 3)."""
    (cy, cp, cr), (sy, sp, sr) = np.cos(angles).T, np.sin(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
