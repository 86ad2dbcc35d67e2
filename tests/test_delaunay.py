"""Own Delaunay triangulation against Qhull and against the definition."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from artemis_edge.delaunay import delaunay, in_circle
from artemis_edge.frames import F64, I32

Triangles = set[tuple[int, int, int]]


def _triangulate(points: F64) -> tuple[I32, I32, F64, F64]:
    """All triangles with the triangles beside them, opposite each corner, -1 where none; rows n..n+2 of the
    coordinates are the enclosing triangle's."""
    n = len(points)
    x, y = np.zeros(n + 3), np.zeros(n + 3)
    x[:n], y[:n] = points[:, 0], points[:, 1]
    corner, link = np.full((2, 4 * (2 * n + 2)), 999_999, np.uint32)
    count = delaunay(x, y, n, corner, link, np.empty(4 * n + 8, np.uint32))
    assert count == 2 * n + 1
    place = link.reshape(-1, 4)[:count, :3].astype(np.int32)
    inside = place < 4 * count
    for t, k in np.argwhere(inside):
        assert link[place[t, k]] == 4 * t + k  # the corner across the edge links back
    triangle = corner.reshape(-1, 4)[:count, :3].astype(np.int32)
    return triangle, np.where(inside, place // 4, -1), x, y


def _inner(corner: I32, n: int) -> Triangles:
    return {tuple(sorted(t)) for t in corner.tolist() if max(t) < n}  # type: ignore[misc]


def _assert_consistent(corner: I32, link: I32) -> None:
    """Each link leads over the opposite edge to a triangle that runs it the other way and links back."""
    for t, (c, across) in enumerate(zip(corner.tolist(), link.tolist(), strict=True)):
        assert len(set(c)) == 3
        for k in range(3):
            if across[k] >= 0:
                a, b = c[(k + 1) % 3], c[(k + 2) % 3]
                other = corner[across[k]].tolist()
                at = next(q for q in range(3) if other[q] not in (a, b))
                assert (other[(at + 1) % 3], other[(at + 2) % 3]) == (b, a)
                assert link[across[k], at] == t


def _areas2(corner: I32, x: F64, y: F64) -> F64:
    a, b, c = corner.T
    area: F64 = (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])
    return area


def _assert_empty_circles(corner: I32, x: F64, y: F64, n: int) -> None:
    for a, b, c in corner.tolist():
        if max(a, b, c) < n:
            assert not any(in_circle(x, y, a, b, c, p) for p in range(n) if p not in (a, b, c))


@pytest.mark.parametrize("n", [3, 4, 5, 8, 16, 25, 40, 64, 100])
def test_random_points_give_qhulls_triangles(n: int) -> None:
    rng = np.random.default_rng(n)
    different = total = 0
    for _ in range(20):
        points = rng.uniform(0.0, 0.6, (n, 2))
        corner, link, x, y = _triangulate(points)
        _assert_consistent(corner, link)
        assert (_areas2(corner, x, y) > 0).all()
        _assert_empty_circles(corner, x, y, n)
        theirs = {tuple(sorted(t)) for t in Delaunay(points).simplices.tolist()}
        ours = _inner(corner, n)
        # the enclosing triangle is not at infinity: slivers at the hull may be missing, none may be extra
        assert ours <= theirs
        different += len(theirs - ours)
        total += len(theirs)
        hull = {frozenset(e) for e in Delaunay(points).convex_hull.tolist()}
        for t in theirs - ours:
            assert any(frozenset(e) in hull for e in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0])))
    assert different <= max(2, 0.01 * total)


@pytest.mark.parametrize("shape", [(2, 2), (3, 3), (5, 7), (10, 10)])
@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_grid_is_covered_once_although_every_square_is_cocircular(
    shape: tuple[int, int], turn: float
) -> None:
    rows, columns = shape
    grid = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), -1).reshape(-1, 2) * 0.05
    c, s = np.cos(turn), np.sin(turn)
    points = grid @ np.array([[c, s], [-s, c]])
    corner, link, x, y = _triangulate(points)
    _assert_consistent(corner, link)
    inner = corner[(corner < len(points)).all(axis=1)]
    assert _areas2(inner, x, y).sum() / 2 == pytest.approx((rows - 1) * (columns - 1) * 0.05**2, rel=1e-6)
    _assert_empty_circles(corner, x, y, len(points))


def test_one_and_two_points_have_no_inner_triangle() -> None:
    for points in (np.array([[0.1, 0.2]]), np.array([[0.1, 0.2], [0.3, 0.1]])):
        corner, link, _, _ = _triangulate(points)
        assert _inner(corner, len(points)) == set()
        _assert_consistent(corner, link)


def test_no_point_leaves_the_enclosing_triangle() -> None:
    corner, _, _, _ = _triangulate(np.empty((0, 2)))
    assert corner.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("along", [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (0.3, -0.7)])
def test_collinear_points_have_no_area(along: tuple[float, float]) -> None:
    points = np.linspace(0.0, 0.5, 20)[:, None] * np.array(along)
    for order in (np.arange(20), np.random.default_rng(0).permutation(20)):
        corner, link, x, y = _triangulate(points[order])
        _assert_consistent(corner, link)
        inner = corner[(corner < 20).all(axis=1)]
        assert np.abs(_areas2(inner, x, y)).sum() < 1e-12


def test_duplicates_terminate_and_cover_the_area_once() -> None:
    rng = np.random.default_rng(5)
    few = rng.uniform(0.0, 0.5, (12, 2))
    points = np.concatenate((few, few, few[:5]))
    corner, link, x, y = _triangulate(points)
    _assert_consistent(corner, link)
    inner = corner[(corner < len(points)).all(axis=1)]
    area = _areas2(inner, x, y)
    assert (area >= -1e-15).all()
    p, q, r = (few[Delaunay(few).simplices[:, k]] for k in range(3))
    whole = np.abs((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0]).sum()
    assert area.sum() == pytest.approx(whole, rel=0.02)


def test_all_points_the_same() -> None:
    corner, link, _, _ = _triangulate(np.full((10, 2), 0.25))
    _assert_consistent(corner, link)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=40))
def test_any_lattice_points_terminate_without_overlap(cells: list[tuple[int, int]]) -> None:
    """Cocircular, collinear and equal points in any mixture."""
    points = np.array(cells, np.float64) * 0.1
    corner, link, x, y = _triangulate(points)
    _assert_consistent(corner, link)
    assert (_areas2(corner, x, y) >= -1e-9).all()
    # the enclosing triangle is filled exactly once
    assert _areas2(corner, x, y).sum() == pytest.approx(4.0e6)


def test_in_circle_agrees_with_the_circumcentre() -> None:
    rng = np.random.default_rng(6)
    for _ in range(300):
        x, y = rng.uniform(size=4), rng.uniform(size=4)
        a, b, c = (0, 1, 2) if _areas2(np.array([[0, 1, 2]], np.int32), x, y)[0] > 0 else (0, 2, 1)
        p = np.stack((x, y), -1)
        centre = np.linalg.solve(2 * (p[1:3] - p[0]), (p[1:3] ** 2).sum(1) - (p[0] ** 2).sum())
        inside = np.linalg.norm(p[3] - centre) - np.linalg.norm(p[0] - centre)
        if abs(inside) > 1e-9:
            assert in_circle(x, y, a, b, c, 3) == (inside < 0)
