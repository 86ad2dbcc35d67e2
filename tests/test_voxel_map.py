"""Evidence against a plain dictionary, vertices against the surfaces they were sampled from."""

import numpy as np
import pytest

from artemis_edge import block_store as bs
from artemis_edge import cell_code as cc
from artemis_edge import voxel_map as vm
from artemis_edge.config import VoxelMapConfig
from artemis_edge.frames import F32, F64, DeskewedScan, TrackedFrame
from artemis_edge.insertion import CHUNK, SATURATED_COUNT
from artemis_edge.voxel_map import VoxelMap
from tests import naive

CONFIG = VoxelMapConfig()
SUMS = 13  # columns of evidence that insertion adds to


def _cells(voxel_map: VoxelMap) -> dict[naive.Cell, F64]:
    """Evidence by cell coordinates, straight from the store."""
    store, out = voxel_map.store, {}
    for block in store.hash_slot[store.hash_key != bs.EMPTY_KEY]:
        for v in store.block_voxel[block][store.block_voxel[block] >= 0]:
            for c in np.flatnonzero(store.voxel_cell[v] >= 0).tolist():
                assert int(store.voxel_mask[v]) >> c & 1
                x, y, z = (store.voxel[v, :3] * 4 + (c >> 4, (c >> 2) & 3, c & 3)).tolist()
                out[x, y, z] = store.evidence[store.voxel_cell[v, c], :SUMS].astype(np.float64)
            assert int(store.voxel_mask[v]).bit_count() == (store.voxel_cell[v] >= 0).sum()
    return out


def _pose(rng: np.random.Generator, reach: float) -> F64:
    T = np.eye(4)
    q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T[:3, :3] = q * np.sign(np.linalg.det(q))
    T[:3, 3] = rng.uniform(-reach, reach, 3)
    return T


def _assert_equal(voxel_map: VoxelMap, twin: dict[naive.Cell, F64]) -> None:
    ours = _cells(voxel_map)
    assert ours.keys() == twin.keys()
    for cell, row in twin.items():
        np.testing.assert_allclose(ours[cell], row, rtol=1e-4, atol=2e-5, err_msg=str(cell))


def _naive(scan: DeskewedScan, T: F64) -> dict[naive.Cell, F64]:
    return naive.accumulate(
        scan.points,
        T,
        scan.origin,
        CONFIG.voxel_m / 4,
        CONFIG.min_range_m,
        CONFIG.max_range_m,
        CONFIG.noise_range_m,
    )


@pytest.mark.parametrize("seed", range(5))
def test_insertion_against_a_dictionary(seed: int) -> None:
    rng = np.random.default_rng(seed)
    voxel_map = VoxelMap(CONFIG, 1.0)
    twin: dict[naive.Cell, F64] = {}
    for stamp in range(1, 4):
        T, origin = _pose(rng, 30.0), rng.uniform(-0.5, 0.5, 3)
        points = rng.normal(0.0, rng.choice([1.0, 2.0, 3.0]), (600, 3)).astype(np.float32)
        scan = DeskewedScan(points, origin)
        degenerate = stamp == 2
        touched = voxel_map.insert(TrackedFrame(0, 0, T, (scan,), degenerate), stamp)
        new = _naive(scan, T)
        trust = CONFIG.degenerate_trust if degenerate else 1.0
        for cell, row in new.items():
            twin[cell] = twin.get(cell, np.zeros(SUMS)) + trust * row
        voxels = {tuple(c >> 2 for c in cell) for cell in new}
        assert len(touched) == len(voxels)
        assert {tuple(v) for v in voxel_map.store.voxel[touched, :3].tolist()} == voxels
        blocks = voxel_map.store.block[voxel_map.touched_blocks(), :3].tolist()
        assert sorted(map(tuple, blocks)) == sorted({tuple(c >> 3 for c in v) for v in voxels})
    _assert_equal(voxel_map, twin)


@pytest.mark.parametrize("n", [1, CHUNK - 1, CHUNK, CHUNK + 1, 2 * CHUNK])
def test_scans_around_the_length_of_a_chunk(n: int) -> None:
    """Every point counts once, and the points out of range between them not at all."""
    points = np.random.default_rng(n).uniform(-4.0, 4.0, (n, 3)).astype(np.float32)
    points[1::7] = np.nan
    scan = DeskewedScan(points, np.array([0.0, 0.0, 9.0]))
    voxel_map = VoxelMap(CONFIG, 1.0)
    for stamp in (1, 2):  # the second scan finds everything there
        voxel_map.insert(TrackedFrame(0, 0, np.eye(4), (scan,)), stamp)
    _assert_equal(voxel_map, {cell: 2.0 * row for cell, row in _naive(scan, np.eye(4)).items()})
    assert voxel_map.store.evidence[:, bs.HITS].sum() == 2 * np.isfinite(points[:, 0]).sum()


def test_two_scans_of_one_frame_touch_a_voxel_once() -> None:
    voxel_map = VoxelMap(CONFIG, 1.0)
    scan = DeskewedScan(np.array([[2.0, 0.1, 0.1], [2.0, 0.1, 0.1]], np.float32), np.zeros(3))
    touched = voxel_map.insert(TrackedFrame(0, 0, np.eye(4), (scan, scan)), 1)
    assert len(touched) == 1 and len(voxel_map.touched_blocks()) == 1
    assert voxel_map.store.voxel[touched[0], bs.PENDING] == 4


def test_points_that_are_not_numbers_or_out_of_range_are_ignored() -> None:
    bad: F32 = np.array(
        [
            [np.nan, 0, 0],
            [3, np.nan, 0],
            [3, 0, np.nan],
            [np.inf, 0, 0],
            [-np.inf, np.inf, 3],
            [0, 0, 0],
            [CONFIG.min_range_m - 0.01, 0, 0],
            [CONFIG.max_range_m + 0.01, 0, 0],
        ],
        np.float32,
    )
    voxel_map = VoxelMap(CONFIG, 1.0)
    assert len(voxel_map.insert(naive.frame_of(bad), 1)) == 0
    assert voxel_map.store.counter[bs.N_BLOCKS] == voxel_map.store.counter[bs.REFUSED_POINTS] == 0
    good = np.array([[CONFIG.min_range_m + 0.01, 0, 0], [0, CONFIG.max_range_m - 0.01, 0]])
    assert len(voxel_map.insert(naive.frame_of(np.concatenate((bad, good))), 2)) == 2


def test_points_just_below_zero_are_in_cell_minus_one() -> None:
    voxel_map = VoxelMap(CONFIG, 1.0)
    voxel_map.insert(naive.frame_of(np.array([[-1e-3, -1e-3, -1e-3]]), sensor=(2, 0, 0)), 1)
    assert list(_cells(voxel_map)) == [(-1, -1, -1)]


def test_empty_frames() -> None:
    voxel_map = VoxelMap(CONFIG, 1.0)
    assert len(voxel_map.insert(naive.frame_of(np.empty((0, 3))), 1)) == 0
    assert len(voxel_map.insert(TrackedFrame(0, 0, np.eye(4), ()), 2)) == 0
    assert len(voxel_map.touched_blocks()) == 0


def test_far_points_weigh_what_their_variance_says() -> None:
    voxel_map = VoxelMap(CONFIG, 1.0)
    voxel_map.insert(naive.frame_of(np.array([[CONFIG.noise_range_m, 0.01, 0.01]])), 1)
    (row,) = _cells(voxel_map).values()
    assert row[0] == pytest.approx(0.5, rel=1e-5)
    np.testing.assert_allclose(row[10:], [-0.5, 0, 0], atol=1e-3)


def test_evidence_of_a_cell_stops_growing() -> None:
    voxel_map = VoxelMap(CONFIG, 1.0)
    points = np.tile([2.0, 0.05, 0.05], (3000, 1))
    voxel_map.insert(naive.frame_of(points), 1)
    (row,) = _cells(voxel_map).values()
    assert SATURATED_COUNT <= row[0] <= SATURATED_COUNT + 1


def test_full_memory_refuses_points_and_counts_them() -> None:
    voxel_map = VoxelMap(CONFIG, 1.0)
    room = len(voxel_map.store.voxel)
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20), np.arange(20), indexing="ij"), -1).reshape(
        -1, 3
    )
    points = grid * CONFIG.voxel_m + 1.0
    for stamp in (1, 2):
        touched = voxel_map.insert(naive.frame_of(points), stamp)
        assert len(touched) == room
    assert voxel_map.store.counter[bs.REFUSED_POINTS] == 2 * (len(points) - room)
    assert len(_cells(voxel_map)) == room


def _refresh(voxel_map: VoxelMap, least_evidence: float = 1.0) -> F32:
    """Refresh every voxel; rows of living vertices."""
    store, space = voxel_map.store, vm.refresh_space()
    rules = vm.RefreshRules(voxel_map.cell_m, CONFIG.plane_sigma_m, 0.6 * voxel_map.cell_m, least_evidence)
    for v in range(store.counter[bs.N_VOXELS]):
        vm.refresh_voxel(store, v, 1, rules, space)
    assert (space.grid == -1).all()
    return store.vertex[: store.counter[bs.N_CELLS]][store.state[: store.counter[bs.N_CELLS]] == bs.ALIVE]


@pytest.mark.parametrize("tilt", [0.0, 0.4, 1.1])
def test_vertices_average_the_noise_of_a_plane_away(tilt: float) -> None:
    rng = np.random.default_rng(1)
    sigma, hits = 0.02, 12
    u, v = np.array([2.0, 0.0, 0.0]), np.array([0.0, 2.0 * np.cos(tilt), 2.0 * np.sin(tilt)])
    corner, normal = np.array([-1.0, -1.0, -2.0]), np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    sensor = corner + 0.5 * (u + v) + 2.0 * normal
    voxel_map = VoxelMap(CONFIG, 1.0)
    points = naive.rectangle(rng, corner, u, v, hits / 0.01, sigma)
    voxel_map.insert(naive.frame_of(points, sensor), 1)
    vertex = _refresh(voxel_map, least_evidence=40.0)  # leaves out cells that the noise alone reached
    assert len(vertex) > 200
    distance = (vertex[:, :3] - corner) @ normal
    # a vertex lies on the plane through the points of nine cells
    assert distance.std() < 2.0 * sigma / np.sqrt(9 * hits)
    assert abs(distance.mean()) < 0.002
    assert (vertex[:, 3:6] @ normal).min() > 0.7, "normals look at the sensor"
    assert (vertex[:, 3:6] @ normal).mean() > 0.97
    np.testing.assert_allclose(np.linalg.norm(vertex[:, 3:6], axis=1), 1.0, atol=1e-4)
    assert np.median(vertex[:, 6]) == pytest.approx(sigma, rel=0.3)


def test_normals_turn_with_the_side_the_plane_is_seen_from() -> None:
    rng = np.random.default_rng(2)
    points = naive.rectangle(rng, (-1, -1, 0.05), (2, 0, 0), (0, 2, 0), 2000, 0.005)
    for height in (3.0, -3.0):
        voxel_map = VoxelMap(CONFIG, 1.0)
        voxel_map.insert(naive.frame_of(points, (0, 0, height)), 1)
        assert (np.sign(_refresh(voxel_map)[:, 5]) == np.sign(height)).all()


def test_vertices_at_a_crease_do_not_cut_the_corner() -> None:
    rng = np.random.default_rng(3)
    floor = naive.rectangle(rng, (-1, -1, 0), (1, 0, 0), (0, 2, 0), 4000, 0.003)
    wall = naive.rectangle(rng, (0, -1, 0), (0, 0, 1), (0, 2, 0), 4000, 0.003)
    voxel_map = VoxelMap(CONFIG, 1.0)
    voxel_map.insert(naive.frame_of(np.concatenate((floor, wall)), (-2, 0, 2)), 1)
    vertex = _refresh(voxel_map, least_evidence=20.0)
    off = np.minimum(np.abs(vertex[:, 0]), np.abs(vertex[:, 2]))
    near = (np.abs(vertex[:, 0]) < 0.1) & (np.abs(vertex[:, 2]) < 0.1)
    # the mean of a cell that holds both sides lies inside the corner; a common plane would lie far more so
    assert near.sum() > 15 and off[near].max() < 0.035 and off[~near].max() < 0.02


def test_living_vertices_keep_their_distance() -> None:
    rng = np.random.default_rng(4)
    voxel_map = VoxelMap(CONFIG, 1.0)
    voxel_map.insert(naive.frame_of(rng.uniform(-1, 1, (3000, 3)), (3, 0, 0)), 1)
    p = _refresh(voxel_map)[:, :3].astype(np.float64)
    gap = np.linalg.norm(p[:, None] - p[None], axis=2)
    gap[np.arange(len(p)), np.arange(len(p))] = 9.0
    assert len(p) > 300
    # checked when a vertex begins to live; later ones may still move a little
    assert np.quantile(gap.min(axis=1), 0.02) > 0.8 * 0.6 * voxel_map.cell_m


def test_a_far_wall_may_be_as_thick_as_its_noise() -> None:
    """The same scatter is noise at 40 m, where a beam's angle is worth 4 cm, and structure at 5 m."""
    scatter = {}
    for distance in (5.0, 40.0):
        rng = np.random.default_rng(8)
        wall = naive.rectangle(rng, (distance + 0.05, -1, -1), (0, 2, 0), (0, 0, 2), 3000, 0.03)
        voxel_map = VoxelMap(CONFIG, 1.0)
        voxel_map.insert(naive.frame_of(wall), 1)
        vertex = _refresh(voxel_map, least_evidence=5.0)
        scatter[distance] = float(np.median(np.abs(vertex[:, 0] - distance - 0.05)))
    assert scatter[40.0] < 0.005
    assert scatter[5.0] > 1.3 * scatter[40.0]


def test_points_in_layers_keep_the_normal_of_their_plane() -> None:
    """A relief of two layers is no plane, but its vertices do not look along the grazing beam either."""
    rng = np.random.default_rng(9)
    layers = [naive.rectangle(rng, (-1, 0.05 + d, -1), (2, 0, 0), (0, 0, 2), 6000, 0.005) for d in (0, 0.08)]
    voxel_map = VoxelMap(CONFIG, 1.0)
    voxel_map.insert(naive.frame_of(np.concatenate(layers), (-8, -2, 0)), 1)
    vertex = _refresh(voxel_map, least_evidence=5.0)
    inner = np.abs(vertex[:, [0, 2]]).max(axis=1) < 0.8
    assert np.median(vertex[inner, 4]) < -0.9


def test_little_evidence_makes_no_vertex() -> None:
    voxel_map = VoxelMap(CONFIG, 1.0)
    voxel_map.insert(naive.frame_of(np.array([[3.0, 0.05, 0.05]])), 1)
    assert len(_refresh(voxel_map, least_evidence=1.0)) == 0
    assert len(_refresh(voxel_map, least_evidence=0.5)) == 1
    vertex = voxel_map.store.vertex[0]
    np.testing.assert_allclose(vertex[:3], [3.0, 0.05, 0.05], atol=1e-5)
    np.testing.assert_allclose(vertex[3:6], [-1, 0, 0], atol=0.05)  # no plane: looks at the sensor


@pytest.mark.parametrize("shape", ["collinear", "one place"])
def test_degenerate_evidence_gives_finite_vertices(shape: str) -> None:
    points = np.tile([3.0, 0.05, 0.05], (200, 1))
    if shape == "collinear":
        points[:, 1] = np.linspace(-1, 1, 200)
    voxel_map = VoxelMap(CONFIG, 1.0)
    voxel_map.insert(naive.frame_of(points), 1)
    vertex = _refresh(voxel_map)
    assert len(vertex) > 0 and np.isfinite(vertex[:, :7]).all()
    np.testing.assert_allclose(vertex[:, [0, 2]], [[3.0, 0.05]] * len(vertex), atol=1e-4)


def test_moments_of_27_cells_against_a_dictionary() -> None:
    rng = np.random.default_rng(5)
    grid, moment = np.full(cc.CODES, -1, np.int32), rng.normal(size=(216, 16))
    cells: dict[naive.Cell, F64] = {}
    for i, c in enumerate({tuple(rng.integers(11, 17, 3).tolist()) for _ in range(120)}):
        grid[cc.code_of(*c)] = i
        cells[c] = moment[i, :13]  # type: ignore[index]
    total, around = np.empty(16), np.empty(28, np.uint32)
    for x, y, z in cells:
        vm._sum_around(moment, around, vm.list_around(grid, cc.code_of(x, y, z), around), total)
        np.testing.assert_allclose(total[:13], naive.sum_around(cells, (x, y, z)))


def test_moved_moments_are_those_of_the_points_themselves() -> None:
    """About the voxel's corner instead of the cell's centre."""
    rng = np.random.default_rng(6)
    voxel_map = VoxelMap(CONFIG, 1.0)
    points = rng.uniform(0.0, CONFIG.voxel_m, (400, 3))
    voxel_map.insert(naive.frame_of(points, (3, 0, 0)), 1)
    store, cell_m, moment = voxel_map.store, voxel_map.cell_m, np.zeros((216, 16))
    for c in range(64):
        s = int(store.voxel_cell[0, c])
        if s >= 0:
            code = cc.code_of(12 + (c >> 4), 12 + ((c >> 2) & 3), 12 + (c & 3))
            vm._move_moments(store.evidence, s, code, cell_m, moment, c)
    w = 1 / (1 + (np.linalg.norm(points - (3, 0, 0), axis=1) / CONFIG.noise_range_m) ** 2)
    square = np.einsum("i,ij,ik->jk", w, points, points)[np.triu_indices(3)]
    np.testing.assert_allclose(
        moment.sum(axis=0)[:10], [w.sum(), *(w @ points), *square], rtol=1e-3, atol=1e-3
    )


def test_new_vertices_tell_only_the_neighbours_that_see_them() -> None:
    voxel_map = VoxelMap(CONFIG, 1.0)
    centres = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(-1, 3) * 0.4 + 0.2
    voxel_map.insert(naive.frame_of(centres, (4, 0.6, 0.6)), 1)
    store, neighbour = voxel_map.store, np.empty(27, np.int32)
    middle = next(v for v in range(27) if store.voxel[v, :3].tolist() == [1, 1, 1])
    bs.neighbours27(store, middle, neighbour)
    store.voxel[:27, bs.AT_MESH] = 1
    for cell in ((0, 1, 2), (3, 3, 3), (1, 2, 1), (0, 0, 3)):
        store.voxel[:27, bs.FRESH] = 0
        vm._tell_neighbours(store, neighbour, cc.code_of(*(12 + c for c in cell)), 1, 5)
        for k, u in enumerate(neighbour):
            d = (k // 9 - 1, (k // 3) % 3 - 1, k % 3 - 1)
            sees = all(s == 0 or c == (0 if s < 0 else 3) for s, c in zip(d, cell, strict=True))
            assert store.voxel[u, bs.FRESH] == (1 if sees and k != 13 else 0)
