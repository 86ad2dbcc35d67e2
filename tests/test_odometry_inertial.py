"""The filter in a small world of boxes, where every pose is known."""

from dataclasses import replace

import numpy as np
import pytest

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import CameraImage, CameraModel, ImuSamples, LidarScan, SyncedFrame
from artemis_edge.odometry import se3
from artemis_edge.odometry.choice import fast_enough, odometry_for
from artemis_edge.odometry.inertial_odometry import InertialOdometry
from artemis_edge.odometry.lidar_odometry import LidarOdometry
from artemis_edge.odometry.rest import first_state
from tests.box_world import GRAVITY, START_NS, corridor, frame, imu, street

CONFIG = OdometryConfig(points=1500)
ORIGIN = (-0.04, -0.02, 0.03)
NOISE, BIAS = 0.03, np.array([0.02, -0.03, 0.01])


def hand(t):
    """Stands for half a second, then walks with bobbing and turns by up to 100 deg/s; smooth."""
    s = max(t - 0.5, 0.0)
    on = s**4 / (0.05 + s**4)
    yaw = on * 0.9 * (1 - np.cos(1.9 * s))
    T = se3.exp(np.array([0.0, 0, 0, on * 0.04 * np.sin(5 * s), on * 0.03 * np.sin(7 * s), yaw]))
    T[:3, 3] = on * s, on * 0.3 * np.sin(s), 1.6 + on * 0.02 * np.sin(12 * s)
    return T


def frames(pose_at, count, boxes=None, **options):
    boxes = street() if boxes is None else boxes
    out = []
    for k in range(count):
        samples = imu(pose_at, 0.1 * k - 0.05, 0.1 * k + 0.05, ORIGIN, noise=NOISE, bias=BIAS, seed=k)
        out.append(replace(frame(k, pose_at, boxes, **options), imu=samples))
    return out


@pytest.fixture(scope="module")
def walk():
    return frames(hand, 30)


def errors_m(tracked, pose_at):
    world = se3.inverse(tracked[0].T_world_lidar)
    start = se3.inverse(pose_at((tracked[0].stamp_ns - START_NS) * 1e-9))
    true = [start @ pose_at((t.stamp_ns - START_NS) * 1e-9) for t in tracked]
    return np.array(
        [
            np.linalg.norm((world @ t.T_world_lidar)[:3, 3] - T[:3, 3])
            for t, T in zip(tracked, true, strict=True)
        ]
    )


def track(sequence, config=CONFIG, **options):
    odometry = InertialOdometry(config, **options)
    return [odometry.track(f) for f in sequence], odometry


def test_a_walk_with_fast_turns(walk):
    tracked, odometry = track(walk)
    assert errors_m(tracked, hand).max() < 0.02
    assert odometry.lost == {} and odometry.instruction is None
    assert not any(t.degenerate for t in tracked)
    state = odometry.state
    np.testing.assert_allclose(state.gyro_bias, 0.1 * BIAS, atol=2e-3)
    np.testing.assert_allclose(state.gravity, GRAVITY, atol=0.08)
    assert np.linalg.eigvalsh(state.P).min() > -1e-12


def test_points_are_moved_to_the_stamp(walk):
    """In the middle of the fastest turn, the ground and the walls are thin."""
    tracked, _ = track(walk)
    start = hand(0.0)
    turning = [t for t in tracked if np.linalg.norm(t.twist[3:]) > 1.0]
    assert len(turning) > 5
    for t in turning:
        T = start @ se3.inverse(tracked[0].T_world_lidar) @ t.T_world_lidar
        z = t.scans[0].points @ T[2, :3] + T[2, 3]
        near = np.abs(z) < 0.15
        assert near.sum() > 500 and np.sqrt(np.mean(z[near] ** 2)) < 0.025


def test_twist_and_poses_of_images_are_those_of_the_motion(walk):
    model = CameraModel(10, 10, 10.0, 10.0, 5.0, 5.0)
    last = replace(
        walk[24],
        images=tuple(
            CameraImage("cam", walk[24].stamp_ns + ms * 1_000_000, b"", model, np.eye(4)) for ms in (-30, 20)
        ),
    )
    tracked, _ = track([*walk[:24], last])
    found = tracked[-1]
    true = se3.log(se3.inverse(hand(2.399)) @ hand(2.401)) / 0.002
    np.testing.assert_allclose(found.twist[:3], true[:3], atol=0.05)
    np.testing.assert_allclose(found.twist[3:], true[3:], atol=0.03)
    for pose, s in zip(found.image_poses, (-0.03, 0.02), strict=True):
        off = se3.log(
            se3.inverse(se3.inverse(found.T_world_lidar) @ pose) @ se3.inverse(hand(2.4)) @ hand(2.4 + s)
        )
        assert np.linalg.norm(off[:3]) < 5e-3 and np.linalg.norm(off[3:]) < 3e-3


def test_where_the_imu_sits_matters(walk):
    """With the IMU half a metre away and a turning rig, ignoring that is seen in the residuals of the bias."""
    far = (0.5, 0.0, 0.0)
    moved = [replace(f, imu=imu(hand, 0.1 * k - 0.05, 0.1 * k + 0.05, far)) for k, f in enumerate(walk[:25])]
    ignored = [replace(f, imu=replace(f.imu, origin=np.zeros(3))) for f in moved]
    biases = [np.linalg.norm(track(sequence)[1].state.accel_bias) for sequence in (moved, ignored)]
    assert biases[0] < 0.5 * biases[1]


def test_a_corridor_is_held_by_the_imu_and_flagged():
    def along(t):
        s = max(t - 0.4, 0.0)
        T = np.eye(4)
        T[:3, 3] = s**3 / (0.3 + s**2), 0.0, 1.3
        return T

    tracked, _ = track(frames(along, 25, corridor(), reach=20.0))
    assert all(t.degenerate for t in tracked[2:])
    assert all(abs(t.degenerate_direction[0]) > 0.99 for t in tracked[2:])
    assert errors_m(tracked, along).max() < 0.15
    for t in tracked:
        assert np.abs(t.T_world_lidar[1:3, 3]).max() < 0.02


def test_a_hole_in_the_imu_is_survived(walk):
    """Half a second in which the hand begins to turn by up to 100 deg/s and back."""
    holed = [replace(f, imu=ImuSamples.empty()) if 10 <= k < 15 else f for k, f in enumerate(walk)]
    tracked, odometry = track(holed)
    error = errors_m(tracked, hand)
    assert error.max() < 0.025 and error[16:].max() < 0.01
    assert odometry.lost == {}


def test_frames_without_points_are_held_by_the_imu(walk):
    nothing = np.empty((0, 3), np.float32)
    holed = [
        replace(f, scans=(LidarScan(nothing, f.stamp_ns),)) if 15 <= k < 20 else f for k, f in enumerate(walk)
    ]
    tracked, odometry = track(holed)
    assert errors_m(tracked, hand).max() < 0.05
    assert odometry.lost == {"no points": 5}


def test_images_alone_move_the_state_on(walk):
    tracked, odometry = track(
        [*walk[:10], SyncedFrame(10, walk[10].stamp_ns, (), imu=walk[10].imu), *walk[11:14]]
    )
    assert errors_m(tracked, hand).max() < 0.02 and odometry.lost == {}
    assert tracked[10].scans == ()


def test_a_start_in_motion_asks_the_operator_to_hold_still(walk):
    started = walk[12:20]
    odometry = InertialOdometry.looking_ahead(CONFIG, started)
    tracked = [odometry.track(f) for f in started]
    assert odometry.lost == {"moving at the start": 1}
    assert "hold it still" in odometry.instruction
    assert errors_m(tracked, hand).max() < 0.06


def test_same_input_same_bytes(walk):
    (first, _), (second, _) = track(walk[:8]), track(walk[:8])
    for a, b in zip(first, second, strict=True):
        assert a.T_world_lidar.tobytes() == b.T_world_lidar.tobytes()
        assert a.scans[0].points.tobytes() == b.scans[0].points.tobytes()


def test_the_first_state_is_level_and_its_gravity_errs_as_the_accelerometer_does():
    tilt = se3.exp(np.array([0.0, 0, 0, 0.2, -0.1, 0.0]))[:3, :3]
    samples = ImuSamples(
        np.arange(20) * 5_000_000, np.tile([0.001, 0.002, 0.0], (20, 1)), np.tile(tilt.T @ -GRAVITY, (20, 1))
    )
    state, still = first_state(0, samples, None, 15.0)
    assert still
    np.testing.assert_allclose(state.gravity, GRAVITY, atol=1e-9)
    np.testing.assert_allclose(state.gyro_bias, [0.001, 0.002, 0.0])
    R = state.T_world_body[:3, :3]
    np.testing.assert_allclose(R @ samples.accel[0], -GRAVITY, atol=1e-9)
    # force = R' (a - g) + bias: at rest the two errors cancel but for the mean's own
    rest = np.hstack([R.T, -np.eye(3)])
    block = np.ix_([15, 16, 17, 12, 13, 14], [15, 16, 17, 12, 13, 14])
    np.testing.assert_allclose(rest @ state.P[block] @ rest.T, 1e-4 * np.eye(3), atol=1e-12)


def test_which_odometry_a_rig_gets(walk):
    def without():
        return iter([replace(f, imu=ImuSamples.empty()) for f in walk[:3]])

    def slow():
        one = [(f, f.imu) for f in walk[:3]]
        return (replace(f, imu=ImuSamples(i.stamp_ns[:1], i.gyro[:1], i.accel[:1])) for f, i in one)

    assert isinstance(odometry_for(CONFIG, lambda: iter(walk[:3])), InertialOdometry)
    assert isinstance(odometry_for(CONFIG, without), LidarOdometry)
    assert isinstance(odometry_for(CONFIG, slow), LidarOdometry)
    assert isinstance(odometry_for(CONFIG, lambda: iter([])), LidarOdometry)
    in_g = replace(walk[0].imu, accel=walk[0].imu.accel / 9.81)
    assert fast_enough(walk[0].imu) and not fast_enough(in_g)


def test_a_place_never_seen_is_mapped_where_the_imu_has_it(walk):
    """As behind a door: from one frame on nothing of the map is in sight."""
    inside = np.array([[-2.0, -2.5, -0.5, -1.5, 3.0, 3.0], [6.0, -2.5, -0.5, 6.5, 3.0, 3.0]])
    inside = np.vstack([inside, [[-2.0, -2.5, -0.5, 6.5, -2.0, 3.0], [-2.0, 2.5, -0.5, 6.5, 3.0, 3.0]]])
    inside = np.vstack([inside, [[-2.0, -2.5, 2.6, 6.5, 3.0, 3.0], [-2.0, -2.5, -0.5, 6.5, 3.0, 0.3]]])
    room = [replace(f, imu=walk[f.index].imu) for f in (frame(k, hand, inside) for k in range(14, 22))]
    tracked, odometry = track([*walk[:14], *room])
    assert errors_m(tracked, hand).max() < 0.05
    assert odometry.lost == {"not registered": 1}
