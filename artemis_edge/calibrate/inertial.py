"""How an IMU sits on the LiDAR: its attitudes and places must be those of the odometry, turned, shifted and late.

Both are compared over windows of a few seconds, whose first attitude, place and velocity are free, so that slow
drift of either does not count.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from artemis_edge.calibrate.poses import SmoothPoses, integrated_turns
from artemis_edge.frames import F64, I64, ImuSamples, Trajectory
from artemis_edge.odometry.scan_motion import during

_WINDOW = 20  # poses in which a bias of the gyroscope is constant and drift of the odometry small
_LATEST_S = 0.2  # clocks further apart are not guessed
_GRID_S = 0.005
_LEAST_RATE = 0.05  # rad/s, deviation of the turn rate: a recording without turns tells nothing
_LEAST_POSES = 30
_ROBUST_RAD = 2e-3  # residual beyond which a pose is taken for a fault
_MOST_LEVER_SIGMA_M = 0.005
_SHORT = 10  # poses over which the accelerometer is integrated twice


class ImuFit(NamedTuple):
    """``rotation`` (3,) rotation vector and ``time_offset_s`` as of ``mounts.ImuMount``, the gyroscope's ``bias``.

    ``position`` (3,) is where the IMU is in the LiDAR frame, m, or None if the motion does not tell;
    ``sigma_rad``, ``sigma_s`` and ``position_sigma_m`` (3,) are one deviation.
    """

    rotation: F64
    time_offset_s: float
    bias: F64
    sigma_rad: float
    sigma_s: float
    position: F64 | None
    position_sigma_m: F64


def fit_imu(poses: Trajectory, imu: ImuSamples) -> ImuFit | None:
    """The IMU's mount from poses (n, 4, 4) and samples in the axes that are assumed; None if they do not tell."""
    if len(poses) < _LEAST_POSES or len(imu.stamp_ns) < len(poses):
        return None
    origin = int(poses.stamp_ns[0])
    pose_s, sample_s = _seconds(poses.stamp_ns, origin), _seconds(imu.stamp_ns, origin)
    inside = (pose_s > sample_s[0] + _LATEST_S) & (pose_s < sample_s[-1] - _LATEST_S)
    pose_s, attitudes = pose_s[inside], np.ascontiguousarray(poses.T_world_lidar[inside, :3, :3])
    if len(pose_s) < _LEAST_POSES:
        return None
    gyro: F64 = np.ascontiguousarray(imu.gyro, np.float64)
    guess = _first_guess(pose_s, attitudes, sample_s, gyro)
    if guess is None:
        return None
    fit = _Attitudes(pose_s, attitudes, sample_s, gyro)
    found = least_squares(fit.residuals, guess, loss="soft_l1", f_scale=_ROBUST_RAD, x_scale=fit.scale())
    variance = 2.0 * found.cost / max(len(found.fun) - len(guess), 1)
    sigma = np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)) * variance)
    mount = ImuSamples(
        imu.stamp_ns + round(found.x[6] * 1e9),
        imu.gyro @ Rotation.from_rotvec(found.x[:3]).as_matrix().T,
        imu.accel @ Rotation.from_rotvec(found.x[:3]).as_matrix().T,
    )
    position, position_sigma = fit_position(poses, mount)
    return ImuFit(
        found.x[:3],
        float(found.x[6]),
        found.x[3:6],
        float(sigma[:3].max()),
        float(sigma[6]),
        position if position_sigma.max() < _MOST_LEVER_SIGMA_M else None,
        position_sigma,
    )


def attitude_rms(poses: Trajectory, imu: ImuSamples) -> float:
    """Residual of attitudes, rad, if the samples' axes and times are right but for the gyroscope's bias."""
    origin = int(poses.stamp_ns[0])
    pose_s, sample_s = _seconds(poses.stamp_ns, origin), _seconds(imu.stamp_ns, origin)
    inside = (pose_s > sample_s[0] + _LATEST_S) & (pose_s < sample_s[-1] - _LATEST_S)
    fit = _Attitudes(
        pose_s[inside],
        np.ascontiguousarray(poses.T_world_lidar[inside, :3, :3]),
        sample_s,
        np.ascontiguousarray(imu.gyro),
    )

    def biased(bias: F64) -> F64:
        return fit.residuals(np.concatenate([np.zeros(3), bias, np.zeros(1)]))

    found = least_squares(biased, np.zeros(3), loss="soft_l1", f_scale=_ROBUST_RAD, x_scale=1e-3)
    return float(np.sqrt(np.mean(found.fun**2)))


class _Attitudes:
    """Residuals of attitudes; unknowns: rotation (3), bias (3) of the gyroscope, time offset."""

    def __init__(self, pose_s: F64, attitudes: F64, sample_s: F64, gyro: F64) -> None:
        self._sample_s, self._gyro = sample_s, gyro
        bounds = [*range(0, len(pose_s) - _WINDOW // 2, _WINDOW), len(pose_s)]
        self._windows = [(pose_s[a:b], Rotation.from_matrix(attitudes[a:b])) for a, b in pairwise(bounds)]

    @staticmethod
    def scale() -> F64:
        """Steps of the unknowns that matter alike."""
        return np.array([1e-3] * 3 + [1e-3] * 3 + [1e-3])

    def residuals(self, x: F64) -> F64:
        """Rotation vectors (3 n,) by which each window's attitudes differ from their own mean difference, rad."""
        mount, out = Rotation.from_rotvec(x[:3]), []
        for pose_s, attitude in self._windows:
            turned = integrated_turns(self._sample_s, self._gyro, x[3:6], pose_s - x[6])
            own = mount * Rotation.from_matrix(turned) * mount.inv()
            difference = attitude * own.inv()
            vector = (difference * difference[len(pose_s) // 2].inv()).as_rotvec()
            out.append(vector - vector.mean(axis=0))
        return np.concatenate(out).ravel()


def _first_guess(pose_s: F64, attitudes: F64, sample_s: F64, gyro: F64) -> F64 | None:
    """Offset by correlation of the speeds of turning, rotation by Kabsch's method; None without turns."""
    turns = Rotation.from_matrix(attitudes)
    rate = (turns[:-1].inv() * turns[1:]).as_rotvec() / np.diff(pose_s)[:, None]
    speed = np.linalg.norm(rate, axis=1)
    if speed.std() < _LEAST_RATE:
        return None
    integral = np.vstack(
        [np.zeros(3), np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(sample_s)[:, None], 0)]
    )
    best, offset = -np.inf, 0.0
    for shift in np.arange(-_LATEST_S, _LATEST_S + _GRID_S, _GRID_S):
        mean = _means(pose_s - shift, sample_s, integral)
        score = float(np.corrcoef(speed, np.linalg.norm(mean, axis=1))[0, 1])
        if score > best:
            best, offset = score, float(shift)
    mean = _means(pose_s - offset, sample_s, integral)
    rotation, _ = Rotation.align_vectors(rate, mean)
    return np.concatenate([rotation.as_rotvec(), np.zeros(3), [offset]])


def _seconds(stamp_ns: I64, origin_ns: int) -> F64:
    return np.asarray((stamp_ns - origin_ns) * 1e-9, np.float64)


def _means(time_s: F64, sample_s: F64, integral: F64) -> F64:
    """Mean rates (n - 1, 3) between times."""
    at = np.stack([np.interp(time_s, sample_s, integral[:, axis]) for axis in range(3)], axis=1)
    return np.asarray(np.diff(at, axis=0) / np.diff(time_s)[:, None])


def fit_position(poses: Trajectory, imu: ImuSamples) -> tuple[F64, F64]:
    """Place (3,) of the IMU in the LiDAR frame and its deviations (3,), m, by linear least squares.

    With attitudes known, the path of the IMU is linear in its place, the bias of the accelerometer, gravity, and
    each window's start and velocity: p_k + R_k r = p_0 + v_0 t + g t^2 / 2 + double integral of R (a - b).
    """
    smooth = SmoothPoses(poses, imu)
    near = during(imu, int(poses.stamp_ns[0]), int(poses.stamp_ns[-1]))
    stamp, accel = near.stamp_ns, near.accel
    R = smooth.at(stamp)[:, :3, :3]
    rows, values = [], []
    for first in range(0, len(poses) - _SHORT, _SHORT // 2):
        part = slice(first, first + _SHORT + 1)
        design, value = _window(poses.stamp_ns[part], poses.T_world_lidar[part], stamp, R, accel)
        rows.append(design)
        values.append(value)
    A, y = np.concatenate(rows), np.concatenate(values)
    x, *_ = np.linalg.lstsq(A, y, rcond=None)
    residual = y - A @ x
    # windows overlap by half: every pose counts twice
    variance = 2.0 * float(residual @ residual) / max(len(y) // 2 - len(x), 1)
    sigma = np.sqrt(np.diag(np.linalg.pinv(A.T @ A)) * variance)
    return np.asarray(x[:3], np.float64), np.asarray(sigma[:3], np.float64)


def _window(pose_ns: I64, T: F64, stamp: I64, R: F64, accel: F64) -> tuple[F64, F64]:
    """Equations of one window for place, bias and gravity; start and velocity are projected out."""
    start = int(pose_ns[0])
    # one sample beyond either end: an integral that stops at the last one before is short by up to 5 ms of speed
    low = max(int(np.searchsorted(stamp, pose_ns[0], "right")) - 1, 0)
    high = int(np.searchsorted(stamp, pose_ns[-1], "left")) + 1
    s, t = _seconds(stamp[low:high], start), _seconds(pose_ns, start)
    force = np.einsum("nij,nj->ni", R[low:high], accel[low:high])
    moved = _twice(s, force, t)
    biased = np.stack([_twice(s, R[low:high, :, axis], t) for axis in range(3)], axis=2)
    n = len(t)
    design = np.zeros((n, 3, 9))
    design[:, :, :3] = T[:, :3, :3]
    design[:, :, 3:6] = biased
    design[:, :, 6:] = -0.5 * (t**2)[:, None, None] * np.eye(3)
    value = moved - T[:, :3, 3]
    basis, _ = np.linalg.qr(np.stack([np.ones(n), t], axis=1))
    design -= np.einsum("ka,ma,mij->kij", basis, basis, design)
    value = value - basis @ (basis.T @ value)
    return design.reshape(-1, 9), value.ravel()


def _twice(sample_s: F64, values: F64, time_s: F64) -> F64:
    """Double integral (n, 3) of samples (m, 3) from their first on, at times (n,)."""
    step = np.diff(sample_s)[:, None]
    speed = np.vstack([np.zeros(3), np.cumsum(0.5 * (values[1:] + values[:-1]) * step, 0)])
    inner = speed[:-1] * step + (2.0 * values[:-1] + values[1:]) * step**2 / 6.0
    place = np.vstack([np.zeros(3), np.cumsum(inner, 0)])
    return np.stack([np.interp(time_s, sample_s, place[:, axis]) for axis in range(3)], axis=1)
