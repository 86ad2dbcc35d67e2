"""The whole odometry in a small world of boxes, where every pose is known."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from artemis_edge.config import OdometryConfig
from artemis_edge.datasets import open_input
from artemis_edge.evaluate.trajectory import evaluate_trajectory
from artemis_edge.frames import CameraImage, CameraModel, ImuSamples, LidarScan, SyncedFrame, Trajectory
from artemis_edge.odometry import se3
from artemis_edge.odometry.lidar_odometry import LidarOdometry
from artemis_edge.odometry.search import all_round
from artemis_edge.trajectory import read_tum
from tests.box_world import PERIOD_S, corridor, frame, scan, street

CONFIG = OdometryConfig(points=1500)


def driving(t):
    """A car at 9 m/s that weaves and nods."""
    T = se3.exp(np.array([0.0, 0, 0, 0.01 * np.sin(4 * t), 0.01 * np.sin(3 * t), 0.12 * np.sin(0.9 * t)]))
    T[:3, 3] = 9.0 * t, 0.5 * np.sin(0.7 * t), 1.7
    return T


def carried(t):
    """A hand that stands for 2 s, then walks and turns by up to 60 deg/s."""
    s = max(t - 2.0, 0.0)
    yaw = 0.75 * (1 - np.cos(1.3 * s))
    T = se3.exp(np.array([0.0, 0, 0, 0.05 * np.sin(s), 0.03 * np.sin(2 * s), yaw]))
    T[:3, 3] = 0.9 * s, 0.3 * np.sin(s), 1.6 + 0.03 * np.sin(5 * s)
    return T


def errors_m(tracked, pose_at, spacing_s=PERIOD_S):
    """Distance (n,) of the estimated places from the true ones, both seen from their first frame."""
    start = se3.inverse(pose_at(0.0))
    world = se3.inverse(tracked[0].T_world_lidar)
    return np.array(
        [
            np.linalg.norm((world @ t.T_world_lidar)[:3, 3] - (start @ pose_at(k * spacing_s))[:3, 3])
            for k, t in enumerate(tracked)
        ]
    )


def track(frames, config=CONFIG):
    odometry = LidarOdometry(config)
    return [odometry.track(f) for f in frames], odometry


def test_a_car_that_drives_when_the_recording_starts():
    boxes = street()
    tracked, odometry = track([frame(k, driving, boxes) for k in range(25)])
    assert errors_m(tracked, driving).max() < 0.03
    assert odometry.lost == {} and not any(t.degenerate for t in tracked)
    assert all(t.degenerate_direction is None for t in tracked) and odometry.instruction is None
    motion = se3.log(se3.inverse(driving(2.3)) @ driving(2.4)) / 0.1
    np.testing.assert_allclose(odometry.twist[:3], motion[:3], atol=0.1)
    np.testing.assert_allclose(odometry.twist[3:], motion[3:], atol=0.01)


def test_a_stamp_at_the_start_of_the_turn_means_the_same():
    """Poses hold at the stamp, wherever in the scan it lies, and so do the points."""
    boxes = street()
    frames = [frame(k, driving, boxes, offset_s=0.05) for k in range(15)]
    tracked, _ = track(frames)
    assert errors_m(tracked, driving).max() < 0.03
    T_start = driving(0.0)
    for t in tracked[5:]:
        T = T_start @ t.T_world_lidar
        world = t.scans[0].points.astype(float) @ T[:3, :3].T + T[:3, 3]
        ground = np.abs(world[:, 2]) < 0.15
        assert ground.sum() > 1000 and np.abs(world[ground, 2]).mean() < 0.03


def test_looking_ahead_corrects_the_first_frame():
    frames = [frame(k, driving, street(), noise=0.0) for k in range(3)]
    scan = frames[0].scans[0]
    twist = se3.log(se3.inverse(driving(-0.05)) @ driving(0.05)) / 0.1
    true = np.array(
        [(se3.exp(t * twist) @ [*p, 1])[:3] for p, t in zip(scan.points, scan.offset_s, strict=True)]
    )

    def blur_m(tracked):
        return np.linalg.norm(tracked.scans[0].points - true, axis=1).mean()

    assert blur_m(LidarOdometry(CONFIG).track(frames[0])) > 0.15
    odometry = LidarOdometry.looking_ahead(CONFIG, frames)
    tracked = [odometry.track(f) for f in frames]
    assert blur_m(tracked[0]) < 0.02
    assert errors_m(tracked, driving).max() < 0.03


def test_a_carried_sensor_at_two_hertz_with_turns():
    """Already corrected scans without point times, half a second apart."""
    boxes = street()
    frames = []
    for k in range(20):
        points, _ = scan(lambda t, k=k: carried(0.5 * k), 0.0, boxes, seed=k)
        frames.append(SyncedFrame(k, k * 500_000_000, (LidarScan(points, k * 500_000_000),)))
    tracked, odometry = track(frames)
    assert errors_m(tracked, carried, 0.5).max() < 0.03
    assert odometry.lost == {}


def test_standing_still_does_not_drift():
    boxes = street()
    tracked, _ = track([frame(k, lambda t: driving(0.0), boxes) for k in range(12)])
    assert errors_m(tracked, lambda t: driving(0.0)).max() < 0.005


def test_a_corridor_is_flagged_and_a_street_is_not():
    def walking(t):
        T = np.eye(4)
        T[:3, 3] = 1.0 * t, 0.0, 1.3
        return T

    tracked, _ = track([frame(k, walking, corridor(), reach=20.0) for k in range(12)])
    assert all(t.degenerate and abs(t.degenerate_direction[0]) > 0.99 for t in tracked[1:])
    for t in tracked:  # what is observed holds
        assert np.abs(t.T_world_lidar[1:3, 3]).max() < 0.02


def test_same_input_same_bytes():
    boxes = street()
    frames = [frame(k, driving, boxes) for k in range(8)]
    (first, _), (second, _) = track(frames), track(frames)
    for a, b in zip(first, second, strict=True):
        assert a.T_world_lidar.tobytes() == b.T_world_lidar.tobytes()
        assert a.scans[0].points.tobytes() == b.scans[0].points.tobytes()


def empty_frame(k):
    return SyncedFrame(k, 10**15 + k * 100_000_000, (LidarScan(np.empty((0, 3), np.float32), 0),))


def test_a_frame_of_images_only_gets_the_predicted_pose():
    boxes = street()
    model = CameraModel(10, 10, 10.0, 10.0, 5.0, 5.0)
    image = CameraImage("cam", 10**15 + 850_000_000, b"", model, np.eye(4))
    odometry = LidarOdometry(CONFIG)
    for k in range(8):
        before = odometry.track(frame(k, driving, boxes))
    seen = odometry.track(SyncedFrame(8, 10**15 + 850_000_000, (), (image,)))
    expected = before.T_world_lidar @ se3.exp(0.15 * odometry.twist)
    np.testing.assert_allclose(seen.T_world_lidar, expected, atol=1e-3)
    assert seen.images == (image,) and seen.scans == () and odometry.lost == {}


def test_gaps_are_bridged_and_counted():
    boxes = street()
    frames = [frame(k, driving, boxes) for k in range(20)]
    nan = np.full((500, 3), np.nan, np.float32)
    frames[10] = empty_frame(10)
    frames[11] = SyncedFrame(11, frames[11].stamp_ns, (LidarScan(nan, frames[11].stamp_ns),))
    frames[12] = replace(frames[12], scans=(LidarScan(frames[12].scans[0].points[:20], frames[12].stamp_ns),))
    tracked, odometry = track(frames)
    assert odometry.lost == {"no points": 2, "not registered": 1}
    error = errors_m(tracked, driving)
    assert error[[k for k in range(20) if k not in (10, 11, 12)]].max() < 0.03
    assert error.max() < 0.3
    assert all(np.isfinite(t.T_world_lidar).all() for t in tracked)


def test_nothing_but_empty_frames():
    tracked, odometry = track([empty_frame(k) for k in range(4)])
    for t in tracked:
        np.testing.assert_array_equal(t.T_world_lidar, np.eye(4))
    assert odometry.lost == {"no points": 4}


def test_a_sensor_carried_elsewhere_begins_anew():
    """After being lost for long the map begins again at the predicted pose, and is counted."""
    boxes = street()
    start = [frame(k, lambda t: driving(0.0), boxes) for k in range(4)]
    rng = np.random.default_rng(0)
    for k in range(4, 30):
        walls = rng.uniform(-2, 2, (4000, 3))
        walls[np.arange(4000), rng.integers(0, 3, 4000)] = 2.0
        points = (walls + np.array([0, 0, 40])).astype(np.float32)
        start.append(SyncedFrame(k, 10**15 + k * 100_000_000, (LidarScan(points, 10**15 + k * 100_000_000),)))
    tracked, odometry = track(start)
    assert odometry.lost["restarts"] == 1 and odometry.lost["not registered"] == 10
    after = np.array([t.T_world_lidar[:3, 3] for t in tracked[15:]])
    assert np.abs(after - after[0]).max() < 0.05


def test_world_is_levelled_by_the_imu():
    boxes = street()
    tilt = se3.exp(np.array([0.0, 0, 0, 0.2, -0.1, 0]))

    def tilted(t):
        return driving(t) @ tilt

    up = tilted(0.0)[:3, :3].T @ np.array([0, 0, 9.81])
    frames = []
    for k in range(5):
        f = frame(k, tilted, boxes)
        stamps = f.stamp_ns - 50_000_000 + np.arange(20) * 5_000_000
        gyro = np.tile(
            se3.log(se3.inverse(tilted(0.1 * k - 0.05)) @ tilted(0.1 * k + 0.05))[3:] / 0.1, (20, 1)
        )
        frames.append(replace(f, imu=ImuSamples(stamps, gyro, np.tile(up, (20, 1)))))
    tracked, _ = track(frames)
    vertical = tracked[0].T_world_lidar[:3, :3] @ (up / 9.81)
    np.testing.assert_allclose(vertical, [0, 0, 1], atol=1e-6)
    assert np.abs(np.array([t.T_world_lidar[2, 3] for t in tracked])).max() < 0.03
    assert errors_m(tracked, tilted).max() < 0.03


def test_the_map_stays_within_its_bounds():
    boxes = street()
    config = OdometryConfig(points=1500, max_voxels=10_000)
    tracked, odometry = track([frame(k, driving, boxes) for k in range(30)], config)
    assert len(odometry._map.planes) <= 10_000
    assert errors_m(tracked, driving).max() < 0.05


def data(*parts):
    root = os.environ.get("ARTEMIS_DATA")
    if root is None or not Path(root, *parts).exists():
        pytest.skip("needs the recordings (ARTEMIS_DATA)")
    return Path(root, *parts)


def estimate(path, frames=None):
    odometry = LidarOdometry(OdometryConfig())
    tracked = [odometry.track(f) for f in open_input(path).frames(0, frames)]
    poses = np.array([t.T_world_lidar for t in tracked])
    return Trajectory(np.array([t.stamp_ns for t in tracked]), poses), odometry


@pytest.mark.data
@pytest.mark.slow
def test_kitti_street():
    drive = data("kitti_raw_0005", "2011_09_26", "2011_09_26_drive_0005_sync")
    found, odometry = estimate(drive)
    assert evaluate_trajectory(found, read_tum(drive / "poses_velo.tum")).ate_rmse_m < 0.05
    assert odometry.lost == {}


@pytest.mark.data
@pytest.mark.slow
def test_hall_at_two_hertz():
    bag = data("hilti_os0_handheld", "bag")
    found, odometry = estimate(bag)
    assert evaluate_trajectory(found, read_tum(bag.parent / "poses.tum")).ate_rmse_m < 0.05
    assert odometry.lost == {}


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("first", [0, 1])
def test_hall_at_one_hertz(first):
    """Every second scan: turns of up to 57 degrees from scan to scan, and nothing else to go by."""
    bag = data("hilti_os0_handheld", "bag")
    odometry = LidarOdometry(OdometryConfig())
    tracked = [odometry.track(f) for k, f in enumerate(open_input(bag).frames()) if k % 2 == first]
    poses = np.array([t.T_world_lidar for t in tracked])
    found = Trajectory(np.array([t.stamp_ns for t in tracked]), poses)
    assert evaluate_trajectory(found, read_tum(bag.parent / "poses.tum")).ate_rmse_m < 0.1
    assert odometry.lost == {}


def test_guesses_all_round_lie_on_the_way_and_about_the_upright_axis():
    start = se3.exp(np.array([1.0, 2, 3, 0.1, 0.2, 0.3]))
    goal = start @ se3.exp(np.array([1.0, 0, 0, 0, 0, 0.4]))
    found = all_round(start, goal, 10.0)
    assert len(found) == 3 * 37
    for T in found:
        turn = se3.log(se3.inverse(start) @ T)[3:]
        np.testing.assert_allclose(turn[:2], 0.0, atol=1e-9)
    places = np.unique(np.array([T[:3, 3] for T in found]).round(6), axis=0)
    assert len(places) == 3
    few = all_round(start, goal, 0.2)
    assert len(few) == 3 * 5
    assert all(abs(se3.log(se3.inverse(start) @ T)[5]) <= 0.35 for T in few)
