"""Patches that something nearer covers a part of, against slow twins; the edge of a shelf before a wall."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from artemis_edge.frames import F64
from artemis_edge.odometry.silhouette import nearest_depth, partly_covered

K = np.array([100.0, 100.0, 64.0, 48.0])
WIDTH, HEIGHT = 128, 96


def naive_nearest(points: F64) -> F64:
    out = np.full((12, 16), np.inf)
    for x, y, z in points:
        if z > 0.3:
            u, v = 100.0 * x / z + 64.0, 100.0 * y / z + 48.0
            if 0 <= u < WIDTH and 0 <= v < HEIGHT:
                cell = int(v // 8), int(u // 8)
                out[cell] = min(out[cell], z)
    return out


def naive_covered(centre: F64, normal: F64, nearest: F64) -> bool:
    """Nearer than the plane's nearest corner of 48 x 48 pixels by 0.1 m, within two cells."""
    if not centre[2] > 0.3:
        return False
    u, v = 100.0 * centre[:2] / centre[2] + [64.0, 48.0]
    depths = [centre[2]]
    for du in (-24, 24):
        for dv in (-24, 24):
            ray = np.array([(u + du - 64.0) / 100.0, (v + dv - 48.0) / 100.0, 1.0])
            if normal @ ray != 0.0 and (normal @ centre) / (normal @ ray) > 0.0:
                depths.append((normal @ centre) / (normal @ ray))
    row, column = int(v // 8), int(u // 8)
    near = [
        nearest[r, c]
        for r in range(row - 2, row + 3)
        for c in range(column - 2, column + 3)
        if 0 <= r < nearest.shape[0] and 0 <= c < nearest.shape[1]
    ]
    return bool(near) and min(near) < min(depths) - 0.1


def wall(x0: float, x1: float, z: float) -> F64:
    x, y = np.meshgrid(np.arange(x0, x1, 0.02), np.arange(-1.0, 1.0, 0.02))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)


FACING = np.array([0.0, 0.0, -1.0])


def test_a_wall_beside_a_shelf_is_covered_and_the_shelf_is_not() -> None:
    nearest = nearest_depth(np.concatenate([wall(-2, 2, 2.6), wall(0.5, 2.0, 2.3)]), K, WIDTH, HEIGHT)
    centres = np.array([[0.45, 0, 2.6], [-0.6, 0, 2.6], [0.55, 0, 2.3], [0.45, 0, -2.6], [9.0, 9.0, 2.6]])
    found = partly_covered(centres, np.tile(FACING, (5, 1)), nearest, K)
    assert found.tolist() == [True, False, False, False, False]


def test_a_floor_stays_where_it_meets_a_wall() -> None:
    x, z = np.meshgrid(np.arange(-2.0, 2.0, 0.02), np.arange(1.5, 4.0, 0.02))
    floor = np.stack([x.ravel(), np.full(x.size, 1.0), z.ravel()], axis=1)
    nearest = nearest_depth(np.concatenate([wall(-2, 2, 4.0), floor]), K, WIDTH, HEIGHT)
    centres = np.array([[0.0, 1.0, 3.8], [0.0, 1.0, 3.0], [0.0, 0.0, 4.0]])
    normals = np.array([[0.0, -1.0, 0.0], [0.0, -1.0, 0.0], FACING])
    assert not partly_covered(centres, normals, nearest, K).any()


def test_without_points_nothing_is_covered() -> None:
    nearest = nearest_depth(np.empty((0, 3)), K, WIDTH, HEIGHT)
    assert nearest.shape == (12, 16) and np.isinf(nearest).all()
    assert not partly_covered(np.array([[0.0, 0.0, 2.0]]), FACING[None], nearest, K).any()
    assert partly_covered(np.empty((0, 3)), np.empty((0, 3)), nearest, K).shape == (0,)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_kernels_are_their_twins(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-3, -3, -1], [3, 3, 6], (60, 3))
    points[0], points[1] = np.nan, 0.0
    nearest = nearest_depth(points, K, WIDTH, HEIGHT)
    np.testing.assert_array_equal(nearest, naive_nearest(points))
    centres = rng.uniform([-3, -3, -1], [3, 3, 6], (20, 3))
    normals = rng.normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    found = partly_covered(centres, normals, nearest, K)
    assert found.tolist() == [naive_covered(c, n, nearest) for c, n in zip(centres, normals, strict=True)]
