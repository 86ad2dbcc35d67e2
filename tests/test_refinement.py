"""Texture from photographs: a wall of known colours, photographed; what comes out must be those colours."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from artemis_edge.block_store import COLOUR, INFORMATION, LOG_CLASS
from artemis_edge.config import RefinementConfig
from artemis_edge.export.atlas import Atlas
from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import F32, F64, U8, CameraImage, CameraModel, TrackedFrame
from artemis_edge.lens import undistorted_lines
from artemis_edge.map_writer import gather_mesh
from artemis_edge.refinement import texels as tx
from artemis_edge.refinement.painting import new_brush, paint
from artemis_edge.refinement.photographs import Alternate, Waiting
from artemis_edge.refinement.reliability import PARTS
from artemis_edge.refinement.stage import Refinement
from tests import naive

WALL_X = 3.3
MODEL = CameraModel(160, 120, 110.0, 112.0, 79.0, 61.0, (-0.1, 0.02, 0.001, -0.001, 0.0))
# x forward of the world is z of the camera
AXES = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
CALM = RefinementConfig(wait_frames=0, patience_frames=0, vignetting=False, alternate=False)


def colour_of(points: F64) -> F64:
    """Colours (n, 3) of places on the wall."""
    y, z = points[:, 1], points[:, 2]
    return np.stack(
        [130 + 60 * np.sin(4 * y), 120 + 50 * np.cos(5 * z), 110 + 40 * np.sin(3 * (y + z))], axis=1
    )


def pose(y: float = 0.0, z: float = 0.0, x: float = 0.0) -> F64:
    """T_world_cam looking at the wall from x, y, z."""
    T = AXES.copy()
    T[:3, 3] = (x, y, z)
    return T


def photograph(T_world_cam: F64, gain: float = 1.0) -> U8:
    """RGB picture of the wall."""
    lines = undistorted_lines(MODEL).astype(np.float64).reshape(-1, 2)
    rays = np.column_stack([lines, np.ones(len(lines))]) @ T_world_cam[:3, :3].T
    t = (WALL_X - T_world_cam[0, 3]) / rays[:, 0]
    colour = colour_of(T_world_cam[:3, 3] + t[:, None] * rays) * gain
    pixels: U8 = np.rint(colour.clip(0, 255)).astype(np.uint8).reshape(MODEL.height, MODEL.width, 3)
    return pixels


def camera_image(pixels: U8, name: str = "cam", exposure_s: float = 0.0) -> CameraImage:
    data = bytes(cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))[1])
    return CameraImage(name, 1_000_000_000, data, MODEL, np.eye(4), exposure_s)


def frame_with(*images: tuple[CameraImage, F64]) -> TrackedFrame:
    empty = naive.frame_of(np.empty((0, 3)))
    return replace(empty, images=tuple(image for image, _ in images), image_poses=tuple(T for _, T in images))


class Scene:
    """The meshed wall and its refinement."""

    def __init__(self, folder: Path, config: RefinementConfig = CALM) -> None:
        rng = np.random.default_rng(5)
        self.mapper = naive.SmallMapper(folder)
        for _ in range(4):
            self.mapper.add(naive.rectangle(rng, (WALL_X, -1.2, -0.9), (0, 2.4, 0), (0, 0, 1.8), 400, 0.003))
        self.mapper.finish()
        self.refinement = Refinement(config, self.mapper.voxel_map, 40e6, folder)

    def look(self, *images: tuple[CameraImage, F64]) -> None:
        self.mapper.stamp += 1
        self.refinement.update(frame_with(*images), self.mapper.stamp)

    def textured(self) -> tuple[Mesh, Atlas]:
        self.refinement.finish()
        mesh = gather_mesh(self.mapper.pager, 0.4, 1)
        return mesh, self.refinement.atlas(mesh)

    def colours(self) -> tuple[F64, F64]:
        """Places and mean colours of the vertices that a camera has seen."""
        store = self.mapper.store
        seen = store.attribute[:, INFORMATION] > 0.0
        return store.vertex[seen, :3].astype(np.float64), store.attribute[seen, COLOUR : COLOUR + 3].astype(
            np.float64
        )


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


def test_no_image_colours_the_map_where_that_is_turned_off(tmp_path: Path) -> None:
    scene = Scene(tmp_path, msgspec.structs.replace(CALM, enabled=False))
    scene.look((camera_image(photograph(pose())), pose()))
    _, atlas = scene.textured()
    assert len(scene.colours()[0]) == 0 and not atlas.pages


def sample(mesh: Mesh, atlas: Atlas, at: F32) -> tuple[F64, F64]:
    """Places and atlas colours at barycentric ``at`` (3,) of every textured face."""
    faces = np.flatnonzero(atlas.page >= 0)
    places = np.einsum("fkc,k->fc", mesh.vertices[mesh.faces[faces]].astype(np.float64), at)
    uv = np.einsum("fkc,k->fc", atlas.uv[faces], at)
    colours = np.empty((len(faces), 3))
    for k, page in enumerate(atlas.pages):
        here = atlas.page[faces] == k
        u, v = (uv[here, c].astype(np.float32)[None] for c in (0, 1))
        colours[here] = cv2.remap(page, u, v, cv2.INTER_LINEAR)[0]
    return places, colours


def error(places: F64, colours: F64) -> float:
    """Root mean square difference to the wall's colours, grey levels."""
    return float(np.sqrt(np.mean((colours - colour_of(places)) ** 2)))


def test_vertices_and_texels_take_the_walls_colours(scene: Scene) -> None:
    for T in (pose(), pose(0.2, 0.1), pose(-0.2, -0.1)):
        scene.look((camera_image(photograph(T)), T))
    places, colours = scene.colours()
    assert len(places) > 150 and error(places, colours) < 3.0
    mesh, atlas = scene.textured()
    assert np.mean(atlas.page >= 0) > 0.95
    for at in ((1 / 3, 1 / 3, 1 / 3), (0.8, 0.1, 0.1), (0.5, 0.5, 0.0)):
        assert error(*sample(mesh, atlas, np.array(at, np.float32))) < 3.0


def test_the_same_images_give_the_same_texture(tmp_path: Path) -> None:
    pages = []
    for name in ("a", "b"):
        scene = Scene(tmp_path / name)
        scene.look((camera_image(photograph(pose())), pose()))
        pages.append(scene.textured()[1])
    for one, other in zip(pages[0].pages, pages[1].pages, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(pages[0].uv, pages[1].uv)


def test_meshing_anew_keeps_the_texture(scene: Scene) -> None:
    for _ in range(2):  # the first image finds out how much is in view
        scene.look((camera_image(photograph(pose())), pose()))
    before = tx.used_texels(scene.refinement.texels)
    rng = np.random.default_rng(9)
    for _ in range(8):  # other points, other vertices, other triangles
        scene.mapper.add(naive.rectangle(rng, (WALL_X, -1.2, -0.9), (0, 2.4, 0), (0, 0, 1.8), 900, 0.003))
    scene.mapper.finish()
    mesh, atlas = scene.textured()
    assert tx.used_texels(scene.refinement.texels) == before
    assert np.mean(atlas.page >= 0) > 0.95
    assert error(*sample(mesh, atlas, np.array((1 / 3, 1 / 3, 1 / 3), np.float32))) < 3.0


def test_an_exposure_jump_is_taken_back(scene: Scene) -> None:
    scene.look((camera_image(photograph(pose())), pose()))
    for k in range(4):
        T = pose(0.05 * k)
        scene.look((camera_image(photograph(T, 0.6)), T))
    places, colours = scene.colours()
    assert error(places, colours) < 4.0


def test_what_one_image_clips_another_may_have_seen(scene: Scene) -> None:
    for k, gain in enumerate((1.6, *6 * (0.8,))):
        T = pose(0.04 * k)
        scene.look((camera_image(photograph(T, gain)), T))
    places, colours = scene.colours()
    assert colours.max() > 270.0
    assert error(places, colours / 1.6) < 4.0
    exposure = scene.refinement.exposure
    assert 0.75 < exposure < 0.98
    mesh, atlas = scene.textured()
    places, colours = sample(mesh, atlas, np.array((1 / 3, 1 / 3, 1 / 3), np.float32))
    assert error(places, colours / (1.6 * exposure)) < 4.0


def test_a_wrong_first_colour_is_not_defended_for_ever(scene: Scene) -> None:
    wrong = np.full((MODEL.height, MODEL.width, 3), 20, np.uint8)
    wrong[:, ::2] = 24
    right = photograph(pose())
    mixed = right.copy()
    mixed[40:80, 60:100] = wrong[40:80, 60:100]  # somebody in front of a part of the wall
    for _ in range(2):
        scene.look((camera_image(mixed), pose()))
    for _ in range(25):
        scene.look((camera_image(right), pose()))
    assert error(*scene.colours()) < 4.0


def test_one_who_walks_by_leaves_little_trace(scene: Scene) -> None:
    right = photograph(pose())
    for _ in range(8):
        scene.look((camera_image(right), pose()))
    passed = right.copy()
    passed[:, 60:100] = (250, 20, 20)
    scene.look((camera_image(passed), pose()))
    assert error(*scene.colours()) < 4.0


def test_what_something_hides_is_not_coloured(tmp_path: Path) -> None:
    scene = Scene(tmp_path)
    rng = np.random.default_rng(2)
    for _ in range(4):  # a board half way, which hides the middle of the wall
        scene.mapper.add(naive.rectangle(rng, (1.65, -0.4, -0.4), (0, 0.8, 0), (0, 0, 0.8), 900, 0.003))
    scene.mapper.finish()
    scene.look((camera_image(photograph(pose())), pose()))
    places, _ = scene.colours()
    wall = places[places[:, 0] > 3.0]
    assert (np.abs(wall[:, 1:]) < 0.55).all(axis=1).sum() == 0
    assert len(wall) > 100
    board = places[places[:, 0] < 2.0]
    assert len(board) > 20


@pytest.mark.parametrize(
    ("reason", "change"),
    [
        ("images_undecodable", lambda i: replace(i, encoded=b"no image")),
        ("images_undecodable", lambda i: replace(i, encoded=b"")),
        ("images_of_wrong_size", lambda i: replace(i, model=replace(MODEL, width=320))),
        ("images_without_calibration", lambda i: replace(i, model=replace(MODEL, fx=float("nan")))),
        ("images_without_pose", lambda i: replace(i, T_cam_lidar=np.full((4, 4), np.nan))),
        ("images_black_or_clipped", lambda i: camera_image(np.zeros((120, 160, 3), np.uint8))),
        ("images_black_or_clipped", lambda i: camera_image(np.full((120, 160, 3), 255, np.uint8))),
    ],
)
def test_bad_images_are_counted_and_harm_nothing(scene: Scene, reason: str, change) -> None:  # type: ignore[no-untyped-def]
    good = camera_image(photograph(pose()))
    scene.look((good, pose()))
    before = scene.mapper.store.attribute.copy()
    scene.look((change(good), pose()))
    scene.look((change(good), pose()))
    assert dict(scene.refinement.lost) == {reason: 2}
    assert list(scene.refinement.refused.sentences) == [reason]
    np.testing.assert_array_equal(scene.mapper.store.attribute, before)


def test_a_smeared_image_weighs_less() -> None:
    from artemis_edge.refinement.stage import sharpness

    image = camera_image(np.zeros((120, 160, 3), np.uint8), exposure_s=0.01)
    turn = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 5.0])
    assert sharpness(image, np.zeros(6)) == 1.0
    assert sharpness(image, turn) == pytest.approx(1.0 / (5.0 * 0.01 * 110.0) ** 2)
    assert sharpness(replace(image, exposure_s=0.0), turn) == 1.0


def test_every_second_image_is_used_where_the_camera_hardly_moves() -> None:
    image = camera_image(np.zeros((120, 160, 3), np.uint8))

    def taken(wanted: bool, places: list[tuple[str, float]]) -> list[bool]:
        chooser = Alternate(wanted)
        return [chooser.takes(Waiting(replace(image, name=n), pose(y), np.zeros(6), 0)) for n, y in places]

    still = [("a", 0.0)] * 5
    assert taken(True, still) == [True, False, True, False, True]
    assert taken(False, still) == [True] * 5
    assert taken(True, [("a", 0.0), ("b", 0.0), ("a", 0.0), ("b", 0.0)]) == [True, True, False, False]
    assert taken(True, [("a", 0.5 * k) for k in range(4)]) == [True] * 4
    assert taken(True, [("a", 0.0), ("a", 0.0), ("a", 1.0)]) == [True, False, True]


def test_images_wait_until_their_surface_is_meshed(tmp_path: Path) -> None:
    scene = Scene(tmp_path, RefinementConfig(wait_frames=3, patience_frames=10))
    scene.look((camera_image(photograph(pose())), pose()))
    for _ in range(2):
        scene.look()
    assert len(scene.colours()[0]) == 0
    scene.look()
    assert len(scene.colours()[0]) > 100


def test_late_surface_is_coloured_from_keyframes(tmp_path: Path) -> None:
    scene = Scene(tmp_path)
    scene.look((camera_image(photograph(pose())), pose()))
    rng = np.random.default_rng(4)
    for _ in range(4):  # the wall goes on beyond what was meshed when the image was used
        scene.mapper.add(naive.rectangle(rng, (WALL_X, 1.2, -0.9), (0, 0.8, 0), (0, 0, 1.8), 400, 0.003))
    scene.mapper.finish()
    mesh, atlas = scene.textured()
    places, colours = sample(mesh, atlas, np.array((1 / 3, 1 / 3, 1 / 3), np.float32))
    late = places[:, 1] > 1.4
    assert late.sum() > 20 and error(places[late], colours[late]) < 4.0


def test_who_wants_an_end_is_told_what_was_left_out(scene: Scene) -> None:
    scene.look((camera_image(photograph(pose())), pose()))
    asked: list[tuple[int, int]] = []

    def go_on(done: int, total: int) -> bool:
        asked.append((done, total))
        return False

    scene.refinement.finish(go_on)
    assert asked == [(0, 1)] and scene.refinement.lost == {"keyframes_not_asked_again": 1}


@pytest.mark.parametrize(("enough", "kept"), [(4.0 * tx.INFORMATION_SCALE, True), (math.inf, False)])
def test_at_the_end_a_view_from_afar_leaves_alone_what_was_seen_from_nearby(
    scene: Scene, enough: float, kept: bool
) -> None:
    near, far = pose(x=WALL_X - 0.6), pose()
    for _ in range(3):
        scene.look((camera_image(photograph(near)), near))
    refinement, texels = scene.refinement, scene.refinement.texels
    used = int(texels.counter[tx.N_TEXELS])  # what lies behind is not initialised
    before = texels.texel[:used].copy()
    view = refinement.viewer.look(photograph(far), MODEL, far)
    photo = refinement.viewer.weigh(view, None, None).photo
    brush = new_brush(scene.mapper.voxel_map.config.voxel_m, CALM.texel_px, CALM.finest_texel_m)
    painted = paint(
        texels, view.visible, scene.mapper.store.vertex, photo, refinement.trust, brush, 99, PARTS, enough
    )
    known = before[:, 3] > 0
    assert known.sum() > 1000 and painted > 1000, "it sees more of the wall"
    assert np.array_equal(texels.texel[:used][known], before[known]) == kept


def test_without_images_there_is_no_texture(scene: Scene) -> None:
    mesh, atlas = scene.textured()
    assert (atlas.page == -1).all() and len(atlas) == len(mesh.faces) and atlas.pages == ()
    assert scene.mapper.store.attribute.shape[1] == LOG_CLASS


def test_texture_comes_back_from_disk(scene: Scene) -> None:
    scene.look((camera_image(photograph(pose())), pose()))
    mesh, whole = scene.textured()
    pages = scene.refinement.pages
    for block in sorted(tx.chart_blocks(scene.refinement.texels)):
        pages.leave(*block)
    assert tx.used_texels(scene.refinement.texels) == 0 and len(pages) > 0
    parts = scene.refinement.atlas(mesh)
    np.testing.assert_array_equal(whole.page, parts.page)
    for one, other in zip(whole.pages, parts.pages, strict=True):
        np.testing.assert_array_equal(one, other)
    scene.refinement.close()
