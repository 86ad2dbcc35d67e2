import numpy as np
import pytest

from artemis_edge.frames import DeskewedScan
from artemis_edge.odometry.normals import CELL_M, normal_spread, weakest_direction
from artemis_edge.odometry.plane_map import PlaneMap, sum_points


def slow_spread(points):
    """Twin of ``normal_spread`` from the points themselves, by eigenvectors."""
    total, count = np.zeros((3, 3)), 0
    cells = np.floor(points / CELL_M).astype(int)
    for cell in np.unique(cells, axis=0):
        p = points[(cells == cell).all(axis=1)]
        if len(p) < 12:
            continue
        values, vectors = np.linalg.eigh(np.cov(p.T, bias=True))
        tilt = values[0] / (len(p) - 3) / values[1:]
        if tilt.sum() > 0.05:
            continue
        n = np.outer(vectors[:, 0], vectors[:, 0])
        for t, e in zip(tilt, vectors.T[1:], strict=True):
            n += t * (np.outer(vectors[:, 0], vectors[:, 0]) - np.outer(e, e))
        total += len(p) * n
        count += len(p)
    return total, count


def weakest(points, map_points=None):
    planes = PlaneMap(0.5, 4, 10_000)
    planes.insert(points if map_points is None else map_points, np.eye(4))
    return weakest_direction([DeskewedScan(points, np.zeros(3))], planes, np.eye(4))


def walls(rng, share, count=6000, noise=0.02):
    """Floor and side walls along x, and a share of points on a wall across."""
    p = rng.uniform([0, 0, 0], [8, 3, 3], (count, 3))
    kind = rng.uniform(size=count)
    p[kind < 0.5, 1] = 0.1
    p[(kind >= 0.5), 2] = 0.1
    p[kind < share, 0] = 4.1
    p[kind < share, 1] = rng.uniform(0, 3, (kind < share).sum())
    return (p + noise * rng.normal(size=p.shape)).astype(np.float32)


def test_like_the_slow_twin():
    points = walls(np.random.default_rng(0), 0.1)
    _, sums = sum_points(points, np.eye(4), CELL_M)
    found, known = normal_spread(sums)
    wanted, count = slow_spread(points.astype(float))
    assert sums[known, 0].sum() == count > 1000
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-3 * count)


@pytest.mark.parametrize("share, degenerate", [(0.0, True), (0.1, False)])
def test_a_corridor_lacks_its_own_direction(share, degenerate):
    points = walls(np.random.default_rng(1), share)
    found = weakest(points)
    assert found.degenerate == degenerate
    assert abs(found.direction[0]) > 0.98


@pytest.mark.parametrize(
    "points",
    [
        np.empty((0, 3)),
        np.zeros((1, 3)),
        np.zeros((50, 3)),
        np.linspace([0, 0, 0], [0.3, 0, 0], 50),
        np.full((30, 3), np.nan),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_without_a_normal_nothing_is_said(points):
    assert weakest(points.astype(np.float32), np.empty((0, 3), np.float32)) is None


def test_sparse_points_ask_the_map():
    rng = np.random.default_rng(2)
    dense = walls(rng, 0.1)
    assert not weakest(dense[::40], dense).degenerate
    assert weakest(dense[::40], walls(rng, 0.0)).degenerate


def test_no_scans():
    assert weakest_direction([], PlaneMap(0.5, 4, 10_000), np.eye(4)) is None
