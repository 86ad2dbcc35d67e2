"""Closed-form eigenvector against LAPACK's."""

import numpy as np
import pytest

from artemis_edge.eigen3 import smallest_eigen3
from artemis_edge.frames import F64


def _ours(a: F64) -> tuple[F64, F64]:
    out = np.full(6, np.nan)
    smallest_eigen3(a[0, 0], a[0, 1], a[0, 2], a[1, 1], a[1, 2], a[2, 2], out)
    return out[:3], out[3:]


def _turned(rng: np.random.Generator, values: list[float]) -> F64:
    q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    a: F64 = q @ np.diag(values) @ q.T
    return (a + a.T) / 2


def test_random_covariances_agree_with_numpy() -> None:
    rng = np.random.default_rng(1)
    for _ in range(500):
        points = rng.normal(size=(rng.integers(4, 30), 3)) * rng.uniform(0.05, 2.0, 3)
        a = np.cov(points.T)
        values, vectors = np.linalg.eigh(a)
        vector, ours = _ours(a)
        np.testing.assert_allclose(ours, values, atol=1e-7 * values[2])
        if values[1] > 1.1 * values[0]:
            assert abs(vector @ vectors[:, 0]) > 1 - 1e-6


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e6])
@pytest.mark.parametrize("flat", [0.0, 1e-9, 1e-4])
def test_normal_of_a_plane(scale: float, flat: float) -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        a = _turned(rng, [flat * scale, 0.5 * scale, scale])
        vector, values = _ours(a)
        assert abs(vector @ np.linalg.eigh(a)[1][:, 0]) > 1 - 1e-6
        assert np.linalg.norm(vector) == pytest.approx(1.0)
        assert values[0] == pytest.approx(flat * scale, abs=1e-7 * scale)


def test_line_gives_a_vector_roughly_across_it() -> None:
    """An exactly double eigenvalue costs the closed form half its digits: no plane is fitted there."""
    rng = np.random.default_rng(3)
    for _ in range(100):
        a = _turned(rng, [0.0, 0.0, 1.0])
        vector, values = _ours(a)
        assert np.linalg.norm(vector) == pytest.approx(1.0)
        np.testing.assert_allclose(values, [0, 0, 1], atol=1e-7)
        assert abs(vector @ np.linalg.eigh(a)[1][:, 2]) < 0.3


@pytest.mark.parametrize("value", [0.0, 1.0, 1e-12, 7e5])
def test_multiple_of_the_identity_has_no_direction(value: float) -> None:
    vector, values = _ours(np.eye(3) * value)
    np.testing.assert_array_equal(vector, [0, 0, 1])
    np.testing.assert_allclose(values, value)


@pytest.mark.parametrize("gap", [1e-15, 1e-12, 1e-9, 1e-6])
def test_nearly_equal_eigenvalues_still_give_a_unit_vector(gap: float) -> None:
    rng = np.random.default_rng(4)
    for values in ([1.0, 1.0 + gap, 2.0], [1.0, 1.0 + gap, 1.0 + 2 * gap], [0.5, 1.0, 1.0 + gap]):
        a = _turned(rng, values)
        vector, ours = _ours(a)
        assert np.linalg.norm(vector) == pytest.approx(1.0)
        np.testing.assert_allclose(ours, values, atol=1e-7)
        # whatever the direction within the near-degenerate space, it does what the eigenvalue says
        assert float(vector @ a @ vector) == pytest.approx(values[0], abs=1e-6 if gap >= 1e-12 else 0.1)
