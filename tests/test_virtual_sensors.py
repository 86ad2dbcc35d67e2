"""The virtual IMU, walk and camera against what they must be exactly (LiDARs: test_virtual_lidar.py)."""

from __future__ import annotations

import numpy as np
import pytest
from artemis_drivers.virtual import avia
from artemis_drivers.virtual.lidar import Beams, Frame, LidarSpec, scan
from artemis_drivers.virtual.mesh_builder import MeshBuilder
from artemis_drivers.virtual.motion import Motion
from artemis_drivers.virtual.observable import REACH_M, HitStore, observed_surface
from artemis_drivers.virtual.scene import Scene, prepare
from artemis_drivers.virtual.shapes import box
from artemis_drivers.virtual.textures import TextureAtlas, build_atlas

IDEAL = LidarSpec(range_noise_m=0.0, angular_noise=0.0)


@pytest.fixture(scope="module")
def atlas() -> TextureAtlas:
    return build_atlas(0)


@pytest.fixture(scope="module")
def wall(atlas: TextureAtlas) -> Scene:
    """A wall at x = 10 m and a box in front of it."""
    builder = MeshBuilder(atlas.index)
    builder.begin("building")
    builder.add(box((10, -30, -30), (11, 30, 30)), "plaster_a")
    builder.begin("other")
    builder.add(box((5, -1, -1), (6, 1, 1)), "concrete")
    return prepare(builder.build(), atlas)


def still(x: float = 0.0) -> Motion:
    time = np.linspace(0, 1, 20)
    return Motion.through(time, np.tile([x, 0.0, 0.0], (20, 1)), np.zeros((20, 3)))


def take(scene: Scene, beams: Beams, spec: LidarSpec = IDEAL, motion: Motion | None = None) -> Frame:
    return scan(scene, motion or still(), np.eye(4), beams, 0.0, spec, np.random.default_rng(0))


# --- what was observed


def test_observed_surface_is_near_beams_in_front_and_unhidden(wall: Scene) -> None:
    store = HitStore()
    for k in range(5):
        frame = take(wall, avia.beams(k))
        store.add(frame.hit, frame.origin, wall.mesh.instance[frame.triangle])
    surface = observed_surface(wall.mesh, wall, store, 0.05)
    assert (surface.normals[:, 0] == -1).all()  # only what faces the sensor at the origin
    assert set(np.unique(surface.labels)) == {2, 9}
    wall_points = surface.points[surface.labels == 2]
    # the box of +-1 m at 5 m hides +-2 m of the wall at 10 m
    assert not (np.abs(wall_points[:, 1:]).max(axis=1) < 2.0 - 1e-3).any()
    nearest = np.sqrt(((wall_points[::50, None] - frame.hit[None, ::3]) ** 2).sum(axis=2)).min(axis=1)
    assert np.median(nearest) < 0.5
    # spacing: about one point per 5 cm square on what was seen of the box front
    box_points = surface.points[surface.labels == 9]
    assert len(box_points) == pytest.approx(4 / 0.05**2, rel=0.1)


def test_observed_surface_reaches_no_further_than_stated(atlas: TextureAtlas) -> None:
    builder = MeshBuilder(atlas.index)
    builder.begin("building")
    builder.add(box((10, -3, -3), (11, 3, 3)), "plaster_a")
    scene = prepare(builder.build(), atlas)
    store = HitStore()
    store.add(np.array([[10.0, 0.0, 0.0]]), np.zeros((1, 3)), np.zeros(1, np.int32))
    surface = observed_surface(scene.mesh, scene, store, 0.01)
    distance = np.linalg.norm(surface.points - [10.0, 0, 0], axis=1)
    assert distance.max() <= REACH_M + 1e-6
    assert len(surface.points) == pytest.approx(np.pi * REACH_M**2 / 0.01**2, rel=0.1)
    other = HitStore()
    other.add(np.array([[10.0, 0.0, 0.0]]), np.zeros((1, 3)), np.ones(1, np.int32))
    assert len(observed_surface(scene.mesh, scene, other, 0.01).points) == 0  # another object's beam


def test_hit_store_keeps_the_nearest_beam_of_a_cube() -> None:
    store = HitStore()
    hit = np.array([[1.01, 0, 0], [1.02, 0, 0], [5.0, 0, 0], [1.03, 0, 0]])
    origin = np.array([[0.0, 0, 0], [0.5, 0, 0], [0, 0, 0], [0.9, 0, 0]])
    store.add(hit, origin, np.array([0, 0, 0, 1], np.int32))
    assert store.hit[:, 0].tolist() == [1.02, 5.0, 1.03]
    store.add(hit, origin, np.array([0, 0, 0, 1], np.int32))
    assert len(store.hit) == 3


def test_hit_store_against_a_dictionary_while_it_grows() -> None:
    rng = np.random.default_rng(4)
    store, naive = HitStore(), dict[tuple[int, ...], tuple[float, list[float]]]()
    for _ in range(4):
        hit, origin = rng.uniform(-1.5, 1.5, (2, 40_000, 3))
        instance = rng.integers(-2, 2, len(hit)).astype(np.int32)
        store.add(hit, origin, instance)
        length2 = ((hit - origin) ** 2).sum(axis=1)
        for cube, of, beam, d2 in zip(np.floor(hit / 0.05).astype(int), instance, hit, length2, strict=True):
            key = (int(of), *cube.tolist())
            if key not in naive or d2 < naive[key][0]:
                naive[key] = d2, beam.tolist()
    assert len(store.hit) == len(naive) > 1 << 16  # it had to grow
    found = {
        (int(of), *np.floor(h / 0.05).astype(int).tolist()): h.tolist()
        for of, h in zip(store.instance, store.hit, strict=True)
    }
    assert found == {key: beam for key, (_, beam) in naive.items()}
    store.add(np.empty((0, 3)), np.empty((0, 3)), np.empty(0, np.int32))
    assert len(store.origin) == len(naive)
