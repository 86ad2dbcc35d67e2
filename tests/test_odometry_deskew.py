import numpy as np
import pytest

from artemis_edge.frames import LidarScan, SyncedFrame
from artemis_edge.odometry import se3
from artemis_edge.odometry.deskew import deskew_frame, deskew_scan, move_points, window
from artemis_edge.odometry.scan_motion import ScanMotion, steady

TWIST = np.array([10.0, -0.5, 0.2, 0.3, -0.2, 2.6])
MOUNT = se3.exp(np.array([0.3, -1.0, 0.5, 0.1, 0.2, -2.0]))


def naive_move_points(points, time_s, shift_s, motion, T_lidar_sensor):
    out = np.empty((len(points), 3), np.float32)
    for i, point in enumerate(points):
        T = motion.at(float(time_s[i]) + shift_s) @ T_lidar_sensor
        out[i] = T[:3, :3] @ point.astype(float) + T[:3, 3]
    return out


@pytest.mark.parametrize("n", [0, 1, 500])
@pytest.mark.parametrize("twist", [TWIST, np.zeros(6), np.r_[TWIST[:3], 0, 0, 0]])
def test_equals_the_naive_twin(n, twist):
    check_twin(n, steady(twist))


@pytest.mark.parametrize("n", [0, 1, 500])
def test_pieces_equal_the_naive_twin(n):
    rng = np.random.default_rng(3)
    T = np.array([se3.exp(rng.normal(0, 0.3, 6)) for _ in range(7)])
    check_twin(n, ScanMotion(-0.02, 0.01, T, rng.normal(0, 2, (7, 6))))


def check_twin(n, motion):
    rng = np.random.default_rng(n)
    points = rng.normal(0, 30, (n, 3)).astype(np.float32)
    time_s = rng.uniform(-0.05, 0.05, n).astype(np.float32)
    fast = move_points(points, time_s, 0.02, motion, MOUNT)
    assert fast.dtype == np.float32
    np.testing.assert_allclose(fast, naive_move_points(points, time_s, 0.02, motion, MOUNT), atol=2e-5)


def test_long_windows_stay_exact():
    points = np.full((3, 3), 10.0, np.float32)
    time_s = np.array([-0.5, 0.0, 0.5], np.float32)
    fast = move_points(points, time_s, 0.0, steady(TWIST), np.eye(4))
    np.testing.assert_allclose(
        fast, naive_move_points(points, time_s, 0.0, steady(TWIST), np.eye(4)), atol=2e-5
    )


def test_not_a_number_stays_with_its_point():
    points = np.ones((3, 3), np.float32)
    points[1, 2] = np.nan
    moved = move_points(points, np.zeros(3, np.float32), 0.0, steady(TWIST), np.eye(4))
    assert np.isfinite(moved[[0, 2]]).all() and np.isnan(moved[1]).any()


def test_a_wall_seen_on_a_spiral_is_flat_again():
    """A sensor that turns and drives measures a wall at x = 20 m of the world over 0.1 s."""
    rng = np.random.default_rng(1)
    wall = np.column_stack([np.full(400, 20.0), rng.uniform(-10, 10, 400), rng.uniform(-2, 5, 400)])
    time_s = np.linspace(-0.05, 0.05, 400)
    measured = np.empty((400, 3))
    for i, t in enumerate(time_s):
        T = se3.inverse(se3.exp(t * TWIST) @ MOUNT)
        measured[i] = T[:3, :3] @ wall[i] + T[:3, 3]
    assert measured[:, 0].std() > 0.1
    scan = LidarScan(measured.astype(np.float32), 10**9, time_s.astype(np.float32), T_lidar_sensor=MOUNT)
    moved = deskew_scan(scan, 10**9, steady(TWIST))
    np.testing.assert_allclose(moved.points, wall, atol=2e-5)
    np.testing.assert_array_equal(moved.origin, MOUNT[:3, 3])


def test_scan_without_point_times_moves_rigidly_to_the_frame():
    point = np.array([[1.0, 2.0, 3.0]], np.float32)
    frame = SyncedFrame(0, 10**9, (LidarScan(point, 10**9), LidarScan(point, 10**9 + 50_000_000)))
    same, later = deskew_frame(frame, steady(TWIST))
    np.testing.assert_array_equal(same.points, point)
    T = se3.exp(0.05 * TWIST)
    np.testing.assert_allclose(later.points[0], T[:3, :3] @ point[0] + T[:3, 3], atol=1e-5)


def test_window_of_a_frame():
    points, offset = np.zeros((3, 3), np.float32), np.array([0.0, 0.02, 0.09], np.float32)
    scans = (LidarScan(points, 10**9, offset), LidarScan(points, 10**9 + 20_000_000))
    assert window(SyncedFrame(0, 10**9 + 50_000_000, scans)) == pytest.approx((-0.05, 0.04))
    assert window(SyncedFrame(0, 10**9, ())) == (0.0, 0.0)
    assert window(SyncedFrame(0, 10**9, (LidarScan(points[:0], 10**9, offset[:0]),))) == (0.0, 0.0)
