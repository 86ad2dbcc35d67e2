"""The virtual camera: scan conversion, textures, light, blur, noise, exposure control, true views."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from artemis_drivers.virtual import sensor, street
from artemis_drivers.virtual.camera import CameraSpec, VirtualCamera, distort, undistort
from artemis_drivers.virtual.mesh_builder import F64, MeshBuilder
from artemis_drivers.virtual.motion import Motion
from artemis_drivers.virtual.scene import Scene, Window, cast_at, local_rays, prepare
from artemis_drivers.virtual.sensor import (
    REFERENCE,
    AutoExposure,
    Exposure,
    Optics,
    SensorSpec,
    amplifier,
    developed,
    expose,
    metered,
)
from artemis_drivers.virtual.shading import Film, sample
from artemis_drivers.virtual.shapes import box, pose
from artemis_drivers.virtual.spans import NOTHING, View, draw, new_canvas
from artemis_drivers.virtual.textures import LEVELS, MACRO, MACRO_M, SIZE, TextureAtlas, build_atlas
from artemis_drivers.virtual.true_view import truth_images
from artemis_drivers.virtual.world import Mover, World

from artemis_edge.frames import CameraModel
from artemis_edge.render import perspective as pinhole
from artemis_edge.render import render, render_camera

AXES = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
SUN = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])


@pytest.fixture(scope="module")
def atlas() -> TextureAtlas:
    return build_atlas(0)


@pytest.fixture(scope="module")
def town(atlas: TextureAtlas) -> tuple[World, Scene]:
    world = street.build(6, 80.0, atlas)
    return world, Window(world, 100.0).at(20.0)


def looking(x: float, y: float, z: float, yaw: float = 0.0) -> F64:
    T = pose(x, y, z, yaw=yaw)
    T[:3, :3] = T[:3, :3] @ AXES
    return T


# --- scan conversion


def naive_draw(view: View, T: F64, vertices: F64, triangles: F64, size: tuple[int, int]) -> F64:
    """Per pixel the nearest front face that the exact line of sight meets."""
    out = np.full((size[1], size[0]), NOTHING)
    best = np.full((size[1], size[0]), np.inf)
    p = vertices @ T[:3, :3].T + T[:3, 3]
    v, u = np.mgrid[0 : size[1], 0 : size[0]]
    if view.orthographic:
        origin = np.stack([(u - view.cx) / view.fx, (v - view.cy) / view.fy, 0 * u - 1e3], axis=2)
        ray = np.broadcast_to([0.0, 0.0, 1.0], origin.shape)
    else:
        origin = np.zeros((*u.shape, 3))
        ray = np.stack([(u - view.cx) / view.fx, (v - view.cy) / view.fy, 1.0 + 0 * u], axis=2)
    for k, (a, b, c) in enumerate(p[triangles]):
        normal = np.cross(b - a, c - a)
        with np.errstate(all="ignore"):
            s = ((a - origin) @ normal) / (ray @ normal)
        hit = origin + s[..., None] * ray
        inside = (ray @ normal < 0) & (view.orthographic | (hit[..., 2] >= 0.05))
        for e, f in ((a, b), (b, c), (c, a)):
            inside &= np.cross(f - e, hit - e) @ normal >= 0
        nearer = inside & (hit[..., 2] < best)
        out[nearer], best[nearer] = k, hit[..., 2][nearer]
    return out


@pytest.mark.parametrize("orthographic", [False, True])
def test_scan_conversion_agrees_with_exact_rays(orthographic: bool) -> None:
    rng = np.random.default_rng(3)
    centre = rng.uniform([-3, -3, -1], [3, 3, 9], (120, 1, 3))
    vertices = (centre + rng.normal(0, 1.0, (120, 3, 3))).reshape(-1, 3).astype(np.float32)
    triangles = np.arange(360, dtype=np.int32).reshape(-1, 3)
    view = View(9.0, 9.0, 31.3, 23.1, True) if orthographic else View(50.0, 50.0, 31.3, 23.1, False)
    canvas = new_canvas(64, 48)
    draw(canvas, view, np.eye(4), vertices, triangles, np.arange(120, dtype=np.int32), 7)
    expected = naive_draw(view, np.eye(4), vertices.astype(np.float64), triangles, (64, 48))
    got = np.where(canvas.triangle == NOTHING, NOTHING, canvas.triangle - 7)
    assert (expected != NOTHING).mean() > 0.4
    assert np.mean(got != expected) < 2e-3  # pixel centres on an edge within rounding


def test_neighbouring_triangles_leave_no_gap_and_do_not_overlap() -> None:
    """Pixel centres on common edges included: every pixel of a square belongs to one triangle."""
    vertices = np.array([[0, 0, 1], [40, 0, 1], [40, 40, 1], [0, 40, 1], [20, 20, 1]], np.float32)
    triangles = np.array([[0, 4, 1], [1, 4, 2], [2, 4, 3], [3, 4, 0]], np.int32)
    count = np.zeros((48, 48), int)
    for k in range(4):
        canvas = new_canvas(48, 48)
        draw(
            canvas,
            View(1, 1, 2.0, 2.0, True),
            np.eye(4),
            vertices,
            triangles[k : k + 1],
            np.zeros(1, np.int32),
            0,
        )
        count += canvas.triangle >= 0
    assert (count[2:42, 2:42] == 1).all() and count.sum() == 1600


def test_degenerate_triangles_are_not_drawn() -> None:
    vertices = np.array([[0, 0, 2], [1, 1, 2], [2, 2, 2], [np.nan, 0, 1], [0, 1, -4], [1, 0, -4]], np.float32)
    triangles = np.array([[0, 1, 2], [0, 0, 1], [0, 3, 1], [4, 5, 4]], np.int32)
    canvas = new_canvas(16, 16)
    draw(canvas, View(4, 4, 2, 2, False), np.eye(4), vertices, triangles, np.arange(4, dtype=np.int32), 0)
    assert (canvas.triangle == NOTHING).all()
    draw(canvas, View(4, 4, 2, 2, False), np.eye(4), vertices, triangles, np.empty(0, np.int32), 0)
    assert (canvas.triangle == NOTHING).all()


# --- textures


def naive_sample(atlas: TextureAtlas, m: int, u: float, v: float, lod: float) -> F64:
    """Trilinear with the middle half of the way between two levels mixed."""
    a = atlas.arrays
    lod = min(max(lod, 0.0), LEVELS - 1.001)
    level = int(lod)

    def level_at(k: int) -> F64:
        size = SIZE >> k
        packed = a.texels[a.start[m, k] : a.start[m, k] + size * size].reshape(size, size)
        picture = np.stack([packed & 255, packed >> 8 & 255, packed >> 16], axis=2).astype(float)
        x, y = u * size - 0.5, (1 - v) * size - 0.5
        j, i = int(np.floor(x)), int(np.floor(y))
        rows = [np.roll(picture[(i + d) % size], 0, axis=0) for d in (0, 1)]
        mixed = [(1 - (x - j)) * r[j % size] + (x - j) * r[(j + 1) % size] for r in rows]
        return np.asarray((1 - (y - i)) * mixed[0] + (y - i) * mixed[1])

    share = min(max(2 * (lod - level) - 0.5, 0.0), 1.0)
    return np.asarray((1 - share) * level_at(level) + share * level_at(level + 1))


def test_textures_are_sampled_between_texels_and_levels(atlas: TextureAtlas) -> None:
    rng = np.random.default_rng(1)
    brick = 5
    for _ in range(200):
        u, v, lod = rng.uniform(-3, 3), rng.uniform(-3, 3), rng.uniform(-1, 9)
        got = sample(atlas.arrays.texels, atlas.arrays.start, brick, u, v, lod)
        # a 64th of the step between two texels is the resolution of the position
        np.testing.assert_allclose(got, naive_sample(atlas, brick, u, v, lod), atol=4.0)


def naive_light(scene: Scene, T: F64, line: F64, sun: F64, wide: float) -> F64:
    """Light along one line of sight x, y by the formulas of the shading, with rays for the shadows."""
    d = np.append(line, 1.0)
    d = T[:3, :3] @ (d / np.linalg.norm(d))
    hits = cast_at(scene, T[None, :3, 3], d[None], 0.0)
    t, s = int(hits.triangle[0]), float(hits.distance_m[0])
    row, look = scene.surface.rows[t].astype(float), scene.surface.look[t].astype(float)
    point = T[:3, 3] + s * d
    (p,), (facing,) = local_rays(scene, hits.triangle, point[None], d[None], 0.0)
    u, v = row[4:7] @ p + row[7], row[8:11] @ p + row[11]
    lod = np.log2(s * wide / np.sqrt(max(-row[:3] @ facing, 0.02)))
    paint = naive_sample(scene.atlas, int(look[3]), u, v, lod + row[12])
    level = min(max(lod + np.log2(SIZE / MACRO_M), 0), LEVELS - 1)
    slow = naive_sample(scene.atlas, MACRO, u * row[15] + row[13], v * row[15] + row[14], float(int(level)))[
        0
    ]
    reflectance = (paint * look[:3] / 255 / 255 * slow / 217) ** 2
    normal = row[:3]
    for mover in scene.movers:
        if t >= mover.first:
            normal = mover.pose(0.0)[0, :3, :3] @ normal
    start = point + 1e-3 * normal
    lit = cast_at(scene, start[None], sun[None], 0.0).triangle[0] < 0
    direct = max(normal @ sun, 0.0) * lit
    sky = 0.62 + 0.38 * normal[2]
    return np.asarray(
        reflectance * (np.array([1.25, 1.15, 0.98]) * direct + np.array([0.42, 0.47, 0.56]) * sky)
    )


@pytest.mark.parametrize("moving", [False, True])
def test_shading_agrees_with_its_formulas_and_with_rays_to_the_sun(atlas: TextureAtlas, moving: bool) -> None:
    """A wall, a floor, and a crate that stands or is carried, whose shadow falls on both."""
    builder = MeshBuilder(atlas.index)
    builder.begin("building")
    builder.add(box((8, -6, 0), (9, 6, 5)), "plaster_a")
    builder.begin("ground")
    builder.add(box((-1, -6, -0.5), (8.5, 6, 0)), "concrete")
    crate = MeshBuilder(atlas.index, 9)
    crate.begin("other")
    crate.add(box((-0.5, -0.5, 0), (0.5, 0.5, 1)), "cardboard")
    here = np.tile([5.0, 0.5, 1.0], (9, 1))
    still = Motion.through(np.linspace(0, 1, 9), here, np.tile([0.4, 0.0, 0.0], (9, 1)))
    movers = (Mover(crate.build(), still),)
    if not moving:
        builder.begin("other")
        builder.add(box((-0.5, -0.5, 0), (0.5, 0.5, 1)), "cardboard", T_world_shape=still.pose(0.0)[0])
        movers = ()
    scene = prepare(builder.build(), atlas, movers)
    sun = np.array([-0.5, -0.35, 0.6]) / np.linalg.norm([-0.5, -0.35, 0.6])
    camera = VirtualCamera(CameraSpec().scaled(96), 0)
    T = looking(0.0, 0.0, 2.0)
    light = camera.render(scene, sun, T)
    rows, columns = (a.ravel() for a in np.mgrid[4:77:4, 4:96:5])
    wide = 1 / camera.spec.fx
    sure = camera._film.depth.reshape(77, 96)[rows, columns] < 100
    expected = np.array(
        [
            naive_light(scene, T, camera.lines[i, j, 4].astype(float), sun, wide) if ok else light[i, j]
            for i, j, ok in zip(rows, columns, sure, strict=True)
        ]
    )
    error = np.abs(light[rows, columns] - expected).max(axis=1)
    assert sure.mean() > 0.6
    assert np.mean(error < 0.02) > 0.9  # the rest: pixels at edges and at the borders of shadows
    dark = (expected[:, 0] < 0.5 * np.median(expected[sure][:, 0])) & sure
    assert dark.sum() > 3


# --- the lens and what is seen


def test_undistort_inverts_distort() -> None:
    spec = CameraSpec()
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.75, 0.75, 500), rng.uniform(-0.6, 0.6, 500)
    xd, yd = distort(x, y, spec.distortion)
    np.testing.assert_allclose(undistort(xd, yd, spec.distortion), (x, y), atol=1e-9)


def test_scaled_camera_sees_the_same() -> None:
    full, half = CameraSpec(), CameraSpec().scaled(640)
    # corner of the first pixel
    assert (-0.5 - full.cx) / full.fx == pytest.approx((-0.5 - half.cx) / half.fx)
    assert (full.width - 0.5 - full.cx) / full.fx == pytest.approx((half.width - 0.5 - half.cx) / half.fx)
    assert (half.width, half.height) == (640, 512)


def edges(depth: F64, instance: F64) -> F64:
    """Pixels with a step in depth or another object within one pixel."""
    low, high = depth.copy(), depth.copy()
    low[np.isnan(depth)], high[np.isnan(depth)] = 1e6, 1e6
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(low, kernel), cv2.dilate(high, kernel)
    first, last = (
        cv2.erode(instance.astype(np.float32), kernel),
        cv2.dilate(instance.astype(np.float32), kernel),
    )
    return np.asarray((high - low > 0.05 * low) | (first != last))


def test_true_depth_agrees_with_the_rasteriser_of_the_mapper(town: tuple[World, Scene]) -> None:
    """Two implementations that share nothing: rays through the hierarchy, triangles through the z-buffer."""
    world, scene = town
    still = prepare(scene.mesh, scene.atlas)
    local = (scene.mesh.vertices - scene.origin).astype(np.float32)
    for yaw, lens in ((0.4, True), (2.2, False)):
        spec = CameraSpec().scaled(320)
        if not lens:
            spec = CameraSpec(320, 256, 225, 225, 160.9, 126.6, (0.0, 0.0, 0.0, 0.0, 0.0))
        T = looking(20.0, 0.0, 1.6, yaw)
        true = truth_images(still, world.sun, T, VirtualCamera(spec, 0), 0.0)
        model = CameraModel(spec.width, spec.height, spec.fx, spec.fy, spec.cx, spec.cy, spec.distortion)
        T_local = T.copy()
        T_local[:3, 3] -= scene.origin
        if lens:
            drawn = render_camera(model, T_local, local, scene.mesh.triangles).depth
        else:
            drawn = render(pinhole(model, T_local), local, scene.mesh.triangles).depth
        error = np.abs(drawn - true.depth)
        assert np.nanmedian(error) < 1e-3
        wrong = (np.isnan(drawn) != np.isnan(true.depth)) | (error > 0.02 * true.depth)
        assert wrong.mean() < (0.02 if lens else 0.005)  # behind a lens the mapper draws on a finer canvas
        assert (wrong & ~edges(true.depth, true.instance)).mean() < (0.003 if lens else 1e-4)


def test_camera_sees_what_exact_rays_meet(town: tuple[World, Scene]) -> None:
    """Movers included; silhouettes may differ by half a sub-pixel."""
    world, town_scene = town
    crate = MeshBuilder(world.atlas.index, 900_000)
    crate.begin("other")
    crate.add(box((-0.6, -0.6, 0), (0.6, 0.6, 1.2)), "cardboard")
    t = np.linspace(0, 4, 40)
    place = np.column_stack([24 + 0 * t, t - 1.5, 0.6 + 0 * t])
    carried = Motion.through(t, place, np.column_stack([0.5 * t, 0 * t, 0 * t]))
    scene = prepare(town_scene.mesh, world.atlas, (Mover(crate.build(), carried),))
    camera = VirtualCamera(CameraSpec().scaled(320), 6)
    T = looking(20.0, 0.0, 1.5)
    true = truth_images(scene, world.sun, T, camera, 1.5)
    assert (true.instance == 900_000).mean() > 0.01
    depth = camera._film.depth.reshape(true.depth.shape)
    depth = np.where(np.isinf(depth), np.nan, depth)
    wrong = (np.isnan(depth) != np.isnan(true.depth)) | (np.abs(depth - true.depth) > 0.01 * true.depth)
    assert wrong.mean() < 0.08  # where a pixel shows several surfaces, the film keeps the nearest
    assert (wrong & ~edges(true.depth, true.instance)).mean() < 0.005
    later = truth_images(scene, world.sun, T, camera, 2.5)
    before, after = (np.flatnonzero((v.instance == 900_000).any(axis=0)).mean() for v in (true, later))
    assert before - after == pytest.approx(225 / 4, rel=0.3)  # a metre to the left at 4 m


def test_true_view_names_what_it_shows(atlas: TextureAtlas) -> None:
    builder = MeshBuilder(atlas.index, 40)
    builder.begin("building")
    builder.add(box((10, -2, -2), (11, 2, 2)), "plaster_a")
    scene = prepare(builder.build(), atlas)
    spec = CameraSpec(64, 48, 40.0, 40.0, 31.5, 23.5, (0.0, 0.0, 0.0, 0.0, 0.0))
    true = truth_images(scene, SUN, looking(0, 0, 0), VirtualCamera(spec, 0), 0.0)
    assert true.instance[24, 32] == 40 and true.label[24, 32] == 2
    assert true.depth[24, 32] == pytest.approx(10, abs=1e-5)
    assert true.instance[0, 0] == -1 and true.label[0, 0] == 0 and np.isnan(true.depth[0, 0])
    # the wall covers |y|, |z| <= 2 m at 10 m: 8 pixels to each side
    assert (true.instance == 40).sum() == 16 * 16
    assert true.colour.shape == (48, 64, 3) and true.colour.dtype == np.uint8
    expected = 255 * np.sqrt(np.clip(true.light / 0.87, 0, 1))
    np.testing.assert_allclose(true.colour, expected, atol=0.51)


def test_what_was_seen_is_what_rays_through_the_pixels_meet(town: tuple[World, Scene]) -> None:
    world, scene = town
    camera = VirtualCamera(CameraSpec().scaled(96), 0)
    T = looking(20.0, -1.5, 1.5, 0.2)
    true = truth_images(scene, world.sun, T, camera, 0.0)
    triangles, depth = camera.seen()
    assert triangles.shape == (*depth.shape, 4)
    label = np.where(triangles >= 0, scene.class_id[triangles], 0)
    whole = (label == label[:, :, :1]).all(axis=2)
    assert (label[whole, 0] == true.label[whole]).mean() > 0.99
    assert (np.isinf(depth) == (triangles < 0).all(axis=2)).all()


# --- motion blur


def blurred(scene: Scene, sun: F64, camera: VirtualCamera, path, time_s: float, exposure_s: float) -> F64:  # type: ignore[no-untyped-def]
    """Mean of many renders within the exposure: what the filter has to come near to."""
    times = time_s + ((np.arange(32) + 0.5) / 32 - 0.5) * exposure_s
    return np.asarray(np.mean([camera.render(scene, sun, path(t), t) for t in times], axis=0))


@pytest.mark.parametrize("case", ["turning", "walking past", "mover"])
def test_motion_blur_is_the_mean_over_the_exposure(atlas: TextureAtlas, case: str) -> None:
    builder = MeshBuilder(atlas.index)
    builder.begin("building")
    builder.add(box((6, -9, -9), (7, 9, 9)), "plaster_a")
    t = np.linspace(0, 1, 30)[:, None]
    passing = Motion.through(t[:, 0], t * [0, 20.0, 0] + [5.0, -10.0, 0], np.zeros((30, 3)))
    crate = MeshBuilder(atlas.index, 9)
    crate.begin("other")
    crate.add(box((0, -1, -1), (0.5, 1, 1)), "cardboard")
    scene = prepare(builder.build(), atlas, (Mover(crate.build(), passing),) if case == "mover" else ())
    spec = CameraSpec(
        160,
        128,
        110.0,
        110.0,
        80.2,
        63.1,
        vignetting=0.0,
        sensor=SensorSpec(noise=0.0, auto=False, bits=16, white=10.0),
    )

    def path(at: float) -> F64:
        speed = {"turning": (0.0, 120.0), "walking past": (4.0, 0.0), "mover": (0.0, 0.0)}[case]
        return looking(0.0, speed[0] * (at - 0.5), 0.0, np.radians(speed[1] * (at - 0.5)))

    exposure = Exposure(0.03, 1.0)
    camera = VirtualCamera(spec, 0)
    sharp = camera.render(scene, SUN, path(0.5), 0.5)
    expected = blurred(scene, SUN, camera, path, 0.5, exposure.exposure_s)
    parts = camera._see(scene, SUN, path(0.5), 0.5)
    raw = camera._raw(scene, parts, path, 0.5, exposure, 0)
    colour = (np.arange(128)[:, None] % 2) + (np.arange(160) % 2)
    a = amplifier(spec.sensor, exposure)
    scale = a.electrons * a.numbers * np.array(spec.sensor.efficiency)[colour]
    got = raw / scale

    def rms(x: F64) -> float:
        mosaic = np.take_along_axis(x, colour[..., None], axis=2)[..., 0]
        return float(np.sqrt(np.mean((got - mosaic)[8:-8, 8:-8] ** 2)))

    # at the silhouette of a mover the filter blurs only what lies inside it
    assert rms(expected) < (0.8 if case == "mover" else 0.35) * rms(sharp)


def naive_trail(light: F64, i: int, j: int, colour: int, du: float, dv: float) -> float:
    """Mean over many points of the path, interpolated across it and by hats of one pixel along it."""
    longer = max(abs(du), abs(dv))
    if longer <= 0.3:
        return float(light[i, j, colour])
    height, width = light.shape[:2]
    at = (np.arange(4000) + 0.5) / 4000 - 0.5
    x, y = j + at * du, i + at * dv
    # along its longer axis the path is read between whole rows or columns at the points where it crosses them
    major, slope = (x, dv / du) if abs(du) >= abs(dv) else (y, du / dv)
    origin = (j, i) if abs(du) >= abs(dv) else (i, j)

    def crossing(n: F64) -> F64:
        minor = origin[1] + (n - origin[0]) * slope
        rows, columns = (minor, n) if abs(du) >= abs(dv) else (n, minor)
        rows, columns = np.clip(rows, 0, height - 1.001), np.clip(columns, 0, width - 1.001)
        rows, columns = (rows, np.rint(columns)) if abs(du) >= abs(dv) else (np.rint(rows), columns)
        r, c = np.floor(rows).astype(int), np.floor(columns).astype(int)
        r1, c1 = np.minimum(r + 1, height - 1), np.minimum(c + 1, width - 1)
        fr, fc = rows - r, columns - c
        upper = light[r, c, colour] * (1 - fc) + light[r, c1, colour] * fc
        lower = light[r1, c, colour] * (1 - fc) + light[r1, c1, colour] * fc
        return np.asarray(upper * (1 - fr) + lower * fr)

    before = np.floor(major)
    share = major - before
    return float(np.mean(crossing(before) * (1 - share) + crossing(before + 1) * share))


def test_trails_are_the_mean_along_the_path() -> None:
    rng = np.random.default_rng(5)
    light = rng.uniform(0, 1, (24, 30, 3)).astype(np.float32)
    lengths = [0.0, 0.2, 0.4, 1.0, 1.9, 2.0, 2.1, 3.7, 6.0, 9.3]
    places = [(12, 15), (8, 20), (1, 1), (0, 7), (23, 29), (22, 3)]
    for length in lengths:
        for angle in (0.0, 0.4, np.pi / 4, 1.3, np.pi / 2, 2.5, 4.0, 5.9):
            du, dv = length * np.cos(angle), length * np.sin(angle)
            for i, j in places:
                expected = naive_trail(light, i, j, 1, du, dv)
                assert sensor._trail(light, i, j, 1, du, dv) == pytest.approx(expected, abs=2e-3)


def naive_expose(film: Film, lines: F64, moved: F64, lens: Optics, raw_scale: F64) -> F64:
    """Numbers without noise: each pixel's path by projecting its point before and after, sampled densely."""
    height, width = lines.shape[:2]
    light = film.light.reshape(height, width, 3).astype(float)
    out = np.zeros((height, width))

    def pixel(p: F64) -> F64:
        return np.array(distort(p[0] / p[2], p[1] / p[2], lens.k)) * [lens.fx, lens.fy]

    for i, j in np.ndindex(height, width):
        n = i * width + j
        far = np.isinf(film.depth[n])
        p = np.append(lines[i, j], 1.0).astype(float) * (1.0 if far else film.depth[n])
        D = moved[film.part[n]]
        h = 1e-4 * (D[:3, :3] @ p + (0 if far else D[:3, 3]))
        du, dv = (pixel(p + h) - pixel(p - h)) / 2e-4
        values = []
        for s in np.linspace(-0.5, 0.5, 801)[:-1] + 0.5 / 800 if max(abs(du), abs(dv)) > 0.3 else [0.0]:
            x, y = np.clip(j - s * du, 0, width - 1.001), np.clip(i - s * dv, 0, height - 1.001)
            a, b = int(x), int(y)
            four = light[b : b + 2, a : a + 2, (i & 1) + (j & 1)]
            values.append([1 - (y - b), y - b] @ four @ [1 - (x - a), x - a])
        out[i, j] = np.mean(values)
    return np.asarray(out * raw_scale[(np.arange(height)[:, None] & 1) + (np.arange(width) & 1)])


def test_exposure_agrees_with_its_slow_twin() -> None:
    rng = np.random.default_rng(5)
    height, width = 14, 18
    smooth = cv2.GaussianBlur(rng.uniform(0.05, 0.6, (height, width, 3)).astype(np.float32), (5, 5), 1.5)
    depth = rng.uniform(2, 9, height * width).astype(np.float32)
    depth[::7] = np.inf
    film = Film(smooth.reshape(-1, 3), depth, (np.arange(height * width) % 3).astype(np.int16))
    v, u = np.mgrid[0:height, 0:width]
    lines = np.stack([(u - 8.3) / 20.0, (v - 7.1) / 20.0], axis=2).astype(np.float32)
    moved = rng.normal(0, 0.12, (3, 4, 4))
    moved[0] = 0.0
    lens = Optics(20.0, 20.0, (-0.09, 0.06, 0.0004, -0.0003, -0.01))
    spec, used = SensorSpec(bits=16, white=2.0), Exposure(0.004, 1.0)
    a, raw = amplifier(spec, used), np.empty((height, width), np.uint16)
    a = a._replace(noise=0.0)
    efficiency = np.array(spec.efficiency)
    flat_field, silence = np.ones((height, width), np.float32), np.zeros((height, width), np.float32)
    expose(film, lines, moved, lens, flat_field, silence, efficiency, a, (0, height), raw)
    expected = naive_expose(film, lines, moved, lens, efficiency * a.electrons * a.numbers)
    np.testing.assert_allclose(raw, expected, rtol=0.03)
    assert np.abs(raw.reshape(-1)[::3] - expected.reshape(-1)[::3]).max() <= 1.0  # what stands still


# --- the sensor


def flat(light: float, height: int = 64, width: int = 96) -> Film:
    """Still, evenly lit."""
    n = height * width
    return Film(np.full((n, 3), light, np.float32), np.full(n, 5.0, np.float32), np.zeros(n, np.int16))


def numbers(spec: SensorSpec, used: Exposure, light: float, seed: int = 0) -> F64:
    raw = np.empty((64, 96), np.uint16)
    noise = np.random.default_rng(seed).standard_normal(raw.shape).astype(np.float32)
    lens = Optics(100.0, 100.0, (0.0, 0.0, 0.0, 0.0, 0.0))
    lines, falloff = np.zeros((64, 96, 2), np.float32), np.ones((64, 96), np.float32)
    D = np.zeros((1, 4, 4))
    expose(
        flat(light),
        lines,
        D,
        lens,
        falloff,
        noise,
        np.array(spec.efficiency),
        amplifier(spec, used),
        (0, 64),
        raw,
    )
    return raw.astype(np.float64)


@pytest.mark.parametrize(("light", "gain"), [(0.4, 1.0), (0.02, 1.0), (0.05, 8.0), (0.0, 8.0)])
def test_noise_is_that_of_photons_and_of_the_reading(light: float, gain: float) -> None:
    spec = SensorSpec(bits=14, efficiency=(1.0, 1.0, 1.0))
    raw = numbers(spec, Exposure(0.004, gain), light)
    electrons = light / 0.87 * 10_000
    per_electron = (2**14 - 1) / 10_000 * gain
    if light > 0:
        assert raw.mean() / per_electron == pytest.approx(electrons, rel=0.02)
        assert raw.std() / per_electron == pytest.approx(np.sqrt(electrons + 100), rel=0.05)
    else:  # half of the read noise is below black
        assert (raw == 0).mean() == pytest.approx(0.5, abs=0.03)


def test_saturation_and_quantisation() -> None:
    spec = SensorSpec()
    assert (numbers(spec, REFERENCE, 3.0)[1::2, 0::2] == 1023).all()
    assert numbers(spec, Exposure(0.008, 1.0), 0.2).mean() == pytest.approx(
        2 * numbers(spec, REFERENCE, 0.2).mean(), rel=0.01
    )


def test_mosaic_is_developed_to_the_colour_that_came_in() -> None:
    spec = SensorSpec(noise=0.0)
    for rgb in ((0.5, 0.2, 0.1), (0.1, 0.2, 0.5), (0.3, 0.3, 0.3)):
        film = flat(0.0)
        film.light[:] = rgb
        raw = np.empty((64, 96), np.uint16)
        lens = Optics(100.0, 100.0, (0.0, 0.0, 0.0, 0.0, 0.0))
        zero = np.zeros((64, 96), np.float32)
        expose(
            film,
            np.zeros((64, 96, 2), np.float32),
            np.zeros((1, 4, 4)),
            lens,
            zero + 1,
            zero,
            np.array(spec.efficiency),
            amplifier(spec, REFERENCE),
            (0, 64),
            raw,
        )
        bgr = developed(raw, spec)[8:-8, 8:-8].reshape(-1, 3)
        np.testing.assert_allclose(
            bgr, np.tile(255 * np.sqrt(np.array(rgb[::-1]) / 0.87), (len(bgr), 1)), atol=1.5
        )


def test_exposure_follows_the_light_after_its_delay() -> None:
    spec = SensorSpec()
    control = AutoExposure(spec)
    used, means = [], []
    for k in range(30):
        light = 0.4 if k < 10 else 0.05
        now = control.next(light)
        mean = min(light * now.exposure_s / 0.004 * now.gain / spec.white, 1.0)
        control.measured(now, mean)
        used.append(now.exposure_s * now.gain)
        means.append(mean)
    np.testing.assert_allclose(means[:10], spec.target, rtol=0.02)
    np.testing.assert_allclose(used[10:13], used[9])  # nobody knows yet
    assert used[13] > 1.5 * used[9]
    assert means[29] == pytest.approx(spec.target, rel=0.1)
    exposures = [control._split(p) for p in (1e-6, 0.004, 0.02, 10.0)]
    assert exposures == [(0.00005, 1.0), (0.004, 1.0), (0.005, 4.0), (0.005, 8.0)]


def test_manual_exposure_stays() -> None:
    control = AutoExposure(SensorSpec(auto=False, exposure_s=0.002, gain=3.0))
    for light in (0.1, 0.9):
        assert control.next(light) == Exposure(0.002, 3.0)
        control.measured(Exposure(0.002, 3.0), 0.9)


# --- photographs


def test_photographs_are_reproducible_and_noisy(town: tuple[World, Scene]) -> None:
    world, scene = town
    T = looking(20.0, 0.0, 1.6)
    spec = CameraSpec().scaled(96)
    first, second = VirtualCamera(spec, 6), VirtualCamera(spec, 6, threads=3)
    one, two = (c.photograph(scene, world.sun, lambda t: T, 0.5, 0) for c in (first, second))
    assert one == two and one.encoding == "jpeg" and one.data[:2] == b"\xff\xd8"
    again = first.photograph(scene, world.sun, lambda t: T, 0.5, 1)
    assert again.exposure_s == one.exposure_s and again.data != one.data
    picture = cv2.imdecode(np.frombuffer(one.data, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (77, 96, 3)
    true = truth_images(scene, world.sun, T, first, 0.5, Exposure(one.exposure_s, one.gain)).colour
    middle = np.s_[30:46, 38:58]
    assert np.abs(picture[..., ::-1][middle].astype(float) - true[middle]).mean() < 15


def test_bayer_output_has_a_byte_for_every_pixel(town: tuple[World, Scene]) -> None:
    world, scene = town
    camera = VirtualCamera(CameraSpec(output="bayer").scaled(64), 0)
    photo = camera.photograph(scene, world.sun, lambda t: looking(20.0, 0.0, 1.6), 0.0, 0)
    assert photo.encoding == "bayer_rggb8" and len(photo.data) == 64 * 51
    raw = np.frombuffer(photo.data, np.uint8).reshape(51, 64)
    assert 0.05 < metered(raw.astype(np.uint16), SensorSpec(bits=8)) < 0.5


def test_vignetting_darkens_the_corners(atlas: TextureAtlas) -> None:
    camera = VirtualCamera(CameraSpec().scaled(128), 0)
    x, y = camera.lines[0, 0, 4]
    assert camera._falloff[0, 0] == pytest.approx(1 / (1 + x * x + y * y) ** 2, rel=1e-5)
    assert camera._falloff.max() == pytest.approx(1.0, abs=1e-3)


def test_ray_hits_agree_at_the_pixel(town: tuple[World, Scene]) -> None:
    """The true depth of one pixel, by hand."""
    world, scene = town
    T = looking(20.0, 0.0, 1.6, 0.9)
    camera = VirtualCamera(CameraSpec().scaled(160), 0)
    true = truth_images(scene, world.sun, T, camera, 0.2)
    x, y = camera.lines[70, 90, 4].astype(np.float64)
    line = np.array([[x, y, 1.0]])
    hits = cast_at(scene, T[None, :3, 3], line / np.linalg.norm(line) @ T[:3, :3].T, 0.2)
    assert true.depth[70, 90] == pytest.approx(hits.distance_m[0] / np.linalg.norm(line), rel=1e-5)
