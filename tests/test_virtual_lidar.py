"""The virtual LiDARs against slow, obvious twins and against what their data sheets state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from artemis_drivers.virtual import avia, mid360, street
from artemis_drivers.virtual.echo import Receiver, empty_echoes, receive, returned_light, seen_m
from artemis_drivers.virtual.footprint import LANES, Spots, fan_out, lane_offsets
from artemis_drivers.virtual.lidar import Beams, Frame, LidarSpec, _jittered, poses_at, range_sigma, scan
from artemis_drivers.virtual.lidars import LIDARS
from artemis_drivers.virtual.mesh_builder import F64, MeshBuilder, WorldMesh
from artemis_drivers.virtual.motion import Motion, rotation
from artemis_drivers.virtual.moving import near_mover
from artemis_drivers.virtual.prisms import deflect, refract
from artemis_drivers.virtual.scene import Scene, Window, cast_at, local_rays, prepare
from artemis_drivers.virtual.shading import sample
from artemis_drivers.virtual.shapes import box
from artemis_drivers.virtual.textures import TextureAtlas, build_atlas
from artemis_drivers.virtual.world import Mover
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

IDEAL = LidarSpec(
    range_noise_m=0.0, angular_noise=0.0, divergence_vertical=0.0, divergence_horizontal=0.0, fading=0.0
)
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


# --- light spots


def test_lanes_have_the_variance_and_mean_of_the_gaussian() -> None:
    offsets = lane_offsets(2.0, 0.5)
    assert offsets.shape == (LANES, 2)
    np.testing.assert_allclose(offsets.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(offsets.std(axis=0), [2.0, 0.5])
    # no line of lanes across the spot
    assert abs(np.mean(offsets[:, 0] * offsets[:, 1])) < 0.03
    assert lane_offsets(0.0, 0.0).tolist() == [[0.0, 0.0]]


def test_fan_out_agrees_with_angles() -> None:
    direction = np.array([[1.0, 0, 0], [0.6, 0.64, 0.48], [0, 0, 1.0]])
    R = np.stack([rotation(np.array([[0.4, -0.2, 0.1]]))[0]] * 3)
    offsets = np.array([[0.0, 0.0], [0.01, 0.0], [0.0, 0.02]])
    fan = np.empty((3, 3, 3), np.float32)
    fan_out(direction, R, offsets, fan)
    back = np.einsum("nji,njk->nik", R, fan)  # into the sensor's frame again
    np.testing.assert_allclose(back[:, :, 0], direction, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(fan, axis=1), 1.0, atol=1e-6)
    up, side = back[:2, :, 1], back[:2, :, 2]
    elevation = np.arcsin(direction[:2, 2])
    np.testing.assert_allclose(np.arcsin(up[:, 2]) - elevation, np.arctan(0.01), atol=2e-6)
    np.testing.assert_allclose(
        np.arctan2(up[:, 1], up[:, 0]), np.arctan2(direction[:2, 1], direction[:2, 0]), atol=1e-6
    )
    np.testing.assert_allclose((side * direction[:2]).sum(axis=1), np.cos(np.arctan(0.02)), atol=1e-6)


def test_spots_agree_with_single_rays(busy: Scene) -> None:
    origin, direction, time = random_rays(400, 3)
    fan = np.empty((400, 3, LANES), np.float32)
    fan_out(direction, np.stack([np.eye(3)] * 400), lane_offsets(0.02, 0.005), fan)
    spots = Spots(busy, origin, fan, time, 100.0)
    for k in range(LANES):
        single = cast_at(busy, origin, fan[:, :, k].astype(np.float64), time, 100.0)
        np.testing.assert_allclose(spots.distance[:, k], single.distance_m, rtol=2e-6, atol=2e-5)
        assert np.mean(spots.triangle[:, k] != single.triangle) < 0.01
        met = single.triangle >= 0
        point = origin[met] + single.distance_m[met, None] * fan[met, :, k]
        _, turned = local_rays(
            busy, single.triangle[met], point, fan[met, :, k].astype(np.float64), time[met]
        )
        cosine = np.abs((busy.surface.rows[single.triangle[met], :3] * turned).sum(axis=1))
        np.testing.assert_allclose(spots.cosine[met, k], cosine, atol=2e-3)
    assert len(np.unique(spots.triangle)) > 8 and (spots.triangle[:, 0] != spots.triangle[:, 7]).any()


def test_spots_know_what_picture_they_met_and_how_much_light_returns(busy: Scene) -> None:
    """Slow twin of _surface_met and _light."""
    origin, direction, time = random_rays(60, 6)
    fan = np.empty((60, 3, LANES), np.float32)
    fan_out(direction, np.stack([np.eye(3)] * 60), lane_offsets(0.001, 0.001), fan)
    spots = Spots(busy, origin, fan, time, 100.0)
    arrays = busy.atlas.arrays
    light = returned_light(busy, spots)
    for i, k in np.argwhere(spots.triangle >= 0)[::7]:
        t = spots.triangle[i, k]
        ray = fan[i, :, k].astype(np.float64)
        point = origin[i] + spots.distance[i, k] * ray
        local, _ = local_rays(busy, np.array([t]), point[None], ray[None], time[i : i + 1])
        row = busy.surface.rows[t].astype(np.float64)
        u, v = row[4:7] @ local[0] + row[7], row[8:11] @ local[0] + row[11]
        np.testing.assert_allclose(spots.texture[i, k], [u, v], atol=2e-4)
        m = busy.surface.look[t, 3]
        rgb = sample(arrays.texels, arrays.start, m, u, v, 3.0)
        rho = arrays.reflectivity[m] * (0.5 + 0.5 * np.mean(rgb) / arrays.mean_luma[m])
        # lanes of one triangle share the picture of the first
        assert light[i, k] == pytest.approx(rho * spots.cosine[i, k], rel=0.1)


def test_spots_of_a_street_agree_with_single_rays(atlas: TextureAtlas) -> None:
    world = street.build(3, 60.0, atlas)
    scene = Window(world, 60.0).at(20.0)
    rng = np.random.default_rng(4)
    direction = rng.normal(size=(1500, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = np.tile(world.path[len(world.path) // 3], (1500, 1))
    fan = np.empty((1500, 3, LANES), np.float32)
    fan_out(direction, np.stack([np.eye(3)] * 1500), lane_offsets(0.002, 0.0002), fan)
    scene = replace(scene, panes=tuple(np.zeros_like(p) for p in scene.panes))
    spots = Spots(scene, origin, fan, np.full(1500, 0.3), 200.0)
    for k in (0, 4, 7):
        single = cast_at(scene, origin, fan[:, :, k].astype(np.float64), 0.3, 200.0)
        np.testing.assert_allclose(spots.distance[:, k], single.distance_m, rtol=2e-6, atol=2e-5)


def test_spots_of_no_beams_and_of_broken_beams(busy: Scene) -> None:
    assert Spots(
        busy, np.empty((0, 3)), np.empty((0, 3, 8), np.float32), np.empty(0), 50.0
    ).distance.shape == (0, 8)
    fan = np.tile(np.array([1.0, 0, 0], np.float32)[:, None], (3, 1, 8))
    fan[1] = np.nan
    spots = Spots(busy, np.zeros((3, 3)), fan, np.array([0.0, 0.0, np.nan]), 50.0)
    assert (spots.triangle[0] >= 0).all() and (spots.triangle[1:] == -1).all()
    assert np.isinf(spots.distance[1:]).all()


# --- echoes


def mixed_point_model(distance: F64, light: F64, plane: F64, gap: float) -> list[tuple[float, float, float]]:
    """Slow twin: range, spread and light of every echo of one spot, before the receiver's threshold."""
    seen = np.flatnonzero(np.isfinite(distance))
    lanes = seen[np.argsort(distance[seen], kind="stable")]
    groups: list[list[int]] = []
    for k in lanes:
        last = groups[-1][-1] if groups else None
        if last is not None and (distance[k] - distance[last] <= gap or plane[k] == plane[last]):
            groups[-1].append(k)
        else:
            groups.append([k])
    out = []
    for g in groups:
        received = light[g] / distance[g] ** 2
        mean = np.average(distance[g], weights=received)
        spread = np.sqrt(np.average((distance[g] - mean) ** 2, weights=received))
        out.append((float(mean), float(spread), float(light[g].sum() / len(distance))))
    return out


@given(st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_receiver_agrees_with_the_mixed_point_model(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lanes = int(rng.integers(1, 9))
    distance = rng.choice([5.0, 5.3, 5.55, 6.4, 9.0, np.inf], lanes) + rng.uniform(0, 0.05, lanes)
    triangle = np.where(np.isfinite(distance), rng.integers(0, 4, lanes), -1).astype(np.int32)
    light = rng.uniform(0.2, 1.0, lanes)
    returns = int(rng.integers(1, 4))
    receiver = Receiver(1000.0, 0.25, 1000.0, 0.0, 0.6, 1.5, returns)
    out = empty_echoes(1)
    receive(
        distance[None].astype(np.float32),
        triangle[None],
        light[None].astype(np.float32),
        np.array([0, 1, 2, 2], np.uint32),  # triangles 2 and 3 are one plane
        receiver,
        np.ones(1),
        out,
    )
    plane = np.array([0, 1, 2, 2, -1])[triangle]
    every = mixed_point_model(distance, light, plane, 0.6)
    strongest = sorted(sorted(every, key=lambda e: -e[2] / e[0] ** 2)[:returns])
    assert out.found[0] == len(strongest)
    for k, (mean, spread, power) in enumerate(strongest):
        np.testing.assert_allclose(
            [out.range_m[0, k], out.spread_m[0, k], out.light[0, k]],
            [mean, spread, power],
            rtol=1e-4,
            atol=2e-4,
        )
        assert out.number[0, k] == 1 + [e[0] for e in every].index(mean)


def test_range_at_which_an_echo_is_seen_is_the_data_sheets() -> None:
    for sensor, figures in (
        (LIDARS["avia"], {0.1: 190, 0.2: 230, 0.8: 320}),
        (LIDARS["mid360"], {0.1: 40, 0.8: 70}),
        (LIDARS["hdl64"], {0.1: 50, 0.8: 120}),
    ):
        for light, metres in figures.items():
            assert seen_m(light, sensor.spec.detect_m, sensor.spec.exponent) == pytest.approx(
                metres, rel=0.02
            )
        assert seen_m(0.025, sensor.spec.detect_m, 0.25) == pytest.approx(sensor.spec.detect_m / 2)


# --- scans


def still(x: float = 0.0) -> Motion:
    time = np.linspace(0, 1, 20)
    return Motion.through(time, np.tile([x, 0.0, 0.0], (20, 1)), np.zeros((20, 3)))


def take(scene: Scene, beams: Beams, spec: LidarSpec = IDEAL, motion: Motion | None = None) -> Frame:
    return scan(scene, motion or still(), np.eye(4), beams, 0.0, spec, np.random.default_rng(0))


def aimed(azimuth_deg: F64, elevation_deg: F64) -> Beams:
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    direction = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return Beams(np.zeros(len(a)), direction, np.zeros(len(a), np.uint8))


@pytest.fixture(scope="module")
def wall(atlas: TextureAtlas) -> Scene:
    """A wall at x = 10 m and a box in front of it."""
    builder = MeshBuilder(atlas.index)
    builder.begin("building")
    builder.add(box((10, -30, -30), (11, 30, 30)), "plaster_a")
    builder.begin("other")
    builder.add(box((5, -1, -1), (6, 1, 1)), "concrete")
    return prepare(builder.build(), atlas)


def test_noise_free_plane_and_reflectivity(wall: Scene) -> None:
    frame = take(wall, avia.beams(0))
    on_wall = wall.class_id[frame.triangle] == 2
    assert np.abs(frame.points[on_wall, 0] - 10).max() < 1e-4
    front = ~on_wall & (np.abs(frame.points[:, 1:]).max(axis=1) < 0.99)
    assert np.abs(frame.points[front, 0] - 5).max() < 1e-4
    assert frame.emitted == 24_000 and len(frame.points) == 24_000
    # 60 % of a white wall are 90 of 255
    assert np.median(frame.intensity[on_wall]) == pytest.approx(0.6 * 150 / 255 * 0.9, rel=0.15)
    np.testing.assert_allclose(frame.offset_ns, np.rint(avia.beams(0).time_s * 1e9), atol=1)
    assert set(frame.tag.tolist()) == {0x10} and not frame.mixed.any()


@pytest.mark.parametrize("name", ["avia", "mid360", "hdl64"])
def test_plane_fit_to_a_wall_has_the_configured_sigma(wall: Scene, name: str) -> None:
    """Defaults of every sensor, squarely on the wall; what is left beside the range noise is told apart."""
    spec = LIDARS[name].spec
    side = np.linspace(-3.0, 3.0, 120)
    azimuth, elevation = np.meshgrid(side, 25 + side)
    frame = take(wall, aimed(azimuth.ravel(), elevation.ravel()), spec)
    assert len(frame.points) == 14_400
    normal_error = frame.points[:, 0] - 10.0
    fit = np.column_stack([frame.points[:, 1:], np.ones(len(frame.points))])
    residual = normal_error - fit @ np.linalg.lstsq(fit, normal_error, rcond=None)[0]
    distance = 10 / np.cos(np.radians(25))
    # along the normal: range noise, the share of it from the slant, and the direction's error across
    stretch = spec.stretch_share * distance * spec.divergence_vertical / 2.355 * np.tan(np.radians(25))
    along = np.hypot(np.hypot(0.02, 0.02 * distance / 100), stretch) * np.cos(np.radians(25))
    across = spec.angular_noise * distance * np.sin(np.radians(25))
    assert residual.std() == pytest.approx(np.hypot(along, across), rel=0.03)
    assert abs(normal_error.mean()) < 1e-3


def test_range_noise_grows_with_distance_and_spread() -> None:
    spec = LidarSpec()
    straight = range_sigma(spec, np.array([20.0, 60.0, 100.0]), np.zeros(3))
    assert straight[0] == pytest.approx(0.02, rel=0.03)
    assert straight[2] == pytest.approx(0.02 * np.sqrt(2))
    slanted = range_sigma(spec, np.full(3, 20.0), np.array([0.0, 0.05, 0.3]))
    assert (np.diff(slanted) > 0).all()
    assert (range_sigma(IDEAL, np.array([20.0]), np.array([0.1])) == 0).all()


def step(atlas: TextureAtlas, gap: float) -> Scene:
    """A low wall at 10 m with its upper edge at the sensor's height, and a high one behind it."""
    return prepare(boxes(atlas, ((10, -9, -9), (10.1, 9, 0)), ((10 + gap, -9, -9), (11 + gap, 9, 9))), atlas)


NO_NOISE = LidarSpec(range_noise_m=0.0, angular_noise=0.0, fading=0.0)


@pytest.mark.parametrize("gap", [0.3, 3.0])
def test_edges_mix_within_the_resolution_and_split_beyond(atlas: TextureAtlas, gap: float) -> None:
    elevation = np.linspace(-0.4, 0.4, 801)
    beams = aimed(np.zeros(801), elevation)
    scene = step(atlas, gap)
    single, dual = take(scene, beams, NO_NOISE), take(scene, beams, replace(NO_NOISE, returns=2))
    # a spot of 0.28 degrees, sampled to 1.6 sigma, meets the edge within 0.19 degrees
    across = np.abs(elevation) < 0.18
    clear = np.abs(elevation) > 0.21
    between = (single.points[:, 0] > 10.01) & (single.points[:, 0] < 10 + gap - 0.01)
    assert len(single.points) == 801 and not between[clear].any()
    if gap < 0.6:
        assert between[across].mean() > 0.9 and single.mixed[across].mean() > 0.9
        assert len(dual.points) == 801
        middle = np.abs(elevation) < 0.005  # half of the light from each wall
        assert np.median(single.points[middle, 0]) == pytest.approx(10 + gap / 2, abs=0.03)
    else:
        assert not between.any()
        twice = np.flatnonzero(np.bincount(dual.beam) == 2)
        assert set(twice) <= set(np.flatnonzero(~clear)) and len(twice) > 0.9 * across.sum()
        first, second = dual.tag == 0x10, dual.tag == 0x20
        np.testing.assert_allclose(dual.points[second, 0], 13, atol=0.01)
        assert second.sum() == len(twice) and first.sum() == 801
        # the strongest: more of the spot on it, or nearer
        assert (single.points[elevation < -0.03, 0] < 10.1).all() and (
            single.points[elevation > 0.12, 0] > 12.9
        ).all()


def test_wires_thinner_than_the_spot_are_seen_in_part(atlas: TextureAtlas) -> None:
    """A horizontal wire of 1 cm at 10 m fills a fifth of the spot: dual return sees it and the wall behind."""
    scene = prepare(
        boxes(atlas, ((10, -9, -0.005), (10.01, 9, 0.005)), ((20, -30, -30), (21, 30, 30))), atlas
    )
    elevation = np.linspace(-0.2, 0.2, 401)
    dual = take(scene, aimed(np.zeros(401), elevation), replace(NO_NOISE, returns=2))
    wire = dual.points[:, 0] < 11
    assert wire.sum() > 150  # a single ray would hit it in 57 of 401
    assert (np.bincount(dual.beam[~wire], minlength=401) == 1).mean() > 0.95


def test_glass_is_passed_and_only_a_square_hit_returns(atlas: TextureAtlas) -> None:
    builder = MeshBuilder(atlas.index)
    builder.begin("glass")
    builder.add(box((8, -30, -30), (8.02, 30, 30)), "pane")
    builder.begin("building")
    builder.add(box((10, -30, -30), (11, 0, 30)), "plaster_a")
    frame = take(prepare(builder.build(), atlas), avia.beams(0))
    direction = avia.beams(0).direction[frame.beam]
    square = direction[:, 0] > np.cos(np.radians(0.9))
    assert (frame.points[square, 0] < 8.1).all() and square.any()
    slanted = direction[:, 0] < np.cos(np.radians(1.1))
    np.testing.assert_allclose(frame.points[slanted, 0], 10, atol=1e-3)
    assert (direction[slanted, 1] < 0).all()  # behind the other half there is nothing
    assert frame.intensity[square].min() == 1.0


def test_retro_reflectors_saturate_and_are_seen_slanted_and_far(atlas: TextureAtlas) -> None:
    builder = MeshBuilder(atlas.index)
    builder.begin("sign")
    builder.add(box((300, -30, -30), (301, 30, 30)), "road_sign_0")
    frame = take(prepare(builder.build(), atlas), aimed(np.linspace(-4, 4, 50), np.zeros(50)))
    assert len(frame.points) == 50 and (frame.intensity == 1.0).all()


def test_nothing_returns_from_the_sky_or_from_too_far(atlas: TextureAtlas) -> None:
    builder = MeshBuilder(atlas.index)
    builder.begin("building")
    builder.add(box((300, -300, -300), (301, 300, 300)), "rubber")
    scene = prepare(builder.build(), atlas)
    frame = take(scene, avia.beams(0))
    # 6 % reflectivity is seen to 190 m * sqrt(0.06 / 0.1) = 147 m
    assert len(frame.points) == 0 and frame.emitted == 24_000
    assert len(take(scene, avia.beams(0), motion=still(200.0)).points) > 1_000
    # near the limit some are lost: 6 % at 147 m
    faded = replace(IDEAL, fading=0.05)
    share = len(take(scene, aimed(np.zeros(4000), np.zeros(4000)), faded, still(300 - 147.2)).points) / 4000
    assert 0.1 < share < 0.9


@pytest.mark.parametrize(("distance", "tag"), [(0.95, None), (1.2, 0x00), (1.6, 0x10)])
def test_near_echoes_are_blind_or_merged(atlas: TextureAtlas, distance: float, tag: int | None) -> None:
    scene = prepare(boxes(atlas, ((distance, -1, -1), (distance + 1, 1, 1))), atlas)
    frame = take(scene, aimed(np.zeros(5), np.zeros(5)))
    assert frame.tag.tolist() == ([] if tag is None else [tag] * 5)


def test_points_are_measured_from_where_the_sensor_was(wall: Scene) -> None:
    time = np.linspace(0, 1, 30)
    position = np.column_stack([3.0 * time, 0 * time, 0 * time])
    moving = Motion.through(time, position, np.column_stack([0.5 * time, 0 * time, 0 * time]))
    frame = take(wall, avia.beams(0), motion=moving)
    T = moving.pose(frame.offset_ns * 1e-9)
    world = np.einsum("nij,nj->ni", T[:, :3, :3], frame.points) + T[:, :3, 3]
    np.testing.assert_allclose(world, frame.hit, atol=2e-4)
    raw = frame.points[wall.class_id[frame.triangle] == 2]
    assert raw[:, 0].max() - raw[:, 0].min() > 0.25  # uncorrected, the wall is no plane


def test_movers_are_met_where_they_are(atlas: TextureAtlas) -> None:
    """A box that passes sideways at 10 m/s: its points lie on its front at each point's own time."""
    mover = Mover(boxes(atlas, ((-0.5, -2, -2), (0.5, 2, 2))), gliding((0, 10, 0), 0.0, (8, -1, 0)))
    scene = prepare(boxes(atlas, ((30, -40, -40), (31, 40, 40))), atlas, (mover,))
    frame = take(scene, avia.beams(0))
    on_it = frame.triangle >= scene.movers[0].first
    assert on_it.sum() > 3000
    offset = frame.hit[on_it, 1] - (-1 + 10 * frame.offset_ns[on_it] * 1e-9)
    front = frame.points[on_it, 0] < 7.51
    assert np.abs(offset).max() < 2.001 and front.mean() > 0.9
    assert offset[front].max() > 1.9 and offset[front].min() < -1.9


def test_direction_noise_turns_across_the_beam() -> None:
    rng = np.random.default_rng(5)
    direction = rng.normal(size=(300, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction[0] = 0, 0, 1
    angle = rng.normal(0, 0.01, (300, 2))
    turned = _jittered(direction, angle)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1.0)
    away = np.arccos(np.clip((turned * direction).sum(axis=1), -1, 1))
    np.testing.assert_allclose(away, np.arctan(np.hypot(*angle.T)), atol=1e-7)
    up = _jittered(direction, np.column_stack([0 * angle[:, 1], angle[:, 1]]))[1:]
    lifted = np.arcsin(up[:, 2]) - np.arcsin(direction[1:, 2])
    np.testing.assert_allclose(lifted, np.arctan(angle[1:, 1]), atol=1e-6)


def test_poses_between_knots_are_those_of_the_motion() -> None:
    time = np.linspace(0, 2, 60)
    wild = Motion.through(
        time,
        np.column_stack([np.sin(3 * time), np.cos(2 * time), 0.1 * np.sin(9 * time)]),
        np.column_stack([2 * np.sin(2 * time), 0.3 * np.sin(7 * time), 0.2 * np.cos(5 * time)]),
    )
    T_body_lidar = np.eye(4)
    T_body_lidar[:3, 3] = 0.1, 0.2, 0.3
    t = np.random.default_rng(0).uniform(0, 0.1, 500)
    origin, R = poses_at(wild, T_body_lidar, 1.3, t)
    exact = wild.pose(1.3 + t) @ T_body_lidar
    np.testing.assert_allclose(origin, exact[:, :3, 3], atol=3e-6)
    np.testing.assert_allclose(R, exact[:, :3, :3], atol=5e-6)
    assert np.isnan(poses_at(wild, T_body_lidar, 0.0, np.array([0.0, np.nan]))[0][1]).all()


def test_scans_are_reproducible_and_noise_is_each_beams_own(wall: Scene) -> None:
    spec, beams = replace(LidarSpec(), returns=2), avia.beams(2, 0.2)
    one, two = take(wall, beams, spec), take(wall, beams, spec)
    for name in Frame.__slots__:
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    empty = prepare(MeshBuilder({}).build(), build_atlas(0))
    nothing = take(empty, beams, spec)
    assert len(nothing.points) == 0 and nothing.emitted == len(beams.line)


def test_a_lidar_has_one_to_three_returns() -> None:
    with pytest.raises(ValueError, match="1 to 3 returns"):
        LidarSpec(returns=4)


# --- patterns


def test_prisms_agree_with_snells_law_in_vectors() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        d, n = rng.normal(size=3), rng.normal(size=3)
        d, n = d / np.linalg.norm(d), n / np.linalg.norm(n)
        n = -n if n @ d > 0 else n
        out = np.array(refract(tuple(d), tuple(n), 1 / 1.51))
        assert np.linalg.norm(out) == pytest.approx(1.0)
        assert np.linalg.norm(np.cross(n, out)) * 1.51 == pytest.approx(np.linalg.norm(np.cross(n, d)))
        assert abs(np.dot(np.cross(n, d), out)) < 1e-12 and out @ d > 0


def test_deflect_agrees_with_surfaces_one_by_one() -> None:
    """Slow twin: every face as a rotated normal, Snell's law with angles."""
    rng = np.random.default_rng(1)
    wedge, rate, time = np.array([0.3, 0.2, 0.05]), np.array([-90.0, 41.0, 200.0]), rng.uniform(0, 1, 60)
    laser = np.array([[1.0, 0.0, 0.0], [np.cos(0.05), 0.0, np.sin(0.05)]])
    which = rng.integers(0, 2, 60)
    out = np.empty((60, 3))
    deflect(wedge, rate, 1.51, laser, which, time, out)
    for t, w, got in zip(time, which, out, strict=True):
        d = laser[w]
        for slope, turns in zip(wedge, rate, strict=True):
            tilted = Rotation.from_rotvec([2 * np.pi * turns * t, 0, 0]).apply(
                [np.cos(slope), np.sin(slope), 0]
            )
            d = bent(bent(d, tilted, 1.0, 1.51), np.array([1.0, 0, 0]), 1.51, 1.0)
        np.testing.assert_allclose(got, d, atol=1e-12)


def bent(d: F64, along: F64, index_from: float, index_to: float) -> F64:
    """Refraction by turning the ray within the plane of incidence; ``along`` is the normal it goes along."""
    axis = np.cross(along, d)
    sine = np.linalg.norm(axis)
    if sine < 1e-15:
        return d
    angle = np.arcsin(index_from / index_to * sine)
    return np.asarray(Rotation.from_rotvec(axis / sine * angle).apply(along))


def test_prisms_with_published_figures_fill_the_published_field_of_view() -> None:
    """The Mid-40: wedges and rates of HELIOS++ and Brazeal et al.; its sheet states a circle of 38.4 degrees."""
    time = np.arange(200_000) / 100_000
    out = np.empty((len(time), 3))
    laser = np.array([[1.0, 0, 0]])
    which = np.zeros(len(time), np.int64)
    deflect(np.radians([18.7481, 17.9634]), np.array([-121.5657, 77.7430]), 1.51, laser, which, time, out)
    assert 2 * np.degrees(np.arccos(out[:, 0].min())) == pytest.approx(38.4, abs=0.15)


@pytest.mark.parametrize("name", ["avia", "mid360", "hdl64"])
def test_counts_lines_and_times_are_exact(name: str) -> None:
    sensor = LIDARS[name]
    frames = [sensor.beams(k, 1.0) for k in range(10)]
    assert sum(len(f.time_s) for f in frames) == pytest.approx(sensor.points_per_second, abs=1)
    time = np.concatenate([k * sensor.frame_s + f.time_s for k, f in enumerate(frames)])
    np.testing.assert_allclose(np.diff(time), 1 / sensor.points_per_second, rtol=1e-5)
    line = np.concatenate([f.line for f in frames])
    np.testing.assert_array_equal(line, np.arange(len(line)) % sensor.lines)
    for f in frames:
        assert f.time_s.min() >= 0 and f.time_s.max() <= sensor.frame_s
        np.testing.assert_allclose(np.linalg.norm(f.direction, axis=1), 1.0)


@pytest.mark.parametrize("name", ["avia", "mid360", "hdl64"])
@pytest.mark.parametrize("density", [0.1, 0.25, 0.9])
def test_density_keeps_whole_volleys(name: str, density: float) -> None:
    sensor = LIDARS[name]
    beams, full = sensor.beams(4, density), sensor.beams(4, 1.0)
    assert len(beams.line) == pytest.approx(len(full.line) * density, abs=sensor.lines)
    assert np.ptp(np.bincount(beams.line)) <= 1
    rows = np.searchsorted(full.time_s, beams.time_s)
    np.testing.assert_array_equal(full.direction[rows], beams.direction)


def angles(name: str, frames: range) -> tuple[F64, F64]:
    d = np.concatenate([LIDARS[name].beams(k, 1.0).direction for k in frames])
    return np.degrees(np.arctan2(d[:, 1], d[:, 0])), np.degrees(np.arcsin(d[:, 2]))


def test_avia_field_of_view() -> None:
    azimuth, elevation = angles("avia", range(30))
    assert np.ptp(azimuth[np.abs(elevation) < 2]) == pytest.approx(70.4, abs=0.3)
    assert np.ptp(elevation[np.abs(azimuth) < 3]) == pytest.approx(77.2, abs=0.5)


def test_mid360_field_of_view_and_published_shots() -> None:
    azimuth, elevation = angles("mid360", range(10))
    assert elevation.min() == pytest.approx(-7, abs=0.3) and elevation.max() == pytest.approx(52, abs=0.3)
    counts = np.histogram(azimuth, 36, (-180, 180))[0]
    assert counts.min() > 0.9 * counts.max()
    # figures of Livox' table: azimuth and zenith at 0, 1.405, 34.14 and 200.085 ms
    for time, line, published in (
        (0.0, 0, (268.99, 37.838)),
        (0.001405, 0, (184.22, 42.385)),
        (0.03414, 1, (212.08, 80.45)),
        (0.20008, 3, (91.12, 37.838)),
        (0.203445, 0, (241.75, 40.1)),
    ):
        d = mid360.direction(np.array([time]), np.array([line]))[0]
        zenith, turn = np.degrees(np.arccos(d[2])), np.degrees(np.arctan2(d[1], d[0]))
        assert zenith == pytest.approx(published[1], abs=1.0)
        assert abs((turn - published[0] + 180) % 360 - 180) < 4


def test_hdl64_field_of_view_and_step() -> None:
    azimuth, elevation = angles("hdl64", range(1))
    assert (elevation.min(), elevation.max()) == (pytest.approx(-24.8), pytest.approx(2.0))
    one_laser = azimuth[::64]
    np.testing.assert_allclose(np.abs(np.diff(np.unwrap(one_laser, period=360))), 0.1728, atol=1e-9)
    assert np.ptp(azimuth) > 359.9


def test_rosettes_do_not_repeat_and_fill_their_field_of_view() -> None:
    for name in ("avia", "mid360"):
        filled = []
        for frames in (range(1), range(3), range(10)):
            grid = np.floor(np.column_stack(angles(name, frames)) / 0.5)
            filled.append(len(np.unique(grid, axis=0)))
        assert filled[0] < 0.85 * filled[1] < 0.85 * 1.15 * filled[2]
        first, second = (LIDARS[name].beams(k, 1.0).direction for k in range(2))
        assert not np.allclose(first, second, atol=1e-2)
