"""Meshes of small worlds: whole, manifold, turned towards the sensor, and nothing bridged."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from artemis_edge import mesher
from artemis_edge.block_store import COUNT, HITS
from artemis_edge.config import MesherConfig, VoxelMapConfig
from artemis_edge.evaluate.topology import topology
from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import F64
from artemis_edge.map_writer import gather_mesh
from artemis_edge.mesher import Rules, hits_close_by, is_surface, workspace
from tests import naive

CELL_M = VoxelMapConfig().voxel_m / 4
LONG_EDGE_M = MesherConfig().long_edge * CELL_M
EDGE_SLACK_M = 0.1  # a vertex may still move by its noise after its patch was made


def _map(
    folder: Path, frames: list[F64], sensor: tuple[float, float, float] = (0.0, 0.0, 1.0)
) -> naive.SmallMapper:
    mapper = naive.SmallMapper(folder)
    for points in frames:
        mapper.add(points, sensor)
    return mapper


def _mesh(mapper: naive.SmallMapper) -> Mesh:
    """The raw mesh, checked to be manifold."""
    mesh = mapper.finish()
    naive.assert_manifold(naive.all_triangles(mapper.pager))
    shape = topology(mesh.vertices, mesh.faces)
    assert shape.non_manifold_share == 0.0 and shape.orientation_share == 1.0
    return mesh


def _finished(mapper: naive.SmallMapper) -> Mesh:
    return gather_mesh(mapper.pager, LONG_EDGE_M, MesherConfig().smallest_island)


def _edge_lengths(mesh: Mesh) -> F64:
    p = mesh.vertices[mesh.faces].astype(np.float64)
    lengths: F64 = np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2)
    return lengths


def _wall(seed: int, x: float, frames: int = 5, sigma: float = 0.005) -> list[F64]:
    rng = np.random.default_rng(seed)
    return [
        naive.rectangle(rng, (x, -1.7, -0.7), (0, 3.4, 0), (0, 0, 3.4), 400, sigma) for _ in range(frames)
    ]


@pytest.mark.parametrize("x", [3.05, 3.13, 3.3, -2.9])
@pytest.mark.parametrize("sigma", [0.0, 0.01])
def test_plane_has_no_holes_and_its_own_area(tmp_path: Path, x: float, sigma: float) -> None:
    mapper = _map(tmp_path, _wall(1, x, sigma=sigma))
    _mesh(mapper)
    mesh = _finished(mapper)
    # the mesh ends at the outermost vertices, on average half a cell or less before the rim
    extent = np.ptp(mesh.vertices[:, 1:], axis=0)
    assert (extent > 3.4 - CELL_M).all()
    assert naive.area(mesh) == pytest.approx(float(np.prod(extent)), rel=0.04)
    assert 3.3**2 * 0.98 < naive.area(mesh) < 3.4**2 * 1.02
    free = np.array(naive.free_edges(mesh.faces.astype(np.int64)))
    middle = np.abs(mesh.vertices[free].mean(axis=1)[:, 1:] - (0.0, 1.0)).max(axis=1)
    assert (middle > 1.7 - 1.5 * CELL_M).all(), "a free edge away from the rim is a hole"
    towards = np.array([-np.sign(x), 0.0, 0.0])
    # a sliver between two vertices that noise set beside each other may stand on edge, hardly more
    assert (naive.face_normals(mesh) @ towards > 0.5).mean() > 0.995
    assert (mesh.normals @ towards > 0.5).all()


@pytest.mark.parametrize("x", [3.2, -4.0])
def test_plane_on_the_border_of_voxels_is_whole_too(tmp_path: Path, x: float) -> None:
    mapper = _map(tmp_path, _wall(1, x))
    _mesh(mapper)
    assert naive.area(_finished(mapper)) > 3.3**2 * 0.98


def test_corner_of_two_walls(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    frames = [
        np.concatenate(
            (
                naive.rectangle(rng, (2.05, -1, 0.05), (0, 2, 0), (0, 0, 2), 400, 0.005),
                naive.rectangle(rng, (0.05, 1.05, 0.05), (2, 0, 0), (0, 0, 2), 400, 0.005),
            )
        )
        for _ in range(6)
    ]
    mapper = _map(tmp_path, frames)
    _mesh(mapper)
    mesh = _finished(mapper)
    assert naive.area(mesh) == pytest.approx(8.0, rel=0.1)
    # the surface goes around the corner in one piece
    assert topology(mesh.vertices, mesh.faces).boundary_share < 0.1
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    inward = -np.sign(naive.face_normals(mesh)[:, :2])
    flat = (middle[:, 0] < 1.8) | (middle[:, 1] < 0.8)
    on_x = np.abs(middle[:, 0] - 2.05) < 0.05
    assert (inward[flat & on_x, 0] > 0).all() and (inward[flat & ~on_x, 1] > 0).all()
    off = np.minimum(np.abs(mesh.vertices[:, 0] - 2.05), np.abs(mesh.vertices[:, 1] - 1.05))
    assert off.max() < 0.06


def test_thin_wall_seen_from_both_sides_is_two_sheets(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    mapper = naive.SmallMapper(tmp_path)
    for _ in range(6):
        for x, sensor in ((2.95, 0.0), (3.25, 6.0)):
            mapper.add(naive.rectangle(rng, (x, -1, 0.1), (0, 2, 0), (0, 0, 2), 400, 0.005), (sensor, 0, 1))
    mesh = _mesh(mapper)
    normal = naive.face_normals(mesh)
    x = mesh.vertices[mesh.faces][:, :, 0]
    near, far = (x < 3.1).all(axis=1), (x > 3.1).all(axis=1)
    assert (normal[near, 0] < -0.5).mean() > 0.99 and (normal[far, 0] > 0.5).mean() > 0.99
    assert (~near & ~far).mean() < 0.02
    assert naive.area(mesh) == pytest.approx(8.0, rel=0.12)


def test_pole_gives_a_surface_and_nothing_away_from_it(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    mapper = naive.SmallMapper(tmp_path)
    for _ in range(8):
        turn = rng.uniform(np.pi / 2, 3 * np.pi / 2, 400)
        height = rng.uniform(0, 2, 400)
        mapper.add(np.stack((3.1 + 0.15 * np.cos(turn), 0.15 * np.sin(turn), height), -1), (0, 0, 1))
    mesh = _mesh(mapper)
    assert len(mesh.faces) > 50
    radius = np.hypot(mesh.vertices[:, 0] - 3.1, mesh.vertices[:, 1])
    assert radius.min() > 0.09 and radius.max() < 0.2
    assert naive.area(mesh) < 1.3 * np.pi * 0.15 * 2


@pytest.mark.parametrize("gap_m", [1.0, LONG_EDGE_M + 3 * CELL_M])
def test_parallel_planes_are_never_bridged(tmp_path: Path, gap_m: float) -> None:
    frames = [np.concatenate(pair) for pair in zip(_wall(5, 3.1), _wall(6, 3.1 + gap_m), strict=True)]
    mesh = _mesh(_map(tmp_path, frames))
    x = mesh.vertices[mesh.faces][:, :, 0]
    assert np.ptp(x, axis=1).max() < gap_m / 2
    assert (x.mean(axis=1) > 3.1 + gap_m / 2).any() and (x.mean(axis=1) < 3.1 + gap_m / 2).any()


def test_gap_wider_than_the_longest_edge_stays_open(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    gap = LONG_EDGE_M + 2 * CELL_M
    frames = [
        np.concatenate(
            [
                naive.rectangle(rng, (3.1, y, 0.1), (0, 1.2, 0), (0, 0, 2), 400, 0.005)
                for y in (-1.2 - gap / 2, gap / 2)
            ]
        )
        for _ in range(5)
    ]
    mesh = _mesh(_map(tmp_path, frames))
    y = mesh.vertices[mesh.faces][:, :, 1]
    assert not ((y.min(axis=1) < 0) & (y.max(axis=1) > 0)).any()
    assert _edge_lengths(mesh).max() < LONG_EDGE_M + EDGE_SLACK_M


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_few_points_are_harmless(tmp_path: Path, n: int) -> None:
    points = np.array([[3.05, 0.05, 1.05], [3.05, 0.15, 1.05], [3.05, 0.05, 1.15]])[:n]
    mapper = _map(tmp_path, [points, points[:0], points, points])
    mesh = _mesh(mapper)
    assert len(mesh.faces) == (1 if n == 3 else 0)
    assert mapper.mesher.waiting == 0 and mapper.mesher.refused == 0


@pytest.mark.xfail(
    strict=False, reason="a second group of the other direction can close a triangle by its back"
)
def test_no_triangle_is_closed_by_its_own_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    mapper = _map(tmp_path, [rng.uniform((2, -2, 0), (6, 2, 3), (600, 3)) for _ in range(6)])
    mapper.finish()
    naive.assert_no_doubles(naive.all_triangles(mapper.pager))


def test_flush_of_an_empty_map(tmp_path: Path) -> None:
    assert len(_mesh(naive.SmallMapper(tmp_path)).faces) == 0


def test_growing_map_covers_what_the_map_made_at_once_covers(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    scene = np.concatenate(
        (
            naive.rectangle(rng, (3.1, -1.5, 0.1), (0, 3, 0), (0, 0, 2), 2500, 0.01),
            naive.rectangle(rng, (0.6, -1.5, 0.05), (2.5, 0, 0), (0, 3, 0), 2500, 0.01),
        )
    )
    rng.shuffle(scene)
    slowly, at_once = _map(tmp_path / "a", np.array_split(scene, 25)), _map(tmp_path / "b", [scene])
    grown, whole = _mesh(slowly), _mesh(at_once)
    assert naive.area(grown) == pytest.approx(naive.area(whole), rel=0.04)
    assert naive.area(_finished(slowly)) == pytest.approx(naive.area(_finished(at_once)), rel=0.03)
    assert slowly.mesher.waiting == at_once.mesher.waiting == 0


def test_bounded_number_of_voxels_a_frame_only_postpones(tmp_path: Path) -> None:
    frames = _wall(9, 3.1, frames=12)
    lazy = naive.SmallMapper(tmp_path, mesher=MesherConfig(most_voxels=3))
    for points in frames:
        lazy.add(points, (0, 0, 1))
    assert lazy.mesher.waiting > 0
    assert naive.area(_mesh(lazy)) == pytest.approx(naive.area(_mesh(_map(tmp_path, frames))), rel=0.03)
    assert lazy.mesher.waiting == 0


def test_full_triangle_memory_is_counted(tmp_path: Path) -> None:
    mapper = naive.SmallMapper(tmp_path)
    mapper.store.counter[3] = len(mapper.store.triangle) - 8  # all but one smallest patch in use
    for points in _wall(10, 3.1):
        mapper.add(points, (0, 0, 1))
    mapper.finish()
    assert mapper.mesher.refused > 0


def _cloud(kind: str, n: int, scale: float, rng: np.random.Generator) -> F64:
    if kind == "uniform":
        return rng.uniform(-scale, scale, (n, 3))
    if kind == "clusters":
        centres = rng.uniform(-scale, scale, (4, 3))
        return centres[rng.integers(4, size=n)] + rng.normal(0.0, 0.05, (n, 3))
    if kind == "collinear":
        a, b = rng.uniform(-scale, scale, (2, 3))
        return a + rng.uniform(size=(n, 1)) * (b - a)
    if kind == "lattice":
        return rng.integers(-8, 9, (n, 3)) * CELL_M / 2  # on the very borders of cells and voxels
    sphere = rng.normal(size=(n, 3))
    return scale * sphere / np.linalg.norm(sphere, axis=1, keepdims=True)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["uniform", "clusters", "collinear", "lattice", "sphere"]),
            st.integers(0, 1500),
            st.floats(0.1, 1.2),
        ),
        min_size=1,
        max_size=8,
    ),
    st.integers(0, 2**32),
)
def test_no_directed_edge_is_ever_used_twice(
    tmp_path_factory: pytest.TempPathFactory, frames: list[tuple[str, int, float]], seed: int
) -> None:
    """The manifold guarantee, for whatever is thrown at it, after every frame and after the flush."""
    rng = np.random.default_rng(seed)
    mapper = naive.SmallMapper(tmp_path_factory.getbasetemp(), mesher=MesherConfig(wait_frames=1))
    for kind, n, scale in frames:
        mapper.add(_cloud(kind, n, scale, rng), rng.uniform(-3, 3, 3))
    naive.assert_manifold(naive.all_triangles(mapper.pager))
    mesh = mapper.finish()
    triangles = naive.all_triangles(mapper.pager)
    naive.assert_manifold(triangles)
    assert np.isfinite(mesh.vertices).all()
    assert set(triangles.ravel().tolist()) <= naive.living_vertices(mapper.pager).keys()


def test_far_hits_count_as_many_as_the_beam_would_have_close_by() -> None:
    row = np.zeros(16, np.float32)
    assert hits_close_by(row) == 0.0
    ranges_m = np.array([5.0, 20.0, 40.0])
    weights = 1.0 / (1.0 + (ranges_m / VoxelMapConfig().noise_range_m) ** 2)
    row[HITS], row[COUNT] = 3.0, weights.sum()
    assert hits_close_by(row) == pytest.approx(3.0 / weights.mean(), rel=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_long_edges_are_surface_where_the_corners_were_hit_often(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rules = Rules(0.2, 0.4, 4.0, 0.2 * (seed % 2) - 1.2 * (1 - seed % 2), 0.3, 0.0)
    w = workspace()
    w.position[:3] = rng.uniform(0.0, 0.32, (3, 3))
    if seed >= 18:
        w.position[2] = 2.0 * w.position[1] - w.position[0]  # collinear
    w.normal[:3] = rng.normal(size=(3, 3))
    w.normal[:3] /= np.linalg.norm(w.normal[:3], axis=1, keepdims=True)
    w.hits[:3] = rng.uniform(0.0, 8.0, 3)
    p = w.position[:3]
    longest = np.linalg.norm(p - np.roll(p, 1, axis=0), axis=1).max()
    normal = np.cross(p[1] - p[0], p[2] - p[0])
    area2 = float(np.linalg.norm(normal))
    facing = area2 > 1e-12 and (w.normal[:3] @ normal / area2).min() >= rules.agreement
    carried = longest <= 0.2 or (longest <= 0.4 and w.hits[:3].sum() >= 4.0 * (longest / 0.2) ** 2)
    assert is_surface(0, 1, 2, rules, w) == (
        carried and (facing or (rules.agreement < -1.0 and area2 > 1e-12))
    )


def test_a_triangle_is_owned_where_the_middle_of_its_cells_lies() -> None:
    rng = np.random.default_rng(3)
    cells = rng.integers(8, 20, (2000, 3, 3))
    spread = ((cells[:, :, 0] << 20) | (cells[:, :, 1] << 10) | cells[:, :, 2]).astype(np.int64)
    sums = cells.sum(axis=1)
    expected = ((sums >= 35) & (sums <= 46)).all(axis=1)
    found = [bool(mesher._is_owned(0, 1, 2, row)) for row in spread]
    assert found == expected.tolist() and 100 < expected.sum() < 1900
