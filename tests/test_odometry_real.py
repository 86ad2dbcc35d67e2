"""De-skew and IMU integration against real recordings; skipped without them (ARTEMIS_DATA)."""

import os
from math import comb
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from artemis_edge.frames import F64, I64, ImuSamples
from artemis_edge.odometry import se3
from artemis_edge.odometry.deskew import move_points
from artemis_edge.odometry.propagation import ImuNoise, propagate
from artemis_edge.odometry.scan_motion import ScanMotion, through
from artemis_edge.odometry.state import State

_DATA = Path(os.environ.get("ARTEMIS_DATA", "")) / "gtsam_points"
needs_data = pytest.mark.skipif(
    "ARTEMIS_DATA" not in os.environ or not _DATA.is_dir(), reason="needs ARTEMIS_DATA with gtsam_points"
)


# --- newer_06: three scans, raw and as their publisher de-skewed them


def _rigid(a: F64, b: F64) -> F64:
    """T (4, 4) that takes points a (n, 3) to b, least squares (Umeyama)."""
    ca, cb = a.mean(axis=0), b.mean(axis=0)
    U, _, V = np.linalg.svd((b - cb).T @ (a - ca))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
    T[:3, 3] = cb - T[:3, :3] @ ca
    return T


def _scan(k: int) -> tuple[np.ndarray, np.ndarray, F64]:
    """Raw points, their times, and the publisher's points."""
    raw, given = (np.fromfile(_DATA / "newer_06" / f"{n}_0{k}.bin", np.float32) for n in ("raw", "deskewed"))
    times = np.fromfile(_DATA / "newer_06" / f"times_0{k}.bin", np.float32)
    return raw.reshape(-1, 3).copy(), times, given.reshape(-1, 3).astype(np.float64)


def _motion(raw: np.ndarray, times: np.ndarray, given: F64) -> tuple[ScanMotion, F64]:
    """The publisher's motion, by what it did to the points measured within 2 ms of every hundredth of a second."""
    nodes = np.linspace(0.0, 0.1, 11)
    near = [np.abs(times - t) < 0.002 for t in nodes]
    poses = np.array([_rigid(raw[m].astype(np.float64), given[m]) for m in near])
    return through(nodes - 0.1, np.linalg.inv(poses[-1]) @ poses), poses[-1]


def _walls(points: F64, band_m: float = 0.2, most: int = 2) -> list[I64]:
    """Rows of the points on the largest straight walls seen from above (RANSAC)."""
    rng = np.random.default_rng(1)
    away = np.linalg.norm(points, axis=1)
    rows = np.flatnonzero((points[:, 2] > -1) & (points[:, 2] < 4) & (away > 2) & (away < 40))
    found = []
    for _ in range(most):
        flat, best = points[rows, :2], np.zeros(len(rows), bool)
        for _ in range(400):
            i, j = rng.integers(0, len(flat), 2)
            way = flat[j] - flat[i]
            if np.linalg.norm(way) > 2.0:
                across = np.array([-way[1], way[0]]) / np.linalg.norm(way)
                near = np.abs((flat - flat[i]) @ across) < band_m
                best = near if near.sum() > best.sum() else best
        found.append(rows[best])
        rows = rows[~best]
    return found


def _thickness_m(points: F64) -> float:
    """Robust deviation across a wall seen from above."""
    off = points[:, :2] - np.median(points[:, :2], axis=0)
    kept = off
    for _ in range(5):
        across = np.linalg.eigh(np.cov(kept.T))[1][:, 0]
        r = off @ across
        spread = 1.4826 * np.median(np.abs(r - np.median(r)))
        kept = off[np.abs(r - np.median(r)) < 3 * spread]
    return float(spread)


@needs_data
def test_deskewed_walls_are_thinner_than_raw_ones() -> None:
    raw_m, ours_m, fastest_m = [], [], 0.0
    for k in range(3):
        raw, times, given = _scan(k)
        motion, T_given_end = _motion(raw, times, given)
        ours = np.asarray(move_points(raw, times, -0.1, motion, np.eye(4)), np.float64)
        theirs = (given - T_given_end[:3, 3]) @ T_given_end[:3, :3]
        moved = float(np.median(np.linalg.norm(raw - theirs, axis=1)))
        assert np.median(np.linalg.norm(ours - theirs, axis=1)) < 0.03 * moved + 0.003
        for rows in _walls(raw.astype(np.float64)):  # chosen on the raw scan, which favours it
            raw_m.append(_thickness_m(raw[rows].astype(np.float64)))
            ours_m.append(_thickness_m(ours[rows]))
        fastest_m = max(fastest_m, moved)
    assert fastest_m > 0.5  # one of them turns fast
    assert np.mean(ours_m) < 0.95 * np.mean(raw_m)
    assert np.mean(ours_m[4:]) < 0.9 * np.mean(raw_m[4:])  # that one


# --- continuous: four minutes of an IMU and of poses


def _recording() -> tuple[ImuSamples, I64, F64]:
    """Samples, stamps of the poses and the poses of the IMU (n, 4, 4)."""
    rows, poses = np.loadtxt(_DATA / "continuous" / "imu.txt"), np.loadtxt(_DATA / "continuous" / "traj.txt")
    start = rows[0, 0]
    stamps = np.rint((rows[:, 0] - start) * 1e9).astype(np.int64)
    imu = ImuSamples(stamps, np.ascontiguousarray(rows[:, 4:7]), np.ascontiguousarray(rows[:, 1:4]))
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(poses[:, 4:8]).as_matrix(), poses[:, 1:4]
    return imu, np.rint((poses[:, 0] - start) * 1e9).astype(np.int64), T


def _white(samples: F64, hz: float, order: int = 5) -> float:
    """Density of white noise: a high difference of the samples holds hardly any motion."""
    return float(np.diff(samples, n=order, axis=0).std() / comb(2 * order, order) ** 0.5 / hz**0.5)


def _misses(imu: ImuSamples, stamps: I64, T: F64, n: int, noise: ImuNoise) -> tuple[F64, F64]:
    """Of windows of n poses: turns that the integration misses by (rad), and second differences of place (m).

    Both in body axes. Two windows in a row, the second begun with the velocity gained in the first, tell place without
    knowing any velocity. Slow biases and gravity's error are taken off by the mean of the windows before and after.
    """
    turned, moved = [], []
    gravity, zero = np.array([0.0, 0.0, -9.82]), np.zeros(3)
    for k in range(0, len(stamps) - 2 * n, 2 * n):
        ends, velocity = [], zero
        for i in (k, k + n):
            state = State(int(stamps[i]), T[i], velocity, zero, zero, gravity, np.zeros((18, 18)))
            end, _ = propagate(state, int(stamps[i + n]), imu, noise, zero, zero)
            ends.append(end.T_world_body)
            velocity = end.velocity
        turned.append(se3.log(se3.inverse(ends[0]) @ T[k + n])[3:])
        told = (ends[1] - T[k + n]) - (ends[0] - T[k])
        moved.append(T[k + n, :3, :3].T @ (T[k + 2 * n] - 2 * T[k + n] + T[k] - told)[:3, 3])
    a, b = np.array(turned), np.array(moved)
    return a[1:-1] - 0.5 * (a[2:] + a[:-2]), b[1:-1] - 0.5 * (b[2:] + b[:-2])


# The derivation is in docs/odometry.md: what the poses and the bias of the accelerometer add to the white noise.
_POSE_M, _POSE_RAD, _BIAS_WALK = 3.5e-5, 1.2e-4, 2.7e-3


@needs_data
@pytest.mark.parametrize("n", [2, 5, 10, 20])
def test_integration_misses_the_poses_by_what_the_noise_allows(n: int) -> None:
    imu, stamps, T = _recording()
    gyro, accel = _white(imu.gyro, 100.0), _white(imu.accel, 100.0)
    assert gyro == pytest.approx(1.7e-4, rel=0.05) and accel == pytest.approx(2.0e-3, rel=0.05)
    turned, moved = _misses(imu, stamps, T, n, ImuNoise(gyro, accel, 0.0, 0.0, 6.0, 3.0))
    s = 0.1 * n
    turn = np.sqrt(1.5 * gyro**2 * s + 3.0 * _POSE_RAD**2)
    tilt = 9.81 * gyro * np.sqrt(2.0 / 3.0 * 1.5 * 2.0 * s**5 / 15.0)
    place = np.sqrt(s**3 * accel**2 + tilt**2 + 9.0 * _POSE_M**2 + _BIAS_WALK**2 * s**5)
    assert 0.4 * turn < np.sqrt(np.mean(np.square(turned))) < 1.25 * turn
    assert 0.7 * place < np.sqrt(np.mean(np.square(moved))) < 1.25 * place
