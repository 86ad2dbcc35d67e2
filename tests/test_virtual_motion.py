"""The virtual rig's motion: splines and their derivatives, walks, recorded real motion."""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from artemis_drivers.virtual import street
from artemis_drivers.virtual.imu import ImuSpec, measure
from artemis_drivers.virtual.mesh_builder import F64
from artemis_drivers.virtual.motion import Motion, rotation
from artemis_drivers.virtual.recorded_motion import along, recorded_motion
from artemis_drivers.virtual.walk import Gait, path_needed_m, walk
from scipy.spatial.transform import Rotation


def polyline(*corners: tuple[float, float, float]) -> F64:
    parts = [
        np.linspace(a, b, int(np.linalg.norm(np.subtract(b, a)) / 0.3) + 1, endpoint=False)
        for a, b in pairwise(corners)
    ]
    return np.concatenate([*parts, [corners[-1]]])


STRAIGHT = polyline((0, 0, 1.5), (200, 0, 1.5))


# --- splines


def test_angular_velocity_and_acceleration_are_the_derivatives() -> None:
    motion = walk(street.build(1, 100.0, None).path, 12.0, 1)
    t, h = np.linspace(1.2, 11, 60), 1e-4
    before, after = motion.pose(t - h), motion.pose(t + h)
    turn = Rotation.from_matrix(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]).as_rotvec()
    np.testing.assert_allclose(motion.angular_velocity(t), turn / (2 * h), atol=2e-5)
    np.testing.assert_allclose(motion.velocity(t), (after[:, :3, 3] - before[:, :3, 3]) / (2 * h), atol=2e-5)
    np.testing.assert_allclose(
        motion.acceleration(t), (motion.velocity(t + h) - motion.velocity(t - h)) / (2 * h), atol=1e-3
    )


def test_rotation_convention() -> None:
    angles = np.array([[0.3, -0.2, 0.1]])
    np.testing.assert_allclose(rotation(angles)[0], Rotation.from_euler("ZYX", angles[0]).as_matrix())
    t = np.linspace(0, 1, 9)
    motion = Motion.through(t, np.zeros((9, 3)), np.tile(angles, (9, 1)) + t[:, None] * [3.0, 0, 0])
    np.testing.assert_allclose(
        motion.angles(t), np.tile(angles, (9, 1)) + t[:, None] * [3.0, 0, 0], atol=1e-9
    )


def test_any_attitude_is_possible() -> None:
    """Straight up and down, where angles of yaw, pitch and roll have no derivative."""
    t = np.linspace(0, 2, 101)
    R = Rotation.from_euler("y", 4.0 * t[:, None]).as_matrix()
    motion = Motion.through_rotations(t, np.zeros((101, 3)), R)
    np.testing.assert_allclose(motion.angular_velocity(t), np.tile([0, 4.0, 0], (101, 1)), atol=1e-6)
    poses = motion.pose(np.linspace(0, 2, 777))[:, :3, :3]
    np.testing.assert_allclose(poses @ np.swapaxes(poses, 1, 2), np.tile(np.eye(3), (777, 1, 1)), atol=1e-12)


def test_moved_motion_is_the_same_motion_elsewhere() -> None:
    motion = walk(STRAIGHT, 8.0, 3)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("zyx", [1.0, 0.4, -0.3]).as_matrix(), (3, -2, 1)
    other, t = motion.moved(T), np.linspace(0, 8, 50)
    np.testing.assert_allclose(other.pose(t), T @ motion.pose(t), atol=1e-12)
    np.testing.assert_allclose(other.angular_velocity(t), motion.angular_velocity(t), atol=1e-9)


# --- walks


def test_walk_stands_still_level_then_walks() -> None:
    world = street.build(2, 100.0)
    motion = walk(world.path, 20.0, 2, Gait(stop_every_s=0))
    early = np.arange(0, 0.98, 0.01)
    assert np.ptp(motion.position(early), axis=0).max() < 1e-6
    assert np.abs(motion.angles(early)[:, 1:]).max() < 1e-6
    travelled = np.linalg.norm(np.diff(motion.position(np.arange(0, 20, 0.1))[:, :2], axis=0), axis=1).sum()
    assert travelled == pytest.approx(1.2 * (20 - 1.75), rel=0.1)
    walking = np.arange(4, 20, 0.01)
    bob = motion.position(walking)[:, 2]
    spectrum = np.abs(np.fft.rfft(bob - np.poly1d(np.polyfit(walking, bob, 6))(walking)))
    frequency = np.fft.rfftfreq(len(walking), 0.01)
    assert frequency[np.argmax(spectrum * (frequency > 1))] == pytest.approx(2.0, abs=0.2)
    assert np.ptp(np.degrees(motion.angles(walking)[:, 0])) > 60  # looks to both sides


def test_walk_needs_a_path_long_enough() -> None:
    with pytest.raises(ValueError, match="too short"):
        walk(STRAIGHT[:30], 60.0, 0)
    for seconds in (3.0, 30.0):
        line = np.array([[0, 0, 1.0], [path_needed_m(seconds), 0, 1.0]])
        assert walk(line, seconds, 0, Gait(stop_every_s=0)).duration_s >= seconds


def test_walk_stops_and_goes_on() -> None:
    t = np.arange(3, 60, 0.02)
    speed = np.linalg.norm(walk(STRAIGHT, 60.0, 1, Gait(stop_every_s=12.0)).velocity(t)[:, :2], axis=1)
    standing = speed < 0.1
    assert 0.03 < standing.mean() < 0.3
    assert np.diff(standing.astype(int)).clip(0).sum() >= 2
    always = np.linalg.norm(walk(STRAIGHT, 60.0, 1, Gait(stop_every_s=0)).velocity(t)[:, :2], axis=1)
    assert always.min() > 0.6


@pytest.mark.parametrize("limit", [60.0, 150.0])
def test_fast_turns_reach_their_limit_and_no_more(limit: float) -> None:
    gait = Gait(look_deg=100.0, turn_deg_s=limit, stop_every_s=0)
    rate = np.degrees(walk(STRAIGHT, 60.0, 4, gait).angular_velocity(np.arange(0, 60, 0.005)))
    fastest = np.linalg.norm(rate, axis=1).max()
    assert limit * 0.85 < fastest < limit * 1.1 + 20  # gait, drift and tremor come on top


def test_corners_are_taken_slowly() -> None:
    path = polyline((0, 0, 1.5), (8, 0, 1.5), (8, 8, 1.5), (0, 8, 1.5), (0, 40, 1.5), (0, 90, 1.5))
    gait = Gait(look_every_s=0, stop_every_s=0)
    t = np.arange(0, 40, 0.01)
    motion = walk(path, 40.0, 2, gait)
    assert np.degrees(np.abs(motion.angular_velocity(t)[:, 2]).max()) < gait.corner_deg_s + 20
    p = motion.position(t)
    away = np.min([np.abs(p[:, None, :2] - path[None, :, :2]).sum(axis=2).min(axis=1)], axis=0)
    assert away.max() < 0.55


def test_stairs_are_climbed_slowly_and_looked_down_at() -> None:
    path = polyline((0, 0, 1.5), (6, 0, 1.5), (10, 0, 3.9), (60, 0, 3.9))
    motion = walk(path, 30.0, 2, Gait(look_every_s=0, stop_every_s=0))
    t = np.arange(0, 30, 0.02)
    p, v = motion.position(t), motion.velocity(t)
    assert p[-1, 2] == pytest.approx(3.9, abs=0.1) and p[0, 2] == pytest.approx(1.5, abs=0.01)
    on_stairs, level = (p[:, 0] > 7.2) & (p[:, 0] < 8.8), (p[:, 0] > 13) & (p[:, 0] < 20)
    speed = np.linalg.norm(v, axis=1)
    assert speed[on_stairs].mean() < 0.65 * speed[level].mean()
    pitch = np.degrees(motion.angles(t)[:, 1])
    assert pitch[on_stairs].mean() > pitch[level].mean() + 4  # positive: down


def test_looks_turn_to_places_worth_it() -> None:
    place = np.array([[14.0, 7.0, 6.0]])
    motion = walk(STRAIGHT, 25.0, 5, Gait(stop_every_s=0), place)
    t = np.arange(3, 25, 0.02)
    T = motion.pose(t)
    towards = place - T[:, :3, 3]
    near = np.linalg.norm(towards, axis=1) < 15
    aim = (T[:, :3, 0] * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    assert np.degrees(np.arccos(aim[near].max())) < 12
    without = walk(STRAIGHT, 25.0, 5, Gait(stop_every_s=0)).pose(t)
    assert not np.allclose(without, T)


def test_same_seed_same_walk() -> None:
    t = np.linspace(0, 10, 99)
    one, two, other = (walk(STRAIGHT, 10.0, seed).pose(t) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, two)
    assert not np.allclose(one, other)


# --- recorded motion


def write_recording(folder: Path, motion: Motion, seconds: float, seed: int = 0) -> tuple[Path, Path]:
    """What a device would log: 10 Hz poses good to 3 mm and 0.05 deg, 100 Hz IMU, in camera-like axes."""
    rng = np.random.default_rng(seed)
    R_body_device = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    t = np.arange(round(seconds * 10)) / 10
    T = motion.pose(t)
    R = Rotation.from_matrix(T[:, :3, :3] @ R_body_device)
    R = R * Rotation.from_rotvec(rng.normal(0, np.radians(0.05), (len(t), 3)))
    poses = np.column_stack([1e9 + t, T[:, :3, 3] + rng.normal(0, 0.003, (len(t), 3)), R.as_quat()])
    spec = ImuSpec(rate_hz=100.0)
    record = measure(motion, spec, seed, seconds)
    imu = np.column_stack([1e9 + record.time_s, record.accel @ R_body_device, record.gyro @ R_body_device])
    np.savetxt(folder / "poses.txt", poses, fmt="%.9f")
    np.savetxt(folder / "imu.txt", imu, fmt="%.9f")
    return folder / "poses.txt", folder / "imu.txt"


def test_recorded_motion_is_recovered(tmp_path: Path) -> None:
    truth = walk(STRAIGHT, 21.0, 7, Gait(tremor_deg=0.02))
    recording = recorded_motion(*write_recording(tmp_path, truth, 20.0))
    t = np.arange(1.0, 19.0, 0.01)
    assert recording.start_s == pytest.approx(1e9)
    np.testing.assert_array_equal(recording.R_recorded_body, [[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    T = truth.pose(t)
    back = T[0] @ np.linalg.inv(recording.motion.pose(t[0])[0])
    placed = recording.motion.moved(back).pose(t)
    assert np.linalg.norm(placed[:, :3, 3] - T[:, :3, 3], axis=1).max() < 0.05
    turn = Rotation.from_matrix(np.swapaxes(placed[:, :3, :3], 1, 2) @ T[:, :3, :3])
    assert np.degrees(turn.magnitude().max()) < 0.6
    rate = recording.motion.angular_velocity(t) - truth.angular_velocity(t)
    assert np.degrees(np.sqrt((rate**2).mean())) < 0.5  # constant bias of 0.1 deg/s and noise included
    assert recording.position_m < 0.01 and recording.accel < 0.1


def test_recorded_gait_goes_along_a_path(tmp_path: Path) -> None:
    truth = walk(STRAIGHT, 21.0, 7, Gait(stop_every_s=0))
    recording = recorded_motion(*write_recording(tmp_path, truth, 20.0))
    path = polyline((5, 5, 2.0), (5, 60, 2.0))
    motion = along(recording, path)
    t = np.arange(3, 17, 0.05)
    p = motion.position(t)
    assert np.abs(p[:, 0] - 5).max() < 0.15 and np.abs(p[:, 2] - 2).max() < 0.1
    assert p[-1, 1] - p[0, 1] == pytest.approx(1.2 * 14, rel=0.12)
    assert np.abs(np.degrees(motion.angles(t)[:, 0]).mean() - 90) < 25
    assert np.std(p[:, 2]) > 0.008  # the steps are there
    with pytest.raises(ValueError, match="too short"):
        along(recording, path[:10])


def test_recordings_with_faults_are_refused(tmp_path: Path) -> None:
    poses, imu = write_recording(tmp_path, walk(STRAIGHT, 6.0, 7), 5.0)
    with pytest.raises(ValueError, match="7 columns"):
        recorded_motion(imu, imu)
    with pytest.raises(ValueError, match="cannot be read"):
        recorded_motion(tmp_path / "nothing.txt", imu)
    rows = np.loadtxt(imu)
    np.savetxt(tmp_path / "late.txt", rows + np.array([100.0, 0, 0, 0, 0, 0, 0]))
    with pytest.raises(ValueError, match="share 0 poses"):
        recorded_motion(poses, tmp_path / "late.txt")
    np.savetxt(tmp_path / "back.txt", rows[::-1])
    with pytest.raises(ValueError, match="ascending"):
        recorded_motion(poses, tmp_path / "back.txt")
    rows[:, 1:4] *= 0.1  # in g
    np.savetxt(tmp_path / "g.txt", rows)
    with pytest.raises(ValueError, match="gravity"):
        recorded_motion(poses, tmp_path / "g.txt")


@pytest.mark.data
def test_real_recording_fits() -> None:
    folder = Path(os.environ.get("ARTEMIS_DATA", "nowhere")) / "gtsam_points" / "continuous"
    if not folder.is_dir():
        pytest.skip("needs ARTEMIS_DATA with gtsam_points")
    recording = recorded_motion(folder / "traj.txt", folder / "imu.txt")
    assert recording.motion.duration_s > 230
    assert recording.position_m < 0.002 and recording.rotation_deg < 0.05 and recording.accel < 0.05
    imu = np.loadtxt(folder / "imu.txt")[500:-500]
    t = imu[:, 0] - recording.start_s
    rate = recording.motion.angular_velocity(t) @ recording.R_recorded_body.T - imu[:, 4:]
    assert np.degrees(rate.std()) < 0.1
    motion = along(recording, STRAIGHT)
    assert np.abs(motion.position(np.arange(0, 230, 0.1))[:, 1]).max() < 0.6
