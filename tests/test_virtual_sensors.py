"""The virtual Avia, IMU, walk and camera against what they must be exactly."""

from __future__ import annotations

import numpy as np
import pytest
from artemis_drivers.virtual import avia, street
from artemis_drivers.virtual.camera import CameraSpec, VirtualCamera, distort, undistort
from artemis_drivers.virtual.imu import GRAVITY, ImuSpec, measure
from artemis_drivers.virtual.lidar import Beams, Frame, LidarSpec, range_sigma, scan
from artemis_drivers.virtual.mesh_builder import F64, MeshBuilder
from artemis_drivers.virtual.motion import Motion, rotation
from artemis_drivers.virtual.observable import REACH_M, HitStore, observed_surface
from artemis_drivers.virtual.raycast import cast
from artemis_drivers.virtual.scene import Scene, Window, prepare
from artemis_drivers.virtual.shapes import box, pose
from artemis_drivers.virtual.textures import TextureAtlas, build_atlas
from artemis_drivers.virtual.walk import Gait, path_needed_m, walk
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from artemis_edge.session.simulate import rasterise

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


# --- Avia


def test_avia_counts_lines_and_times_are_exact() -> None:
    frames = [avia.beams(k) for k in range(10)]
    assert [len(f.time_s) for f in frames] == [24_000] * 10
    assert np.bincount(frames[3].line).tolist() == [4_000] * 6
    np.testing.assert_array_equal(frames[0].line, np.arange(24_000) % 6)
    np.testing.assert_allclose(np.diff(frames[0].time_s), 1 / 240_000, rtol=1e-9)
    assert frames[0].time_s[0] == 0 and frames[0].time_s[-1] < 0.1


@pytest.mark.parametrize("density", [0.1, 0.25, 0.5, 0.9])
def test_avia_density_keeps_whole_volleys(density: float) -> None:
    beams = avia.beams(4, density)
    assert len(beams.line) == pytest.approx(24_000 * density, abs=6)
    assert len(set(np.bincount(beams.line).tolist())) == 1
    full = avia.beams(4)
    rows = np.searchsorted(full.time_s, beams.time_s)
    np.testing.assert_array_equal(full.direction[rows], beams.direction)


def test_avia_field_of_view() -> None:
    direction = np.concatenate([avia.beams(k).direction for k in range(30)])
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0)
    elevation = np.degrees(np.arcsin(direction[:, 2]))
    level = np.abs(elevation) < 2
    azimuth = np.degrees(np.arctan2(direction[level, 1], direction[level, 0]))
    assert np.ptp(azimuth) == pytest.approx(70.4, abs=0.5)
    ahead = np.abs(np.degrees(np.arctan2(direction[:, 1], direction[:, 0]))) < 3
    assert np.ptp(elevation[ahead]) == pytest.approx(77.2, abs=0.7)
    assert elevation.max() <= 38.6 + 1e-6 and elevation.min() >= -38.6 - 1e-6


def test_avia_does_not_repeat_and_fills_its_field_of_view() -> None:
    def cells(frames: range) -> int:
        d = np.concatenate([avia.beams(k).direction for k in frames])
        grid = np.floor(np.degrees(np.column_stack([np.arctan2(d[:, 1], d[:, 0]), np.arcsin(d[:, 2])])) / 0.5)
        return len(np.unique(grid, axis=0))

    one, three, ten = cells(range(1)), cells(range(3)), cells(range(10))
    assert one < 0.85 * three < 0.85 * 1.15 * ten
    assert not np.allclose(avia.beams(0).direction, avia.beams(1).direction, atol=1e-2)


# --- LiDAR


def test_noise_free_plane_and_reflectivity(wall: Scene) -> None:
    frame = take(wall, avia.beams(0))
    on_wall = wall.mesh.class_id[frame.triangle] == 2
    assert np.abs(frame.points[on_wall, 0] - 10).max() < 1e-4
    front = ~on_wall & (np.abs(frame.points[:, 1:]).max(axis=1) < 0.99)
    assert np.abs(frame.points[front, 0] - 5).max() < 1e-4
    assert frame.emitted == 24_000 and len(frame.points) == 24_000
    assert 0.4 < np.median(frame.intensity[on_wall]) < 0.8
    np.testing.assert_allclose(frame.offset_ns, np.rint(avia.beams(0).time_s * 1e9), atol=1)


def test_range_noise_has_the_stated_sigma(wall: Scene) -> None:
    beams = avia.beams(0)
    ahead = beams.direction[:, 0] > 0.99
    aimed = Beams(beams.time_s[ahead], beams.direction[ahead], beams.line[ahead])
    frame = take(wall, aimed, LidarSpec(angular_noise=0.0))
    error = np.linalg.norm(frame.points, axis=1) - np.linalg.norm(frame.hit - frame.origin, axis=1)
    assert error.std() == pytest.approx(0.02, rel=0.05)
    assert abs(error.mean()) < 0.001


def test_range_noise_grows_with_distance_and_slant() -> None:
    spec = LidarSpec()
    straight = range_sigma(spec, np.array([20.0, 60.0, 100.0]), np.ones(3))
    assert straight[0] == pytest.approx(0.02, rel=0.03)
    assert (np.diff(straight) > 0).all()
    slanted = range_sigma(spec, np.full(3, 20.0), np.array([1.0, 0.5, 0.1]))
    assert (np.diff(slanted) > 0).all()
    assert np.isfinite(range_sigma(spec, np.array([20.0]), np.array([0.0]))).all()


def test_nothing_returns_from_the_sky_or_from_too_far(atlas: TextureAtlas) -> None:
    builder = MeshBuilder(atlas.index)
    builder.begin("building")
    builder.add(box((300, -300, -300), (301, 300, 300)), "rubber")
    scene = prepare(builder.build(), atlas)
    frame = take(scene, avia.beams(0))
    # 6 % reflectivity is seen to 190 m * sqrt(0.06 / 0.1) = 147 m
    assert len(frame.points) == 0 and frame.emitted == 24_000
    assert len(take(scene, avia.beams(0), motion=still(200.0)).points) > 1_000


def test_points_are_measured_from_where_the_sensor_was(wall: Scene) -> None:
    time = np.linspace(0, 1, 30)
    position = np.column_stack([3.0 * time, 0 * time, 0 * time])
    moving = Motion.through(time, position, np.column_stack([0.5 * time, 0 * time, 0 * time]))
    frame = take(wall, avia.beams(0), motion=moving)
    T = moving.pose(frame.offset_ns * 1e-9)
    world = np.einsum("nij,nj->ni", T[:, :3, :3], frame.points) + T[:, :3, 3]
    np.testing.assert_allclose(world, frame.hit, atol=2e-4)
    raw = frame.points[wall.mesh.class_id[frame.triangle] == 2]
    assert raw[:, 0].max() - raw[:, 0].min() > 0.25  # uncorrected, the wall is no plane


def test_trees_let_about_half_of_the_beams_through(atlas: TextureAtlas) -> None:
    from artemis_drivers.virtual.furniture import add_tree

    shares = []
    for seed in range(4):
        builder = MeshBuilder(atlas.index)
        add_tree(builder, np.random.default_rng(seed), np.eye(4))
        mesh = builder.build()
        leaf = mesh.material == atlas.index["leaf"]
        middle = mesh.corners()[leaf].mean(axis=(0, 1)).astype(np.float64)
        offset = np.random.default_rng(seed).uniform(-0.6, 0.6, (2000, 3))
        origin = middle + np.array([-20.0, 0, 0]) + offset
        hits = cast(prepare(mesh, atlas).bvh, origin, np.tile([1.0, 0, 0], (2000, 1)))
        shares.append(np.mean(hits.triangle >= 0))
    assert 0.35 < np.mean(shares) < 0.75


# --- motion and IMU


def test_angular_velocity_and_acceleration_are_the_derivatives() -> None:
    motion = walk(street.build(1, 100.0, None).path, 12.0, 1)
    t, h = np.linspace(1.2, 11, 60), 1e-4
    before, after = motion.pose(t - h), motion.pose(t + h)
    turn = Rotation.from_matrix(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]).as_rotvec()
    np.testing.assert_allclose(motion.angular_velocity(t), turn / (2 * h), atol=1e-5)
    np.testing.assert_allclose(motion.velocity(t), (after[:, :3, 3] - before[:, :3, 3]) / (2 * h), atol=1e-5)
    np.testing.assert_allclose(
        motion.acceleration(t), (motion.velocity(t + h) - motion.velocity(t - h)) / (2 * h), atol=1e-4
    )


def test_rotation_convention() -> None:
    angles = np.array([[0.3, -0.2, 0.1]])
    np.testing.assert_allclose(rotation(angles)[0], Rotation.from_euler("ZYX", angles[0]).as_matrix())


def test_walk_stands_still_level_then_walks() -> None:
    world = street.build(2, 100.0)
    motion = walk(world.path, 20.0, 2)
    early = np.arange(0, 1.0, 0.01)
    assert np.ptp(motion.position(early), axis=0).max() < 1e-6
    assert np.abs(motion.angles(early)[:, 1:]).max() < 1e-7
    travelled = np.linalg.norm(np.diff(motion.position(np.arange(0, 20, 0.1))[:, :2], axis=0), axis=1).sum()
    assert travelled == pytest.approx(1.2 * (20 - 1.75), rel=0.1)
    walking = np.arange(4, 20, 0.01)
    bob = motion.position(walking)[:, 2]
    spectrum = np.abs(np.fft.rfft(bob - np.poly1d(np.polyfit(walking, bob, 6))(walking)))
    frequency = np.fft.rfftfreq(len(walking), 0.01)
    assert frequency[np.argmax(spectrum * (frequency > 1))] == pytest.approx(2.0, abs=0.1)
    assert np.ptp(np.degrees(motion.angles(walking)[:, 0])) > 60  # looks to both sides


def test_walk_needs_a_path_long_enough() -> None:
    path = np.column_stack([np.linspace(0, 10, 40), np.zeros(40), np.ones(40)])
    with pytest.raises(ValueError, match="too short"):
        walk(path, 60.0, 0)
    seconds = 30.0
    straight = np.column_stack([np.linspace(0, path_needed_m(seconds), 200), np.zeros(200), np.ones(200)])
    assert walk(straight, seconds, 0, Gait()).duration_s >= seconds


def integrate(record_time: F64, gyro: F64, accel: F64, start: F64, velocity: F64) -> F64:
    """Poses at the samples: both signals as splines, Runge-Kutta of the attitude, quadrature of the force."""
    step = record_time[1]
    rate = make_interp_spline(record_time, gyro, 5)
    force = make_interp_spline(record_time, accel, 5)
    q = Rotation.from_matrix(start[:3, :3])
    p, v = start[:3, 3].copy(), velocity.copy()
    down = np.array([0.0, 0.0, -GRAVITY])
    nodes, weights = np.polynomial.legendre.leggauss(3)
    out = [start]
    for t in record_time[:-1]:
        share = (nodes + 1) / 2
        half = [_turned(q, rate, t, s * step) for s in share]
        pull = np.array([r.apply(force(t + s * step)) + down for r, s in zip(half, share, strict=True)])
        w = weights / 2
        p = p + v * step + step**2 * ((1 - share) * w) @ pull
        v = v + step * w @ pull
        q = _turned(q, rate, t, step)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = q.as_matrix(), p
        out.append(T)
    return np.array(out)


def _turned(q: Rotation, rate, t: float, h: float) -> Rotation:  # type: ignore[no-untyped-def]
    """Attitude after h: fourth-order Magnus step (Iserles & Norsett 1999)."""
    c = np.sqrt(3) / 6
    a, b = rate(t + (0.5 - c) * h), rate(t + (0.5 + c) * h)
    return q * Rotation.from_rotvec(h * (a + b) / 2 + np.sqrt(3) / 12 * h**2 * np.cross(a, b))


def test_integrating_the_ideal_imu_gives_the_true_trajectory() -> None:
    motion = walk(street.build(4, 100.0).path, 21.0, 4)
    record = measure(motion, ImuSpec().scaled(0.0), 4, 20.0)
    assert len(record.time_s) == 4001
    poses = integrate(record.time_s, record.gyro, record.accel, motion.pose(0.0)[0], motion.velocity(0.0)[0])
    truth = motion.pose(record.time_s)
    assert np.abs(poses[:, :3, 3] - truth[:, :3, 3]).max() < 1e-3
    wrong = record.gyro + np.array([0.0, 1e-4, 0.0])  # the test must be able to fail
    part = slice(0, 1201)
    drift = integrate(record.time_s[part], wrong[part], record.accel[part], truth[0], motion.velocity(0.0)[0])
    assert np.abs(drift[:, :3, 3] - truth[part, :3, 3]).max() > 5e-3


def test_imu_at_rest_measures_gravity_upwards_and_the_stated_noise() -> None:
    time = np.linspace(0, 200, 400)
    rest = Motion.through(time, np.zeros((400, 3)), np.zeros((400, 3)))
    ideal = measure(rest, ImuSpec().scaled(0.0), 0, 1.0)
    np.testing.assert_allclose(ideal.accel, np.tile([0, 0, GRAVITY], (201, 1)), atol=1e-12)
    np.testing.assert_allclose(ideal.gyro, 0.0, atol=1e-12)
    spec = ImuSpec()
    record = measure(rest, spec, 0, 199.0)
    white = record.gyro - record.gyro_bias
    np.testing.assert_allclose(white.std(axis=0), spec.gyro_noise * np.sqrt(200), rtol=0.02)
    step = np.diff(record.accel_bias, axis=0)
    np.testing.assert_allclose(step.std(axis=0), spec.accel_walk / np.sqrt(200), rtol=0.02)


# --- camera


def test_undistort_inverts_distort() -> None:
    spec = CameraSpec()
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.75, 0.75, 500), rng.uniform(-0.6, 0.6, 500)
    xd, yd = distort(x, y, spec.distortion)
    np.testing.assert_allclose(undistort(xd, yd, spec.distortion), (x, y), atol=1e-9)


def test_camera_agrees_with_the_ray_caster(atlas: TextureAtlas) -> None:
    """The triangles seen through lens and rasteriser are those the exact rays meet, but for silhouettes."""
    world = street.build(6, 80.0, atlas)
    scene = Window(world, 100.0).at(20.0)
    camera = VirtualCamera(CameraSpec().scaled(160), rasterise, 6)
    axes = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    T = pose(20.0, 0.0, 1.6, yaw=0.7)
    T[:3, :3] = T[:3, :3] @ axes
    light = camera.render(scene, world.sun, T)
    assert light.shape == (128, 160, 3) and np.isfinite(light).all() and light.min() >= 0
    T_local = T.copy()
    T_local[:3, 3] -= scene.origin
    local = (scene.mesh.vertices - scene.origin).astype(np.float32)
    ids, _ = rasterise(
        local, scene.mesh.triangles, np.linalg.inv(T_local), camera.canvas_view, camera.canvas_size, False
    )
    seen = ids.reshape(-1)[camera.canvas[..., 0]].reshape(-1)
    line = camera.lines[:, :, 0].reshape(-1, 2).astype(np.float64)
    ray = np.column_stack([line, np.ones(len(line))])
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True) @ T[:3, :3].T
    hits = cast(scene.bvh, np.tile(T[:3, 3], (len(ray), 1)), ray)
    key = np.append(scene.surface.key, 0)
    exact = key[hits.triangle].reshape(128, 160)
    around = np.stack([np.roll(exact, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    inside = (around == exact).all(axis=0)
    wrong = key[seen].reshape(128, 160) != exact
    assert inside.mean() > 0.4
    assert np.mean(wrong[inside]) < 1e-3
    assert np.mean(wrong) < 0.15  # borders: the canvas has two pixels for one


def test_photographs_are_reproducible_and_noisy(atlas: TextureAtlas) -> None:
    world = street.build(6, 80.0, atlas)
    scene = Window(world, 100.0).at(20.0)
    axes = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    T = pose(20.0, 0.0, 1.6)
    T[:3, :3] = T[:3, :3] @ axes
    first, second = (VirtualCamera(CameraSpec().scaled(96), rasterise, 6) for _ in range(2))
    one, two = first.photograph(scene, world.sun, T, 0), second.photograph(scene, world.sun, T, 0)
    assert one == two and one[:2] == b"\xff\xd8"
    light = first.render(scene, world.sun, T)
    difference = first.develop(light, 0).astype(float) - first.develop(light, 1)
    assert difference.std() == pytest.approx(1.5 * np.sqrt(2), rel=0.15)


def test_scaled_camera_sees_the_same(atlas: TextureAtlas) -> None:
    full, half = CameraSpec(), CameraSpec().scaled(640)
    # corner of the first pixel
    assert (-0.5 - full.cx) / full.fx == pytest.approx((-0.5 - half.cx) / half.fx)
    assert (full.width - 0.5 - full.cx) / full.fx == pytest.approx((half.width - 0.5 - half.cx) / half.fx)
    assert (half.width, half.height) == (640, 512)


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
    store.thin()
    assert store.hit[:, 0].tolist() == [1.02, 5.0, 1.03]
    store.thin()
    assert len(store.hit) == 3
