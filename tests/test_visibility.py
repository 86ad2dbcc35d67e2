"""Range images against a plain angular table; what is looked through goes, what is hit stays."""

from pathlib import Path

import numpy as np
import pytest

from artemis_edge import block_store as bs
from artemis_edge import range_cube, visibility
from artemis_edge.block_store import (
    ALIVE,
    CARVED,
    CARVED_CELLS,
    CLASSES,
    CONFIRMED,
    COUNT,
    HITS,
    LOG_CLASS,
    SUM,
    THROUGH,
    Store,
)
from artemis_edge.class_rows import CLEAR_LOG
from artemis_edge.config import VoxelMapConfig
from artemis_edge.frames import F32, F64, Bool, DeskewedScan, TrackedFrame
from artemis_edge.range_cube import FAR, PIXELS, SPREAD, TILE, TILES, RangeCube
from artemis_edge.visibility import EVERY, MOVED, FreeSpace
from artemis_edge.voxel_map import VoxelMap, is_seen_through
from tests import naive

SENSOR = (0.0, 0.0, 1.0)


def test_pixel_against_the_definition() -> None:
    rng = np.random.default_rng(1)
    for d in rng.normal(size=(3000, 3)):
        assert range_cube.pixel(*d) == naive.pixel(d, PIXELS)
    assert range_cube.pixel(0.0, 0.0, 0.0)[0] == -1
    assert range_cube.pixel(np.nan, 1.0, 0.0)[0] == -1 or 0 <= range_cube.pixel(np.nan, 1.0, 0.0)[1] < PIXELS


def _between_pixels(ways: F32) -> Bool:
    """Which rays are so near a pixel's border that rounding decides."""
    size = np.abs(ways.astype(np.float64))
    major = size.max(axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        at = (ways / major + 1.0) / 2.0 * PIXELS
        second = np.sort(size, axis=1)[:, 1:2] / major
        near: Bool = ((np.abs(at - np.round(at)) < 1e-3) & (size < major)).any(axis=1) | (
            second[:, 0] > 0.9999
        )
    return near


def test_columns_of_rays_against_one_at_a_time() -> None:
    rng = np.random.default_rng(8)
    ways = rng.normal(0.0, 10.0, (3000, 3)).astype(np.float32)
    ways = ways[~_between_pixels(ways)]
    ways = np.concatenate((ways, np.eye(3), -np.eye(3), [[1, 1, 1], [-2, 2, -2]])).astype(np.float32)
    bad = [[0, 0, 0], [np.nan, 1, 2], [1, np.nan, 2], [1, 2, np.nan], [np.inf, 1, 1], [1, -np.inf, np.nan]]
    rays = range_cube.new_rays(len(ways) + len(bad))
    rays.way[:] = np.concatenate((ways, bad)).T
    range_cube.look_up(rays, len(ways) + len(bad))
    for k, way in enumerate(ways.astype(np.float64)):
        face, row, column = range_cube.pixel(*way)
        assert rays.pixel[k] == (face * PIXELS + row) * PIXELS + column
    np.testing.assert_allclose(rays.range_m[: len(ways)], np.linalg.norm(ways, axis=1), rtol=1e-6)
    assert (rays.pixel[len(ways) :] == -1).all()


def test_no_pixel_near_a_direction_is_farther_than_its_tile_says() -> None:
    rng = np.random.default_rng(9)
    cube = RangeCube()
    ways = rng.normal(size=(60, 3))
    far_apart = [(w / np.linalg.norm(w) * rng.uniform(2, 40)).astype(np.float32) for w in ways]
    cube.look(DeskewedScan(np.array(far_apart), np.zeros(3)))
    below = 0
    for _ in range(20000):
        way = rng.normal(size=3)
        way /= np.linalg.norm(way)
        aside = rng.normal(size=3)
        other = way + aside / np.linalg.norm(aside) * SPREAD * rng.uniform(0.0, 1.0) ** 0.3
        face, row, column = range_cube.pixel(*way)
        farthest = cube.farthest_m[face, row // TILE, column // TILE]
        seen = cube.range_m[range_cube.pixel(*other)]
        assert seen <= farthest or seen == FAR
        below += farthest == 0.0
    assert below > 2000, "most directions know that nothing was seen"
    assert cube.farthest_m.shape == (6, TILES, TILES)


def test_every_direction_has_a_pixel() -> None:
    """Edges and corners of the cube, where two or three coordinates are equal."""
    for x in (-1.0, 0.0, 1.0):
        for y in (-1.0, 0.0, 1.0):
            for z in (-1.0, 0.0, 1.0):
                if x or y or z:
                    face, row, column = range_cube.pixel(x, y, z)
                    assert 0 <= face < 6 and 0 <= row < PIXELS and 0 <= column < PIXELS


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.4, -0.2, 1.0)])
def test_cube_against_a_table(origin: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(2)
    points = rng.normal(0.0, 5.0, (4000, 3)).astype(np.float32)
    points[::50] = np.nan
    centre = np.array(origin, np.float32).astype(np.float64)
    points[1] = centre
    points[2::50] = points[3::50] * np.float32(1.5)
    points = points[~_between_pixels(points - centre.astype(np.float32))]
    cube = np.full((6, PIXELS, PIXELS), FAR, np.float32)
    range_cube.fill_cube(points, centre, cube.reshape(-1), range_cube.new_rays(range_cube.CHUNK))
    table = naive.nearest_ranges(points, centre, PIXELS)
    assert set(zip(*(k.tolist() for k in np.nonzero(cube < FAR)), strict=True)) == table.keys()
    for at, r in table.items():
        assert cube[at] == pytest.approx(r, rel=1e-6)


def test_look_keeps_the_nearest_of_a_pixel_and_its_neighbours() -> None:
    points: F32 = np.array([[5.0, 0.01, 0.01], [9.0, 0.01, 0.12]], np.float32)
    cube = RangeCube()
    for _ in range(2):  # the second look forgets the first
        cube.look(DeskewedScan(points, np.zeros(3)))
    face, row, column = range_cube.pixel(5.0, 0.01, 0.01)
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


def _judge_slowly(store: Store, cube: F32, frame: TrackedFrame, config: VoxelMapConfig, stamp: int) -> None:
    """Every cell of every second block by the definition, without the reach."""
    (scan,), T, cell_m = frame.scans, frame.T_world_lidar, config.voxel_m / 4
    for block in store.hash_slot[store.hash_key != bs.EMPTY_KEY]:
        if (store.block[block, :3].sum() + stamp // EVERY) % 2:
            continue
        for v in store.block_voxel[block][store.block_voxel[block] >= 0]:
            for c in np.flatnonzero(store.voxel_cell[v] >= 0).tolist():
                s = store.voxel_cell[v, c]
                e = store.evidence[s]
                if e[COUNT] == 0.0:
                    continue
                cell = store.voxel[v, :3] * 4 + (c >> 4, (c >> 2) & 3, c & 3)
                mean = (cell + 0.5) * cell_m + e[SUM : SUM + 3].astype(np.float64) / e[COUNT]
                way = T[:3, :3].T @ (mean - T[:3, :3] @ scan.origin - T[:3, 3])
                seen, r = cube[range_cube.pixel(*way)], np.linalg.norm(way)
                if seen >= FAR or seen <= r - config.voxel_m:
                    continue
                if seen <= r + config.voxel_m + config.free_space_slope * r:
                    e[CONFIRMED] += 1.0
                    continue
                e[THROUGH] += 1.0
                if is_seen_through(e):
                    store.state[s] = CARVED
                    e[COUNT:THROUGH] = e[HITS] = 0.0


def test_judgement_against_every_cell_by_itself(tmp_path: Path) -> None:
    """Voxels passed over because they lie behind what was seen would have been left alone one by one."""
    rng = np.random.default_rng(10)
    config = VoxelMapConfig(free_space_range_m=60.0)
    mapper = naive.SmallMapper(tmp_path, config)
    judge, cube = FreeSpace(config, mapper.voxel_map), RangeCube()
    for k in range(1, 7):
        wall = naive.rectangle(rng, (12.0 - (k % 3), -9, -3), (0, 18, 0), (0, 0, 7), 30, 0.05)
        points = np.concatenate((wall, rng.uniform(-14, 14, (200, 3)), _box(rng)))
        mapper.add(points, SENSOR)
        frame = naive.frame_of(points[:: 1 + k % 3], (0.1 * k, 0.2, 1.0))
        store = mapper.store
        evidence, state = store.evidence.copy(), store.state.copy()
        before = store._replace(evidence=evidence, state=state)
        cube.look(frame.scans[0])
        _judge_slowly(before, cube.range_m, frame, config, EVERY * k)
        judge.carve(frame, EVERY * k)
        # a mean between two pixels may be judged by either
        differs = (store.evidence != evidence).any(axis=1) | (store.state != state)
        assert differs.sum() <= 2
    assert evidence[:, CONFIRMED].sum() > 1000 and (state == CARVED).sum() > 100
    view, w = judge._view(frame, frame.scans[0]), judge._candidates
    listed = [visibility._list_voxels(store, b, view, judge._rules, w) for b in mapper.pager.resident()]
    assert 1000 < sum(listed) < store.counter[bs.N_VOXELS] - 200, "some, but not all, are looked at closely"


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


def test_movable_things_that_were_looked_through_are_removed_like_one_by_one(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    voxel_map = VoxelMap(VoxelMapConfig(dynamic_filter=True), 1.0, LOG_CLASS + CLASSES)
    store = voxel_map.store
    block = bs.find_or_add_block(store, 0, 0, 0)
    for k in range(8):
        v = bs.add_voxel(store, block, bs.inner_index(k, 0, 0), k, 0, 0)
        for c in range(0, 64, 3):
            s = bs.add_cell(store, v, c)
            store.state[s] = ALIVE if rng.random() < 0.8 else bs.EVIDENCE_ONLY
            store.vertex[s, :3] = rng.random(3)
            store.evidence[s, [THROUGH, CONFIRMED]] = rng.integers(0, 4), rng.integers(0, 30)
            store.evidence[s, COUNT] = 3.0
            store.attribute[s, LOG_CLASS:] = -0.5 if rng.random() < 0.3 else -9.0
            store.attribute[s, LOG_CLASS + int(rng.integers(0, 4))] = 0.0
    movable = np.zeros(CLASSES, np.uint8)
    movable[[1, 2]] = 1
    gone = []
    for s in np.flatnonzero(store.state == ALIVE):
        through, confirmed = store.evidence[s, [THROUGH, CONFIRMED]]
        lam = store.attribute[s, LOG_CLASS:]
        best = int(lam.argmax())
        clear = lam[best] - np.delete(lam, best).max() >= CLEAR_LOG
        if clear and movable[best] and through >= 1 and through >= MOVED * (through + confirmed):
            gone.append(int(s))
    assert 5 < len(gone) < (store.state == ALIVE).sum()
    places = store.vertex[gone, :3].copy()
    space = FreeSpace(voxel_map.config, voxel_map)
    store.block[block, bs.SEEN] = 0
    assert space.remove_movable(movable, 3) == len(gone)
    assert (store.state[gone] == CARVED).all() and not store.evidence[gone, COUNT].any()
    assert (store.evidence[gone, THROUGH] >= 1).all(), "what was looked through stays known"
    assert (store.state == CARVED).sum() == len(gone)
    assert sorted(map(tuple, space.removed.tolist())) == sorted(map(tuple, places.tolist()))
    assert space.remove_movable(movable, 4) == 0
