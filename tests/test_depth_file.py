"""Reference depth kept in a file: what comes back, what is refused, what a question to a finished mesh makes of it."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from artemis_edge.ask import MeshBrush
from artemis_edge.config import SemanticsConfig
from artemis_edge.depth_file import decode_depth, encode_depth
from artemis_edge.errors import InputError
from artemis_edge.export.mesh import bare_mesh
from artemis_edge.frames import F32, F64, CameraImage, CameraModel
from artemis_edge.segmentation.backend import DenseScores, Grid, Segmentation
from artemis_edge.segmentation.keyframes import Apart, Keyframe, KeyframeStore, read_keyframes
from artemis_edge.sight import DEPTH, DOWN, INVERSE, RIGHT, Sight, cell_px, filled, new_sight

CAMERA = CameraModel(320, 256, 225.0, 225.0, 160.0, 128.0)
STEP = 0.002  # of what is relative to the depth
APART = Apart(0.5, 0.3)


def some_depth() -> Sight:
    """Random planes, a quarter of the cells unknown."""
    view, rng = new_sight(CAMERA, np.eye(4)), np.random.default_rng(3)
    shape = view.depth.shape[:2]
    z = np.exp(rng.uniform(np.log(0.3), np.log(60.0), shape))
    view.depth[:, :, DEPTH] = np.where(rng.random(shape) < 0.25, np.inf, z)
    view.depth[:, :, INVERSE] = rng.uniform(-0.5, 2.0, shape) / z
    view.depth[:, :, RIGHT], view.depth[:, :, DOWN] = rng.normal(0.0, 0.1, (2, *shape)) / z
    view.depth[view.depth[:, :, DEPTH] == np.inf, 1:] = 0.0
    return view


def test_depth_comes_back_as_exactly_as_it_is_known() -> None:
    view = some_depth()
    content = encode_depth(view.depth, view.lens)
    assert content == encode_depth(view.depth.copy(), view.lens)
    found = decode_depth(content, view.lens)
    assert (found.shape, found.dtype) == (view.depth.shape, np.float32)
    known = np.isfinite(view.depth[:, :, DEPTH])
    assert 0.6 < known.mean() < 0.9
    np.testing.assert_array_equal(np.isfinite(found[:, :, DEPTH]), known)
    assert not found[~known][:, 1:].any()
    z = view.depth[known][:, DEPTH]
    np.testing.assert_allclose(found[known][:, DEPTH] / z, 1.0, atol=0.51 * STEP)
    scale = np.array([1.0, cell_px(view.lens), cell_px(view.lens)])
    # the planes are relative to the depth as it is told
    off = (found[known] - view.depth[known])[:, 1:] * found[known][:, :1] * scale
    assert np.abs(off).max() < 0.51 * STEP
    assert encode_depth(found, view.lens) == content, "it is told once"


def test_nothing_known_and_planes_beyond_all_numbers() -> None:
    view = new_sight(CAMERA, np.eye(4))
    np.testing.assert_array_equal(decode_depth(encode_depth(view.depth, view.lens), view.lens), view.depth)
    view.depth[2, 3] = 5.0, 1e9, -1e9, np.float32(3e30)
    far = decode_depth(encode_depth(view.depth, view.lens), view.lens)[2, 3]
    assert np.isfinite(far).all() and far[DEPTH] == pytest.approx(5.0, rel=STEP)
    assert far[INVERSE] > 10 and far[RIGHT] < -1 and far[DOWN] > 1


def test_what_is_no_depth_of_this_camera_is_refused() -> None:
    view = some_depth()
    whole = encode_depth(view.depth, view.lens)
    eight_bits = bytes(
        cv2.imencode(".png", np.zeros((4 * view.depth.shape[0], view.depth.shape[1]), np.uint8))[1]
    )
    wider = view.lens.copy()
    wider[9] += 100.0
    for content, lens in (
        (b"", view.lens), (b"\x89PNG no", view.lens), (whole[:90], view.lens), (eight_bits, view.lens), (whole, wider),
    ):  # fmt: skip
        with pytest.raises(InputError, match="is not a depth map of"):
            decode_depth(content, lens)
    beyond = np.full((4 * view.depth.shape[0], view.depth.shape[1]), 65535, np.uint16)
    with pytest.raises(InputError, match="depths beyond any map"):
        decode_depth(bytes(cv2.imencode(".png", beyond)[1]), view.lens)


def test_the_size_is_refused_before_anything_is_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    view = some_depth()
    whole = encode_depth(view.depth, view.lens)
    header = b"IHDR" + struct.pack(">II", 16_000, 16_000) + whole[24:29]
    vast = whole[:12] + header + struct.pack(">I", zlib.crc32(header)) + whole[33:]
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    for content in (vast, whole[:20], b"BM" + whole[2:]):
        with pytest.raises(InputError, match="is not a depth map of"):
            decode_depth(content, view.lens)


def test_where_nothing_was_known_what_is_known_now_stands() -> None:
    then, now = some_depth(), some_depth()
    now.depth[:, :, DEPTH] += 1.0
    both, known = filled(then.depth, now.depth), np.isfinite(then.depth[:, :, DEPTH])
    np.testing.assert_array_equal(both[known], then.depth[known])
    np.testing.assert_array_equal(both[~known], now.depth[~known])
    assert filled(np.empty((0, 0, 4), np.float32), now.depth) is now.depth


def png() -> bytes:
    return bytes(cv2.imencode(".png", np.full((256, 320, 3), 90, np.uint8))[1])


def photograph(time_s: float) -> CameraImage:
    return CameraImage("cam", round(time_s * 10**9), png(), CAMERA, np.eye(4))


def place(x: float) -> F64:
    T = np.eye(4)
    T[0, 3] = x
    return T


def test_keyframes_keep_their_depth_and_hand_it_on(tmp_path: Path) -> None:
    view, looked = some_depth(), list[float]()

    def look(camera: CameraModel, T_world_cam: F64) -> Sight:
        looked.append(T_world_cam[0, 3])
        return view

    store = KeyframeStore(tmp_path / "scratch", APART, 10_000_000)
    assert store.offer(photograph(0), place(0.0), look) and store.offer(photograph(1), place(2.0))
    assert not store.offer(photograph(2), place(2.1), look)
    assert store.offer(photograph(3), place(4.0), new_sight)
    assert looked == [0.0], "nobody looks for a photograph that is not kept"
    assert store.size == sum(path.stat().st_size for path in (tmp_path / "scratch").iterdir())
    store.save(tmp_path / "map")
    again = KeyframeStore(tmp_path / "scratch_2", APART, 10_000_000)
    again.take_over(tmp_path / "map")
    again.save(tmp_path / "map_2")
    for folder in (tmp_path / "map", tmp_path / "map_2"):
        first, second, third = read_keyframes(folder)
        told: list[str] = []
        np.testing.assert_array_equal(
            first.known_depth(view.lens, told.append),
            decode_depth(encode_depth(view.depth, view.lens), view.lens),
        )
        assert second.depth is None and not second.known_depth(view.lens, told.append).size
        assert np.isinf(third.known_depth(view.lens, told.append)[:, :, DEPTH]).all(), "nothing was known"
        assert told == []
        assert first.depth is not None
        first.depth.write_bytes(b"no")
        assert not first.known_depth(view.lens, told.append).size
        first.depth.unlink()
        assert not first.known_depth(view.lens, told.append).size
        assert "is not a depth map" in told[0] and "cannot read" in told[1]


def test_the_depth_is_renewed_while_the_camera_stands_still(tmp_path: Path) -> None:
    known: list[float] = []  # pose and depth of the looks

    def look(camera: CameraModel, T_world_cam: F64) -> Sight:
        view = new_sight(camera, T_world_cam)
        view.depth[:] = 2.0 + len(known), 1.0 / (2.0 + len(known)), 0.0, 0.0
        known.append(T_world_cam[0, 3])
        return view

    store = KeyframeStore(tmp_path / "scratch", APART, 10_000_000)
    for k, x in ((0, 0.0), (0.5, 0.01), (1, 0.05), (1.5, 0.0), (2, 0.2), (3, 0.6), (4, 0.0), (5, 0.6)):
        store.offer(photograph(k), place(x), look)
    # half a second is too soon, 0.2 m too far; at 4 s it is back at the first, whose time is over
    assert known == [0.0, 0.0, 0.6, 0.6]
    store.save(tmp_path / "map")
    lens = new_sight(CAMERA, np.eye(4)).lens
    depths = [k.known_depth(lens, pytest.fail)[0, 0, DEPTH] for k in read_keyframes(tmp_path / "map")]
    np.testing.assert_allclose(depths, [3.0, 5.0], rtol=STEP)
    assert store.size == sum(path.stat().st_size for path in (tmp_path / "map/keyframes").glob("cam*"))
    again = KeyframeStore(tmp_path / "scratch_2", APART, 10_000_000)
    again.take_over(tmp_path / "map")
    again.offer(photograph(9), place(0.6), look)
    assert len(known) == 4, "of an earlier map it stays"


def test_the_depth_is_part_of_the_budget_and_goes_with_its_photograph(tmp_path: Path) -> None:
    view = some_depth()
    most = 3 * (len(png()) + len(encode_depth(view.depth, view.lens)))
    store = KeyframeStore(tmp_path, APART, most)
    for k in range(12):
        store.offer(photograph(k), place(0.6 * k), lambda *_: view)
        files = list(tmp_path.iterdir())
        assert sum(path.stat().st_size for path in files) == store.size <= most
        assert len(files) == 2 * len(store)
    (tmp_path / next(path.name for path in files if "depth" in path.name)).unlink()
    before = len(store)
    store.after_copy()
    assert len(store) == before - 1, "the other process thinned it out"


def sheet(z: float) -> F32:
    x, y = np.meshgrid(np.arange(-0.3, 0.35, 0.1), np.arange(-0.3, 0.35, 0.1))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1).astype(np.float32)


def test_a_question_sees_what_stood_free_when_the_photograph_was_taken(tmp_path: Path) -> None:
    """In the finished mesh a sheet 2 m before the camera hides one at 4 m, which was known to be free in the right
    half of the photograph; in the left half nothing was known, and the photograph tells nothing."""
    points = np.concatenate([sheet(2.0), sheet(4.0)])
    normals = np.tile(np.float32([0, 0, -1]), (len(points), 1))
    faces = np.empty((0, 3), np.int32)
    mesh = bare_mesh(points, faces, normals=normals)
    view = new_sight(CAMERA, np.eye(4))
    wide = view.depth.shape[1]
    view.depth[:, wide // 2 :] = 4.0, 0.25, 0.0, 0.0
    path = tmp_path / "depth.png"
    path.write_bytes(encode_depth(view.depth, view.lens))
    scores = np.zeros((8, 10, 2), np.uint8)
    scores[:, :, 1] = 250
    found = Segmentation(320, 256, (), (), DenseScores((0, 1), scores, Grid(1 / 32, 1 / 32, 0.0, 0.0)))
    for depth, near_left, near_right, far_left, far_right in (
        (None, True, True, False, False),
        (path, False, False, False, True),
    ):
        brush = MeshBrush(mesh, ("car",), SemanticsConfig(agreement=0.0), 0.1)
        brush.refine(Keyframe(tmp_path / "p", "cam", 0, CAMERA, np.eye(4), depth), found)
        seen = brush.labelled()[1] > 0.0
        left, near = points[:, 0] < -0.05, points[:, 2] < 3.0
        inner = np.abs(points[:, 0]) > 0.05
        for where, wanted in (
            (near & left, near_left), (near & ~left & inner, near_right),
            (~near & left, far_left), (~near & ~left & inner, far_right),
        ):  # fmt: skip
            assert (seen[where] == wanted).all(), (depth, where)
