from itertools import pairwise

import numpy as np
import pytest

from artemis_edge.frames import DeskewedScan
from artemis_edge.odometry.normals import (
    CELL_M,
    RADIUS_M,
    by_cell,
    draw,
    fit,
    in_ball,
    keep,
    mean,
    normal_spread,
    tilt2,
    weakest_direction,
    within,
)
from artemis_edge.odometry.plane_map import PlaneMap

SIGMA_M = 0.03


def slow_cells(points):
    """Twin of ``by_cell``: rows of each cell, cells in order of their first point."""
    found = {}
    for row, cell in enumerate(np.floor(points / CELL_M).astype(int).tolist()):
        found.setdefault(tuple(cell), []).append(row)
    return list(found.values())


def slow_fit(points):
    """Twin of ``fit``."""
    values, vectors = np.linalg.eigh(np.cov(points.T, bias=True))
    return vectors[:, 0], values, vectors[:, 0] @ points.mean(axis=0)


def slow_draw(points, m, sigma_m):
    """Twin of ``draw``: normal and offset of the best of twelve planes through three points."""
    best, judges, seed = (0.0, None), points[:: max(m // 50, 1)], 1
    for _ in range(12):
        rows = []
        for _ in range(3):
            seed = (seed * 1103515245 + 12345) % 2**31
            rows.append(seed // 2**16 % m)
        p, q, r = points[rows]
        normal = np.cross(q - p, r - p)
        if np.linalg.norm(normal) > 0.0:
            normal /= np.linalg.norm(normal)
            score = (1.0 / (1.0 + ((judges - p) @ normal / sigma_m) ** 4)).sum()
            best = max(best, (score, (normal, normal @ p)), key=lambda found: found[0])
    return best[1]


def weakest(points, map_points=None):
    planes = PlaneMap(0.5, 4, 10_000)
    planes.insert(points if map_points is None else map_points, np.eye(4))
    return weakest_direction([DeskewedScan(points, np.zeros(3))], planes, np.eye(4), SIGMA_M)


def walls(rng, share, count=12_000, noise=0.02):
    """Floor and side walls along x, and a share of points on a wall across."""
    p = rng.uniform([0, 0, 0], [8, 3, 3], (count, 3))
    kind = rng.uniform(size=count)
    p[kind < 0.5, 1] = 0.15
    p[(kind >= 0.5), 2] = 0.15
    p[kind < share, 0] = 4.05
    p[kind < share, 1] = rng.uniform(0, 3, (kind < share).sum())
    return (p + noise * rng.normal(size=p.shape)).astype(np.float32)


def corner(rng, count=120):
    """Two thirds of the points of a cell on one wall, the others on one across; the first wall's rows first."""
    p = rng.uniform(0, CELL_M, (count, 3))
    p[: 2 * count // 3, 0] = 0.28
    p[2 * count // 3 :, 1] = 0.02
    return (p + 0.01 * rng.normal(size=p.shape)).astype(np.float32)


def test_cells_like_the_slow_twin():
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3)).astype(np.float32)
    cells = by_cell(points, CELL_M)
    assert [cells.order[a:b].tolist() for a, b in pairwise(cells.starts)] == slow_cells(points)


@pytest.mark.parametrize("count", [0, 1, 500, 100_000])
def test_a_ball_like_the_slow_twin(count):
    points = np.random.default_rng(0).uniform(-1, 1, (count, 3)).astype(np.float32)
    cells, rows, centre = by_cell(points, CELL_M), np.empty(400, np.int64), np.array([0.31, -0.02, 0.3])
    n = in_ball(points, cells, centre, RADIUS_M, rows)
    inside = np.flatnonzero(np.linalg.norm(points - centre, axis=1) < RADIUS_M)
    assert set(rows[:n]) <= set(inside) and len(set(rows[:n])) == n
    if count <= 500:
        assert n == len(inside)
    else:  # a ball is a fifteenth of the eight cells that it touches, of which 300 points are looked at
        assert 10 < n < 40
        np.testing.assert_allclose(points[rows[:n]].mean(axis=0), centre, atol=0.06)


def test_the_mean_of_some_rows():
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3)).astype(np.float32)
    out = np.empty(3)
    mean(points, np.arange(10, 30), out)
    np.testing.assert_allclose(out, points[10:30].mean(axis=0), atol=1e-6)


def test_a_drawn_plane_is_that_of_the_slow_twin():
    points = corner(np.random.default_rng(1))
    shuffled = np.random.default_rng(2).permutation(len(points))
    plane = np.empty(7)
    assert draw(points, shuffled, SIGMA_M, plane)
    normal, offset = slow_draw(points[shuffled].astype(float), len(points), SIGMA_M)
    np.testing.assert_allclose(plane[[0, 1, 2, 6]], [*normal, offset], atol=1e-5)


def test_points_of_another_surface_are_sorted_out():
    points = corner(np.random.default_rng(1))
    rows, plane = np.random.default_rng(2).permutation(len(points)), np.empty(7)
    draw(points, rows, SIGMA_M, plane)
    n = keep(points, rows, plane, 0.05)
    near = np.abs(points @ plane[:3] - plane[6]) < 0.05
    assert n == within(points, np.arange(len(points)), plane, 0.05)
    assert sorted(rows[:n]) == np.flatnonzero(near).tolist() and sorted(rows) == list(range(len(points)))
    fit(points, rows[:n], plane)
    normal, values, offset = slow_fit(points[rows[:n]].astype(float))
    sign = np.sign(plane[:3] @ normal)
    np.testing.assert_allclose(plane[[0, 1, 2, 6]], sign * np.array([*normal, offset]), atol=1e-5)
    np.testing.assert_allclose(plane[3:6], values, rtol=1e-3, atol=1e-9)
    assert abs(plane[0]) > 0.98


def test_the_tilt_of_a_fitted_plane_is_what_is_said():
    rng, tilts, said = np.random.default_rng(3), [], []
    for _ in range(300):
        p = np.column_stack([rng.uniform(-0.1, 0.1, (30, 2)), 0.02 * rng.normal(size=30)]).astype(np.float32)
        plane = np.empty(7)
        fit(p, np.arange(30), plane)
        tilts.append(plane[0] ** 2 + plane[1] ** 2)
        said.append(tilt2(plane, 30))
    assert np.mean(tilts) == pytest.approx(np.mean(said), rel=0.25)


def test_a_line_has_any_normal():
    line = np.linspace([0, 0, 0], [0.2, 0.1, 0], 30).astype(np.float32)
    plane = np.empty(7)
    fit(line, np.arange(30), plane)
    assert not tilt2(plane, 30) < 1.0


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_the_mean_has_no_bias_by_noise(noise):
    points = walls(np.random.default_rng(4), 0.1, 20_000, noise)
    cells = by_cell(points, CELL_M)
    spread, counted, _ = normal_spread(points, cells, RADIUS_M, SIGMA_M)
    across = spread[0, 0] / counted.sum()
    assert across == pytest.approx(0.1, abs=0.02)


def test_of_many_cells_some_are_looked_at():
    rng = np.random.default_rng(6)
    p = rng.uniform([0, 0, 0], [15, 15, 3], (120_000, 3))
    p[:100_000, 2], p[100_000:, 0] = 0.1, 0.1
    p = (p + 0.01 * rng.normal(size=p.shape)).astype(np.float32)
    cells = by_cell(p, CELL_M)
    spread, counted, crowded = normal_spread(p, cells, RADIUS_M, SIGMA_M)
    assert 500 < np.count_nonzero(counted) <= 1000 < len(counted) and crowded[counted == 0].any()
    assert spread[0, 0] / counted.sum() == pytest.approx(1 / 6, abs=0.03)


@pytest.mark.parametrize("turn", [0.0, 0.1, 0.5])
def test_a_wall_that_cells_cut_faces_its_own_way_only(turn):
    rng = np.random.default_rng(5)
    p = np.column_stack([rng.uniform(-2, 2, (10_000, 2)), 0.02 * rng.normal(size=10_000)])
    R = np.array([[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]])
    assert weakest((p @ R.T).astype(np.float32)).share < 1e-3


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
    assert weakest_direction([], PlaneMap(0.5, 4, 10_000), np.eye(4), SIGMA_M) is None
