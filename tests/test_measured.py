"""Points that beams met around an image's time: which the image shows, whose vertices they are, and what they tell."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from artemis_edge import block_store as bs
from artemis_edge.block_store import CLASSES, LOG_CLASS, WEIGHT
from artemis_edge.config import SemanticsConfig
from artemis_edge.frames import F32, F64, U8, CameraImage, CameraModel, DeskewedScan, TrackedFrame
from artemis_edge.measured import (
    ENOUGH,
    FRONT,
    HOLLOW_M,
    NEAR_BY_M,
    REACH_CELLS,
    ROUGH_M,
    ROUGH_SHARE,
    THIN_M,
    LatestScans,
    Scratch,
    Shown,
    in_blocks,
    scope_of,
    see_measured,
    vertex_at,
)
from artemis_edge.segmentation.backend import DenseScores, Grid
from artemis_edge.semantic_map import LateMask, SemanticMap
from artemis_edge.sight import NEAR_M, Sight, empty_depth, new_seen, new_sight

CAMERA = CameraModel(320, 256, 225.0, 225.0, 160.0, 128.0, (-0.1, 0.02, 0.001, -0.001, 0.0))
CELL_M = 0.1
REACH_M = 40.0


def frame(*points: F32, T: F64 | None = None) -> TrackedFrame:
    scans = tuple(DeskewedScan(p.astype(np.float32), np.zeros(3)) for p in points)
    return TrackedFrame(0, 0, np.eye(4) if T is None else T, scans)


def scans_of(*frames: TrackedFrame) -> LatestScans:
    out = LatestScans()
    for one in frames:
        out.take(one)
    return out


def naive_pixel(p: F64) -> tuple[float, float] | None:
    """Of a point in the camera's axes; None where the image does not show it."""
    if not NEAR_M <= p[2] <= REACH_M:
        return None
    x, y = p[0] / p[2], p[1] / p[2]
    k1, k2, p1, p2, k3 = CAMERA.distortion
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = 225.0 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 160.0
    v = 225.0 * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + 128.0
    return (u, v) if -0.5 < u < 319.5 and -0.5 < v < 255.5 else None


def test_points_in_view_and_what_is_nearer_around_them() -> None:
    rng = np.random.default_rng(1)
    # no two in one cube of THIN_M
    points = rng.permutation(np.stack(np.mgrid[-8:8, -8:8, -1:9], axis=-1).reshape(-1, 3)) * 1.03 + 0.21
    sight = new_sight(CAMERA, np.eye(4))
    found = scans_of(frame(points[:900], points[900:])).in_view(sight, REACH_M)
    size = max(round(225.0 / 224.0), 1)
    pixel = {i: naive_pixel(p) for i, p in enumerate(points)}
    shown = {i: (int(uv[0] / size), int(uv[1] / size)) for i, uv in pixel.items() if uv is not None}
    assert len(found) == len(shown) > 100
    at = {tuple(np.round(p, 2)): i for i, p in enumerate(points)}
    mine = [at[tuple(np.round(row[:3].astype(np.float64), 2))] for row in found]
    assert sorted(mine) == sorted(shown)
    for row, i in zip(found, mine, strict=True):
        around = [
            points[j, 2]
            for j, cell in shown.items()
            if max(abs(cell[0] - shown[i][0]), abs(cell[1] - shown[i][1])) <= REACH_CELLS
        ]
        assert row[FRONT] == pytest.approx(min(around), rel=1e-5)


def test_points_close_together_are_thinned_out_and_those_of_no_use_left_out() -> None:
    close = np.array([[0.02 + 0.01 * k, 0.02, 5.02] for k in range(5)])
    apart = np.array([[0.02, 0.02, 5.02 + THIN_M]])
    useless = np.array(
        [[0.0, 0.0, -5.0], [0.0, 0.0, 0.1], [np.nan, 0.0, 5.0], [np.inf, 1.0, 2.0], [9.0, 0.0, 1.0]]
    )
    sight = new_sight(CAMERA, np.eye(4))
    found = scans_of(frame(close, useless, apart)).in_view(sight, REACH_M)
    kept = np.concatenate((close[:ENOUGH], apart))
    np.testing.assert_allclose(found[np.lexsort(found.T[:3]), :3], kept[np.lexsort(kept.T)], atol=1e-6)
    assert LatestScans().in_view(sight, REACH_M).shape == (0, 4)
    assert scans_of(frame(np.empty((0, 3)))).in_view(sight, REACH_M).shape == (0, 4)


def test_rows_are_sorted_by_place_and_none_is_lost() -> None:
    rng = np.random.default_rng(4)
    rows = rng.uniform(-20, 20, (3000, 4)).astype(np.float32)
    out = in_blocks(rows)
    order = np.lexsort(rows.T)
    np.testing.assert_array_equal(out[np.lexsort(out.T)], rows[order])
    cube = [tuple(c) for c in np.floor(out[:, :3] / NEAR_BY_M).astype(int)]
    changes = sum(a != b for a, b in itertools.pairwise(cube))
    assert changes < 3000
    np.testing.assert_array_equal(in_blocks(rows), out)
    assert in_blocks(rows[:0]).shape == (0, 4)


def test_the_latest_frame_counts_at_its_own_pose() -> None:
    moved = np.eye(4)
    moved[0, 3] = 1.0
    frames = [frame(np.array([[0.0, 0.0, 5.0 + k]]), T=moved) for k in range(3)]
    found = scans_of(*frames).in_view(new_sight(CAMERA, np.eye(4)), REACH_M)
    assert found[:, :3].tolist() == [[1.0, 0.0, 7.0]]


def vertex(store: bs.Store, place: tuple[float, float, float], normal: tuple[float, float, float]) -> int:
    """A living vertex in the cell of ``place``; returns its slot."""
    cell = [math.floor(x / CELL_M) for x in place]
    voxel = [c // 4 for c in cell]
    block = bs.find_or_add_block(store, *(v // 8 for v in voxel))
    inner = bs.inner_index(*voxel)
    v = int(store.block_voxel[block, inner])
    if v < 0:
        v = int(bs.add_voxel(store, block, inner, *voxel))
    s = int(bs.add_cell(store, v, (cell[0] % 4) * 16 + (cell[1] % 4) * 4 + cell[2] % 4))
    store.state[s] = bs.ALIVE
    store.vertex[s, :3], store.vertex[s, 3:6] = place, normal
    return s


def test_a_vertex_is_found_by_any_place_in_its_cell() -> None:
    rng, store = np.random.default_rng(2), bs.allocate(1.0, LOG_CLASS + CLASSES)
    place = {}
    for p in rng.uniform(-4, 4, (200, 3)):
        key = tuple(math.floor(x / CELL_M) for x in p)
        if key not in place:
            place[key] = vertex(store, tuple(p), (0.0, 0.0, 1.0))
    dead = next(iter(place))
    store.state[place.pop(dead)] = bs.CARVED
    for p in rng.uniform(-4.5, 4.5, (2000, 3)):
        key = tuple(math.floor(x / CELL_M) for x in p)
        voxel, slot = vertex_at(store, *p, CELL_M)
        assert slot == place.get(key, -1)
        assert voxel >= 0 or slot < 0
    assert vertex_at(store, *((np.array(dead) + 0.5) * CELL_M), CELL_M)[1] == -1


def seen_of(store: bs.Store, points: F64, sight: Sight, score: U8 | None = None) -> tuple[list[int], F32]:
    """Slots seen and mean scores, of points all measured in one frame."""
    seen, mean = new_seen(len(store.state)), np.empty((len(store.state), 3), np.float32)
    rows = scans_of(frame(points)).in_view(sight, REACH_M)
    layers = np.zeros((256, 320, 3), np.uint8) if score is None else score
    shown = Shown(layers, np.array([1.0, 1.0, 0.0, 0.0], np.float32), np.array([0, 4, 7], np.int32))
    scratch = Scratch(np.zeros(len(store.state), np.int32), np.empty(6, np.float32))
    n = int(
        see_measured(store, rows, sight, scope_of(sight.lens, REACH_M, CELL_M), shown, scratch, seen, mean)
    )
    assert (seen.depth_error[:n] == 0.0).all() and (seen.reliability[:n] == 1.0).all()
    assert [vertex_at(store, *store.vertex[s, :3], CELL_M)[0] for s in seen.slot[:n]] == seen.voxel[
        :n
    ].tolist()
    return seen.slot[:n].tolist(), mean[:n]


def test_what_a_nearer_point_may_cover_is_left_out_but_not_a_surface_by_itself() -> None:
    store = bs.allocate(1.0, LOG_CLASS + CLASSES)
    behind = vertex(store, (0.05, 0.05, 6.05), (0.0, 0.0, -1.0))
    aside = vertex(store, (0.65, 0.05, 6.05), (0.0, 0.0, -1.0))
    wall = np.array([[0.05, 0.05, 6.05], [0.65, 0.05, 6.05]])
    sight = new_sight(CAMERA, np.eye(4))
    assert set(seen_of(store, wall, sight)[0]) == {behind, aside}
    # 2 pixels beside the first: within reach of the mask's outline
    twig = np.array([[0.05 / 6.05 * 3.0 + 2.0 / 225.0 * 3.0, 0.025, 3.0]])
    assert seen_of(store, np.concatenate((wall, twig)), sight)[0] == [aside]
    # ground 1.5 m below, 8 m away: the next pixel is 0.2 m nearer, and one surface
    floor = [(x, 1.55, z) for z in np.arange(7.05, 9.0, 0.1) for x in np.arange(-0.25, 0.3, 0.1)]
    slots = [vertex(store, p, (0.0, -1.0, 0.0)) for p in floor]
    assert set(slots) <= set(seen_of(store, np.array(floor), sight)[0])
    # from behind nothing is seen
    vertex(store, (-1.05, 0.05, 6.05), (0.0, 0.0, 1.0))
    assert seen_of(store, np.array([[-1.05, 0.05, 6.05]]), sight)[0] == []
    assert (1.0 - ROUGH_SHARE) * 6.05 - ROUGH_M > 3.0


def test_scores_of_a_vertex_are_the_mean_over_its_points() -> None:
    rng, store = np.random.default_rng(3), bs.allocate(1.0, LOG_CLASS + CLASSES)
    for x in np.arange(-0.95, 1.0, 0.1):
        vertex(store, (float(x), 0.05, 3.05), (0.0, 0.0, -1.0))
    points = np.column_stack((rng.uniform(-1.0, 1.0, 60), rng.uniform(0.0, 0.1, 60), np.full(60, 3.05)))
    score = rng.integers(0, 256, (256, 320, 3), np.uint8)
    sight = new_sight(CAMERA, np.eye(4))
    found = dict(zip(*seen_of(store, points, sight, score), strict=True))
    expected: dict[int, list[F32]] = {}
    for p in points.astype(np.float32).astype(np.float64):
        slot = vertex_at(store, *p, CELL_M)[1]
        uv = naive_pixel(p)
        assert uv is not None and slot >= 0
        if len(expected.setdefault(slot, [])) < ENOUGH:
            expected[slot].append(score[round(uv[1]), round(uv[0])] / np.float32(255))
    assert set(found) == set(expected)
    for slot, mean in found.items():
        np.testing.assert_allclose(mean, np.mean(expected[slot], axis=0), atol=1e-5)


@pytest.mark.parametrize(
    ("before", "shown", "counts"), [(4, 1, False), (4, 2, True), (None, 2, False), (0, 1, True)]
)
def test_behind_what_the_map_has_a_point_counts_where_the_pixel_shows_another_class(
    before: int | None, shown: int, counts: bool
) -> None:
    """``before`` is the class in the map of a surface 3 m before the point, ``shown`` the layer that the pixel shows
    (of slots 0, 4 and 7). Where nobody knows what stands there, the point tells nothing."""
    store = bs.allocate(1.0, LOG_CLASS + CLASSES)
    pane = vertex(store, (0.05, 0.05, 3.05), (0.0, 0.0, -1.0))
    near, far = 3.05 + HOLLOW_M / 2, 6.05
    slots = {z: vertex(store, (0.05 / 6.05 * z, 0.05 / 6.05 * z, z), (0.0, 0.0, -1.0)) for z in (near, far)}
    if before is not None:
        store.attribute[pane, LOG_CLASS:] = -5.0
        store.attribute[pane, LOG_CLASS + before] = 0.0
    score = np.zeros((256, 320, 3), np.uint8)
    score[:, :, shown] = 240
    bare = new_sight(CAMERA, np.eye(4))
    known = bare._replace(depth=empty_depth(bare.lens))
    known.depth[:] = 3.05, 1 / 3.05, 0.0, 0.0
    for z, slot in slots.items():
        point = np.array([[0.05 / 6.05 * z, 0.05 / 6.05 * z, z]])
        assert seen_of(store, point, known, score)[0] == ([slot] if counts or z == near else [])
        assert seen_of(store, point, bare, score)[0] == [slot], "nothing known before it"


@pytest.mark.parametrize(("railing", "told"), [(2, True), (1, False)])
def test_a_beam_through_a_railing_tells_what_is_behind_but_not_one_through_a_pane(
    railing: int, told: bool
) -> None:
    """Bars a vertex apart hide the wall behind by the map's depth; points between them are of the wall. Where the pixel
    shows the very class that stands before the point, the beam has passed a pane of that, and tells nothing."""
    store = bs.allocate(1.0, LOG_CLASS + CLASSES)
    brush = SemanticMap(SemanticsConfig(), store, 4 * CELL_M)
    brush.ask(["wall", "railing"])
    bars = [
        vertex(store, (x, y, 2.05), (0.0, 0.0, -1.0))
        for x in np.arange(-0.45, 0.5, 0.1)
        for y in (-0.05, 0.05)
    ]
    wall = vertex(store, (0.05, 0.05, 4.05), (0.0, 0.0, -1.0))
    for s in bars:
        store.attribute[s, LOG_CLASS:] = -9.0
        store.attribute[s, LOG_CLASS + railing] = 0.0
    image = CameraImage("cam_0", 0, b"", CAMERA, np.eye(4))
    scores = DenseScores((0, 1, 2), np.zeros((64, 80, 3), np.uint8), Grid(0.25, 0.25, 0.0, 0.0))
    scores.score[:, :, 1] = 240
    unmeasured = LateMask(brush.sight(image, np.eye(4)), scores)
    brush.refine(unmeasured, brush.fuse(unmeasured, 1), 1)
    assert not store.attribute[wall, LOG_CLASS:].any(), "hidden, and nothing measured"
    store.attribute[bars, LOG_CLASS:] = -9.0
    store.attribute[bars, LOG_CLASS + railing] = 0.0
    brush.scans.take(frame(np.array([[0.05, 0.05, 4.05]])))
    mask = LateMask(brush.sight(image, np.eye(4)), scores)
    brush.refine(mask, brush.fuse(mask, 2), 2)
    assert (store.attribute[wall, LOG_CLASS:].argmax() == 1) == told
    assert store.voxel_class[vertex_at(store, 0.05, 0.05, 4.05, CELL_M)[0], WEIGHT] == 0.0
