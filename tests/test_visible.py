"""What an image shows of the map: against all triangles one by one, and with what is hidden left out."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import F64, CameraModel
from artemis_edge.refinement.camera import Camera, make_camera, view_bounds
from artemis_edge.refinement.reliability import Trust, clearly_behind, front_at, geometric
from artemis_edge.refinement.visible import Scope, Visible, list_visible, new_visible
from tests import naive

MODEL = CameraModel(160, 120, 110.0, 112.0, 79.0, 61.0, (-0.1, 0.02, 0.001, -0.001, 0.0))
T_WORLD_CAM = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
TRUST = Trust(80.0, 0.05, 0.1, 400.0, 16.0, 0.2, 0.03)
ALL = 1 << 30


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> tuple[naive.SmallMapper, Mesh]:
    """Three walls one behind the other, the farthest the largest; beside each something of the next is seen."""
    mapper, rng = naive.SmallMapper(tmp_path_factory.mktemp("pages")), np.random.default_rng(5)
    for _ in range(4):
        for x, half in ((2.1, 0.7), (4.1, 1.9), (8.3, 4.0)):
            corner = (x, -half, -half)
            mapper.add(naive.rectangle(rng, corner, (0, 2 * half, 0), (0, 0, 2 * half), 250, 0.003))
    return mapper, mapper.finish()


def camera() -> Camera:
    return make_camera(MODEL, T_WORLD_CAM, view_bounds(MODEL))


def look(mapper: naive.SmallMapper, behind: float, most: int = ALL, room: int = 100):  # type: ignore[no-untyped-def]
    voxel_m = mapper.voxel_map.config.voxel_m
    scratch = new_visible(mapper.store, room, room)
    return list_visible(mapper.store, camera(), Scope(voxel_m, 80.0, 2, behind, most), scratch)


def corners(mapper: naive.SmallMapper, seen: Visible) -> F64:
    """Places (m, 3, 3) of the corners of the listed triangles."""
    slots = seen.slot[seen.triangle[: seen.length[1]]]
    return mapper.store.vertex[slots, :3].astype(np.float64)


def names(places: F64) -> set[bytes]:
    """A name for each triangle (m, 3, 3), whatever corner it begins with."""
    return {np.sort(place.astype(np.float32).view("f4,f4,f4").ravel()).tobytes() for place in places}


def test_all_in_view_is_listed_once(world: tuple[naive.SmallMapper, Mesh]) -> None:
    mapper, mesh = world
    seen, _ = look(mapper, np.inf)
    listed = corners(mapper, seen)
    assert len(names(listed)) == len(listed)
    slots = seen.slot[: seen.length[0]]
    assert len(np.unique(slots)) == len(slots)
    K = np.array([[MODEL.fx, 0, MODEL.cx], [0, MODEL.fy, MODEL.cy], [0, 0, 1]])
    turned = mesh.vertices.astype(np.float64) @ T_WORLD_CAM[:3, :3]
    pixel = cv2.projectPoints(turned, np.zeros(3), np.zeros(3), K, np.array(MODEL.distortion))[0][:, 0]
    inside = ((pixel > 0) & (pixel < [MODEL.width - 1, MODEL.height - 1])).all(axis=1)
    whole = mesh.faces[inside[mesh.faces].all(axis=1)]
    assert len(whole) > 1000
    assert names(mesh.vertices[whole].astype(np.float64)) <= names(listed)


def test_only_what_is_clearly_hidden_is_left_out(world: tuple[naive.SmallMapper, Mesh]) -> None:
    mapper, _ = world
    whole, deep = look(mapper, np.inf)
    seen, depth = look(mapper, clearly_behind(TRUST))
    np.testing.assert_array_equal(depth.nearness, deep.nearness)
    kept = set(seen.slot[: seen.length[0]].tolist())
    gone = [i for i in range(whole.length[0]) if whole.slot[i] not in kept]
    assert len(gone) > 0.15 * whole.length[0]
    for u, v, near in whole.pixel[gone]:
        if 0 <= u < MODEL.width - 1 and 0 <= v < MODEL.height - 1:
            assert geometric(front_at(depth, u, v), near, 0.0, TRUST.sigma_geom) < TRUST.least


def test_of_too_many_triangles_the_nearest_are_looked_at(world: tuple[naive.SmallMapper, Mesh]) -> None:
    mapper, _ = world
    seen, _ = look(mapper, np.inf, most=500)
    assert 500 <= seen.length[1] < look(mapper, np.inf)[0].length[1]
    assert corners(mapper, seen)[..., 0].max() < 5.0


def test_an_empty_map_shows_nothing(tmp_path: Path) -> None:
    seen, depth = look(naive.SmallMapper(tmp_path), 1.1)
    assert seen.length.tolist() == [0, 0] and not depth.nearness.any() and depth.nearness.shape == (60, 80)


def test_the_stretch_of_a_lens_bounds_its_enlargement() -> None:
    for k1 in (-0.2, 0.0, 0.15):
        model = CameraModel(640, 480, 400.0, 410.0, 320.0, 250.0, (k1, 0.02, 0.001, -0.002, 0.0))
        bounded = make_camera(model, np.eye(4), view_bounds(model))
        assert 1.0 <= bounded.stretch < 1.6
        K, lens = np.array([[400.0, 0, 320], [0, 410.0, 250], [0, 0, 1]]), np.array(model.distortion)
        rng = np.random.default_rng(3)
        line = rng.uniform([bounded.left, bounded.top], [bounded.right, bounded.bottom], (300, 2))
        angle = rng.uniform(0.0, 2.0 * np.pi, 300)
        step = 1e-4 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        both = [np.column_stack([at, np.ones(300)]) for at in (line, line + step)]
        a, b = (cv2.projectPoints(at, np.zeros(3), np.zeros(3), K, lens)[0][:, 0] for at in both)
        inside = ((a >= 0) & (a < [640, 480])).all(axis=1)
        moved = np.linalg.norm((b - a)[inside] / [400.0, 410.0], axis=1)
        assert (moved <= bounded.stretch * 1e-4).all()
