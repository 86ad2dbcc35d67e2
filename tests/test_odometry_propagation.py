"""IMU propagation, the path between two states and how errors move it: against analytic motions."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from artemis_edge.frames import ImuSamples
from artemis_edge.odometry import se3
from artemis_edge.odometry.propagation import HOLE_S, ImuNoise, longest_hole_s, propagate, steadied
from artemis_edge.odometry.state import State

GRAVITY = np.array([0.0, 0.0, -9.80665])
NOISE = ImuNoise(2.4e-4, 1.7e-3, 1e-5, 1e-4, 6.0, 3.0)
NO_NOISE = ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
ORIGIN = np.array([0.04, 0.02, -0.03])
START_NS = 10**15


def motion(t):
    """A hand that swings and turns by up to 150 deg/s: T_world_body, velocity, turn rate, specific force."""
    p = np.array([np.sin(1.3 * t), 0.4 * np.cos(2.1 * t), 0.05 * np.sin(12 * t)])
    v = np.array([1.3 * np.cos(1.3 * t), -0.84 * np.sin(2.1 * t), 0.6 * np.cos(12 * t)])
    a = np.array([-1.69 * np.sin(1.3 * t), -1.764 * np.cos(2.1 * t), -7.2 * np.sin(12 * t)])
    axis = np.array([0.36, -0.48, 0.8])
    angle, rate = 0.9 * np.sin(2.9 * t), 2.61 * np.cos(2.9 * t)
    T = se3.exp(np.concatenate([np.zeros(3), angle * axis]))
    T[:3, 3] = p
    return T, v, rate * axis, T[:3, :3].T @ (a - GRAVITY)


def imu(first_s, last_s, hz=200.0):
    at = np.arange(round(first_s * hz), round(last_s * hz) + 1) / hz
    gyro, accel = (np.array([motion(t)[k] for t in at]) for k in (2, 3))
    return ImuSamples(START_NS + np.rint(at * 1e9).astype(np.int64), gyro, accel)


def state(t=0.0, sigma=0.01):
    T, v, _, _ = motion(t)
    return State(START_NS + round(t * 1e9), T, v, np.zeros(3), np.zeros(3), GRAVITY, sigma**2 * np.eye(18))


def lidar(t):
    T = motion(t)[0]
    T[:3, 3] += T[:3, :3] @ ORIGIN
    return T


def go(s, seconds, samples, noise=NOISE):
    return propagate(s, s.stamp_ns + round(seconds * 1e9), samples, noise, ORIGIN, np.zeros(3))


@pytest.mark.parametrize("start", [0.0, 0.33, 1.7])
def test_nominal_values_follow_an_analytic_motion(start):
    end, _ = go(state(start), 0.1, imu(start - 0.1, start + 0.2))
    T, v, _, _ = motion(start + 0.1)
    assert np.linalg.norm(end.T_world_body[:3, 3] - T[:3, 3]) < 2e-4
    assert np.linalg.norm(se3.log(se3.inverse(T) @ end.T_world_body)[3:]) < 2e-4
    assert np.linalg.norm(end.velocity - v) < 2e-3


def test_every_time_of_a_scan_is_where_it_was():
    """Back-propagation from the end of the scan, at the points' times, between the samples' too."""
    end, path = go(state(0.4), 0.1, imu(0.3, 0.6))
    true_end = replace(end, T_world_body=motion(0.5)[0], velocity=motion(0.5)[1])
    for t in np.linspace(-0.1, 0.0, 23):
        seen = path.at(true_end, t)
        off = se3.log(se3.inverse(lidar(0.5 + t)) @ seen.T_world_lidar)
        assert np.linalg.norm(off[:3]) < 3e-4 and np.linalg.norm(off[3:]) < 4e-4
    relative = path.motion(true_end, -0.1, 0.0)
    for t in (-0.1, -0.063, -0.01, 0.0):
        off = se3.log(se3.inverse(relative.at(t)) @ se3.inverse(lidar(0.5)) @ lidar(0.5 + t))
        assert np.linalg.norm(off[:3]) < 1e-3 and np.linalg.norm(off[3:]) < 1e-3


def test_twist_of_a_path_is_its_derivative():
    end, path = go(state(0.4), 0.1, imu(0.3, 0.6))
    before, seen, after = (path.at(end, -0.0525 + dt) for dt in (-1e-4, 0.0, 1e-4))
    found = se3.log(se3.inverse(before.T_world_lidar) @ after.T_world_lidar) / 2e-4
    np.testing.assert_allclose(seen.twist, found, atol=1e-3)


@pytest.mark.parametrize("t", [-0.1, -0.04, 0.0, 0.02])
def test_jacobian_of_a_path_is_its_derivative(t):
    end, path = go(state(0.4).with_camera("cam", 1.0, 1.0), 0.1, imu(0.3, 0.6))
    seen = path.at(end, t)
    assert seen.J.shape == (6, 20)
    for k in range(20):
        error = np.zeros(20)
        error[k] = 1e-6
        moved = path.at(end.plus(error), t)
        found = se3.log(se3.inverse(seen.T_world_lidar) @ moved.T_world_lidar) / 1e-6
        np.testing.assert_allclose(seen.J[:, k], found, atol=1e-5)


def test_covariance_is_carried_as_errors_are():
    """Of a thousand starts drawn from P, the ends have the covariance that was predicted."""
    rng = np.random.default_rng(0)
    sigma = np.repeat([0.01, 0.002, 0.05, 0.001, 0.02, 0.01], 3)
    start = replace(state(0.4), P=np.diag(sigma**2))
    samples = imu(0.3, 0.8)
    end, _ = go(start, 0.3, samples, NO_NOISE)
    errors = []
    for _ in range(1000):
        moved, _ = go(start.plus(sigma * rng.normal(size=18)), 0.3, samples, NO_NOISE)
        errors.append(moved.minus(end))
    found = np.cov(np.array(errors).T)
    scale = np.sqrt(np.diag(end.P))
    np.testing.assert_allclose(found / np.outer(scale, scale), end.P / np.outer(scale, scale), atol=0.15)


def test_noise_of_the_samples_adds_what_it_does():
    rng = np.random.default_rng(1)
    noise = ImuNoise(0.01, 0.1, 0.0, 0.0, 6.0, 3.0)
    start = replace(state(0.4), P=np.zeros((18, 18)))
    clean = imu(0.3, 0.9)
    end, _ = go(start, 0.4, clean, noise)
    errors = []
    for _ in range(600):
        draw = rng.normal(size=(2, len(clean.gyro), 3)) * np.sqrt(200.0)
        noisy = ImuSamples(clean.stamp_ns, clean.gyro + 0.01 * draw[0], clean.accel + 0.1 * draw[1])
        errors.append(go(start, 0.4, noisy, noise)[0].minus(end))
    found = np.array(errors)[:, :9].std(axis=0)
    np.testing.assert_allclose(found / np.sqrt(np.diag(end.P)[:9]), 1.0, atol=0.15)


def test_a_hole_is_bridged_with_the_velocity_and_says_so():
    samples = imu(0.3, 0.9)
    missing = (samples.stamp_ns < START_NS + 450_000_000) | (samples.stamp_ns > START_NS + 600_000_000)
    holed = ImuSamples(samples.stamp_ns[missing], samples.gyro[missing], samples.accel[missing])
    whole, _ = go(state(0.4), 0.3, samples)
    end, _ = go(state(0.4), 0.3, holed)
    off = np.abs(end.minus(whole)[:9])
    assert (off < 3 * np.sqrt(np.diag(end.P)[:9])).all()
    assert (np.diag(end.P)[:9] > 5 * np.diag(whole.P)[:9]).all()


def test_in_a_hole_the_error_of_the_held_rate_is_estimated():
    s, dt, alpha = state(0.4, 0.0), 0.1, NOISE.angular_acceleration
    end, path = propagate(s, s.stamp_ns + 10**8, ImuSamples.empty(), NOISE, ORIGIN, np.zeros(3))
    assert path.holes
    # white angular acceleration of the density q: a rate that is wrong by q dt is a bias of the other sign
    q = alpha**2 * 0.1
    np.testing.assert_allclose(np.diag(end.P)[3:6], q * dt**3 / 3.0)
    np.testing.assert_allclose(np.diag(end.P)[9:12], q * dt, rtol=1e-6)
    np.testing.assert_allclose(np.diag(end.P[3:6, 9:12]), -0.5 * q * dt**2)
    np.testing.assert_array_equal(end.P, end.P.T)


@pytest.mark.parametrize("gap_s", [0.1, 0.25])
def test_after_a_hole_the_gyroscope_has_its_own_bias_again(gap_s):
    s = replace(state(0.4), gyro_bias=np.array([0.01, -0.02, 0.03]))
    hole, _ = propagate(s, s.stamp_ns + round(gap_s * 1e9), imu(0.3, 0.4), NOISE, ORIGIN, np.ones(3))
    assert hole.known is not None and hole.P[9, 9] > 100 * s.P[9, 9]
    found = replace(hole, gyro_bias=hole.gyro_bias + 0.5)  # by a LiDAR: the rig turned slower than held
    after, path = propagate(found, found.stamp_ns + 10**8, imu(0.55, 0.8), NOISE, ORIGIN, np.full(3, 0.5))
    assert after.known is None and path.holes == (gap_s == 0.1)
    np.testing.assert_array_equal(after.gyro_bias, s.gyro_bias)
    np.testing.assert_allclose(after.P[9:12, 9:12], s.P[9:12, 9:12], atol=1e-9)
    if gap_s == 0.1:  # in the 50 ms before the samples the rate goes from the held one to the first measured
        first = motion(0.55)[2] - s.gyro_bias
        np.testing.assert_allclose(path.turn_rate[0], 0.5 * (0.5 + first), atol=1e-9)


@pytest.mark.parametrize("cuts", [1, 4])
def test_what_is_unknown_in_a_hole_does_not_depend_on_how_it_is_cut(cuts):
    s = state(0.4, 0.0)
    for _ in range(cuts):
        s, _ = propagate(s, s.stamp_ns + 10**8 // cuts, ImuSamples.empty(), NOISE, ORIGIN, np.zeros(3))
    whole, _ = propagate(state(0.4, 0.0), s.stamp_ns, ImuSamples.empty(), NOISE, ORIGIN, np.zeros(3))
    np.testing.assert_allclose(s.P, whole.P, atol=1e-12)


def naive_longest_hole(stamps, first, last):
    inside = [t for t in stamps if first < t < last]
    before, after = [t for t in stamps if t <= first], [t for t in stamps if t >= last]
    ends = [max(before) if before else first, *inside, min(after) if after else last]
    return max([b - a for a, b in pairwise(ends)], default=0) * 1e-9


@pytest.mark.parametrize("stamps", [[], [5], [0, 10, 30, 70], [12, 18, 40], [200], [0, 100], [20, 80]])
def test_longest_hole(stamps):
    none = np.zeros((len(stamps), 3))
    samples = ImuSamples(np.array(stamps, np.int64), none, none)
    for first, last in [(10, 60), (0, 100), (15, 16), (20, 20)]:
        assert longest_hole_s(samples, first, last) == pytest.approx(naive_longest_hole(stamps, first, last))


def test_a_carrier_that_hardly_accelerates_tells_where_down_is():
    samples = imu(0.0, 1.2)
    true, level = state(0.2), np.zeros(18)
    level[3:6] = 0.4, -0.3, 0.2
    s = replace(true.plus(level), P=np.diag([1e-4] * 3 + [0.3**2] * 3 + [0.5**2] * 3 + [1e-6] * 9))
    for _ in range(8):
        before, end = s, go(s, 0.1, samples)[0]
        s = steadied(before, end, NOISE)
    T = motion(1.0)[0]
    down = s.T_world_body[:3, :3].T @ GRAVITY - T[:3, :3].T @ GRAVITY
    assert np.linalg.norm(down) / 9.8 < 0.12  # 0.3 at first; the hand swings with 3 m/s2
    sure = replace(state(0.2), P=1e-8 * np.eye(18))
    np.testing.assert_allclose(
        steadied(sure, go(sure, 0.1, samples)[0], NOISE).minus(go(sure, 0.1, samples)[0]), 0.0, atol=1e-6
    )


def test_without_samples_velocity_and_turn_are_held():
    s = state(0.4)
    rate = np.array([0.1, 0.2, -0.3])
    end, path = propagate(s, s.stamp_ns + 10**8, ImuSamples.empty(), NOISE, np.zeros(3), rate)
    np.testing.assert_allclose(end.velocity, s.velocity)
    np.testing.assert_allclose(end.T_world_body[:3, 3], s.T_world_body[:3, 3] + 0.1 * s.velocity)
    turn = se3.log(se3.inverse(s.T_world_body) @ end.T_world_body)[3:]
    np.testing.assert_allclose(turn, 0.1 * rate, atol=1e-12)
    np.testing.assert_allclose(path.at(end, -0.1).T_world_lidar, s.T_world_body, atol=1e-9)


@pytest.mark.parametrize("seconds", [0.0, 1e-9, HOLE_S])
def test_short_spans(seconds):
    end, path = go(state(0.4), seconds, imu(0.3, 0.9))
    assert np.isfinite(end.P).all() and np.isfinite(path.at(end, -0.01).T_world_lidar).all()
