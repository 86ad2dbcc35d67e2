import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from artemis_edge.odometry import plane_map as pm
from artemis_edge.odometry import se3
from artemis_edge.odometry.plane_map import PlaneMap, coarsen, sum_points

POSE = se3.exp(np.array([3.0, -40.0, 2.0, 0.2, -0.3, 1.0]))


def naive_voxels(points, T, voxel_m, levels):
    """Points of every voxel: {(level, x, y, z): (n, 3)}."""
    world = points.astype(float) @ T[:3, :3].T + T[:3, 3]
    voxels = {}
    for level in range(levels):
        for p in world:
            cell = np.floor(np.floor(p / voxel_m) / 2**level).astype(int)
            voxels.setdefault((level, *cell.tolist()), []).append(p)
    return {key: np.array(value) for key, value in voxels.items()}


def naive_plane(points, size):
    """Normal, centre, thickness, inverse in-plane covariance; None where the points are no thin sheet."""
    if len(points) < pm.MIN_POINTS:
        return None
    values, vectors = np.linalg.eigh(np.cov(points.T, bias=True))
    if values[0] > pm._MAX_THICKNESS * values[1] or values[1] < (pm._MIN_WIDTH * size) ** 2:
        return None
    spread = sum(np.outer(v, v) / w for w, v in zip(values[1:], vectors[:, 1:].T, strict=True))
    n = len(points)
    return vectors[:, 0], points.mean(axis=0), values[0] * n / (n - 3), spread


def rows_of(plane_map):
    pm.fit_all(plane_map.table, len(plane_map), plane_map.voxel_m)
    return {
        int(k): row
        for k, row in zip(plane_map.table.keys, plane_map.table.rows[: len(plane_map)], strict=False)
    }


def cloud(kind, n=390):
    rng = np.random.default_rng(5)
    points = rng.uniform(-3, 3, (n, 3))
    if kind == "plane":
        points[:, 2] = 0.3 * points[:, 0] + 0.01 * rng.normal(size=n)
    if kind == "line":
        points[:, 1:] = 0.1
    if kind == "one place":
        points[:] = 0.1
    return points.astype(np.float32)


@pytest.mark.parametrize("kind", ["blob", "plane", "line", "one place", "one", "none"])
def test_map_equals_the_naive_twin(kind):
    points = cloud(kind)[: {"one": 1, "none": 0}.get(kind, 390)]
    plane_map = PlaneMap(0.5, 3, 10_000)
    for part in np.array_split(points, 3):  # moments run on over several scans
        assert plane_map.insert(part, POSE) == 0
    expected = naive_voxels(points, POSE, 0.5, 3)
    rows = rows_of(plane_map)
    assert len(plane_map) == len(expected) == len(rows)
    planes = 0
    for (level, x, y, z), inside in expected.items():
        row = rows[pm.cell_key(level, x, y, z)]
        assert row[pm.COUNT] == len(inside)
        plane = naive_plane(inside, 0.5 * 2**level)
        assert (row[pm.THICKNESS] >= 0) == (plane is not None)
        if plane is None:
            continue
        planes += 1
        normal, centre, thickness, spread = plane
        assert abs(row[pm.NORMAL : pm.NORMAL + 3] @ normal) == pytest.approx(1, abs=1e-6)
        np.testing.assert_allclose(row[pm.CENTRE : pm.CENTRE + 3], centre, atol=1e-9)
        assert row[pm.THICKNESS] == pytest.approx(thickness, rel=1e-5, abs=1e-9)
        upper = spread[np.triu_indices(3)]
        np.testing.assert_allclose(
            row[pm.SPREAD : pm.SPREAD + 6], upper, rtol=1e-4, atol=1e-4 * abs(upper).max()
        )
    assert (planes > 0) == (kind in ("plane", "blob"))


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 200), st.integers(0, 2**32 - 1))
def test_coarse_sums_are_the_sums_of_the_points(n, seed):
    points = np.random.default_rng(seed).uniform(-4, 4, (n, 3)).astype(np.float32)
    cells, sums = sum_points(points, np.eye(4), 0.5)
    cells, sums = coarsen(cells, sums, 0.5)
    direct_cells, direct = sum_points(points, np.eye(4), 1.0)
    order, direct_order = np.lexsort(cells.T), np.lexsort(direct_cells.T)
    np.testing.assert_array_equal(cells[order], direct_cells[direct_order])
    np.testing.assert_allclose(sums[order], direct[direct_order], atol=1e-9)


def test_a_voxel_forgets_what_is_old():
    """A wall that moves by 20 cm is at its new place after as many points again as are remembered."""
    rng = np.random.default_rng(0)
    plane_map = PlaneMap(1.0, 1, 1000)
    for x in (0.3, 0.5):
        for _ in range(40):
            wall = np.column_stack([np.full(50, x), rng.uniform(0, 1, (50, 2))]).astype(np.float32)
            plane_map.insert(wall, np.eye(4))
    (row,) = rows_of(plane_map).values()
    assert row[pm.COUNT] <= pm._MAX_POINTS + 50
    assert row[pm.CENTRE] == pytest.approx(0.5, abs=0.01)


def test_a_full_map_refuses_and_says_so():
    points = (np.arange(300, dtype=np.float32).reshape(100, 3) * 10).astype(np.float32)
    plane_map = PlaneMap(0.5, 1, 60)
    assert plane_map.insert(points, np.eye(4)) == 40
    assert len(plane_map) == 60


def test_evicting_keeps_exactly_the_near_voxels():
    rng = np.random.default_rng(2)
    points = rng.uniform(-50, 50, (3000, 3)).astype(np.float32)
    plane_map = PlaneMap(0.5, 2, 20_000)
    plane_map.insert(points, np.eye(4))
    before = {key: row.copy() for key, row in rows_of(plane_map).items()}
    near = pm.nearby(plane_map.table.keys[: len(plane_map)], np.zeros(3), 30.0, 0.5)
    expected = set(plane_map.table.keys[: len(plane_map)][near].tolist())
    plane_map.evict(np.zeros(3), 30.0)
    after = rows_of(plane_map)
    assert set(after) == expected and 0 < len(after) < len(before)
    for key, row in after.items():
        np.testing.assert_array_equal(row, before[key])
        assert plane_map.table.hash[pm.probe(plane_map.table.hash, key), 0] == key


def test_evicting_a_full_map_frees_half_of_it():
    points = np.random.default_rng(3).uniform(-10, 10, (5000, 3)).astype(np.float32)
    plane_map = PlaneMap(0.5, 1, 4000)
    plane_map.insert(points, np.eye(4))
    assert len(plane_map) > 2000
    plane_map.evict(np.zeros(3), 100.0)
    assert 0 < len(plane_map) <= 2000


def test_planes_of_a_level():
    plane_map = PlaneMap(0.5, 2, 1000)
    plane_map.insert(cloud("plane", 4000), np.eye(4))
    for level in (0, 1):
        normals, centres, thickness = plane_map.planes(level)
        assert len(normals) == len(centres) == len(thickness) > 0
        expected = np.array([-0.3, 0, 1]) / np.hypot(0.3, 1)
        assert np.median(np.abs(normals @ expected)) > 0.995
        assert np.median(thickness) == pytest.approx((0.01 / np.hypot(0.3, 1)) ** 2, rel=0.5)
