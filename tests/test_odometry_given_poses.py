import numpy as np
import pytest

from artemis_edge.errors import InputError
from artemis_edge.frames import LidarScan, SyncedFrame, Trajectory
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
