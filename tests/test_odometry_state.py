"""The filter's state and its updates: against plain least squares, and with covariances that are singular."""

from dataclasses import replace

import numpy as np
import pytest

from artemis_edge.odometry import se3
from artemis_edge.odometry.state import (
    POSE,
    ROTATION,
    NormalEquations,
    State,
    iterated_update,
    right_jacobian,
)


def state(P=None):
    T = se3.exp(np.array([1.0, 2, 3, 0.3, -0.2, 0.9]))
    plain = State(
        10**15,
        T,
        np.array([0.5, 0, 0.1]),
        np.zeros(3),
        np.zeros(3),
        np.array([0, 0, -9.81]),
        np.eye(18) if P is None else P,
    )
    return plain.with_camera("left", 0.1, 0.01)


@pytest.mark.parametrize("turn", [1e-9, 0.01, 1.0, 2.5])
def test_plus_and_minus_undo_each_other(turn):
    rng = np.random.default_rng(0)
    error = rng.normal(size=20)
    error[ROTATION] *= turn / np.linalg.norm(error[ROTATION])
    s = state()
    np.testing.assert_allclose(s.plus(error).minus(s), error, atol=1e-9)
    assert len(s) == 20 and s.exposure_column("left") == 18


def test_a_camera_is_added_with_its_own_uncertainty():
    s = state().with_camera("right", 0.2, 0.05)
    assert s.cameras == ("left", "right") and len(s) == 22
    np.testing.assert_allclose(np.diag(s.P)[18:], [0.01, 0.0001, 0.04, 0.0025])
    moved = s.plus(np.arange(22.0) * 1e-3)
    np.testing.assert_allclose(moved.log_inverse_exposure, [0.018, 0.020])
    np.testing.assert_allclose(moved.image_delay_s, [0.019, 0.021])


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.5, 2.0])
def test_right_jacobian_is_the_derivative(angle):
    turn = angle * np.array([0.6, 0, -0.8])
    J = right_jacobian(turn)
    full = np.zeros(6)
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-6
        full[3:] = turn
        start = se3.exp(full)
        full[3:] = turn + step
        found = se3.log(se3.inverse(start) @ se3.exp(full))[3:] / 1e-6
        np.testing.assert_allclose(found, J[:, k], atol=1e-5)


def places(s):
    """Measures three points of the body in world: pose in full."""
    arms = np.array([[1.0, 0, 0], [0, 2.0, 0], [0, 0, 3.0]])
    R, t = s.T_world_body[:3, :3], s.T_world_body[:3, 3]
    J = np.zeros((9, len(s)))
    for k, arm in enumerate(arms):
        J[3 * k : 3 * k + 3, :3] = np.eye(3)
        J[3 * k : 3 * k + 3, 3:6] = -R @ se3.skew(arm)
    return (arms @ R.T + t).ravel(), J


def measure(truth, sigma):
    wanted, _ = places(truth)

    def linearise(s):
        at, J = places(s)
        return NormalEquations(J.T @ J / sigma**2, J.T @ (at - wanted) / sigma**2)

    return linearise


def test_a_sure_measurement_far_away_is_reached():
    prior = state()
    error = np.zeros(20)
    error[POSE] = 0.5, -1.0, 2.0, 0.4, 0.3, -0.5
    truth = prior.plus(error)
    found = iterated_update(prior, measure(truth, 1e-4), iterations=20, converged=1e-12)
    np.testing.assert_allclose(found.T_world_body, truth.T_world_body, atol=1e-5)
    assert np.diag(found.P)[:6].max() < 1e-7 and np.diag(found.P)[6:18].min() > 0.5


def test_the_optimum_minimises_prior_and_measurement():
    """Against the cost itself: no small step makes it smaller."""
    rng = np.random.default_rng(1)
    A = rng.normal(size=(18, 18))
    prior = state(0.05 * A @ A.T + 0.01 * np.eye(18))
    error = np.zeros(20)
    error[POSE] = 0.3, 0.2, -0.4, 0.3, -0.6, 0.2
    truth, sigma = prior.plus(error), 0.2
    wanted, _ = places(truth)
    found = iterated_update(prior, measure(truth, sigma), iterations=30, converged=1e-12)

    def cost(s):
        d, r = s.minus(prior), places(s)[0] - wanted
        return d @ np.linalg.solve(prior.P, d) + r @ r / sigma**2

    best = cost(found)
    for k in range(20):
        for sign in (-1, 1):
            step = np.zeros(20)
            step[k] = sign * 1e-3
            assert cost(found.plus(step)) > best
    assert np.linalg.eigvalsh(found.P).min() > 0


def test_what_the_prior_knows_exactly_stays():
    P = np.eye(18)
    P[:3], P[:, :3] = 0.0, 0.0
    prior = state(P)
    error = np.zeros(20)
    error[POSE] = 1.0, 1, 1, 0.1, 0, 0
    found = iterated_update(prior, measure(prior.plus(error), 0.01))
    np.testing.assert_allclose(found.T_world_body[:3, 3], prior.T_world_body[:3, 3], atol=1e-12)
    assert np.isfinite(found.P).all()


def test_correlations_carry_a_measurement_to_what_was_not_measured():
    P = np.eye(18)
    P[0, 6] = P[6, 0] = 0.9
    prior = state(P)
    error = np.zeros(20)
    error[0] = 1.0
    found = iterated_update(prior, measure(prior.plus(error), 1e-3))
    assert found.velocity[0] - prior.velocity[0] == pytest.approx(0.9, abs=1e-3)


def test_no_measurement_changes_nothing():
    prior = state()
    found = iterated_update(prior, lambda s: NormalEquations.none(len(s)))
    np.testing.assert_allclose(found.minus(prior), 0.0, atol=1e-12)
    np.testing.assert_allclose(found.P, prior.P)
    assert replace(found, P=prior.P).cameras == prior.cameras


def test_a_state_moved_to_another_frame_goes_the_same_way():
    rng = np.random.default_rng(9)
    root = rng.normal(size=(18, 18))
    there, turn = state(root @ root.T), se3.exp(rng.normal(size=6))
    moved, J = there.moved(turn), np.eye(len(there))
    for part in (slice(0, 3), slice(6, 9), slice(15, 18)):  # place, velocity and gravity are in world
        J[part, part] = turn[:3, :3]
    error = 1e-6 * rng.normal(size=len(there))
    np.testing.assert_allclose(moved.plus(J @ error).minus(there.plus(error).moved(turn)), 0.0, atol=1e-11)
    np.testing.assert_allclose(moved.P, J @ there.P @ J.T, atol=1e-9)
