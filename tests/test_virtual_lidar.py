"""The virtual LiDARs against slow, obvious twins and against what their data sheets state."""

from __future__ import annotations

import numpy as np
import pytest
from artemis_drivers.virtual.mesh_builder import F64, MeshBuilder, WorldMesh
from artemis_drivers.virtual.motion import Motion
from artemis_drivers.virtual.moving import near_mover
from artemis_drivers.virtual.scene import Scene, cast_at, local_rays, prepare
from artemis_drivers.virtual.shapes import box
from artemis_drivers.virtual.textures import TextureAtlas, build_atlas
from artemis_drivers.virtual.world import Mover

Corner = tuple[float, float, float]


@pytest.fixture(scope="module")
def atlas() -> TextureAtlas:
    return build_atlas(0)


def boxes(atlas: TextureAtlas, *corners: tuple[Corner, Corner]) -> WorldMesh:
    builder = MeshBuilder(atlas.index)
    for low, high in corners:
        builder.begin("other")
        builder.add(box(low, high), "concrete")
    return builder.build()


def gliding(velocity: tuple[float, float, float], turn: float, start: tuple[float, float, float]) -> Motion:
    time = np.linspace(0.0, 2.0, 40)
    position = np.array(start) + time[:, None] * np.array(velocity)
    return Motion.through(time, position, np.column_stack([turn * time, 0.1 * turn * time, 0 * time]))


@pytest.fixture(scope="module")
def busy(atlas: TextureAtlas) -> Scene:
    """A wall and two movers, one of which turns."""
    wall = boxes(atlas, ((20, -30, -5), (21, 30, 10)))
    movers = (
        Mover(boxes(atlas, ((-1, -1, 0), (1, 1, 2))), gliding((0, 6, 0), 2.0, (12, -5, -1))),
        Mover(
            boxes(atlas, ((3, -1, 0), (4, 1, 1)), ((5, 5, 5), (6, 6, 6))), gliding((1, -2, 0), 0.0, (4, 1, 0))
        ),
    )
    return prepare(wall, atlas, movers)


# --- movers


def brute_force(scene: Scene, origin: F64, direction: F64, time: float, limit: float) -> tuple[float, int]:
    """Slow twin: every triangle put where it is at that time, all of them tried in float64."""
    corners = [scene.mesh.corners().astype(np.float64)]
    for mover in scene.movers:
        t = min(max(time, 0.0), mover.motion.duration_s)
        T = mover.motion.pose(t)[0]
        corners.append(mover.mesh.corners() @ T[:3, :3].T + T[:3, 3])
    all_corners = np.concatenate(corners)
    a, e1, e2 = (
        all_corners[:, 0],
        all_corners[:, 1] - all_corners[:, 0],
        all_corners[:, 2] - all_corners[:, 0],
    )
    best, hit = limit, -1
    for k in range(len(a)):
        M = np.column_stack([e1[k], e2[k], -direction])
        if abs(np.linalg.det(M)) < 1e-14:
            continue
        u, v, s = np.linalg.solve(M, origin - a[k])
        if u >= -1e-9 and v >= -1e-9 and u + v <= 1 + 1e-9 and 1e-4 < s < best:
            best, hit = s, k
    return (best if hit >= 0 else np.inf), hit


def random_rays(count: int, seed: int) -> tuple[F64, F64, F64]:
    rng = np.random.default_rng(seed)
    direction = np.column_stack(
        [np.ones(count), rng.uniform(-0.8, 0.8, count), rng.uniform(-0.2, 0.2, count)]
    )
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return rng.uniform(-0.5, 0.5, (count, 3)), direction, rng.uniform(-0.2, 2.5, count)


def test_cast_at_agrees_with_brute_force(busy: Scene) -> None:
    origin, direction, time = random_rays(500, 0)
    hits = cast_at(busy, origin, direction, time, 25.0)
    expected = [brute_force(busy, o, d, t, 25.0) for o, d, t in zip(origin, direction, time, strict=True)]
    distance = np.array([e[0] for e in expected])
    np.testing.assert_allclose(hits.distance_m, distance, atol=2e-5)
    moving = hits.triangle >= len(busy.mesh.triangles)
    assert moving.sum() > 50 and (~moving).sum() > 50 and (hits.triangle < 0).any()
    other = hits.triangle != np.array([e[1] for e in expected])
    assert other.mean() < 0.02  # ties on an edge that two triangles share


def test_local_rays_lie_on_the_surface_as_it_is_described(busy: Scene) -> None:
    origin, direction, time = random_rays(400, 1)
    hits = cast_at(busy, origin, direction, time)
    met = hits.triangle >= 0
    point = origin[met] + hits.distance_m[met, None] * direction[met]
    local, turned = local_rays(busy, hits.triangle[met], point, direction[met], time[met])
    rows = busy.surface.rows[hits.triangle[met]]
    assert np.abs((rows[:, :3] * local).sum(axis=1) - rows[:, 3]).max() < 5e-5
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1.0)
    one, _ = local_rays(busy, hits.triangle[met][:5], point[:5], direction[met][:5], time[met][:5])
    np.testing.assert_allclose(one, local[:5])


def test_rows_of_all_triangles_have_class_and_instance(busy: Scene) -> None:
    count = len(busy.mesh.triangles) + sum(len(m.mesh.triangles) for m in busy.movers)
    assert (
        len(busy.class_id) == len(busy.instance) == len(busy.surface.rows) == len(busy.surface.key) == count
    )
    assert [m.first for m in busy.movers] == [12, 24]


def test_near_mover_drops_no_ray_that_meets_it(busy: Scene) -> None:
    origin, direction, time = random_rays(3000, 2)
    everything = cast_at(busy, origin, direction, time)
    for mover in busy.movers:
        rows = near_mover(mover, origin, direction, time, np.full(3000, 100.0))
        mine = (everything.triangle >= mover.first) & (
            everything.triangle < mover.first + len(mover.mesh.triangles)
        )
        assert set(np.flatnonzero(mine)) <= set(rows.tolist())
        assert len(rows) < 2500


def test_cast_at_degenerate_rays(busy: Scene) -> None:
    assert len(cast_at(busy, np.empty((0, 3)), np.empty((0, 3)), np.empty(0)).triangle) == 0
    origin, direction = np.zeros((3, 3)), np.array([[1.0, 0, 0], [np.nan, 0, 0], [-1.0, 0, 0]])
    hits = cast_at(busy, origin, direction, np.array([0.0, 0.5, np.nan]))
    assert hits.triangle[0] >= 0 and hits.triangle[1:].tolist() == [-1, -1]
    assert np.isinf(hits.distance_m[1:]).all()
