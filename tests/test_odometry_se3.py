import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from artemis_edge.odometry import se3

vectors = st.lists(st.floats(-1.7, 1.7), min_size=6, max_size=6).map(np.array)


def naive_exp(twist):
    generator = np.zeros((4, 4))
    generator[:3, :3] = np.cross(np.eye(3), twist[3:])
    generator[:3, 3] = twist[:3]
    return scipy.linalg.expm(generator)


@settings(deadline=None, max_examples=200)
@given(vectors, st.sampled_from([0.0, 1e-12, 1e-8, 1e-5, 1e-4, 1e-3, 1.0]))
def test_exp_equals_the_matrix_exponential(twist, scale):
    twist = np.concatenate([twist[:3], scale * twist[3:]])
    np.testing.assert_allclose(se3.exp(twist), naive_exp(twist), atol=1e-12)


@settings(deadline=None, max_examples=200)
@given(vectors, st.sampled_from([0.0, 1e-12, 1e-8, 1e-5, 1e-4, 1e-3, 1.0]))
def test_log_inverts_exp(twist, scale):
    twist = np.concatenate([twist[:3], scale * twist[3:]])
    np.testing.assert_allclose(se3.log(se3.exp(twist)), twist, atol=1e-9)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0, 0.8), (-0.6, 0.8, 0)])
@pytest.mark.parametrize("short_of_pi", [0.0, 1e-9, 1e-6, 1e-3])
def test_log_near_half_a_turn(axis, short_of_pi):
    twist = np.array([1.0, -2.0, 3.0, *(np.array(axis) * (np.pi - short_of_pi))])
    T = se3.exp(twist)
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=1e-9)


def test_inverse_and_orthonormal():
    T = se3.exp(np.array([1.0, 2.0, 3.0, 0.4, -0.5, 0.6]))
    np.testing.assert_allclose(se3.inverse(T) @ T, np.eye(4), atol=1e-15)
    drifted = T + 1e-7
    drifted[3] = T[3]
    R = se3.orthonormal(drifted)[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-6)
