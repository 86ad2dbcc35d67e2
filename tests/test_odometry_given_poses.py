import dataclasses

import numpy as np
import pytest

from artemis_edge.errors import InputError
from artemis_edge.frames import ImuSamples, LidarScan, SyncedFrame, Trajectory
from artemis_edge.odometry import se3
from artemis_edge.odometry.given_poses import GivenPoses

TWIST = np.array([8.0, 0.1, -0.1, 0.05, -0.02, 0.8])
START = se3.exp(np.array([5.0, 6.0, 7.0, 0.3, -0.2, 1.0]))
STAMPS = 10**18 + np.arange(8) * 100_000_000  # as large as Unix time: float seconds would lose microseconds


def steady():
    return GivenPoses(Trajectory(STAMPS, np.array([START @ se3.exp(0.1 * k * TWIST) for k in range(8)])))


def frame(stamp_ns, **fields):
    return SyncedFrame(3, int(stamp_ns), **{"scans": (), **fields})


@pytest.mark.parametrize("k", range(8))
def test_a_stamp_of_the_trajectory_gives_exactly_its_pose(k):
    pose, twist = steady().at(int(STAMPS[k]))
    np.testing.assert_allclose(pose, START @ se3.exp(0.1 * k * TWIST), atol=1e-12)
    np.testing.assert_allclose(twist, TWIST, atol=1e-9)


@pytest.mark.parametrize("offset_ns", [-10_000_000, 1, 30_000_000, 99_999_999, 333_000_000, 709_000_000])
def test_between_poses_constant_velocity(offset_ns):
    pose, twist = steady().at(int(STAMPS[0]) + offset_ns)
    np.testing.assert_allclose(pose, START @ se3.exp(offset_ns * 1e-9 * TWIST), atol=1e-9)
    np.testing.assert_allclose(twist, TWIST, atol=1e-9)


def test_points_are_moved_to_the_stamp():
    time_s = np.array([-0.05, 0.05], np.float32)
    points = np.array([[20, 0, 0], [20, 0, 0]], np.float32)
    tracked = steady().track(frame(STAMPS[4], scans=(LidarScan(points, int(STAMPS[4]), time_s),)))
    for moved, point, t in zip(tracked.scans[0].points, points, time_s, strict=True):
        T = se3.exp(float(t) * TWIST)
        np.testing.assert_allclose(moved, T[:3, :3] @ point + T[:3, 3], atol=1e-5)
    assert tracked.index == 3 and tracked.stamp_ns == STAMPS[4] and not tracked.degenerate


def test_a_single_pose_has_no_velocity():
    pose, twist = GivenPoses(Trajectory(STAMPS[:1], START[None])).at(int(STAMPS[0]))
    np.testing.assert_allclose(pose, START, atol=1e-12)
    np.testing.assert_array_equal(twist, np.zeros(6))


@pytest.mark.parametrize("offset_ns", [-10_000_001, 710_000_001])
def test_frames_outside_the_trajectory_are_refused(offset_ns):
    with pytest.raises(InputError, match="no given pose covers"):
        steady().track(frame(STAMPS[0] + offset_ns))


def test_bad_trajectories_are_refused():
    for trajectory, words in (
        (Trajectory(STAMPS[:0], np.empty((0, 4, 4))), "empty"),
        (Trajectory(STAMPS[[1, 0]], np.stack([START, START])), "ascend"),
        (Trajectory(STAMPS[[0, 0]], np.stack([START, START])), "ascend"),
        (Trajectory(STAMPS[:1], START[None] * np.nan), "finite"),
        (Trajectory(STAMPS[:2], START[None]), "one a stamp"),
    ):
        with pytest.raises(InputError, match=words):
            GivenPoses(trajectory)


@pytest.mark.parametrize(("far_m", "fits"), [(99_999.0, True), (-100_001.0, False), (5e6, False)])
def test_poses_far_from_the_origin_are_refused(far_m, fits):
    poses = np.stack([START, START])
    poses[1, 1, 3] = far_m
    if fits:
        assert GivenPoses(Trajectory(STAMPS[:2], poses)).at(int(STAMPS[1]))[0][1, 3] == far_m
    else:
        with pytest.raises(InputError, match=f"reach {abs(far_m) / 1000:.6g} km .* subtract one offset"):
            GivenPoses(Trajectory(STAMPS[:2], poses))


def shaken(t):
    """A pose of a hand that turns, T_world_lidar (4, 4)."""
    turn = 0.3 * np.sin(9.0 * t)
    return START @ se3.exp(
        np.array([1.2 * t, 0.02 * np.sin(12 * t), 0, 0.2 * turn, 0.3 * np.cos(7 * t), turn])
    )


def shaken_frame(stamp_s, gyro_bias=0.0):
    """A frame of 100 ms that looks at fixed points of the world, with gyroscope samples at 200 Hz."""
    rng = np.random.default_rng(0)
    world = rng.uniform(-15, 15, (60, 3)) + np.array([5.0, 6.0, 7.0])
    time_s = np.linspace(-0.05, 0.05, 60).astype(np.float32)
    points = [
        (se3.inverse(shaken(stamp_s + float(t))) @ np.append(p, 1.0))[:3]
        for t, p in zip(time_s, world, strict=True)
    ]
    at = stamp_s + np.arange(-0.06, 0.0601, 0.005)
    gyro = [se3.log(se3.inverse(shaken(t - 1e-4)) @ shaken(t + 1e-4))[3:] / 2e-4 + gyro_bias for t in at]
    imu = ImuSamples(np.rint(at * 1e9).astype(np.int64), np.array(gyro), np.zeros((len(at), 3)))
    scan = LidarScan(np.array(points, np.float32), round(stamp_s * 1e9), time_s)
    return SyncedFrame(0, round(stamp_s * 1e9), (scan,), imu=imu), world


def error_of(poses_s, imu):
    """Largest error of the de-skewed points in the world when poses at these times are given, metres."""
    seen, world = shaken_frame(1.0)
    given = Trajectory(
        np.rint(np.asarray(poses_s) * 1e9).astype(np.int64), np.array([shaken(t) for t in poses_s])
    )
    if not imu:
        seen = dataclasses.replace(seen, imu=ImuSamples.empty())
    tracked = GivenPoses(given).track(seen)
    moved = tracked.scans[0].points @ tracked.T_world_lidar[:3, :3].T + tracked.T_world_lidar[:3, 3]
    return float(np.linalg.norm(moved - world, axis=1).max())


def test_motion_within_a_scan_follows_what_is_known_of_it():
    sparse, dense = np.arange(0.5, 1.55, 0.1), np.arange(0.9, 1.1, 0.0025)
    assert error_of(sparse, imu=False) > 0.05, "one twist a scan does not do"
    assert error_of(sparse, imu=True) < 0.03
    assert error_of(dense, imu=False) < 0.005
    assert error_of(dense, imu=True) < 0.005
