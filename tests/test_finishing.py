"""What the finished mesh is made of: holes closed, whiskers trimmed, pieces told apart by edges."""

import numpy as np
import pytest

from artemis_edge import finishing
from artemis_edge.frames import F32, I32
from tests import naive

LONGEST_M = 0.45


def sheet(n: int) -> tuple[F32, F32, I32]:
    """A flat square of (n - 1)^2 pairs of triangles at 0.1 m, facing up."""
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    vertices = np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)]).astype(np.float32) * np.float32(0.1)
    normals = np.tile(np.array([0, 0, 1], np.float32), (n * n, 1))
    a = (x[:-1, :-1] * n + y[:-1, :-1]).ravel()
    faces = np.concatenate([np.stack([a, a + n, a + n + 1], 1), np.stack([a, a + n + 1, a + 1], 1)])
    return vertices, normals, faces.astype(np.int32)


def inner(faces: I32, n: int) -> I32:
    """Rows of faces whose corners are all away from the rim."""
    x, y = faces // n, faces % n
    return np.flatnonzero(((x > 0) & (x < n - 1) & (y > 0) & (y < n - 1)).all(axis=1)).astype(np.int32)


def covered_m2(vertices: F32, faces: I32) -> float:
    p, q, r = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    return float(np.cross(q - p, r - p)[:, 2].sum() / 2)


@pytest.mark.parametrize("seed", range(6))
def test_small_holes_are_closed_wherever_they_touch(seed: int) -> None:
    """Holes that meet in a vertex are walked around one by one."""
    n = 14
    vertices, normals, faces = sheet(n)
    rng = np.random.default_rng(seed)
    gone = rng.choice(inner(faces, n), 30, replace=False)
    holed = np.delete(faces, gone, axis=0)
    closed = finishing.close_loops(vertices, normals, holed, LONGEST_M)
    naive.assert_manifold(closed.astype(np.int64))
    missing = covered_m2(vertices, faces) - covered_m2(vertices, closed)
    assert -1e-6 < missing < 0.25 * 30 * 0.005, "three of four at least"
    again = finishing.close_loops(vertices, normals, closed, LONGEST_M)
    naive.assert_manifold(again.astype(np.int64))


def test_the_rim_of_the_sheet_and_wide_holes_stay_open() -> None:
    n = 12
    vertices, normals, faces = sheet(n)
    x, y = faces // n, faces % n
    wide = ((x >= 3) & (x <= 8) & (y >= 3) & (y <= 8)).all(axis=1)
    holed = faces[~wide]
    np.testing.assert_array_equal(finishing.close_loops(vertices, normals, holed, LONGEST_M), holed)


def test_free_edges_are_those_without_a_twin() -> None:
    _, _, faces = sheet(5)
    free = finishing.free_edges(faces)
    found = {
        (int(f[k]), int(f[(k + 1) % 3]))
        for f, row in zip(faces, free, strict=True)
        for k in range(3)
        if row[k]
    }
    assert found == set(naive.free_edges(faces.astype(np.int64)))
    assert finishing.free_edges(faces[:0]).shape == (0, 3)


def test_whiskers_are_trimmed() -> None:
    vertices, normals, faces = sheet(6)
    tip = np.array([[0.9, 0.2, 0]], np.float32)
    vertices, normals = np.concatenate([vertices, tip]), np.concatenate([normals, normals[:1]])
    whisker = np.array([[5 * 6 + 1, 36, 5 * 6 + 2]], np.int32)
    finished = finishing.finish(vertices, normals, np.concatenate([faces, whisker]), LONGEST_M, 1)
    assert not (finished == 36).any() and len(finished) >= len(faces) - 2


def test_pieces_that_share_only_a_corner_are_two() -> None:
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 5, 6], [5, 7, 6]], np.int32)
    assert finishing.large_islands(faces, 3).tolist() == [True, True, True, False, False]
    assert finishing.large_islands(faces, 2).all()
    assert finishing.large_islands(faces[:0], 4).shape == (0,)


def test_nothing_stays_nothing() -> None:
    vertices, normals, faces = sheet(2)
    assert len(finishing.finish(vertices, normals, faces[:0], LONGEST_M, 4)) == 0
