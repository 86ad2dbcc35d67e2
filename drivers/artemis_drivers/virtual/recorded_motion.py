"""Real motion, recorded as poses and IMU samples, as a smooth trajectory that can drive the virtual rig.

Files: poses as lines "t x y z qx qy qz qw" (TUM), IMU as lines "t ax ay az wx wy wz" in m/s2 and rad/s of the same
body, both in seconds. The gyroscopes give the attitude between the poses, the accelerometers the position: a
spline is fitted to both by least squares, together with gravity and the sensors' constant biases. The result turns
like the real thing up to about 20 Hz; its derivatives are exact, so that a virtual IMU on it is, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import BSpline, CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from artemis_drivers.virtual.imu import GRAVITY
from artemis_drivers.virtual.mesh_builder import F64
from artemis_drivers.virtual.motion import Motion

_KNOT_S = 0.02
_DEGREE = 5
_POSE_M = 0.01  # what a recorded position is trusted to, one sigma
_ACCEL = 0.05  # m/s2, what a recorded acceleration is trusted to
_DRIFT_S = 0.5  # slower than this the poses give the attitude, faster the gyroscopes
_SLOW_S = 2.0  # what is slower is travel, what is faster is gait and sway
_LEAST_POSES = 20


@dataclass(frozen=True, slots=True)
class Recording:
    """``motion`` from time 0, body x ahead, y left, z up, in a level world whose x is the first heading.

    ``start_s`` is the recording's time of 0; ``R_recorded_body`` (3, 3) the body's axes in the recorded ones;
    root mean squares of what the spline leaves: ``position_m``, ``rotation_deg``, ``accel`` m/s2.
    """

    motion: Motion
    start_s: float
    R_recorded_body: F64
    position_m: float
    rotation_deg: float
    accel: float


def recorded_motion(poses_file: Path, imu_file: Path) -> Recording:
    """Fit the files. Raises ValueError that says what is wrong with them."""
    poses, imu = _rows(poses_file, 8, "t x y z qx qy qz qw"), _rows(imu_file, 7, "t ax ay az wx wy wz")
    start, stop = max(poses[0, 0], imu[0, 0]), min(poses[-1, 0], imu[-1, 0])
    poses = poses[(poses[:, 0] >= start) & (poses[:, 0] <= stop)]
    imu = imu[(imu[:, 0] >= start) & (imu[:, 0] <= stop)]
    if len(poses) < _LEAST_POSES or len(imu) < 2 * len(poses):
        raise ValueError(
            f"{poses_file} and {imu_file} share {len(poses)} poses and {len(imu)} IMU samples; at least"
            f" {_LEAST_POSES} poses and twice as many samples of the same time are needed"
        )
    begin, time = poses[0, 0], imu[:, 0] - poses[0, 0]
    imu, time = imu[time >= 0], time[time >= 0]
    attitude = _attitude(poses[:, 0] - begin, Rotation.from_quat(poses[:, 4:]), time, imu[:, 4:])
    fit = _position(poses[:, 0] - begin, poses[:, 1:4], time, attitude.apply(imu[:, 1:4]), attitude)
    motion, R = _levelled(fit.spline, time, attitude, fit.gravity)
    residual = Rotation.from_matrix(motion.pose(poses[:, 0] - begin)[:, :3, :3] @ R.T)
    turn = residual * Rotation.from_quat(poses[:, 4:]).inv()
    level = turn.mean()
    return Recording(
        motion,
        float(begin),
        R,
        fit.position_m,
        float(np.degrees(np.sqrt(((turn * level.inv()).magnitude() ** 2).mean()))),
        fit.accel,
    )


def along(recording: Recording, path: F64) -> Motion:
    """The recorded gait, sway and looks along ``path`` (n, 3) of a virtual world, at the recorded speed.

    Slow travel and slow turns are replaced by the path's. Raises ValueError when the path is too short.
    """
    time = np.arange(0.0, recording.motion.duration_s, _KNOT_S)
    position = np.asarray(recording.motion.position(time), np.float64)
    slow = _smoothed(position, _SLOW_S)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(slow, axis=0), axis=1))])
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    if travelled[-1] > arc[-1]:
        raise ValueError(
            f"the path of {arc[-1]:.1f} m is too short for {travelled[-1]:.1f} m of recorded motion"
        )
    on_path = _smoothed(np.column_stack([np.interp(travelled, arc, path[:, a]) for a in range(3)]), _SLOW_S)
    ahead = np.gradient(on_path, axis=0)
    moving = np.hypot(ahead[:, 0], ahead[:, 1]) > 1e-7
    course = np.unwrap(np.arctan2(ahead[moving, 1], ahead[moving, 0]))
    heading = _smoothed(np.interp(time, time[moving], course), _SLOW_S)
    turn = heading - _smoothed(recording.motion.angles(time)[:, 0], _SLOW_S)
    about_z = Rotation.from_euler("z", turn[:, None])
    R = (about_z * Rotation.from_matrix(recording.motion.pose(time)[:, :3, :3])).as_matrix()
    return Motion.through_rotations(time, on_path + about_z.apply(position - slow), R)


def _rows(file: Path, columns: int, names: str) -> F64:
    """Numbers of a text file, sorted by time, rows with nonsense refused."""
    try:
        rows = np.loadtxt(file, ndmin=2, comments="#")
    except (OSError, ValueError) as error:
        raise ValueError(f"{file} cannot be read as lines of numbers {names}: {error}") from None
    if rows.shape[1] != columns:
        raise ValueError(f"{file} has {rows.shape[1]} columns; it must have {columns}: {names}")
    if not np.isfinite(rows).all() or not (np.diff(rows[:, 0]) > 0).all():
        raise ValueError(f"{file} must have finite numbers and ascending times in its lines {names}")
    return rows


def _attitude(pose_s: F64, poses: Rotation, imu_s: F64, gyro: F64) -> Rotation:
    """Attitudes at the IMU's times: its integrated rates, drawn to the poses slowly."""
    step = np.diff(imu_s)[:, None]
    turns = Rotation.from_rotvec((gyro[1:] + gyro[:-1]) / 2 * step)
    chained = [Rotation.identity()]
    for turn in turns:
        chained.append(chained[-1] * turn)
    free = Rotation.concatenate(chained)
    held = _between(imu_s, free, pose_s)
    off = poses * held.inv()
    # the correction is a slow, small rotation about its first value
    first = off[0]
    rate = len(pose_s) / max(pose_s[-1] - pose_s[0], 1e-9)
    vector = gaussian_filter1d((off * first.inv()).as_rotvec(), _DRIFT_S * rate, axis=0, mode="nearest")
    at = CubicSpline(pose_s, vector)(np.clip(imu_s, pose_s[0], pose_s[-1]))
    return Rotation.from_rotvec(at) * first * free


def _between(time: F64, attitude: Rotation, wanted: F64) -> Rotation:
    """Attitudes at other times, turning evenly between neighbours."""
    k = np.clip(np.searchsorted(time, wanted, side="right") - 1, 0, len(time) - 2)
    share = np.clip((wanted - time[k]) / (time[k + 1] - time[k]), 0, 1)
    step = (attitude[k].inv() * attitude[k + 1]).as_rotvec()
    return attitude[k] * Rotation.from_rotvec(step * share[:, None])


@dataclass(frozen=True, slots=True)
class _Fit:
    spline: BSpline
    gravity: F64
    position_m: float
    accel: float


def _position(pose_s: F64, position: F64, imu_s: F64, force: F64, attitude: Rotation) -> _Fit:
    """Least squares over all spline coefficients, gravity and bias: p(pose) = position and
    p''(imu) + R bias - gravity = R force.
    """
    stop = max(pose_s[-1], imu_s[-1])
    inner = np.arange(0.0, stop + _KNOT_S, _KNOT_S)
    before, after = _KNOT_S * np.arange(-_DEGREE, 0), inner[-1] + _KNOT_S * np.arange(1, _DEGREE + 1)
    knots = np.concatenate([before, inner, after])
    count = len(knots) - _DEGREE - 1
    place = BSpline.design_matrix(pose_s, knots, _DEGREE)
    bend = _second_derivative(imu_s, knots)
    R = attitude.as_matrix()
    blocks = []
    for a in range(3):
        row: list[object] = [None] * 4
        row[a] = sparse.vstack([place / _POSE_M, bend / _ACCEL])
        extra = np.zeros((len(pose_s) + len(imu_s), 6))
        extra[len(pose_s) :, :3] = R[:, a] / _ACCEL
        extra[len(pose_s) :, 3 + a] = -1 / _ACCEL
        row[3] = sparse.csr_matrix(extra)
        blocks.append(row)
    A = sparse.bmat(blocks, format="csr")
    b = np.concatenate([np.concatenate([position[:, a] / _POSE_M, force[:, a] / _ACCEL]) for a in range(3)])
    prior = sparse.diags(np.concatenate([np.full(3 * count, 1e-8), np.full(3, 1.0), np.zeros(3)]))
    x = spsolve((A.T @ A + prior).tocsc(), A.T @ b)
    left = (A @ x - b).reshape(3, -1)
    return _Fit(
        BSpline(knots, x[: 3 * count].reshape(3, count).T, _DEGREE),
        x[-3:],
        float(np.sqrt((left[:, : len(pose_s)] ** 2).mean()) * _POSE_M),
        float(np.sqrt((left[:, len(pose_s) :] ** 2).mean()) * _ACCEL),
    )


def _second_derivative(time: F64, knots: F64) -> sparse.csr_matrix:
    """Matrix from spline coefficients to second derivatives, for knots that are evenly spaced."""
    count = len(knots) - _DEGREE - 1
    low = BSpline.design_matrix(time, knots[2:-2], _DEGREE - 2)
    ones = np.ones(count)
    twice = sparse.diags([ones, -2 * ones, ones], [0, 1, 2], shape=(count - 2, count)) / _KNOT_S**2
    return sparse.csr_matrix(low @ twice)


def _levelled(spline: BSpline, time: F64, attitude: Rotation, gravity: F64) -> tuple[Motion, F64]:
    """Motion with gravity along -z, the first heading along x and the body's axes ahead, left, up; and those
    axes in the recorded body.
    """
    if not 0.9 * GRAVITY < np.linalg.norm(gravity) < 1.1 * GRAVITY:
        raise ValueError(
            f"poses and IMU samples do not belong to one body: gravity fits {np.linalg.norm(gravity):.2f} m/s2"
        )
    knots = np.arange(0.0, time[-1], _KNOT_S)
    position = np.asarray(spline(knots), np.float64)
    level, _ = Rotation.align_vectors(np.array([[0.0, 0.0, -1.0]]), gravity[None] / np.linalg.norm(gravity))
    turned = _between(time, attitude, knots)
    R = _body_axes(level * turned, level.apply(spline(knots, 1)))
    body = level * turned * Rotation.from_matrix(R)
    yaw = np.arctan2(*body.as_matrix()[0, [1, 0], 0])
    T = np.eye(4)
    T[:3, :3] = (Rotation.from_euler("z", -yaw) * level).as_matrix()
    T[:3, 3] = -T[:3, :3] @ position[0]
    smooth = _low_pass(turned * Rotation.from_matrix(R))
    return Motion.through_rotations(knots, position, smooth).moved(T), R


def _low_pass(attitude: Rotation) -> F64:
    """Rotations (n, 3, 3) without what is faster than two knots can carry."""
    quaternion = attitude.as_quat()
    flips = np.sign((quaternion[1:] * quaternion[:-1]).sum(axis=1))
    quaternion[1:] *= np.cumprod(np.where(flips == 0, 1.0, flips))[:, None]
    return np.asarray(Rotation.from_quat(gaussian_filter1d(quaternion, 0.5, axis=0)).as_matrix(), np.float64)


def _body_axes(attitude: Rotation, velocity: F64) -> F64:
    """Columns: ahead, left, up in the recorded body, each the recorded axis nearest to the mean direction."""
    up = _nearest_axis(attitude.inv().apply([0.0, 0.0, 1.0]).mean(axis=0), np.zeros(3))
    ahead = _nearest_axis(attitude.inv().apply(velocity).mean(axis=0), up)
    return np.column_stack([ahead, np.cross(up, ahead), up])


def _nearest_axis(direction: F64, without: NDArray[np.float64]) -> F64:
    size = np.where(without != 0, -1.0, np.abs(direction))
    k = int(np.argmax(size))
    return np.asarray(np.eye(3)[k] * (1.0 if direction[k] >= 0 else -1.0))


def _smoothed(value: F64, seconds: float) -> F64:
    return np.asarray(gaussian_filter1d(value, seconds / _KNOT_S, axis=0, mode="nearest"), np.float64)
