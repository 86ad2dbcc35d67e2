"""What matched planes tell of the pose: shared errors against a least-squares problem with them as unknowns."""

import numpy as np
import pytest

from artemis_edge.odometry import se3
from artemis_edge.odometry.observed import Expected, by_plane, observed_part
from artemis_edge.odometry.registration import linearise

SIGMA = 0.03


def wall(n=500, planes=50, tilt=0.05, seed=7):
    """Points on a wall 5 m ahead, its planes tilted at random: rows as of ``registration.match``."""
    rng = np.random.default_rng(seed)
    p = np.column_stack([np.full(n, 5.0), rng.uniform(-2, 2, (n, 2))])
    which = np.sort(rng.integers(0, planes, n))
    normals = np.column_stack([np.ones(planes), tilt * rng.normal(size=(planes, 2))])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    normal = normals[which]
    columns = [np.full(n, v) for v in (1e-4, 0.0, 1e-5, 4e-4, 50.0)]
    columns[1] = which.astype(float)
    return np.column_stack([p, normal, (normal * p).sum(axis=1), *columns])


def naive_by_plane(matched, T, noise2, miss2):
    """Every point its own residual, every plane's place an unknown with a prior; the places eliminated at the end."""
    J = np.array([np.r_[R := T[:3, :3].T @ m[3:6], np.cross(m[:3], R)] for m in matched])
    r = np.array([m[3:6] @ (T[:3, :3] @ m[:3] + T[:3, 3]) - m[6] for m in matched])
    s2 = noise2 + matched[:, 7]
    w = np.where(r**2 > 9 * s2, 0.0, (4 / (4 + r**2 / s2)) ** 2 / s2)
    planes, which = np.unique(matched[:, 8], return_inverse=True)
    B = np.eye(len(planes))[which]
    shared = [
        (m[9] + 10 * max(m[10] - SIGMA**2, 0.0)) * (1 + m[11] * miss2)
        for m in (matched[which == k][0] for k in range(len(planes)))
    ]
    W, D = np.diag(w), B.T @ np.diag(w) @ B + np.diag(1 / np.array(shared))
    left = J.T @ W @ B @ np.linalg.inv(D)
    return J.T @ W @ J - left @ B.T @ W @ J, J.T @ W @ r - left @ B.T @ W @ r


@pytest.mark.parametrize("thick", [1e-4, 4e-3])
def test_the_error_of_a_plane_is_shared_by_its_points(thick):
    matched = wall(60, 7)
    matched[::3, 10] = thick
    matched[:, 10] = matched[np.searchsorted(matched[:, 8], matched[:, 8]), 10]
    T = se3.exp(np.array([0.03, 0.02, -0.04, 0.01, 0.02, -0.01]))
    found = by_plane(matched, T, SIGMA**2, SIGMA**2, 0.01)
    H, g = naive_by_plane(matched, T, SIGMA**2, 0.01)
    np.testing.assert_allclose(found.H, H, atol=1e-6 * np.abs(H).max())
    np.testing.assert_allclose(found.g, g, atol=1e-6 * np.abs(g).max())
    assert (np.diag(found.H) <= np.diag(linearise(matched, T, SIGMA**2).H)).all()


def test_before_a_wall_the_noise_of_normals_tells_nothing():
    matched, T = wall(), se3.exp(np.array([0.0, 0.05, 0.05, 0.05, 0.0, 0.0]))
    whole = by_plane(matched, T, 1e-3, SIGMA**2, 0.0).H
    said = observed_part(matched, T, 1e-3, Expected(1e-6 * np.eye(6), 1e-3, 5.0)).H
    across = [1, 2, 3]  # sideways, upwards, about the line of sight
    assert (np.diag(said)[across] < 0.1 * np.diag(whole)[across]).all()
    np.testing.assert_allclose(np.diag(said)[[0, 4, 5]], np.diag(whole)[[0, 4, 5]], rtol=0.1)


def end_of_a_corridor():
    """A wall, and two points of a hundred on a plane across."""
    matched = wall(100, 10, 0.0)
    matched[-2:, 3:6], matched[-2:, 6], matched[-2:, 8] = (0.0, 1.0, 0.0), 0.4 + matched[-2:, 1], 99.0
    matched[:, 9] = 1e-3  # so that no plane counts for more than a few points
    matched[-2:, 9] = 1e-2
    return matched


@pytest.mark.parametrize(("sigma_m", "heard"), [(0.02, True), (0.3, False)])
def test_a_few_planes_are_heard_where_it_is_known_which_they_are(sigma_m, heard):
    T, P = np.eye(4), np.diag([1e-4, sigma_m**2, 1e-4, 1e-6, 1e-6, 1e-6])
    said = observed_part(end_of_a_corridor(), T, 0.05, Expected(P, sigma_m, 5.0))
    alone = by_plane(end_of_a_corridor()[-2:], T, 0.05, SIGMA**2, sigma_m**2)
    assert alone.H[1, 1] > 1.0
    assert (said.H[1, 1] > 0.5 * alone.H[1, 1]) == heard
    assert (abs(said.g[1]) > 0.5 * abs(alone.g[1])) == heard


def test_of_a_motion_along_a_wall_a_little_is_seen_across():
    for sigma_m in (1e-3, 1.0):
        P = np.diag([1e-4, sigma_m**2, 1e-4, 1e-6, 1e-6, 1e-6])
        said = observed_part(wall(tilt=0.0), np.eye(4), 1e-3, Expected(P, 1e-3, 5.0)).H
        assert (1.0 / np.sqrt(said[0, 0]) > 0.019) == (sigma_m == 1.0)


def test_nothing_matched_says_nothing():
    said = observed_part(np.empty((0, 12)), np.eye(4), 1e-3, Expected(np.eye(6), 1.0, 5.0))
    assert not said.H.any() and not said.g.any()
