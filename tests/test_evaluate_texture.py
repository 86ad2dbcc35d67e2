"""Likeness to photographs against slow formulas, and the command from a map with points and images."""

import json
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from artemis_edge.cli import main
from artemis_edge.colouring import add_colours, coloured_points, open_splats
from artemis_edge.errors import InputError
from artemis_edge.evaluate.likeness import channel_gains, psnr_db, ssim
from artemis_edge.evaluate.photos import read_photos
from artemis_edge.evaluate.texture import run
from artemis_edge.export.atlas import write_atlas
from artemis_edge.export.ply import write_ply
from artemis_edge.frames import CameraModel
from artemis_edge.kept_images import INDEX
from artemis_edge.kept_points import FILE, ROW, PointSpool, open_points
from artemis_edge.known_lenses import write_lenses
from artemis_edge.lens import distort
from artemis_edge.lens import falloff as darkened
from artemis_edge.render import picture
from artemis_edge.splats import NOTHING, blank, lens_of, splat
from artemis_edge.trajectory import inverse, matrix_from_quaternion
from tests.textured import square_room

CAMERA = CameraModel(96, 72, 60.0, 60.0, 47.1, 36.4, (-0.1, 0.02, 0.001, 0.0, 0.0))


def camera_pose(yaw: float) -> np.ndarray:
    """In the middle of the room, looking along x turned by yaw about z."""
    turn = np.array([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)])
    look = matrix_from_quaternion(np.zeros(3), np.array([-0.5, 0.5, -0.5, 0.5]))
    return matrix_from_quaternion(np.array([0.1, -0.2, 0.1]), turn) @ look


def naive_ssim(a: np.ndarray, b: np.ndarray, covered: np.ndarray) -> float:
    """Pixel by pixel, window by window (Wang et al. 2004), weights of covered pixels only."""
    luma = np.array([0.299, 0.587, 0.114])
    x, y = a.astype(float) @ luma, b.astype(float) @ luma
    h, w = covered.shape
    values = []
    for v in range(h):
        for u in range(w):
            if not covered[v, u]:
                continue
            weights, xs, ys = [], [], []
            for dv in range(-5, 6):
                for du in range(-5, 6):
                    row, column = v + dv, u + du
                    if 0 <= row < h and 0 <= column < w and covered[row, column]:
                        weights.append(np.exp(-(du * du + dv * dv) / (2 * 1.5**2)))
                        xs.append(x[row, column])
                        ys.append(y[row, column])
            g, p, q = np.array(weights) / np.sum(weights), np.array(xs), np.array(ys)
            mp, mq = g @ p, g @ q
            vp, vq, c = g @ (p - mp) ** 2, g @ (q - mq) ** 2, g @ ((p - mp) * (q - mq))
            c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
            values.append((2 * mp * mq + c1) * (2 * c + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2)))
    return float(np.mean(values))


@pytest.mark.parametrize("share", [1.0, 0.6, 0.02])
def test_ssim_equals_the_naive_one(share: float) -> None:
    rng = np.random.default_rng(4)
    a = rng.integers(0, 256, (19, 23, 3)).astype(np.uint8)
    b = np.clip(a + rng.normal(0, 40, a.shape), 0, 255).astype(np.float32)
    covered = rng.random((19, 23)) < share
    assert ssim(a, b, covered) == pytest.approx(naive_ssim(a, b, covered), abs=1e-9)
    b[~covered] = 1e6  # what is not covered has no influence
    assert ssim(a, b, covered) == pytest.approx(naive_ssim(a, b, covered), abs=1e-9)


def test_psnr_and_gains() -> None:
    rng = np.random.default_rng(2)
    own = rng.uniform(10, 200, (12, 9, 3)).astype(np.float32)
    covered = rng.random((12, 9)) < 0.5
    photo = np.rint(own * [1.2, 0.8, 1.0]).astype(np.uint8)
    np.testing.assert_allclose(channel_gains(photo, own, covered), [1.2, 0.8, 1.0], atol=0.01)
    error = (photo.astype(float) - own)[covered]
    assert psnr_db(photo, own, covered) == pytest.approx(10 * np.log10(255**2 / np.mean(error**2)))
    assert psnr_db(photo, photo.astype(np.float32), covered) == 130.0
    assert channel_gains(photo, np.zeros_like(own), covered).tolist() == [1.0, 1.0, 1.0]


def naive_splat(points: np.ndarray, T: np.ndarray, camera: CameraModel) -> np.ndarray:
    """Number of the point that each pixel shows: all points for every pixel."""
    q = points.astype(float) @ T[:3, :3].T + T[:3, 3]
    uv = np.full((len(q), 2), np.nan)
    for k, (x, y, z) in enumerate(q):
        if z >= 0.05:
            a, b = distort(x / z, y / z, np.array(camera.distortion))
            uv[k] = camera.fx * a + camera.cx, camera.fy * b + camera.cy
    out = np.full((camera.height, camera.width), NOTHING)
    for v in range(camera.height):
        for u in range(camera.width):
            with np.errstate(invalid="ignore"):
                on = np.flatnonzero(
                    (np.floor(uv) <= [u, v]).all(axis=1) & (np.floor(uv) + 1 >= [u, v]).all(axis=1)
                )
            if len(on):
                out[v, u] = on[np.argmin(q[on, 2].astype(np.float32))]
    return out


def test_splats_equal_the_naive_ones() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform([-1, -2, -2], [4, 2, 2], (400, 3)).astype(np.float32)
    points[7] = np.nan
    camera = CameraModel(30, 22, 18.0, 18.0, 14.5, 10.0)  # no fold to keep the naive one simple
    T = inverse(camera_pose(0.0))
    nearest, number = blank(camera)
    splat(points[:150], T, lens_of(camera), 0, nearest, number)
    splat(points[150:], T, lens_of(camera), 150, nearest, number)
    np.testing.assert_array_equal(number, naive_splat(points, T, camera))
    before = number.copy()
    splat(points[:0], T, lens_of(camera), 400, nearest, number)
    np.testing.assert_array_equal(number, before)


def test_hidden_points_get_no_colour() -> None:
    camera = CameraModel(21, 21, 20.0, 20.0, 10.0, 10.0)
    points = np.array([[0, 0, 2.0], [0, 0, 2.05], [0, 0, 5.0], [0, 0, -2.0], [9, 0, 2.0]], np.float32)
    image = np.zeros((21, 21, 3), np.uint8)
    image[10, 10] = [10, 20, 30]
    nearest, number = blank(camera)
    splat(points, np.eye(4), lens_of(camera), 0, nearest, number)
    sums, seen = np.zeros((5, 3), np.float32), np.zeros(5, np.int64)
    add_colours(points, np.eye(4), lens_of(camera), nearest, image, sums, seen)
    assert seen.tolist() == [1, 1, 0, 0, 0]
    assert sums[:2].tolist() == [[10, 20, 30]] * 2 and (sums[2:] == 0).all()


@pytest.mark.parametrize("most", [3, 100, 10_000])
def test_point_spool_keeps_every_stride_th(tmp_path: Path, most: int) -> None:
    rng = np.random.default_rng(1)
    spool = PointSpool(tmp_path / "spool", most)
    everything = []
    for k in range(9):
        points = rng.normal(size=(rng.integers(0, 40), 3)).astype(np.float32)
        points[::7] = np.nan
        time_s = np.linspace(-0.05, 0.05, len(points), dtype=np.float32)
        spool.add(
            points, 10**9 + k * 10**8, time_s, None if k % 2 else np.full(len(points), 0.25, np.float32)
        )
        everything.append(points[np.isfinite(points).all(axis=1)])
    spool.save(tmp_path)
    kept = open_points(tmp_path)
    assert kept is not None
    rows = np.concatenate(list(kept.chunks()))
    whole = np.concatenate(everything)
    np.testing.assert_array_equal(rows["position"], whole[:: kept.stride])
    assert len(rows) <= most and (kept.stride == 1) == (len(whole) <= most)
    assert len(rows) * 2 + 2 > min(most, len(whole))
    assert rows["seen"].max() == 0 and set(rows["intensity"]) <= {0, 16384}
    seconds = kept.zero_ns * 1e-9 + rows["tick"] * 1e-5
    assert seconds.min() > 0.949 and seconds.max() < 1.86 and (np.diff(rows["tick"].astype(int)) >= 0).all()


def test_damaged_points_are_refused(tmp_path: Path) -> None:
    assert open_points(tmp_path) is None
    spool = PointSpool(tmp_path / "spool", 100)
    spool.add(np.eye(3, dtype=np.float32), 0, np.zeros(3, np.float32), None)
    spool.save(tmp_path)
    content = (tmp_path / FILE).read_bytes()
    for damaged in (b"", content[:-1], content + bytes(ROW.itemsize), b"x" + content[1:]):
        (tmp_path / FILE).write_bytes(damaged)
        with pytest.raises(InputError, match="damaged"):
            open_points(tmp_path)


def photo_entry(file: str, T_world_cam: np.ndarray) -> dict[str, object]:
    return {
        "file": file, "fx": CAMERA.fx, "fy": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy,
        "distortion": list(CAMERA.distortion), "T_cam_world": inverse(T_world_cam).tolist(),
    }  # fmt: skip


def write_photos(folder: Path, index: str, yaws: list[float], gain: float = 1.0) -> None:
    """Photographs of the room and their index; the last one is taken looking at nothing."""
    mesh, atlas = square_room()
    entries = []
    for k, yaw in enumerate(yaws):
        T = camera_pose(yaw)
        image = picture(mesh, atlas, CAMERA, T).values * gain
        name = f"{index}_{k}.png"
        cv2.imwrite(str(folder / name), np.rint(image[..., ::-1]).clip(0, 255).astype(np.uint8))
        entries.append(photo_entry(name, T))
    (folder / index).write_text(json.dumps({"photos": entries}))


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """A textured map with points on its walls, images of it, and photographs that are half as bright."""
    mesh, atlas = square_room()
    folder = tmp_path / "map"
    folder.mkdir()
    write_ply(tmp_path / "mesh.ply", mesh)
    write_atlas(folder, atlas)
    rng = np.random.default_rng(5)
    wall = np.concatenate([np.full((6000, 1), 2.0), rng.uniform([-2, -0.7], [2, 0.7], (6000, 2))], axis=1)
    behind = wall[:300] + np.array([1.5, 0, 0])
    spool = PointSpool(tmp_path / "spool", 10_000)
    spool.add(np.concatenate([behind, wall]).astype(np.float32), 0, np.zeros(6300, np.float32), None)
    spool.save(folder)
    write_photos(folder, INDEX, [0.05, -0.1])
    write_photos(tmp_path, "PHOTOS.json", [0.0, 0.02], gain=0.5)
    return tmp_path


def test_points_take_the_mean_of_the_images_that_see_them(room: Path) -> None:
    kept = coloured_points(room / "map")
    assert kept is not None
    before = kept.path.stat()
    assert coloured_points(room / "map") == open_points(room / "map") == kept
    after = kept.path.stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns) and kept.coloured  # once
    rows = np.concatenate(list(kept.chunks()))
    assert (rows["seen"][300:] == 2).mean() > 0.4
    assert (rows["seen"][:300] == 0).mean() > 0.8  # behind the wall
    images = list(read_photos(room / "map" / INDEX))
    for k in np.flatnonzero(rows["seen"] == 2)[::50]:
        colours = []
        for photo in images:
            x, y, z = (inverse(photo.T_world_cam) @ np.append(rows["position"][k], 1.0))[:3]
            a, b = distort(x / z, y / z, np.array(CAMERA.distortion))
            u, v = round(CAMERA.fx * a + CAMERA.cx), round(CAMERA.fy * b + CAMERA.cy)
            colours.append(photo.image[v, u])
        np.testing.assert_allclose(rows["colour"][k], np.mean(colours, axis=0), atol=0.51)


def test_evaluate_texture_measures_map_and_baseline(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["evaluate", "texture", str(room), "--photos", str(room / "PHOTOS.json")]
    assert main([*arguments, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert {"psnr", "psnr_gain", "ssim", "coverage", "photos", "points_baseline"} == set(result)
    assert result["psnr_gain"] > 45 > 15 > result["psnr"]  # half as bright; rounded to whole levels
    assert result["ssim"] > 0.99 and 0.7 < result["coverage"] < 1.0
    photos = result["photos"]
    assert [photo["file"] for photo in photos] == ["PHOTOS.json_0.png", "PHOTOS.json_1.png"]
    assert result["psnr"] == pytest.approx(np.mean([photo["psnr"] for photo in photos]))
    baseline = result["points_baseline"]
    assert 15 < baseline["psnr_gain"] < result["psnr_gain"] and 0.2 < baseline["coverage"] < 0.9
    assert len(baseline["photos"]) == 2
    common = baseline["common"]
    assert common["mesh"]["coverage"] == common["points"]["coverage"] <= baseline["coverage"]
    assert common["mesh"]["psnr_gain"] > common["points"]["psnr_gain"]
    assert main(arguments) == 0
    assert "on the pixels that both cover" in capsys.readouterr().out


def test_the_lens_fall_off_is_put_back(room: Path) -> None:
    falloff = (-0.5, 0.1, -0.2)
    index = json.loads((room / "PHOTOS.json").read_text())
    for entry in index["photos"]:
        entry["falloff"] = falloff
        image = np.asarray(cv2.imread(str(room / entry["file"]))) * darkened(CAMERA, falloff)[..., None]
        cv2.imwrite(str(room / entry["file"]), np.rint(image).astype(np.uint8))
    (room / "PHOTOS.json").write_text(json.dumps(index))
    result = run(room, room / "PHOTOS.json").to_json()
    assert result["psnr_gain"] > 45 > 35 > result["without_falloff"]["psnr_gain"]
    common = result["points_baseline"]["common"]
    assert common["mesh"]["psnr_gain"] > common["mesh_without_falloff"]["psnr_gain"]
    bare = {"photos": [{k: v for k, v in entry.items() if k != "falloff"} for entry in index["photos"]]}
    (room / "PHOTOS.json").write_text(json.dumps(bare))
    assert "without_falloff" not in run(room, room / "PHOTOS.json").to_json()
    write_lenses(room / "map", {"cam": (CAMERA, np.array(falloff))})
    assert run(room, room / "PHOTOS.json").to_json() == result
    (room / "PHOTOS.json").write_text(json.dumps({"photos": [index["photos"][0] | {"falloff": "dark"}]}))
    with pytest.raises(InputError, match="not complete"):
        run(room, room / "PHOTOS.json")


def test_a_bare_mesh_has_no_baseline_and_may_cover_nothing(room: Path, tmp_path: Path) -> None:
    alone = tmp_path / "alone"
    alone.mkdir()
    mesh, _ = square_room()
    mesh.vertices[:] += 100.0
    write_ply(alone / "mesh.ply", mesh)
    result = run(alone / "mesh.ply", room / "PHOTOS.json").to_json()
    assert result["points_baseline"] is None
    assert (result["psnr"], result["ssim"], result["coverage"]) == (None, None, 0.0)


def test_a_map_whose_points_no_image_saw_has_no_baseline(tmp_path: Path) -> None:
    assert open_splats(tmp_path) is None
    spool = PointSpool(tmp_path / "spool", 100)
    spool.add(np.eye(3, dtype=np.float32), 0, np.zeros(3, np.float32), None)
    spool.save(tmp_path)
    assert open_splats(tmp_path) is None


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"file": "none.png"}, "cannot read the photograph"),
        ({"file": "PHOTOS.json"}, "not a picture that can be decoded"),
        ({"fx": 0}, "fx and fy must be"),
        ({"fx": None}, "is not complete"),
        ({"distortion": [0, 0]}, "is not complete"),
        ({"T_cam_world": np.diag([1, 1, -1, 1]).tolist()}, "not a rotation"),
        ({"T_cam_world": [[1]]}, "not a rotation"),
    ],
)
def test_photos_of_no_use_are_refused(room: Path, change: dict[str, object], sentence: str) -> None:
    content = json.loads((room / "PHOTOS.json").read_text())
    content["photos"][0] |= change
    (room / "PHOTOS.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=sentence):
        run(room, room / "PHOTOS.json")


def test_a_picture_larger_than_any_is_refused(room: Path) -> None:
    """Its header is whole, so that the decoder does not return nothing but raises."""
    path = room / json.loads((room / "PHOTOS.json").read_text())["photos"][0]["file"]
    header = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    path.write_bytes(
        path.read_bytes()[:12] + header + struct.pack(">I", zlib.crc32(header)) + path.read_bytes()[33:]
    )
    with pytest.raises(InputError, match="not a picture that can be decoded"):
        run(room, room / "PHOTOS.json")


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"photos": []}', '{"photos": 3}'])
def test_an_index_without_photos_is_refused(room: Path, content: str) -> None:
    (room / "PHOTOS.json").write_text(content)
    with pytest.raises(InputError, match="holdout N"):
        run(room, room / "PHOTOS.json")
