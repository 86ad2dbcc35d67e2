"""Textured views against a ray caster with a slow sampler, highlighting, and the command."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from artemis_edge import render
from artemis_edge.atlas_raster import sample_page
from artemis_edge.cli import main
from artemis_edge.errors import InputError
from artemis_edge.export.atlas import UNTEXTURED, Atlas, empty_atlas, write_atlas
from artemis_edge.export.ply import bare_mesh, write_ply
from artemis_edge.frames import CameraModel
from artemis_edge.highlighted import highlighted_triangles
from artemis_edge.known_lenses import known_falloff, write_lenses
from artemis_edge.lens import falloff
from artemis_edge.opened_map import open_map
from artemis_edge.trajectory import matrix_from_quaternion
from tests.textured import smooth_picture, square_room

CAMERA = CameraModel(80, 60, 45.0, 44.0, 38.7, 30.2)
FORWARD = matrix_from_quaternion(np.array([0.2, -0.1, 0.3]), np.array([-0.5, 0.5, -0.5, 0.5]))
POSE = "0.2 -0.1 0.3 -0.5 0.5 -0.5 0.5"


def naive_sample(image: np.ndarray, x: float, y: float) -> np.ndarray:
    rows, columns, _ = image.shape
    x, y = min(max(x, 0.0), columns - 1.0), min(max(y, 0.0), rows - 1.0)
    total = np.zeros(3)
    for row in range(rows):
        for column in range(columns):
            weight = max(1.0 - abs(x - column), 0.0) * max(1.0 - abs(y - row), 0.0)
            total += weight * image[row, column]
    return total


def test_sampling_equals_the_naive_one() -> None:
    image = np.random.default_rng(1).integers(0, 256, (4, 7, 3), dtype=np.uint8)
    places = np.array([[[0, 0], [6, 3], [-2, 9]], [[2.25, 1.75], [5.999, 0.5], [100, -1]]], np.float32)
    page = np.array([[0, 0, 0], [0, 5, 0]], np.int32)
    out = np.full((2, 3, 3), -1, np.float32)
    sample_page(image, 0, page, places, out)
    for v in range(2):
        for u in range(3):
            expected = np.full(3, -1.0) if page[v, u] else naive_sample(image, *places[v, u])
            np.testing.assert_allclose(out[v, u], expected, atol=1e-3)


def naive_colour(mesh: object, atlas: object, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
    """Colour of the nearest triangle along a ray, one triangle after the other."""
    best, colour = np.inf, None
    for face, page, uv in zip(mesh.faces, atlas.page, atlas.uv, strict=True):  # type: ignore[attr-defined]
        a, b, c = mesh.vertices[face].astype(float)  # type: ignore[attr-defined]
        solution = np.linalg.solve(np.stack([b - a, c - a, -direction], axis=1), origin - a)
        v, w, t = solution
        if v < 0 or w < 0 or v + w > 1 or not 0 < t < best:
            continue
        best, weights = t, np.array([1 - v - w, v, w])
        if page == UNTEXTURED:
            colour = weights @ mesh.colours[face]  # type: ignore[attr-defined]
        else:
            colour = naive_sample(atlas.pages[page], *(weights @ uv))  # type: ignore[attr-defined]
    return colour


def test_textured_view_equals_the_ray_caster() -> None:
    mesh, atlas = square_room(pixels=12)
    seen = render.render_coloured(mesh, atlas, CAMERA, FORWARD)
    compared = 0
    for v in range(1, 60, 9):
        for u in range(1, 80, 9):
            ray = np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0])
            expected = naive_colour(mesh, atlas, FORWARD[:3, 3], FORWARD[:3, :3] @ ray)
            assert (expected is not None) == seen.covered[v, u]
            if expected is not None:
                np.testing.assert_allclose(seen.values[v, u], expected, atol=0.6)
                compared += 1
    assert compared > 30
    assert 0.3 < seen.covered.mean() < 1.0  # the room has no ceiling


def test_texture_through_a_lens_is_the_distorted_picture() -> None:
    mesh, atlas = square_room()
    lens = CameraModel(80, 60, 45.0, 44.0, 38.7, 30.2, (-0.2, 0.05, 0.001, -0.001, 0.0))
    straight = render.render_coloured(mesh, atlas, CAMERA, FORWARD)
    bent = render.render_coloured(mesh, atlas, lens, FORWARD)
    K = np.array([[45.0, 0, 38.7], [0, 44.0, 30.2], [0, 0, 1]])
    undone = cv2.undistort(bent.values, K, np.array(lens.distortion))
    middle = np.s_[20:50, 15:65]
    shown = straight.covered[middle] & (
        cv2.undistort(bent.covered.astype(np.float32), K, np.array(lens.distortion))[middle] > 0.99
    )
    assert shown.mean() > 0.7
    error = np.abs(undone[middle] - straight.values[middle])[shown]
    assert np.median(error) < 1.5 and np.mean(error) < 4.0


def test_an_atlas_without_texture_changes_nothing() -> None:
    mesh, _ = square_room()
    plain = render.render_coloured(mesh, None, CAMERA, FORWARD)
    empty = render.render_coloured(mesh, empty_atlas(len(mesh.faces)), CAMERA, FORWARD)
    np.testing.assert_array_equal(plain.values, empty.values)


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """An output directory with a textured map whose floor is an object."""
    mesh, atlas = square_room()
    mesh.labels[16:] = 3
    mesh.label_names.update({0: "background", 3: "floor"})
    write_ply(tmp_path / "mesh.ply", mesh)
    (tmp_path / "map").mkdir()
    write_atlas(tmp_path / "map", atlas)
    box = {"center": [2.0, 0.0, 0.0], "size": [0.2, 4.0, 4.0], "yaw": 0.0}
    wall = {"id": 1, "text": "Front Wall", "status": "matched", "score": 0.9, "box": box}
    lost = {"id": 2, "text": "unicorn", "status": "unsupported", "box": box}
    (tmp_path / "objects.json").write_text(json.dumps({"objects": [wall, lost]}))
    return tmp_path


def test_render_command_overlays_colour_alpha_and_depth(room: Path) -> None:
    out, depth = room / "view.png", room / "depth.npy"
    arguments = ["render", str(room), "--pose", POSE, "--intrinsics", "80 60 45 44 38.7 30.2"]
    assert main([*arguments, "--out", str(out), "--depth", str(depth)]) == 0
    image, z = cv2.imread(str(out), cv2.IMREAD_UNCHANGED), np.load(depth)
    mesh, atlas = square_room()
    seen = render.picture(mesh, atlas, CAMERA, FORWARD)
    np.testing.assert_array_equal(image[..., 3] == 255, seen.covered)
    np.testing.assert_array_equal(np.isnan(z), ~seen.covered)
    np.testing.assert_allclose(image[..., 2::-1][seen.covered], seen.values[seen.covered], atol=0.51)
    assert (image[~seen.covered] == 0).all()
    np.testing.assert_allclose(z[30, 40], 1.8, atol=1e-3)


def test_a_pixel_of_a_picture_shows_its_whole_area() -> None:
    mesh, atlas = square_room()
    rng = np.random.default_rng(2)
    noisy = tuple(rng.integers(0, 256, page.shape, dtype=np.uint8) for page in atlas.pages)
    fine = Atlas(noisy, atlas.page, atlas.uv, atlas.padding)
    small = CameraModel(20, 15, 11.25, 11.0, 9.3, 7.175)  # CAMERA with pixels of four times its pixels' edge
    seen = render.picture(mesh, fine, small, FORWARD)
    point = render.render_coloured(mesh, fine, small, FORWARD)
    np.testing.assert_array_equal(seen.covered, point.covered)
    np.testing.assert_array_equal(seen.depth, point.depth)
    dense = render.render_coloured(mesh, fine, CAMERA, FORWARD)
    whole = dense.covered.reshape(15, 4, 20, 4).all(axis=(1, 3)) & seen.covered
    mean = dense.values.reshape(15, 4, 20, 4, 3).mean(axis=(1, 3))
    error, before = (np.abs(view.values - mean)[whole].mean() for view in (seen, point))
    assert whole.sum() > 100 and error < 0.6 * before


def test_render_darkens_as_the_lens_of_the_map_does(room: Path) -> None:
    out, lens = room / "view.png", np.array([-0.5, 0.1, 0.0])
    arguments = ["render", str(room), "--pose", POSE, "--out", str(out), "--intrinsics"]
    intrinsics = "80 60 45 44 38.7 30.2"
    assert main([*arguments, intrinsics]) == 0
    before = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)
    other = replace(CAMERA, fx=60.0)
    assert write_lenses(room / "map", {}) == 0
    write_lenses(room / "map", {"far": (other, 3 * lens), "cam": (CAMERA, lens)})
    assert main([*arguments, intrinsics]) == 0
    after = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)
    expected = np.rint(before[..., :3] * falloff(CAMERA, lens.tolist())[..., None])
    np.testing.assert_allclose(after[..., :3], expected, atol=1.0)
    assert after[30, 5, 0] < 0.9 * before[30, 5, 0]
    assert main([*arguments[:-1], "--no-falloff", "--intrinsics", intrinsics]) == 0
    np.testing.assert_array_equal(cv2.imread(str(out), cv2.IMREAD_UNCHANGED), before)
    assert known_falloff(room / "map", replace(CAMERA, fx=50.0)) == ()
    assert known_falloff(None, CAMERA) == ()
    (room / "map" / "lenses.json").write_text("[]")
    with pytest.raises(InputError, match="damaged"):
        known_falloff(room / "map", CAMERA)


@pytest.mark.parametrize(("text", "expected"), [("front wall", {0, 1}), ("FLOOR", {8, 9})])
def test_highlight_finds_objects_and_classes(room: Path, text: str, expected: set[int]) -> None:
    mesh, _ = open_map(room)
    assert set(np.flatnonzero(highlighted_triangles(room, mesh, text)).tolist()) == expected


def test_highlight_tints_only_what_is_meant(room: Path) -> None:
    mesh, atlas = open_map(room)
    plain, _ = render.overlay(mesh, CAMERA, FORWARD, atlas)
    tinted, _ = render.overlay(mesh, CAMERA, FORWARD, atlas, highlighted_triangles(room, mesh, "floor"))
    triangle = render.render_coloured(mesh, atlas, CAMERA, FORWARD).triangle
    floor = triangle >= 8
    assert floor.any() and not floor.all()
    np.testing.assert_array_equal(plain[~floor], tinted[~floor])
    assert (plain[floor] != tinted[floor]).any(axis=1).mean() > 0.95


def test_highlight_of_what_is_not_there_says_what_is(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["render", str(room), "--pose", POSE, "--intrinsics", "80 60 45 44 38.7 30.2"]
    assert main([*arguments, "--out", str(room / "x.png"), "--highlight", "unicorn"]) == 2
    told = capsys.readouterr().err
    assert "'unicorn'" in told and "Front Wall, floor" in told and not (room / "x.png").exists()


def test_texture_of_another_mesh_is_refused(room: Path) -> None:
    mesh, _ = square_room()
    write_ply(room / "mesh.ply", bare_mesh(mesh.vertices, mesh.faces[:4]))
    with pytest.raises(InputError, match="is of 10 triangles"):
        open_map(room)
    assert open_map(room, textured=False)[1] is None


def test_pictures_are_smooth_enough_for_these_tests() -> None:
    steps = np.abs(np.diff(smooth_picture(32, 64, 0).astype(int), axis=1))
    assert 0 < steps.max() < 30
