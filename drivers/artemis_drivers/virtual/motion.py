"""A trajectory as quintic splines: exact pose, velocity, acceleration and angular velocity at any time.

Position and attitude (a quaternion, normalised where it is used) are interpolating splines of degree five, so
everything an IMU measures is an analytic derivative and continuous (both are C4), in any attitude.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, make_interp_spline
from scipy.spatial.transform import Rotation

from artemis_drivers.virtual.mesh_builder import F64

_DEGREE = 5


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of a body in the world over ``duration_s``.

    ``position`` and ``attitude`` are splines of time (s): metres in world, and the quaternion x, y, z, w of
    R_world_body, not normalised.
    """

    position: BSpline
    attitude: BSpline
    duration_s: float

    @classmethod
    def through(cls, time_s: F64, position: F64, angles: F64) -> Motion:
        """Interpolate samples (n, 3) of position and yaw, pitch, roll at ascending times (n,), n > 5.

        R_world_body = Rz(yaw) Ry(pitch) Rx(roll), radians.
        """
        return cls.through_rotations(time_s, position, rotation(angles))

    @classmethod
    def through_rotations(cls, time_s: F64, position: F64, R_world_body: F64) -> Motion:
        """Interpolate positions (n, 3) and rotations (n, 3, 3) at ascending times (n,), n > 5; neighbours
        must differ by less than half a turn.
        """
        quaternion = Rotation.from_matrix(R_world_body).as_quat()
        # q and -q are one rotation; neighbours get the signs that are nearer to each other
        flips = np.sign((quaternion[1:] * quaternion[:-1]).sum(axis=1))
        quaternion[1:] *= np.cumprod(np.where(flips == 0, 1.0, flips))[:, None]
        return cls(
            make_interp_spline(time_s, position, _DEGREE),
            make_interp_spline(time_s, quaternion, _DEGREE),
            float(time_s[-1]),
        )

    def pose(self, time_s: ArrayLike) -> F64:
        """T_world_body float64 (n, 4, 4)."""
        t = np.atleast_1d(np.asarray(time_s, np.float64))
        T = np.zeros((len(t), 4, 4))
        T[:, :3, :3] = _matrix(self.attitude(t))
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
        """Angular velocity in the body's axes, rad/s (n, 3): twice the vector part of q* dq/dt.

        The part of dq/dt along q, which only normalises, is in the scalar part.
        """
        t = np.atleast_1d(np.asarray(time_s, np.float64))
        q, dq = self.attitude(t), self.attitude(t, 1)
        v, w = q[:, :3], q[:, 3:]
        vector = w * dq[:, :3] - dq[:, 3:] * v - np.cross(v, dq[:, :3])
        return np.asarray(2 * vector / (q**2).sum(axis=1, keepdims=True), np.float64)

    def angles(self, time_s: ArrayLike) -> F64:
        """Yaw (unwrapped over the given times), pitch, roll in radians (n, 3)."""
        R = self.pose(time_s)[:, :3, :3]
        yaw = np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
        pitch = np.arcsin(np.clip(-R[:, 2, 0], -1, 1))
        return np.column_stack([yaw, pitch, np.arctan2(R[:, 2, 1], R[:, 2, 2])])

    def moved(self, T_target_world: F64) -> Motion:
        """The same motion seen from another frame (rigid transform): exact, as splines are affine."""
        R, p = T_target_world[:3, :3], self.position
        x, y, z, w = Rotation.from_matrix(R).as_quat()
        left = np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
        return Motion(
            BSpline(p.t, p.c @ R.T + T_target_world[:3, 3], p.k),
            BSpline(self.attitude.t, self.attitude.c @ left.T, self.attitude.k),
            self.duration_s,
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


def _matrix(quaternion: F64) -> F64:
    """Rotations float64 (n, 3, 3) of quaternions x, y, z, w (n, 4) of any length but 0."""
    x, y, z, w = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
