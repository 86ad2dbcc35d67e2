import numpy as np
import pytest

from artemis_edge.frames import ImuSamples
from artemis_edge.odometry import se3
from artemis_edge.odometry.scan_motion import covers, during, steady, through, times, turning

TWIST = np.array([1.0, -0.5, 0.2, 0.3, -0.2, 2.6])


def samples(stamp_s, gyro):
    stamps = np.rint(np.asarray(stamp_s) * 1e9).astype(np.int64)
    return ImuSamples(stamps, np.asarray(gyro, np.float64), np.zeros((len(stamps), 3)))


@pytest.mark.parametrize("t", [-0.3, 0.0, 0.07, 2.5])
def test_steady_motion_is_the_exponential(t):
    np.testing.assert_allclose(steady(TWIST).at(t), se3.exp(t * TWIST), atol=1e-12)


@pytest.mark.parametrize("first, last", [(-0.05, 0.05), (0.0, 0.0), (0.0, 0.1), (-0.013, 0.002)])
def test_pieces_cover_the_window_evenly(first, last):
    ends = times(first, last)
    assert ends[0] == first and ends[-1] >= last and len(ends) >= 2
    np.testing.assert_allclose(np.diff(ends), ends[1] - ends[0])
    assert ends[1] - ends[0] <= 0.0100001


def test_motion_through_poses_meets_them_and_goes_on_beyond():
    ends = times(-0.04, 0.06)
    poses = np.array([se3.exp(t * TWIST + 3 * t * t) for t in ends])
    motion = through(ends, poses)
    for t, T in zip(ends, poses, strict=True):
        np.testing.assert_allclose(motion.at(t), T, atol=1e-9)
    np.testing.assert_allclose(motion.at(0.07), poses[-1] @ se3.exp(0.01 * motion.twist[-1]), atol=1e-9)
    np.testing.assert_allclose(motion.at(-0.05), poses[0] @ se3.exp(-0.01 * motion.twist[0]), atol=1e-9)


@pytest.mark.parametrize("shift", [-0.03, 0.0, 0.011, 0.2])
def test_another_reference_is_the_same_motion(shift):
    ends = times(-0.04, 0.06)
    motion = through(ends, np.array([se3.exp(t * TWIST + t * t) for t in ends]))
    moved = motion.referred_to(shift)
    for t in (-0.04, 0.0, 0.033):
        np.testing.assert_allclose(
            moved.at(t - shift), se3.inverse(motion.at(shift)) @ motion.at(t), atol=1e-9
        )


def test_turning_follows_a_turn_that_changes():
    """About z by 0.3 sin(9 t): the rate is 2.7 cos(9 t)."""
    at = np.arange(0.9, 1.1, 0.005)
    gyro = np.column_stack([np.zeros_like(at), np.zeros_like(at), 2.7 * np.cos(9 * at)])
    motion = turning(samples(at, gyro), 10**9, np.array([1.0, 2.0, 3.0]), times(-0.05, 0.05))
    for t in (-0.05, -0.02, 0.0, 0.04, 0.05):
        angle = 0.3 * (np.sin(9 * (1 + t)) - np.sin(9.0))
        np.testing.assert_allclose(se3.log(motion.at(t))[3:], [0, 0, angle], atol=2e-4)
        # between two ends the place goes along the arc of a piece
        np.testing.assert_allclose(motion.at(t)[:3, 3], np.array([1.0, 2.0, 3.0]) * t, atol=1e-3)


def test_at_the_reference_nothing_has_moved():
    imu = samples([0.99, 1.01], [[0, 0, 1], [0, 0, 1]])
    for window in ((-0.05, 0.05), (0.0, 0.1), (-0.1, 0.0), (0.02, 0.1)):
        motion = turning(imu, 10**9, np.zeros(3), times(*window))
        np.testing.assert_allclose(motion.at(0.0), np.eye(4), atol=1e-9)


def test_samples_of_a_window_and_whether_they_cover_it():
    imu = samples([1.0, 1.01, 1.02, 1.03], np.zeros((4, 3)))
    assert during(imu, 1_012_000_000, 1_018_000_000).stamp_ns.tolist() == [1_010_000_000, 1_020_000_000]
    assert during(imu, 0, 2 * 10**9).stamp_ns.tolist() == imu.stamp_ns.tolist()
    assert covers(imu, 1_000_000_000, 1_030_000_000)
    assert covers(imu, 985_000_000, 1_045_000_000)
    assert not covers(imu, 970_000_000, 1_030_000_000)
    assert not covers(imu, 1_000_000_000, 1_060_000_000)
    assert not covers(ImuSamples.empty(), 0, 1)
