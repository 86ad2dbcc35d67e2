"""Shapes are closed and wound outwards; the street has what a street has; the ray caster equals its twin."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from artemis_drivers.virtual import furniture, person, shapes, street
from artemis_drivers.virtual.building import add_house, fitted_panel
from artemis_drivers.virtual.car import add_car
from artemis_drivers.virtual.cyclist import add_bicycle
from artemis_drivers.virtual.mesh_builder import CLASS_NAMES, MeshBuilder, Shape, WorldMesh, joined
from artemis_drivers.virtual.raycast import build_bvh, cast, first_free_line
from artemis_drivers.virtual.scene import prepare
from artemis_drivers.virtual.textures import LEVELS, SIZE, TextureAtlas, build_atlas
from artemis_drivers.virtual.tree import add_tree
from artemis_drivers.virtual.world import World


@pytest.fixture(scope="module")
def atlas() -> TextureAtlas:
    return build_atlas(3)


@pytest.fixture(scope="module")
def world(atlas: TextureAtlas) -> World:
    return street.build(3, 80.0, atlas)


def volume(shape: Shape) -> float:
    a, b, c = np.moveaxis(shape.vertices[shape.triangles], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def open_edges(shape: Shape) -> int:
    """Directed edges without exactly one opposite."""
    edges = Counter((int(t[k]), int(t[(k + 1) % 3])) for t in shape.triangles.tolist() for k in range(3))
    return sum(edges[(b, a)] != n for (a, b), n in edges.items())


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        (shapes.box((0, 0, 0), (1, 2, 3)), 6.0),
        (shapes.cylinder(0.5, 0, 2, 64), np.pi / 2),
        (shapes.cylinder(1.0, 0, 1, 64, 0.5), np.pi * (1 + 0.5 + 0.25) / 3),
        (shapes.ellipsoid((1, 2, 3), 48, 48), 8 * np.pi),
        (shapes.prism([(0, 0), (2, 0), (0, 1)], -1, 2), 3.0),
        (shapes.panel(2.0, 1.0, 0.1), 0.2),
        (shapes.disc_panel(1.0, 0.2, 64), 0.2 * np.pi),
        (shapes.limb((0, 0, 0), (0, 0, 1), 0.1, 0.1, 32), np.pi * 0.01 * 1.1),
    ],
    ids=["box", "cylinder", "frustum", "ellipsoid", "prism", "panel", "disc", "limb"],
)
def test_solids_are_closed_and_wound_outwards(shape: Shape, expected: float) -> None:
    assert open_edges(shape) == 0
    assert volume(shape) == pytest.approx(expected, rel=0.06)


def test_leaf_cards_are_closed_thin_solids() -> None:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(5, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    leaves = shapes.leaf_cards(rng.normal(size=(5, 3)), normals, rng.uniform(0, 6, 5), 0.2, 0.1)
    assert open_edges(leaves) == 0
    assert volume(leaves) > 0


def test_texture_coordinates_are_metres() -> None:
    shape = shapes.box((0, 0, 0), (1, 2, 3))
    corners = shape.vertices[shape.triangles]
    for k in range(3):
        length = np.linalg.norm(corners[:, k] - corners[:, k - 1], axis=1)
        texture = np.linalg.norm(shape.uv[:, k] - shape.uv[:, k - 1], axis=1)
        np.testing.assert_allclose(texture, length)


def test_a_fitted_panel_shows_its_picture_once_and_upright() -> None:
    panel = fitted_panel(3.0, 0.5, 0.1)
    front = panel.part == 0
    position, uv = panel.vertices[panel.triangles[front]], panel.uv[front]
    np.testing.assert_allclose(uv[..., 0], position[..., 0] / 3.0)
    np.testing.assert_allclose(uv[..., 1], position[..., 2] / 0.5)


@pytest.mark.parametrize(
    "add",
    [
        add_car,
        person.add_person,
        person.add_statue,
        person.add_backpack,
        add_bicycle,
        furniture.add_bench,
        add_tree,
        furniture.add_planter,
        furniture.add_lamp,
        furniture.add_road_sign,
        furniture.add_bin,
        furniture.add_boxes,
        furniture.add_bollard,
        furniture.add_cabinet,
    ],
)
def test_objects_show_only_their_fronts(add, atlas: TextureAtlas) -> None:  # type: ignore[no-untyped-def]
    """Rays from all around meet triangles that face them: true for unions of closed, outward solids."""
    for seed in range(3):
        builder = MeshBuilder(atlas.index)
        add(builder, np.random.default_rng(seed), np.eye(4))
        mesh = builder.build()
        facing, hits = _facing(mesh, np.random.default_rng(seed))
        assert hits > 200
        # thin leaves lose a ray in some thousand at their rims to rounding
        assert np.count_nonzero(facing > 0) <= 2 + hits * 5e-4


def test_a_house_shows_only_its_fronts(atlas: TextureAtlas) -> None:
    builder = MeshBuilder(atlas.index)
    add_house(builder, np.random.default_rng(1), np.eye(4), 11.0, 9.0)
    facing, hits = _facing(builder.build(), np.random.default_rng(1))
    assert hits > 1000
    assert np.count_nonzero(facing > 0) <= hits * 1e-3


def _facing(mesh: WorldMesh, rng: np.random.Generator) -> tuple[np.ndarray, int]:  # type: ignore[type-arg]
    """Cosine between ray and normal where rays from around and above meet the mesh, and their number."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    middle, radius = (low + high) / 2, np.linalg.norm(high - low)
    direction = rng.normal(size=(6000, 3))
    direction[:, 2] = np.abs(direction[:, 2])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = middle + direction * radius
    target = rng.uniform(low, high, (6000, 3))
    ray = target - origin
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    hits = cast(build_bvh(mesh.corners()), origin, ray)
    met = hits.triangle >= 0
    _, normal = mesh.areas_and_normals()
    return (normal[hits.triangle[met]] * ray[met]).sum(axis=1), int(met.sum())


def test_street_has_every_class_and_many_instances(world: World) -> None:
    mesh = world.mesh()
    labels = {CLASS_NAMES[k] for k in np.unique(mesh.class_id)}
    assert labels >= set(CLASS_NAMES[1:10])
    assert len(np.unique(mesh.instance)) > 60
    for instance in np.unique(mesh.instance):
        assert len(np.unique(mesh.class_id[mesh.instance == instance])) == 1
    area, _ = mesh.areas_and_normals()
    assert (area > 1e-9).all()
    assert np.isfinite(mesh.vertices).all() and np.isfinite(mesh.uv).all()


def test_kerb_is_twelve_centimetres(world: World) -> None:
    mesh = world.build_block(0)
    kerb = mesh.material == world.atlas.index["kerbstone"]
    _, normal = mesh.areas_and_normals()
    riser = kerb & (np.abs(normal[:, 2]) < 0.5)
    heights = np.ptp(mesh.corners()[riser][:, :, 2], axis=1)
    assert np.median(heights) == pytest.approx(0.12, abs=0.01)


def test_seed_decides_the_street(atlas: TextureAtlas) -> None:
    first, same, other = (street.build(seed, 80.0, atlas).build_block(1) for seed in (5, 5, 6))
    assert first.vertices.tobytes() == same.vertices.tobytes()
    assert first.tint.tobytes() == same.tint.tobytes()
    assert first.vertices.shape != other.vertices.shape or not np.array_equal(first.vertices, other.vertices)


def test_many_seeds_build(atlas: TextureAtlas) -> None:
    for seed in range(6):
        world = street.build(seed, 80.0, atlas)
        mesh = world.build_block(seed % 2)
        assert 30_000 < len(mesh.triangles) < 120_000
        assert np.isfinite(mesh.vertices).all()


def test_a_block_does_not_depend_on_the_length_of_the_street(atlas: TextureAtlas) -> None:
    short, long = street.build(5, 120.0, atlas), street.build(5, 1400.0, atlas)
    assert short.build_block(1).vertices.tobytes() == long.build_block(1).vertices.tobytes()
    assert long.block_count == 35
    assert np.linalg.norm(np.diff(long.path, axis=0), axis=1).sum() > 1380


def test_blocks_near(world: World) -> None:
    assert list(world.blocks_near(10.0, 5.0)) == [0]
    assert list(world.blocks_near(38.0, 5.0)) == [0, 1]
    assert list(world.blocks_near(1e6, 5.0)) == [1]
    assert list(world.blocks_near(-1e6, 5.0)) == [0]


def test_atlas_is_seeded_tileable_and_mip_mapped(atlas: TextureAtlas) -> None:
    one, two, three = atlas, build_atlas(3), build_atlas(2)
    assert one.arrays.texels.tobytes() == two.arrays.texels.tobytes()
    assert one.arrays.texels.tobytes() != three.arrays.texels.tobytes()
    for name in ("asphalt", "plaster_a", "concrete", "macro"):
        start = one.arrays.start[one.index[name], 0]
        red = (one.arrays.texels[start : start + SIZE * SIZE] & 255).reshape(SIZE, SIZE).astype(float)
        inside = np.abs(np.diff(red, axis=1)).mean()
        seam = np.abs(red[:, 0] - red[:, -1]).mean()
        assert seam < 2 * inside + 1
    last = one.arrays.start[:, LEVELS - 1]
    for material, first in enumerate(last):
        smallest = one.arrays.texels[first : first + (SIZE >> (LEVELS - 1)) ** 2]
        mean = np.mean([smallest & 255, smallest >> 8 & 255, smallest >> 16])
        assert mean == pytest.approx(one.arrays.mean_luma[material], abs=3)


def test_textures_are_rich_at_the_scale_of_centimetres(atlas: TextureAtlas) -> None:
    """Contrast of what one sees of 1 cm at a metre: the big surfaces have some everywhere."""
    for name in ("asphalt", "paving", "brick_a", "brick_b", "plaster_a", "plaster_b", "concrete", "bark"):
        m = atlas.index[name]
        level = max(int(np.log2(0.01 / (atlas.arrays.metres[m] / SIZE))), 0)
        size, start = SIZE >> level, atlas.arrays.start[m, level]
        red = (atlas.arrays.texels[start : start + size * size] & 255).reshape(size, size).astype(float)
        assert np.abs(np.diff(red, axis=1)).mean() > 3


def naive_cast(corners: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> tuple[float, int]:  # type: ignore[type-arg]
    """Plane of every triangle, then three edge tests."""
    best, which = np.inf, -1
    for k, (a, b, c) in enumerate(corners.astype(np.float64)):
        normal = np.cross(b - a, c - a)
        down = normal @ direction
        if down == 0:
            continue
        t = normal @ (a - origin) / down
        p = origin + t * direction
        inside = all(np.cross(v - u, p - u) @ normal >= 0 for u, v in ((a, b), (b, c), (c, a)))
        if 1e-4 < t < best and inside:
            best, which = t, k
    return best, which


def test_ray_caster_equals_its_twin() -> None:
    rng = np.random.default_rng(0)
    centre = rng.uniform(-3, 3, (150, 1, 3))
    corners = (centre + rng.normal(0, 0.5, (150, 3, 3))).astype(np.float32)
    origin = rng.uniform(-4, 4, (200, 3))
    direction = rng.normal(size=(200, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction[:3] = np.eye(3)
    hits = cast(build_bvh(corners), origin, direction)
    for k in range(200):
        distance, triangle = naive_cast(corners, origin[k], direction[k])
        assert hits.triangle[k] == triangle
        if triangle >= 0:
            assert hits.distance_m[k] == pytest.approx(distance, abs=2e-5)
            a, b, c = corners[triangle].astype(np.float64)
            met = a + hits.u[k] * (b - a) + hits.v[k] * (c - a)
            np.testing.assert_allclose(met, origin[k] + distance * direction[k], atol=1e-4)
        else:
            assert hits.distance_m[k] == np.inf


def test_ray_caster_far_from_the_world_origin() -> None:
    wall = np.array([[[1400.0, -5, -5], [1400, 5, -5], [1400, 0, 9]]], np.float32)
    hits = cast(build_bvh(wall), np.array([[1390.123456, 0, 0]]), np.array([[1.0, 0, 0]]))
    assert hits.distance_m[0] == pytest.approx(9.876544, abs=1e-5)


def test_ray_caster_degenerate_input() -> None:
    ray = (np.zeros((2, 3)), np.array([[1.0, 0, 0], [np.nan, 0, 0]]))
    empty = cast(build_bvh(np.empty((0, 3, 3), np.float32)), *ray)
    assert (empty.triangle == -1).all() and (empty.distance_m == np.inf).all()
    one = np.array([[[2.0, -1, -1], [2, 1, -1], [2, 0, 2]]], np.float32)
    hits = cast(build_bvh(one), *ray)
    assert hits.triangle.tolist() == [0, -1]
    assert cast(build_bvh(one), *ray, max_m=1.5).triangle.tolist() == [-1, -1]
    line = np.array([[[2.0, -1, 0], [2, 0, 0], [2, 1, 0]]], np.float32)  # collinear corners
    assert cast(build_bvh(line), *ray).triangle.tolist() == [-1, -1]
    stacked = np.repeat(one, 50, axis=0)  # nothing separates these
    assert cast(build_bvh(stacked), *ray).triangle[0] >= 0


def test_no_ray_slips_between_neighbours() -> None:
    n = 20
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij")
    v = np.stack([np.full_like(x, 5.0), x + 0.1 * y, y], axis=-1).astype(np.float32)
    a, b, c, d = v[:-1, :-1], v[1:, :-1], v[1:, 1:], v[:-1, 1:]
    corners = np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3, 3)
    target = corners.reshape(-1, 3).astype(np.float64)
    target = target[np.abs(target[:, 1:]).max(axis=1) < 0.85]
    middle = (target + np.roll(target, 1, axis=0)) / 2
    aim = np.concatenate([target, middle])
    direction = aim / np.linalg.norm(aim, axis=1, keepdims=True)
    assert (cast(build_bvh(corners), np.zeros_like(aim), direction).triangle >= 0).all()


def test_first_free_line() -> None:
    wall = np.array([[[1.0, -1, -1], [1, 1, -1], [1, 0, 3]]], np.float32)
    bvh = build_bvh(wall)
    eyes = np.array([[0.0, 0, 0], [3.0, 0, 0]]) - bvh.origin
    points = np.array([[2.0, 0, 0], [0.5, 0, 0], [1.0, 0, 0]]) - bvh.origin
    tries = np.array([[0, 1], [0, 1], [0, -1]], np.int32)
    assert first_free_line(bvh, points, eyes, tries, 0.01).tolist() == [1, 0, 0]
    assert first_free_line(bvh, points[:1], eyes, tries[:1, :1], 0.01).tolist() == [-1]


def test_joined_keeps_everything(world: World) -> None:
    parts = [world.build_block(0), world.build_block(1)]
    both = joined(parts)
    assert len(both.triangles) == sum(len(p.triangles) for p in parts)
    np.testing.assert_array_equal(both.corners()[len(parts[0].triangles) :], parts[1].corners())
    assert len(np.intersect1d(parts[0].instance, parts[1].instance)) == 0


def test_surface_mapping_gives_back_the_corners(world: World) -> None:
    mesh = world.build_block(0)
    scene = prepare(mesh, world.atlas)
    rows = scene.surface.rows.astype(np.float64)
    local = mesh.corners() - scene.origin
    for k in range(2):
        uv = (rows[:, None, 4 + 4 * k : 7 + 4 * k] * local).sum(axis=2) + rows[:, None, 7 + 4 * k]
        metres = world.atlas.arrays.metres[mesh.material][:, None]
        error = np.abs(uv * metres - mesh.uv[:, :, k])
        assert np.percentile(error, 99.9) < 2e-3
    height = (rows[:, None, :3] * local).sum(axis=2) - rows[:, None, 3]
    assert np.abs(height).max() < 1e-3
