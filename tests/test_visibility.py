"""Range images against a plain angular table; what is looked through goes, what is hit stays."""

from pathlib import Path

import numpy as np
import pytest

from artemis_edge import visibility
from artemis_edge.block_store import ALIVE, CARVED_CELLS
from artemis_edge.config import VoxelMapConfig
from artemis_edge.frames import F32, F64, DeskewedScan
from artemis_edge.visibility import FAR, PIXELS, FreeSpace, RangeCube
from tests import naive

SENSOR = (0.0, 0.0, 1.0)


def test_pixel_against_the_definition() -> None:
    rng = np.random.default_rng(1)
    for d in rng.normal(size=(3000, 3)):
        assert visibility.pixel(*d) == naive.pixel(d, PIXELS)
    assert visibility.pixel(0.0, 0.0, 0.0)[0] == -1
    assert visibility.pixel(np.nan, 1.0, 0.0)[0] == -1 or 0 <= visibility.pixel(np.nan, 1.0, 0.0)[1] < PIXELS


def test_every_direction_has_a_pixel() -> None:
    """Edges and corners of the cube, where two or three coordinates are equal."""
    for x in (-1.0, 0.0, 1.0):
        for y in (-1.0, 0.0, 1.0):
            for z in (-1.0, 0.0, 1.0):
                if x or y or z:
                    face, row, column = visibility.pixel(x, y, z)
                    assert 0 <= face < 6 and 0 <= row < PIXELS and 0 <= column < PIXELS


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.4, -0.2, 1.0)])
def test_cube_against_a_table(origin: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(2)
    points = rng.normal(0.0, 5.0, (4000, 3)).astype(np.float32)
    points[::50] = np.nan
    points[1] = origin
    points[2::50] = points[3::50] * np.float32(1.5)
    cube = np.full((6, PIXELS, PIXELS), FAR, np.float32)
    visibility.fill_cube(points, np.array(origin), cube)
    table = naive.nearest_ranges(points, np.array(origin), PIXELS)
    assert set(zip(*(k.tolist() for k in np.nonzero(cube < FAR)), strict=True)) == table.keys()
    for at, r in table.items():
        assert cube[at] == pytest.approx(r, rel=1e-6)


def test_look_keeps_the_nearest_of_a_pixel_and_its_neighbours() -> None:
    points: F32 = np.array([[5.0, 0.01, 0.01], [9.0, 0.01, 0.12]], np.float32)
    cube = RangeCube()
    for _ in range(2):  # the second look forgets the first
        cube.look(DeskewedScan(points, np.zeros(3)))
    face, row, column = visibility.pixel(5.0, 0.01, 0.01)
    np.testing.assert_allclose(cube.range_m[face, row - 1 : row + 2, column - 1 : column + 2], 5.0, rtol=1e-4)
    assert (cube.range_m[1:] == FAR).all()
    assert (cube.range_m[0] < FAR).sum() in (9, 12, 15, 18)
    cube.look(DeskewedScan(points[:0], np.zeros(3)))
    assert (cube.range_m == FAR).all()


def _wall(rng: np.random.Generator) -> F64:
    return naive.rectangle(rng, (6.15, -4, -1), (0, 8, 0), (0, 0, 4), 400, 0.01)


def _box(rng: np.random.Generator) -> F64:
    return naive.rectangle(rng, (3, -0.5, 0.5), (0, 1, 0), (0, 0, 1), 600, 0.01)


def _visible(wall: F64) -> F64:
    """The wall without the shadow of the box."""
    at_box = SENSOR + (wall - SENSOR) * (3.0 / wall[:, :1])
    hidden = (np.abs(at_box[:, 1]) < 0.5) & (np.abs(at_box[:, 2] - 1.0) < 0.5)
    return wall[~hidden]


def _walk(folder: Path, free_space: bool) -> tuple[naive.SmallMapper, FreeSpace]:
    """Five scans of a box before a wall, fifteen of the wall alone."""
    rng = np.random.default_rng(3)
    config = VoxelMapConfig(free_space=free_space)
    mapper = naive.SmallMapper(folder, config)
    judge = FreeSpace(config, mapper.voxel_map)
    for k in range(20):
        wall = _wall(rng)
        points = np.concatenate((_visible(wall), _box(rng))) if k < 5 else wall
        judge.carve(naive.frame_of(points, SENSOR), mapper.stamp + 1)
        mapper.add(points, SENSOR)
    return mapper, judge


def _near_box(positions: F64) -> int:
    return int((positions[:, 0] < 4.0).sum())


def test_a_box_that_went_away_is_carved_and_the_wall_stays(tmp_path: Path) -> None:
    mapper, _ = _walk(tmp_path, True)
    mesh = mapper.finish()
    living = np.array(list(naive.living_vertices(mapper.pager).values()))
    assert mapper.store.counter[CARVED_CELLS] > 50
    assert _near_box(living) == 0
    assert _near_box(mesh.vertices) == 0
    # no triangle of any patch names what is gone
    assert (
        set(naive.all_triangles(mapper.pager).ravel().tolist()) <= naive.living_vertices(mapper.pager).keys()
    )
    naive.assert_manifold(naive.all_triangles(mapper.pager))
    assert naive.area(mesh) == pytest.approx(32.0, rel=0.05)


def test_without_free_space_nothing_is_carved(tmp_path: Path) -> None:
    mapper, judge = _walk(tmp_path, False)
    mesh = mapper.finish()
    assert mapper.store.counter[CARVED_CELLS] == 0
    assert naive.area(mesh) > 31.0
    assert judge.carve(naive.frame_of(_wall(np.random.default_rng(4)), SENSOR), 99) == 0


def test_a_wall_hit_in_every_frame_is_never_carved(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    mapper = naive.SmallMapper(tmp_path)
    judge = FreeSpace(VoxelMapConfig(), mapper.voxel_map)
    for k in range(30):
        sensor = (0.1 * k, 0.05 * k, 1.0)
        wall = _wall(rng)
        assert judge.carve(naive.frame_of(wall, sensor), mapper.stamp + 1) == 0
        mapper.add(wall, sensor)
    cells = mapper.store.counter[2]
    assert (mapper.store.state[:cells] == ALIVE).sum() > 3000


def test_a_carved_place_can_become_surface_again(tmp_path: Path) -> None:
    mapper, judge = _walk(tmp_path, True)
    rng = np.random.default_rng(6)
    for _ in range(12):
        points = np.concatenate((_visible(_wall(rng)), _box(rng)))
        judge.carve(naive.frame_of(points, SENSOR), mapper.stamp + 1)
        mapper.add(points, SENSOR)
    mapper.finish()
    naive.assert_manifold(naive.all_triangles(mapper.pager))
    living = np.array(list(naive.living_vertices(mapper.pager).values()))
    assert np.isfinite(living).all()


def test_the_sensors_own_place_and_empty_scans_are_harmless(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    mapper = naive.SmallMapper(tmp_path)
    judge = FreeSpace(VoxelMapConfig(), mapper.voxel_map)
    mapper.add(_box(rng), SENSOR)
    mapper.finish()
    empty = naive.frame_of(np.empty((0, 3)), SENSOR)
    assert judge.carve(empty, 2) == judge.carve(empty, 3) == 0
    position = mapper.store.vertex[0, :3].astype(np.float64)
    assert judge.carve(naive.frame_of(_wall(rng), position), 2) >= 0
