import numpy as np
import pytest

from artemis_edge.frames import ImuSamples
from artemis_edge.odometry import se3
from artemis_edge.odometry.imu import join, levelling, mean_rate, shortest_rotation, since


def samples(stamps, accel=(0.0, 0.0, 9.81)):
    stamps = np.array(stamps, np.int64)
    gyro = np.column_stack([stamps, stamps * 0, stamps * 0]).astype(float)
    return ImuSamples(stamps, gyro, np.tile(np.array(accel, float), (len(stamps), 1)))


@pytest.mark.parametrize("tilt", [(0, 0, 0), (0.3, -0.2, 0), (3.0, 0, 0), (np.pi, 0, 0), (0, np.pi, 0)])
def test_levelling_brings_the_measured_up_to_z(tilt):
    R_lidar_world = se3.exp(np.array([0.0, 0, 0, *tilt]))[:3, :3]
    up = R_lidar_world @ np.array([0, 0, 9.81])
    R = levelling(samples([1, 2, 3], up))
    np.testing.assert_allclose(R @ up, [0, 0, 9.81], atol=1e-9)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_levelling_does_not_turn_about_the_vertical():
    np.testing.assert_allclose(levelling(samples([1], (0, 0, 9.7))), np.eye(3), atol=1e-12)


@pytest.mark.parametrize("accel", [(0, 0, 1.0), (0, 0, 0), (np.nan, 0, 0), (30, 0, 0)])
def test_what_is_not_gravity_does_not_level(accel):
    np.testing.assert_array_equal(levelling(samples([1], accel)), np.eye(3))


def test_no_samples_no_level_and_no_rate():
    np.testing.assert_array_equal(levelling(ImuSamples.empty()), np.eye(3))
    assert mean_rate(ImuSamples.empty(), 0, 10) is None


def test_joined_samples_are_in_order_and_once():
    joined = join(samples([1, 2, 3]), samples([2, 3, 4, 5]))
    assert joined.stamp_ns.tolist() == [1, 2, 3, 4, 5]
    assert joined.gyro[:, 0].tolist() == [1, 2, 3, 4, 5]
    assert mean_rate(joined, 1, 4)[0] == 3.0
    assert since(joined, 3).stamp_ns.tolist() == [4, 5]
    assert join(ImuSamples.empty(), samples([7])).stamp_ns.tolist() == [7]


@pytest.mark.parametrize("b", [(0, 0, 1), (1, 0, 0), (0, 0.6, -0.8), (-1, 0, 0)])
def test_shortest_rotation(b):
    a = np.array([1.0, 0, 0])
    R = shortest_rotation(a, np.array(b, float))
    np.testing.assert_allclose(R @ a, b, atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
