"""Eqs 1, 3, 5, 7, 12 and 13 against slow twins, and what the map makes of masks."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.distance import jensenshannon

from artemis_edge import block_store as bs
from artemis_edge.block_store import CLASSES, LOG_CLASS, WEIGHT
from artemis_edge.class_rows import are_two_objects, clear_class
from artemis_edge.config import SemanticsConfig
from artemis_edge.errors import InputError
from artemis_edge.export.mesh import edges_of
from artemis_edge.frames import F32, CameraImage, CameraModel
from artemis_edge.refinement.semantics import DEEPEST, FLOOR, labels_of, refine
from artemis_edge.segmentation.backend import DenseScores, Grid
from artemis_edge.semantic_constraint import entropy, jensen_shannon
from artemis_edge.semantic_map import LateMask, SemanticMap, slot_layers, spread_labels, start_blank
from artemis_edge.sight import Seen, new_seen
from artemis_edge.voxel_fusion import distribution, fuse, grid_of, sample_scores

VOXEL_M = 0.4


def small_store(voxels: int = 3, cells: int = 2) -> bs.Store:
    store = bs.allocate(1.0, LOG_CLASS + CLASSES)
    block = bs.find_or_add_block(store, 0, 0, 0)
    for k in range(voxels):
        v = bs.add_voxel(store, block, bs.inner_index(k, 0, 0), k, 0, 0)
        for c in range(cells):
            s = bs.add_cell(store, v, c)
            store.state[s] = bs.ALIVE
            store.vertex[s, :3] = (k * VOXEL_M + 0.05, 0.05, 0.05 + 0.1 * c)
            store.vertex[s, 3:6] = (0.0, 0.0, -1.0)
            store.evidence[s, 0] = 5.0
    return store


def random_seen(rng: np.random.Generator, store: bs.Store, n: int) -> Seen:
    seen = new_seen(len(store.state))
    seen.slot[:n] = np.arange(n)
    seen.voxel[:n] = np.arange(n) // 2
    for column, high in ((seen.u, 30.0), (seen.v, 20.0), (seen.cosine, 1.0), (seen.depth_error, 0.5)):
        column[:n] = rng.uniform(0, high, n)
    seen.z[:n] = 5.0
    return seen


def scores_of(rng: np.random.Generator, slots: tuple[int, ...]) -> DenseScores:
    return DenseScores(slots, rng.integers(0, 256, (12, 16, len(slots)), np.uint8), Grid(0.5, 0.5, 0.0, 0.0))


def test_samples_are_those_of_the_interface() -> None:
    rng = np.random.default_rng(1)
    store, scores = small_store(), scores_of(rng, (0, 1, 3))
    seen = random_seen(rng, store, 6)
    out = np.empty((6, 3), np.float32)
    sample_scores(seen, 6, scores.score, grid_of(scores), out)
    np.testing.assert_allclose(out, scores.sample(seen.u[:6], seen.v[:6]), atol=1e-6)


def test_fusion_is_the_weighted_sum_of_eq_1() -> None:
    rng = np.random.default_rng(2)
    store, slots = small_store(), (0, 1, 3)
    seen, sampled = random_seen(rng, store, 6), rng.random((6, 3)).astype(np.float32)
    layer = slot_layers(scores_of(rng, slots))
    sigma_d = 0.2
    assert fuse(store, seen, 6, sampled, layer, sigma_d, np.empty(CLASSES, np.float32)) == 3
    for voxel in range(3):
        rows = [2 * voxel, 2 * voxel + 1]
        omega = np.zeros(3)
        for i in rows:
            if seen.depth_error[i] / sigma_d < 4.0:
                omega += sampled[i] * seen.cosine[i] * math.exp(-seen.depth_error[i] / sigma_d) / len(rows)
        found = store.voxel_class[voxel]
        np.testing.assert_allclose(found[[0, 1, 3]], omega, rtol=1e-5)
        assert found[2] == found[0], "a class nobody asked for would have shown as background"
        assert found[WEIGHT] == pytest.approx(omega.sum(), rel=1e-5)


def test_an_unseen_voxel_has_no_distribution() -> None:
    out = np.empty(CLASSES, np.float32)
    active = np.ones(CLASSES, np.uint8)
    assert not distribution(np.zeros(CLASSES + 1, np.float32), active, out)
    assert not out.any()


def naive_refine(lam: F32, share: F32, slots: np.ndarray, w: float) -> F32:
    p = (share + FLOOR) / (share + FLOOR).sum()
    out = lam + w * np.log(p)[np.maximum(slots, 0)]
    return np.asarray(np.maximum(out - out.max(), DEEPEST), np.float32)


def test_refinement_is_eqs_12_and_13() -> None:
    rng = np.random.default_rng(3)
    store = small_store()
    seen, sampled = random_seen(rng, store, 6), rng.random((6, 3)).astype(np.float32)
    layer = slot_layers(scores_of(rng, (0, 1, 3)))
    start = -rng.random((6, CLASSES)).astype(np.float32)
    store.attribute[:6, LOG_CLASS:] = start
    weight = np.array([1.0, 0.5, 0.01, 0.9, 0.2, 1.0], np.float32)
    assert refine(store, seen, 6, sampled, layer, weight, 1, np.empty(CLASSES, np.float32)) == 5
    for i in range(6):
        expected = start[i] if i == 2 else naive_refine(start[i], sampled[i], layer, weight[i])
        np.testing.assert_allclose(store.attribute[i, LOG_CLASS:], expected, atol=2e-5)


def test_agreeing_masks_win_over_the_ones_that_err() -> None:
    rng = np.random.default_rng(4)
    store, scratch = small_store(), np.empty(CLASSES, np.float32)
    seen = random_seen(rng, store, 6)
    layer = slot_layers(scores_of(rng, (0, 1, 2)))
    for k in range(10):
        sampled = np.zeros((6, 3), np.float32)
        sampled[:, 2 if k % 3 == 0 else 1] = 0.95
        refine(store, seen, 6, sampled, layer, np.ones(6, np.float32), k, scratch)
    label, probability = np.zeros(6, np.uint8), np.zeros(6, np.float32)
    active = np.array([1, 1, 1] + [0] * 13, np.uint8)
    labels_of(store.attribute[:6, LOG_CLASS:], active, label, probability, scratch)
    assert (label == 1).all() and (probability > 0.9).all()


def test_labels_are_the_softmax_and_blank_rows_are_unknown() -> None:
    lam = np.zeros((3, CLASSES), np.float32)
    lam[1, 1:] = -2.0
    lam[2, :4] = (-1.0, 0.0, -3.0, 5.0)  # slot 3 is not in use
    active = np.array([1, 1, 1] + [0] * 13, np.uint8)
    label, probability = np.zeros(3, np.uint8), np.zeros(3, np.float32)
    labels_of(lam, active, label, probability, np.empty(CLASSES, np.float32))
    assert label.tolist() == [0, 0, 1]
    assert probability[0] == 0.0
    assert probability[2] == pytest.approx(1 / (1 + math.exp(-1) + math.exp(-3)), rel=1e-5)


def test_divergence_is_scipys() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        P, Q = rng.dirichlet(np.full(CLASSES, 0.3), 2).astype(np.float32)
        found = jensen_shannon(P, Q, entropy(P), entropy(Q))
        assert found == pytest.approx(jensenshannon(P, Q) ** 2, abs=1e-5)
    one = np.eye(CLASSES, dtype=np.float32)
    assert jensen_shannon(one[0], one[1], 0.0, 0.0) == pytest.approx(math.log(2.0))
    assert jensen_shannon(one[0], one[0], 0.0, 0.0) == 0.0


def test_a_class_is_clear_when_no_other_comes_near() -> None:
    row = np.zeros(LOG_CLASS + CLASSES, np.float32)
    assert clear_class(row) == -1
    row[LOG_CLASS + 1 :] = -3.0
    assert clear_class(row) == 0
    row[LOG_CLASS + 2] = -1.0
    assert clear_class(row) == -1
    other = np.full(LOG_CLASS + CLASSES, -5.0, np.float32)
    other[LOG_CLASS + 2] = 0.0
    row[LOG_CLASS + 2] = -9.0
    assert are_two_objects(row, other) and not are_two_objects(row, row)
    assert not are_two_objects(row[:LOG_CLASS], other[:LOG_CLASS]), "a map without classes has no objects"


def test_labels_spread_over_the_surface_but_not_around_corners() -> None:
    faces = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4]], np.int32)
    normals = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1], [1, 0, 0]], np.float32)
    label, known = np.array([2, 0, 0, 0, 0], np.uint8), np.array([True, False, False, False, False])
    assert spread_labels(label, known, normals, faces, 0).tolist() == [2, 0, 0, 0, 0]
    assert spread_labels(label, known, normals, faces, 1).tolist() == [2, 2, 2, 0, 0]
    assert spread_labels(label, known, normals, faces, 5).tolist() == [2, 2, 2, 2, 0]


def test_rows_without_an_image_start_from_their_voxel() -> None:
    lam = np.zeros((2, CLASSES), np.float32)
    lam[1] = -1.0
    voxel = np.zeros((2, CLASSES + 1), np.float32)
    voxel[:, 3], voxel[:, WEIGHT] = 2.0, 2.0
    start_blank(lam, voxel)
    assert lam[0].argmax() == 3 and lam[0, 3] == 0.0
    assert (lam[1] == -1.0).all()


@pytest.mark.parametrize("known", [True, False])
def test_a_mask_reaches_the_vertices_it_shows_and_not_those_behind(known: bool) -> None:
    """A wall of vertices 2 m before the camera hides one 4 m away, which a mask must not label; be the wall known when
    the image is taken, or found before its mask is there."""
    store = bs.allocate(1.0, LOG_CLASS + CLASSES)
    brush = SemanticMap(SemanticsConfig(), store, VOXEL_M)
    brush.ask(["car"])
    image = _image(CameraModel(80, 64, 60.0, 60.0, 40.0, 32.0))
    empty = brush.sight(image, np.eye(4))
    slots = {}
    for z in (2.0, 4.0):
        span = np.arange(-0.35, 0.4, 0.1) if z == 2.0 else [0.05]
        for x in span:
            for y in span:
                slots[round(x, 2), round(y, 2), z] = _vertex(store, x, y, z)
    scores = DenseScores((0, 1), np.zeros((8, 10, 2), np.uint8), Grid(0.125, 0.125, 0.0, 0.0))
    scores.score[:, :, 1] = 250
    mask = LateMask(brush.sight(image, np.eye(4)) if known else empty, scores)
    n = brush.fuse(mask, 1)
    assert brush.refine(mask, n, 1) == len(slots) - 1
    front, behind = slots[0.05, 0.05, 2.0], slots[0.05, 0.05, 4.0]
    assert store.attribute[front, LOG_CLASS:].argmax() == 1
    assert not store.attribute[behind, LOG_CLASS:].any()


def test_more_classes_than_slots_are_refused() -> None:
    brush = SemanticMap(SemanticsConfig(), bs.allocate(1.0, LOG_CLASS + CLASSES), VOXEL_M)
    with pytest.raises(InputError, match="at most 15"):
        brush.ask([f"thing {k}" for k in range(16)])


def _vertex(store: bs.Store, x: float, y: float, z: float) -> int:
    place = np.array([x, y, z])
    voxel = np.floor(place / VOXEL_M).astype(int)
    block = bs.find_or_add_block(store, *(int(k) >> 3 for k in voxel))
    inner = bs.inner_index(*(int(k) for k in voxel))
    v = store.block_voxel[block, inner]
    if v < 0:
        v = bs.add_voxel(store, block, inner, *(int(k) for k in voxel))
    cx, cy, cz = np.floor((place - voxel * VOXEL_M) / 0.1).astype(int)
    s = bs.add_cell(store, int(v), int((cx << 4) | (cy << 2) | cz))
    store.state[s] = bs.ALIVE
    store.vertex[s, :3], store.vertex[s, 3:6] = place, (0.0, 0.0, -1.0)
    return int(s)


def _image(camera: CameraModel) -> CameraImage:
    return CameraImage("cam_0", 0, b"", camera, np.eye(4))


@pytest.mark.parametrize("count", [0, 1, 40])
def test_edges_of_triangles(count: int) -> None:
    faces = (
        np.random.default_rng(count)
        .permuted(np.tile(np.arange(9), (count, 1)), axis=1)[:, :3]
        .astype(np.int32)
    )
    pairs = {(min(f[a], f[b]), max(f[a], f[b])) for f in faces.tolist() for a, b in ((0, 1), (1, 2), (2, 0))}
    assert edges_of(faces).tolist() == [list(pair) for pair in sorted(pairs)]
