"""Poses between the frames, as smooth as a hand moves: a spline of places, attitudes from the gyroscope."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline, Slerp

from artemis_edge._jit import njit
from artemis_edge.frames import F64, I64, ImuSamples, Trajectory
from artemis_edge.odometry import se3
from artemis_edge.odometry.scan_motion import covers

_DIFFERENCE_S = 1e-3  # step of the central difference that gives the twist


@njit
def integrated_turns(sample_s: F64, gyro: F64, bias: F64, time_s: F64) -> F64:
    """Attitudes (n, 3, 3) R_start_t at ascending times (n,), from the first of them, by rates (m, 3) rad/s.

    Rates are linear between samples and constant beyond them.
    """
    out = np.empty((len(time_s), 3, 3))
    R, at, j = np.eye(3), time_s[0], np.searchsorted(sample_s, time_s[0], side="right")
    twist = np.zeros(6)
    for k in range(len(time_s)):
        while at < time_s[k]:
            until = min(sample_s[j], time_s[k]) if j < len(sample_s) else time_s[k]
            middle = 0.5 * (at + until)
            for axis in range(3):
                twist[3 + axis] = np.interp(middle, sample_s, gyro[:, axis]) - bias[axis]
            R = R @ np.ascontiguousarray(se3.exp((until - at) * twist)[:3, :3])
            at = until
            if j < len(sample_s) and at >= sample_s[j]:
                j += 1
        out[k] = R
    return out


class SmoothPoses:
    """T_world_lidar at any time of a trajectory of at least four poses (fewer: straight between them)."""

    def __init__(self, trajectory: Trajectory, imu: ImuSamples) -> None:
        self.start_ns, self.stop_ns = int(trajectory.stamp_ns[0]), int(trajectory.stamp_ns[-1])
        self._knot_s = (trajectory.stamp_ns - self.start_ns) * 1e-9
        self._place = CubicSpline(self._knot_s, trajectory.T_world_lidar[:, :3, 3])
        turns = Rotation.from_matrix(trajectory.T_world_lidar[:, :3, :3])
        self._gyro: Slerp | None = None
        if covers(imu, self.start_ns, self.stop_ns):
            self._gyro = self._integrated(imu)
            # what the gyroscope leaves is its bias: slow, so that the shortest way between knots is right
            self._turn: RotationSpline | Slerp = Slerp(self._knot_s, turns * self._gyro(self._knot_s).inv())
        else:
            self._turn = RotationSpline(self._knot_s, turns)

    def _integrated(self, imu: ImuSamples) -> Slerp:
        sample_s = (imu.stamp_ns - self.start_ns) * 1e-9
        inner = sample_s[(sample_s > 0.0) & (sample_s < self._knot_s[-1])]
        times = np.unique(np.concatenate([[0.0], inner, self._knot_s[-1:]]))
        turns = integrated_turns(sample_s, np.ascontiguousarray(imu.gyro), np.zeros(3), times)
        return Slerp(times, Rotation.from_matrix(turns))

    def covers(self, stamp_ns: int, margin_s: float = 0.0) -> bool:
        """Whether a time lies within the trajectory, at least ``margin_s`` from its ends."""
        margin = round(margin_s * 1e9)
        return self.start_ns + margin <= stamp_ns <= self.stop_ns - margin

    def at(self, stamp_ns: I64) -> F64:
        """Poses (n, 4, 4); beyond the ends the first or last."""
        time_s = np.clip((np.asarray(stamp_ns) - self.start_ns) * 1e-9, 0.0, self._knot_s[-1])
        return self._at(time_s)

    def _at(self, time_s: F64) -> F64:
        turn = self._turn(time_s) if self._gyro is None else self._turn(time_s) * self._gyro(time_s)
        T = np.zeros((len(time_s), 4, 4))
        T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = turn.as_matrix(), self._place(time_s), 1.0
        return T

    def twist(self, stamp_ns: I64) -> F64:
        """Body twists (n, 6), m/s and rad/s."""
        time_s = (np.asarray(stamp_ns) - self.start_ns) * 1e-9
        time_s = np.clip(time_s, _DIFFERENCE_S, self._knot_s[-1] - _DIFFERENCE_S)
        before, after = self._at(time_s - _DIFFERENCE_S), self._at(time_s + _DIFFERENCE_S)
        steps = [se3.log(se3.inverse(a) @ b) for a, b in zip(before, after, strict=True)]
        return np.array(steps).reshape(-1, 6) / (2.0 * _DIFFERENCE_S)
