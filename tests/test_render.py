"""The rasteriser against a ray caster that tries every triangle for every pixel."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from artemis_edge import raster, render
from artemis_edge.errors import InputError
from artemis_edge.export.ply import bare_mesh, write_ply
from artemis_edge.frames import CameraModel
from artemis_edge.lens import distort, undistorted_lines
from artemis_edge.raster import NOTHING
from artemis_edge.trajectory import inverse, matrix_from_quaternion

CAMERA = CameraModel(64, 48, 40.0, 42.0, 31.3, 22.8)
BARREL = (-0.28, 0.07, 0.001, -0.0015, 0.0)
NEAR = render.NEAR_M


def naive_cast(
    vertices: np.ndarray, faces: np.ndarray, lines: np.ndarray, near: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest hit of the lines (x, y, 1) t with vertices given in view coordinates: z, triangle, weights.

    Moller and Trumbore (1997), one triangle after the other, in float64.
    """
    rays = np.concatenate([lines, np.ones((*lines.shape[:2], 1))], axis=2)
    depth, triangle = np.full(lines.shape[:2], np.inf), np.full(lines.shape[:2], NOTHING)
    weights = np.zeros((*lines.shape[:2], 3))
    for number, (a, b, c) in enumerate(vertices[faces].astype(np.float64)):
        e1, e2 = b - a, c - a
        p = np.cross(rays, e2)
        with np.errstate(all="ignore"):
            det = p @ e1
            u = (p @ -a) / det
            q = np.cross(-a, e1)
            v = (rays @ q) / det
            z = (e2 @ q) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (z >= near) & (z < depth)
        depth[hit], triangle[hit] = z[hit], number
        weights[hit] = np.stack([1 - u - v, u, v], axis=2)[hit]
    return np.where(triangle == NOTHING, np.nan, depth), triangle, weights


def lines_of(camera: CameraModel) -> np.ndarray:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=2)


def in_view(vertices: np.ndarray, T_world_cam: np.ndarray) -> np.ndarray:
    T = inverse(T_world_cam)
    return vertices.astype(np.float64) @ T[:3, :3].T + T[:3, 3]


def pose(x: float, y: float, z: float) -> np.ndarray:
    """Camera at (x, y, z), looking along +x of a z-up world, slightly down and rolled."""
    T = matrix_from_quaternion(np.array([x, y, z]), np.array([-0.5, 0.5, -0.5, 0.5]))
    return T @ matrix_from_quaternion(np.zeros(3), np.array([-0.06, 0.03, 0.04, 1.0]))


def scene(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """A floor under the camera, a sphere and a cloud of random triangles, some of them behind the camera."""
    rng = np.random.default_rng(seed)
    floor = np.array([[-30, -30, -1], [30, -30, -1.1], [30, 30, -1.2], [-30, 30, -1]])
    sphere = trimesh.creation.icosphere(2, radius=1.5)
    soup = rng.uniform(-6, 9, (60, 1, 3)) + rng.normal(0, 1.0, (60, 3, 3))
    vertices = np.concatenate([floor, np.add(sphere.vertices, [6, 1, 0]), soup.reshape(-1, 3)])
    faces = [
        [[0, 1, 2], [0, 2, 3]],
        sphere.faces + 4,
        4 + len(sphere.vertices) + np.arange(180).reshape(-1, 3),
    ]
    return vertices.astype(np.float32), np.concatenate(faces).astype(np.int32)


def agree_but_for_borders(a: np.ndarray, b: np.ndarray, share: float) -> None:
    """Two triangle buffers are the same up to rounding on borders of triangles."""
    assert np.mean(a != b) <= share


@pytest.mark.parametrize("seed", range(4))
def test_render_equals_the_ray_caster(seed: int) -> None:
    vertices, faces = scene(seed)
    values = np.random.default_rng(9).normal(size=(len(vertices), 3)).astype(np.float32)
    T = pose(0.2, -0.3, 0.1)
    seen = render.render(render.perspective(CAMERA, T), vertices, faces, values)
    depth, triangle, weights = naive_cast(in_view(vertices, T), faces, lines_of(CAMERA), NEAR)
    assert np.mean(triangle != NOTHING) > 0.4
    agree_but_for_borders(seen.triangle, triangle, 0.002)
    same = (seen.triangle == triangle) & (triangle != NOTHING)
    np.testing.assert_allclose(seen.depth[same], depth[same], rtol=2e-4)
    expected = np.einsum("pk,pkc->pc", weights[same], values[faces[triangle[same]]].astype(np.float64))
    np.testing.assert_allclose(seen.values[same], expected, atol=5e-3)
    assert np.isnan(seen.depth[~seen.covered]).all() and (seen.values[~seen.covered] == 0).all()
    only_depth = render.depth_map(render.perspective(CAMERA, T), vertices, faces)
    np.testing.assert_allclose(only_depth, seen.depth, rtol=2e-3)


def test_clipping_at_the_near_plane() -> None:
    # One triangle from far behind to far ahead fills the lower half up to the horizon.
    vertices = np.array([[-50, 80, -1], [-50, -80, -1], [400, 0, -1]], np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    T = matrix_from_quaternion(np.zeros(3), np.array([-0.5, 0.5, -0.5, 0.5]))
    seen = render.render(render.perspective(CAMERA, T), vertices, faces)
    depth, triangle, _ = naive_cast(in_view(vertices, T), faces, lines_of(CAMERA), NEAR)
    np.testing.assert_array_equal(seen.triangle, triangle)
    covered = triangle == 0
    assert covered[30:, 20:44].all() and not covered[:22].any()
    np.testing.assert_allclose(seen.depth[covered], depth[covered], rtol=1e-4)


def test_perspective_correct_values() -> None:
    # On a plane seen at a slant the vertex value x interpolates to the x of the point that is seen.
    vertices = np.array([[1, 3, -1], [1, -3, -1], [60, -3, -1], [60, 3, -1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    T = matrix_from_quaternion(np.zeros(3), np.array([-0.5, 0.5, -0.5, 0.5]))
    seen = render.render(render.perspective(CAMERA, T), vertices, faces, vertices[:, :1])
    v, u = np.nonzero(seen.covered)
    assert len(v) > 100
    distance = 1.0 / ((v - CAMERA.cy) / CAMERA.fy)  # the plane lies 1 m below
    np.testing.assert_allclose(seen.values[v, u, 0], distance, rtol=1e-4)
    np.testing.assert_allclose(seen.depth[v, u], distance, rtol=1e-4)


def test_common_edges_leave_no_gap() -> None:
    # A triangulated wall with vertices on pixel centres and between them: every pixel inside is covered.
    rng = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.arange(0, 41, 4.0), np.arange(0, 41, 4.0)), axis=2)
    grid[1:-1, 1:-1] += rng.choice([0.0, 0.5, 0.3217], (9, 9, 2))
    xy = grid.reshape(-1, 2)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(10), np.arange(10), indexing="ij"))
    a, b, c, d = i * 11 + j, i * 11 + j + 1, (i + 1) * 11 + j + 1, (i + 1) * 11 + j
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    vertices = np.concatenate([xy, np.ones((121, 1))], axis=1).astype(np.float32)
    camera = CameraModel(41, 41, 1.0, 1.0, 0.0, 0.0)
    seen = render.render(render.perspective(camera, np.eye(4)), vertices, faces)
    assert seen.covered.all()


def test_culling_hides_backs() -> None:
    sphere = trimesh.creation.icosphere(3, radius=2.0)
    vertices, faces = sphere.vertices.astype(np.float32), sphere.faces.astype(np.int32)
    outside, inside = pose(-6, 0, 0), pose(0, 0, 0)
    far = render.render(render.perspective(CAMERA, outside), vertices, faces)
    culled = render.render(render.perspective(CAMERA, outside, cull=True), vertices, faces)
    np.testing.assert_array_equal(far.triangle, culled.triangle)  # fronts hide the backs anyway
    assert render.render(render.perspective(CAMERA, inside), vertices, faces).covered.all()
    assert not render.render(render.perspective(CAMERA, inside, cull=True), vertices, faces).covered.any()


def test_map_from_above() -> None:
    # A floor, and a ceiling that faces down: from above one looks through its back onto the floor.
    floor = np.array([[0, 0, 0], [2, 0, 0.5], [2, 1, 0.5], [0, 1, 0]])
    vertices = np.concatenate([floor, np.add(floor[::-1], [0, 0, 2.5])]).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    low, high = np.array([-0.5, 0.0, 0.0]), np.array([2.5, 1.0, 3.0])
    view = render.from_above(low, high, 0.1)
    assert (view.width, view.height) == (30, 10)
    seen = render.render(view, vertices, faces, vertices)
    assert seen.covered[:, 5:25].all() and not seen.covered[:, :5].any() and not seen.covered[:, 25:].any()
    x = -0.5 + (np.arange(5, 25) + 0.5) * 0.1
    y = 1.0 - (np.arange(10) + 0.5) * 0.1
    np.testing.assert_allclose(seen.values[:, 5:25, 0], np.broadcast_to(x, (10, 20)), atol=1e-5)
    np.testing.assert_allclose(seen.values[:, 5:25, 1], np.broadcast_to(y[:, None], (10, 20)), atol=1e-5)
    np.testing.assert_allclose(seen.depth[:, 5:25], np.broadcast_to(3.0 - x / 4, (10, 20)), atol=1e-5)
    assert (seen.triangle[seen.covered] < 2).all()
    open_top = render.render(render.from_above(low, high, 0.1, cull=False), vertices, faces)
    assert (open_top.triangle[open_top.covered] >= 2).all()


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("dimmed", [False, True])
def test_shading_is_that_of_every_pixel_by_itself(orthographic: bool, dimmed: bool) -> None:
    """The slow twin: each fine pixel's colour and normal by ``render``, lit, then the mean of each square."""
    rng = np.random.default_rng(3)
    sphere = trimesh.creation.icosphere(2, radius=2.0)
    vertices, faces = sphere.vertices.astype(np.float32), sphere.faces.astype(np.int32)
    colours = rng.integers(0, 256, (len(vertices), 3)).astype(np.uint8)
    normals = (sphere.vertex_normals * rng.uniform(0.5, 2.0, (len(vertices), 1))).astype(np.float32)
    normals[7] = 0.0
    above = render.from_above(np.array([-2.5, -2, -2]), np.array([2.5, 2, 2]), 0.05)
    view = above if orthographic else render.perspective(CAMERA, pose(-5, 0, 0), cull=True)
    lamp = raster.Lamp(np.array([0.0, 0.6, 0.8]), 0.4, np.array([250, 240, 230], np.uint8))
    seen = render.render(view, vertices, faces, np.concatenate([colours, normals], 1).astype(np.float32))
    dim = rng.uniform(0.5, 1.0, seen.triangle.shape).astype(np.float32)
    normal = seen.values[..., 3:]
    cosine = np.abs(normal @ lamp.direction) / np.maximum(np.linalg.norm(normal, axis=2), 1e-6)
    light = (0.4 + 0.6 * cosine) * (dim if dimmed else 1.0)
    fine = np.where(seen.covered[..., None], seen.values[..., :3] * light[..., None], lamp.paper)
    h, w = (n // 2 for n in seen.triangle.shape)
    expected = fine[: 2 * h, : 2 * w].reshape(h, 2, w, 2, 3).mean(axis=(1, 3))
    points, triangle, _ = render.visible(view, vertices, faces)
    out = np.empty((h, w, 3), np.uint8)
    looks = raster.Looks(colours, normals)
    raster.shade(points, faces, triangle, view.projection, looks, lamp, dim if dimmed else dim[:0], out)
    assert 0.2 < seen.covered.mean() < 0.95
    assert np.abs(out - expected).max() < 0.51


def test_degenerate_input_draws_nothing() -> None:
    view = render.perspective(CAMERA, np.eye(4))
    for vertices, faces in (
        (np.zeros((0, 3)), np.zeros((0, 3))),
        (np.array([[0, 0, 2], [1, 1, 2], [2, 2, 2]]), [[0, 1, 2]]),  # collinear
        (np.array([[0, 0, 2]]), [[0, 0, 0]]),
        (np.array([[np.nan, 0, 2], [1, 0, 2], [0, 1, 2]]), [[0, 1, 2]]),
        (np.array([[0, 0, np.nan], [1, 0, 2], [0, 1, 2]]), [[0, 1, 2]]),
        (np.array([[0, 0, -2], [1, 0, -2], [0, 1, -2]]), [[0, 1, 2]]),  # behind
    ):
        faces_array = np.asarray(faces, np.int32).reshape(-1, 3)
        seen = render.render(view, vertices.astype(np.float32), faces_array)
        assert not seen.covered.any() and np.isnan(seen.depth).all()


def test_equal_depth_keeps_the_first_and_repeats_are_equal() -> None:
    vertices, faces = scene(2)
    twice = np.concatenate([faces, faces])
    view = render.perspective(CAMERA, pose(0, 0, 0))
    one, two = render.render(view, vertices, faces), render.render(view, vertices, twice)
    np.testing.assert_array_equal(one.triangle, two.triangle)
    assert one.depth.tobytes() == render.render(view, vertices, faces).depth.tobytes()


def test_undistorted_lines_invert_the_lens() -> None:
    camera = CameraModel(64, 48, 40.0, 42.0, 31.3, 22.8, BARREL)
    lines = undistorted_lines(camera).astype(np.float64)
    assert np.isfinite(lines).all()
    x, y = distort.py_func(lines[..., 0], lines[..., 1], np.array(BARREL))
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    np.testing.assert_allclose(x * 40.0 + 31.3, u, atol=1e-3)
    np.testing.assert_allclose(y * 42.0 + 22.8, v, atol=1e-3)
    K = np.array([[40.0, 0, 31.3], [0, 42.0, 22.8], [0, 0, 1]])
    points = np.concatenate([lines, np.ones((48, 64, 1))], axis=2).reshape(-1, 3)
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(BARREL))[0].reshape(48, 64, 2)
    np.testing.assert_allclose(pixels[..., 0], u, atol=1e-3)


def test_lines_beyond_the_fold_are_none() -> None:
    # r (1 - 0.5 r^2) never exceeds 0.5443: pixels further out have no line of sight.
    camera = CameraModel(101, 1, 50.0, 50.0, 50.0, 0.0, (-0.5, 0.0, 0.0, 0.0, 0.0))
    finite = np.isfinite(undistorted_lines(camera)[0, :, 0])
    reached = np.abs(np.arange(101) - 50) / 50 < 0.5443
    np.testing.assert_array_equal(finite, reached)
    vertices = np.array([[-9, -9, 1], [9, -9, 1], [0, 20, 1]], np.float32)
    seen = render.render_camera(camera, np.eye(4), vertices, np.array([[0, 1, 2]], np.int32))
    np.testing.assert_array_equal(seen.covered[0], reached)


@pytest.mark.parametrize("distortion", [BARREL, (0.2, 0.05, 0.0, 0.0, 0.01)])
def test_render_through_a_lens_equals_the_ray_caster(distortion: tuple[float, ...]) -> None:
    camera = CameraModel(64, 48, 40.0, 42.0, 31.3, 22.8, distortion)  # type: ignore[arg-type]
    vertices, faces = scene(1)
    values = vertices.copy()
    T = pose(0.2, -0.3, 0.1)
    seen = render.render_camera(camera, T, vertices, faces, values)
    lines = undistorted_lines(camera).astype(np.float64)
    depth, triangle, _ = naive_cast(in_view(vertices, T), faces, lines, NEAR)
    agree_but_for_borders(seen.triangle, triangle, 0.06)  # which triangle: to half a pixel
    same = (seen.triangle == triangle) & (triangle != NOTHING)
    np.testing.assert_allclose(seen.depth[same], depth[same], rtol=2e-4)
    rays = np.concatenate([lines, np.ones((48, 64, 1))], axis=2) * depth[..., None]
    world = rays[same] @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(seen.values[same], world, atol=5e-3)


def test_command_writes_rgba_and_depth(tmp_path: Path) -> None:
    sphere = trimesh.creation.icosphere(3)
    colours = np.tile(np.uint8([200, 40, 10]), (len(sphere.vertices), 1))
    write_ply(
        tmp_path / "mesh.ply", bare_mesh(np.add(sphere.vertices, [5, 0, 0]), sphere.faces, colours=colours)
    )
    arguments = (tmp_path, "0 0 0 -0.5 0.5 -0.5 0.5", "64 48 80 80 31.5 23.5", "-0.1 0 0 0 0")
    render.run(*arguments, tmp_path / "a.png", tmp_path / "a.npy")
    render.run(*arguments, tmp_path / "b.png")
    image = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    depth = np.load(tmp_path / "a.npy")
    assert image.shape == (48, 64, 4) and depth.shape == (48, 64) and depth.dtype == np.float32
    assert image[24, 32].tolist() == [10, 40, 200, 255] and image[0, 0].tolist() == [0, 0, 0, 0]
    assert depth[24, 32] == pytest.approx(4.0, abs=0.01) and np.isnan(depth[0, 0])
    np.testing.assert_array_equal(np.isnan(depth), image[..., 3] == 0)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize(
    ("pose_text", "intrinsics", "distortion", "option"),
    [
        ("1 2 3", "64 48 80 80 31 23", None, "--pose"),
        ("0 0 0 0 0 0 0", "64 48 80 80 31 23", None, "--pose"),
        ("0 0 0 0 0 0 1", "64 48 80 80 31", None, "--intrinsics"),
        ("0 0 0 0 0 0 1", "64 48 0 80 31 23", None, "--intrinsics"),
        ("0 0 0 0 0 0 1", "64.5 48 80 80 31 23", None, "--intrinsics"),
        ("0 0 0 0 0 0 1", "64000 48000 80 80 31 23", None, "--intrinsics"),
        ("0 0 0 0 0 0 1", "64 48 80 80 31 23", "0.1 x 0 0 0", "--distortion"),
        ("0 0 0 0 0 0 1", "64 48 80 80 31 23", "nan 0 0 0 0", "--distortion"),
    ],
)
def test_bad_arguments(pose_text: str, intrinsics: str, distortion: str | None, option: str) -> None:
    with pytest.raises(InputError, match=option):
        render.run(Path("unused.ply"), pose_text, intrinsics, distortion, Path("unused.png"))


def test_no_mesh(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no mesh at"):
        render.run(tmp_path, "0 0 0 0 0 0 1", "64 48 80 80 31 23", None, tmp_path / "x.png")
