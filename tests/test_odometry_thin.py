import numpy as np
import pytest

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import LidarScan, SyncedFrame
from artemis_edge.odometry import se3
from artemis_edge.odometry.thin import Thinner, first_per_voxel


def naive_first_per_voxel(points, voxel_m, low, high):
    seen, rows = set(), []
    for row, p in enumerate(points.astype(float)):
        distance = np.sqrt((p**2).sum())
        if not (low <= distance <= high):
            continue
        cell = tuple(np.floor(p / voxel_m))
        if cell not in seen:
            seen.add(cell)
            rows.append(row)
    return rows


@pytest.mark.parametrize("n", [0, 1, 2000])
def test_equals_the_naive_twin(n):
    points = np.random.default_rng(n).normal(0, 4, (n, 3)).astype(np.float32)
    if n > 2:
        points[::50] = np.nan
        points[1::50, 1] = np.inf
        points[2::50] = 0.0
    rows = first_per_voxel(points, 0.75, 1.0, 9.0)
    assert rows.tolist() == naive_first_per_voxel(points, 0.75, 1.0, 9.0)


def scan_of(n, extent, seed=0):
    points = np.random.default_rng(seed).uniform(-extent, extent, (n, 3)).astype(np.float32)
    points[:, 2] = -1.5  # a floor
    return LidarScan(points, 10**9, np.linspace(0, 0.1, n).astype(np.float32))


@pytest.mark.parametrize("extent", [3.0, 10.0, 50.0])
def test_number_of_points_follows_the_configuration_not_the_scene(extent):
    config = OdometryConfig(points=500, insert_m=0.05)
    scan = Thinner(config).thin(SyncedFrame(0, 10**9, (scan_of(40_000, extent),)))
    assert 300 < len(scan.sparse.points) < 800
    assert len(scan.dense.points) > 2 * len(scan.sparse.points)


def test_times_are_from_the_middle_of_the_points():
    scan = Thinner(OdometryConfig()).thin(SyncedFrame(0, 10**9 - 20_000_000, (scan_of(20_000, 10.0),)))
    assert scan.stamp_ns == pytest.approx(10**9 + 50_000_000, abs=100_000)
    assert scan.dense.time_s.min() == pytest.approx(-0.05, abs=1e-3)
    assert scan.dense.time_s.max() == pytest.approx(0.05, abs=1e-3)


def test_scans_of_several_lidars_meet_in_the_lidar_frame():
    mount = se3.exp(np.array([1.0, 2.0, 3.0, 0.3, 0.2, 0.1]))
    wall = np.array([[5.0, 1.0, 2.0]], np.float32)
    seen = se3.inverse(mount)
    other = (wall @ seen[:3, :3].T + seen[:3, 3]).astype(np.float32)
    scans = (LidarScan(wall, 10**9), LidarScan(other, 10**9 + 40_000_000, T_lidar_sensor=mount))
    scan = Thinner(OdometryConfig()).thin(SyncedFrame(0, 10**9, scans))
    np.testing.assert_allclose(scan.dense.points, np.vstack([wall, wall]), atol=1e-5)
    np.testing.assert_allclose(scan.dense.time_s, [-0.02, 0.02], atol=1e-6)


def test_an_empty_scan_gives_no_points():
    scan = Thinner(OdometryConfig()).thin(SyncedFrame(0, 7, (LidarScan(np.empty((0, 3), np.float32), 7),)))
    assert scan.stamp_ns == 7 and len(scan.dense.points) == len(scan.sparse.points) == 0
