"""A frame cut by time, and what its parts gave put together again."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from artemis_edge.frames import CameraImage, CameraModel
from artemis_edge.odometry.parts import Steps, in_parts
from artemis_edge.odometry.recovery import drawn, opened
from tests.test_odometry_inertial import frames, hand
from tests.test_odometry_propagation import NOISE, ORIGIN, go, imu, propagate, state


def with_images(frame, *ms):
    model = CameraModel(10, 10, 10.0, 10.0, 5.0, 5.0)
    images = [CameraImage("cam", frame.stamp_ns + m * 1_000_000, b"", model, np.eye(4)) for m in ms]
    return replace(frame, images=tuple(images))


def test_every_point_and_image_is_in_one_part():
    frame = with_images(frames(hand, 1)[0], -200, -30, 10, 10, 300)
    parts = in_parts(frame, 0.025)
    assert len(parts) == 4
    for kind in (lambda f: f.scans[0].points, lambda f: f.scans[0].offset_s):
        assert sorted(np.concatenate([kind(p) for p in parts]).tolist()) == sorted(kind(frame).tolist())
    assert [len(p.images) for p in parts] == [2, 0, 2, 1]
    ends = [(p.scans[0].offset_s.min(), p.scans[0].offset_s.max()) for p in parts]
    assert all(b - a <= 0.0251 for a, b in ends)
    assert all(before[1] <= after[0] for before, after in pairwise(ends))


def test_a_frame_of_one_time_stays_whole():
    moving = frames(hand, 1)[0]
    still = replace(moving, scans=(replace(moving.scans[0], offset_s=None),))
    for frame in (still, replace(moving, scans=())):
        assert in_parts(frame, 0.025) == (frame,)


def test_steps_are_one_motion():
    samples = imu(0.0, 1.0)
    whole = go(state(0.3), 0.1, samples)
    half = go(state(0.3), 0.05, samples)
    rest = go(half[0], 0.05, samples)
    one, two = Steps((whole[::-1],)), Steps((half[::-1], rest[::-1]))
    stamp_ns = whole[0].stamp_ns - 40_000_000
    for t in (-0.06, 0.0, 0.04):
        at = [steps.at(stamp_ns + round(t * 1e9)).T_world_lidar for steps in (one, two)]
        np.testing.assert_allclose(at[0], at[1], atol=1e-4)
        motions = [steps.motion(stamp_ns, -0.06, 0.04).at(t) for steps in (one, two)]
        np.testing.assert_allclose(motions[0], motions[1], atol=2e-4)


def test_draws_have_the_covariance():
    A = np.random.default_rng(3).normal(size=(18, 18)) * 0.01
    s = replace(state(), P=A @ A.T)
    errors = np.array([one.minus(s) for one in drawn(s, 4000)])
    np.testing.assert_allclose(errors.T @ errors / 4000, s.P, atol=0.1 * np.diag(s.P).max())
    np.testing.assert_array_equal(errors[0], drawn(s, 4000)[0].minus(s))


def test_where_a_map_begins_anew_speed_and_attitude_are_open():
    s = opened(state(sigma=0.01), 15.0)
    assert (np.diag(s.P)[6:9] > 15.0**2).all() and (np.diag(s.P)[3:6] > 0.1**2).all()
    assert propagate(s, s.stamp_ns, imu(0.0, 0.1), NOISE, ORIGIN, np.zeros(3))[0].stamp_ns == s.stamp_ns
