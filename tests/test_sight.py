"""What an image sees: the depth of planes at the very pixel, who is hidden, and no vertex lost to the culling."""

from __future__ import annotations

import math

import numpy as np

from artemis_edge import block_store as bs
from artemis_edge.block_store import CLASSES, LOG_CLASS
from artemis_edge.frames import F32, F64, CameraModel
from artemis_edge.sight import (
    LEAST_COSINE,
    Seen,
    Sight,
    Visibility,
    cell_px,
    keep_visible,
    look,
    new_seen,
    new_sight,
    see_rows,
    splat_depth,
    without_depth,
)

CAMERA = CameraModel(320, 256, 225.0, 225.0, 160.0, 128.0)
SPACING_M = 0.1
RULES = Visibility(0.03, 0.05, 0.6)
# z forward, y down, standing 1.5 m above the ground and looking along x
LEVEL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1.0]])


def ground(far_m: float) -> F32:
    """Rows (n, 6) of vertices on the ground, r apart, and their normals."""
    x, y = np.meshgrid(np.arange(2.8, far_m, SPACING_M), np.arange(-1.0, 1.0, SPACING_M))
    rows = np.zeros((x.size, 6), np.float32)
    rows[:, 0], rows[:, 1], rows[:, 5] = x.ravel(), y.ravel(), 1.0
    return rows


def seen_by(rows: F32, T_world_cam: F64) -> tuple[Sight, Seen, int]:
    sight, seen = new_sight(CAMERA, T_world_cam), new_seen(len(rows))
    n = int(see_rows(rows, sight.T_cam_world, sight.lens, 40.0, seen))
    splat_depth(seen, n, sight.lens[0], SPACING_M, cell_px(sight.lens), sight.depth)
    return sight, seen, n


def visible(rows: F32, T_world_cam: F64) -> tuple[Seen, int]:
    sight, seen, n = seen_by(rows, T_world_cam)
    return seen, int(keep_visible(seen, n, cell_px(sight.lens), sight.depth, RULES))


def naive_depth(rows: F32, T_world_cam: F64, row: int, size: float) -> tuple[float, float]:
    """Depth error and W of one vertex by going through all others."""
    T = np.linalg.inv(T_world_cam)
    p, n = rows[:, :3] @ T[:3, :3].T + T[:3, 3], rows[:, 3:] @ T[:3, :3].T
    u, v = 225.0 * p[:, 0] / p[:, 2] + 160.0, 225.0 * p[:, 1] / p[:, 2] + 128.0
    column, line = math.floor(u[row] / size + 0.5), math.floor(v[row] / size + 0.5)
    half = 0.75 * SPACING_M * 225.0 / p[:, 2]
    covers = [
        k
        for k in range(len(p))
        if math.floor((u[k] - half[k]) / size + 0.5) <= column <= math.floor((u[k] + half[k]) / size + 0.5)
        and math.floor((v[k] - half[k]) / size + 0.5) <= line <= math.floor((v[k] + half[k]) / size + 0.5)
    ]
    first = min(covers, key=lambda k: p[k, 2])
    cosine = -(n * p).sum(1) / np.linalg.norm(p, axis=1)
    ray = np.array([(u[row] - 160.0) / 225.0, (v[row] - 128.0) / 225.0, 1.0])
    depth = p[first, 2]
    if cosine[first] >= LEAST_COSINE:
        along = float(n[first] @ ray / (n[first] @ p[first]))
        depth = float(np.clip(1.0 / max(along, 1e-6), p[first, 2] / 2, p[first, 2] * 2))
    error = abs(float(p[row, 2]) - float(depth))
    r = error / (max(float(p[row, 2]) - error, 0.3) * RULES.sigma_geom)
    return error, math.exp(-0.5 * r * r) if cosine[row] > LEAST_COSINE else 0.0


def test_depth_is_that_of_the_nearest_plane_at_the_very_pixel() -> None:
    rng = np.random.default_rng(1)
    rows = np.zeros((150, 6), np.float32)
    rows[:, :3] = rng.uniform([3, -1.5, 0.3], [7, 1.5, 2.5], (150, 3))
    normal = rng.normal([-1, 0, 0], 0.7, (150, 3))
    rows[:, 3:] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    seen, n = visible(rows, LEVEL)
    assert 20 < n < 150, "some are hidden"
    found = {int(seen.slot[i]): (float(seen.depth_error[i]), float(seen.reliability[i])) for i in range(n)}
    for row in range(150):
        error, weight = naive_depth(rows, LEVEL, row, cell_px(new_sight(CAMERA, LEVEL).lens))
        kept = error < RULES.most_error_m or weight >= RULES.least_reliability
        assert (row in found) == kept
        if kept:
            np.testing.assert_allclose(found[row], (error, weight), atol=2e-4)


def test_grazing_ground_hides_nothing_of_itself_and_a_wall_hides_what_is_behind() -> None:
    rows = ground(20.0)
    seen, n = visible(rows, LEVEL)
    assert n == len(rows) and seen.reliability[:n].min() > 0.95
    x, z = np.meshgrid(np.arange(-1.0, 1.0, SPACING_M), np.arange(0.0, 3.0, SPACING_M))
    wall = np.zeros((x.size, 6), np.float32)
    wall[:, 0], wall[:, 1], wall[:, 2], wall[:, 3] = 6.0, x.ravel(), z.ravel(), -1.0
    seen, n = visible(np.concatenate((rows, wall)), LEVEL)
    ahead = rows[seen.slot[:n][seen.slot[:n] < len(rows)], 0]
    assert ahead.max() < 6.7 and (ahead < 5.9).sum() == (rows[:, 0] < 5.9).sum()


def test_nothing_in_view_is_nothing() -> None:
    sight, seen, n = seen_by(np.empty((0, 6), np.float32), LEVEL)
    assert n == 0 and np.isinf(sight.depth[:, :, 0]).all()
    assert keep_visible(seen, 0, cell_px(sight.lens), sight.depth, RULES) == 0
    behind = ground(5.0)
    behind[:, 0] *= -1
    assert seen_by(behind, LEVEL)[2] == 0


def test_blocks_and_voxels_that_are_passed_over_hold_nothing_in_view() -> None:
    rng = np.random.default_rng(2)
    store = bs.allocate(1.0, LOG_CLASS + CLASSES)
    places = rng.uniform([-8, -8, -2], [8, 8, 4], (600, 3))
    for place in places:
        voxel = np.floor(place / 0.4).astype(int)
        block = bs.find_or_add_block(store, *(int(k) >> 3 for k in voxel))
        inner = bs.inner_index(*(int(k) for k in voxel))
        v = store.block_voxel[block, inner]
        if v < 0:
            v = bs.add_voxel(store, block, inner, *(int(k) for k in voxel))
        cx, cy, cz = np.floor((place - voxel * 0.4) / 0.1).astype(int)
        if store.voxel_mask[v] & np.uint64(1 << int((cx << 4) | (cy << 2) | cz)):
            continue
        s = bs.add_cell(store, int(v), int((cx << 4) | (cy << 2) | cz))
        store.state[s], store.vertex[s, :3], store.vertex[s, 3:6] = bs.ALIVE, place, (-1, 0, 0)
    n_cells = int((store.state == bs.ALIVE).sum())
    rows = store.vertex[:n_cells, :6].copy()
    sight, every = new_sight(CAMERA, LEVEL), new_seen(len(store.state))
    wanted = set(every.slot[: see_rows(rows, sight.T_cam_world, sight.lens, 40.0, every)].tolist())
    blocks = np.arange(store.counter[bs.N_BLOCKS], dtype=np.int32)
    size = cell_px(sight.lens)
    n = look(store, without_depth(sight), blocks, 3.2, 40.0, RULES, every)
    assert set(every.slot[:n].tolist()) == wanted and 20 < n < n_cells
    splat_depth(every, n, sight.lens[0], SPACING_M, size, sight.depth)
    kept = int(keep_visible(every, n, size, sight.depth, RULES))
    at_once = new_seen(len(store.state))
    assert look(store, sight, blocks, 3.2, 40.0, RULES, at_once) == kept < n
    for column, same in zip(every, at_once, strict=True):
        if column is not every.right and column is not every.down:  # only splats need them
            np.testing.assert_array_equal(column[:kept], same[:kept])
