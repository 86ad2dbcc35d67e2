"""LAZ and COLMAP of the points and images kept beside a map, read back as other programs do."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from artemis_edge.cli import main
from artemis_edge.colouring import add_colours, sees
from artemis_edge.evaluate.photos import read_photos
from artemis_edge.export import colmap
from artemis_edge.export.colmap import undistorted
from artemis_edge.export.ply import write_ply
from artemis_edge.frames import CameraImage, CameraModel, Trajectory
from artemis_edge.kept_images import INDEX, ImageSpool
from artemis_edge.kept_points import PointSpool, open_points
from artemis_edge.render import render_coloured
from artemis_edge.splats import blank, lens_of
from artemis_edge.trajectory import inverse, matrix_from_quaternion
from tests.textured import square_room

CAMERA = CameraModel(96, 72, 60.0, 60.0, 47.1, 36.4, (-0.1, 0.02, 0.001, 0.0, 0.01))
T_CAM_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0.05], [1, 0, 0, 0], [0, 0, 0, 1]])


def poses() -> Trajectory:
    T = [matrix_from_quaternion(np.array([0.1 * k, 0, 0]), np.array([0, 0, 0.1 * k, 1])) for k in range(3)]
    return Trajectory(np.array([0, 10**9, 2 * 10**9]), np.array(T))


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """A map of two walls with points and three images; all surfaces bear a label."""
    mesh, atlas = square_room()
    mesh.labels[:] = 2
    mesh.label_names.update({0: "background", 2: "front wall"})
    write_ply(tmp_path / "mesh.ply", mesh)
    folder, spool = tmp_path / "map", tmp_path / "spool"
    folder.mkdir()
    spool.mkdir()
    rng = np.random.default_rng(1)
    walls = [
        np.c_[np.full(900, 2.0), rng.uniform([-2, -0.7], [2, 0.7], (900, 2))],
        rng.normal(0, 9, (100, 3)),
    ]
    points = PointSpool(spool / "points", 5000)
    time_s = np.linspace(0.0, 0.5, 1000, dtype=np.float32)
    points.add(np.concatenate(walls).astype(np.float32), 10**9, time_s, np.full(1000, 0.5, np.float32))
    points.save(folder)
    images, trajectory = ImageSpool(spool, 100), poses()
    for stamp, T in zip(trajectory.stamp_ns.tolist(), trajectory.T_world_lidar, strict=True):
        picture = render_coloured(mesh, atlas, CAMERA, T @ inverse(T_CAM_LIDAR)).values
        png = bytes(cv2.imencode(".png", np.rint(picture[..., ::-1]).astype(np.uint8))[1])
        images.add(CameraImage("cam", stamp, png, CAMERA, T_CAM_LIDAR))
    images.save(folder, trajectory)
    return tmp_path


def test_laz_has_everything_and_is_the_same_twice(room: Path) -> None:
    laspy = pytest.importorskip("laspy")
    for name in ("a.laz", "b.laz"):
        assert main(["export", str(room), "--format", "laz", "--out", str(room / name)]) == 0
    assert (room / "a.laz").read_bytes() == (room / "b.laz").read_bytes()
    kept = open_points(room / "map")
    assert kept is not None
    rows = np.concatenate(list(kept.chunks()))
    las = laspy.read(room / "a.laz")
    np.testing.assert_allclose(las.xyz, rows["position"], atol=0.00051)
    np.testing.assert_array_equal(las.intensity, rows["intensity"])
    np.testing.assert_allclose(las.gps_time, 1.0 + np.linspace(0, 0.5, 1000), atol=1e-5)
    coloured = rows["seen"] > 0
    assert 0.3 < coloured.mean() < 1.0
    np.testing.assert_array_equal(np.asarray(las.red)[coloured] // 257, rows["colour"][coloured, 0])
    assert not np.asarray(las.blue)[~coloured].any()
    assert (np.asarray(las.classification)[:900] == 2).any()
    distance = np.linalg.norm(rows["position"][:, None] - square_room()[0].vertices[None], axis=2).min(axis=1)
    np.testing.assert_array_equal(np.asarray(las.classification) == 2, distance < 0.2)
    lookup = next(vlr for vlr in las.header.vlrs if vlr.record_id == 0 and vlr.user_id == "LASF_Spec")
    assert b"front wall" in lookup.record_data_bytes()


def naive_model(folder: Path) -> tuple[dict, dict, dict]:
    """Cameras, images and points of a text model, as the format's description says."""

    def lines(name: str) -> list[list[str]]:
        text = (folder / "sparse" / "0" / name).read_text().splitlines()
        return [line.split() for line in text if not line.startswith("#")]

    cameras = {
        int(w[0]): (w[1], int(w[2]), int(w[3]), [float(v) for v in w[4:]]) for w in lines("cameras.txt")
    }
    rows, images = lines("images.txt"), {}
    for head, body in zip(rows[::2], rows[1::2], strict=True):
        w, x, y, z, *t = (float(v) for v in head[1:8])
        T = matrix_from_quaternion(np.array(t), np.array([x, y, z, w]))
        seen = [
            (float(u), float(v), int(p)) for u, v, p in zip(body[::3], body[1::3], body[2::3], strict=True)
        ]
        images[int(head[0])] = (T, int(head[8]), head[9], seen)
    points = {
        int(w[0]): (np.array(w[1:4], float), [int(c) for c in w[4:7]], [int(v) for v in w[8:]])
        for w in lines("points3D.txt")
    }
    return cameras, images, points


def test_colmap_model_is_consistent_and_projects_right(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(colmap, "MOST_POINTS", 300)
    out = room / "model"
    assert main(["export", str(room), "--format", "colmap", "--out", str(out)]) == 0
    cameras, images, points = naive_model(out)
    assert len(cameras) == 1 and len(images) == 3 and 200 < len(points) <= 300
    kind, width, height, (fx, fy, cx, cy) = cameras[1]
    assert (kind, width, height) == ("PINHOLE", 96, 72)
    observed = 0
    for number, (T, camera, name, seen) in images.items():
        assert camera == 1
        picture = cv2.imread(str(out / "images" / name))
        assert picture.shape == (72, 96, 3)
        assert len(seen) > 50
        for k, (u, v, point) in enumerate(seen):
            position, _, track = points[point]
            x, y, z = T[:3, :3] @ position + T[:3, 3]
            assert abs(fx * x / z + cx - u) < 0.05 and abs(fy * y / z + cy - v) < 0.05
            assert (number, k) in set(zip(track[::2], track[1::2], strict=True))
            observed += 1
    assert observed == sum(len(track) // 2 for _, _, track in points.values())


def test_the_undone_lens_shows_the_same_world(room: Path) -> None:
    mesh, atlas = square_room()
    for photo in read_photos(room / "map" / INDEX):
        straight = undistorted(photo)
        seen = render_coloured(mesh, atlas, straight.camera, straight.T_world_cam)
        assert seen.covered.mean() > 0.3
        assert np.abs(seen.values - straight.image)[seen.covered].mean() < 4.0


def test_colmap_into_a_folder_with_something_is_refused(room: Path) -> None:
    assert main(["export", str(room), "--format", "colmap", "--out", str(room)]) == 2
    (room / "empty").mkdir()
    assert main(["export", str(room), "--format", "colmap", "--out", str(room / "empty")]) == 0
    assert (room / "empty" / "sparse" / "0" / "points3D.txt").is_file()


def test_a_damaged_photograph_is_left_out_and_told(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pictures = sorted((room / "map" / "images").glob("*.png"))
    pictures[0].write_bytes(pictures[0].read_bytes()[:40])
    pictures[1].unlink()
    assert main(["export", str(room), "--format", "colmap", "--out", str(room / "out")]) == 0
    said = capsys.readouterr().err
    assert pictures[0].name in said and pictures[1].name in said and "goes on without it" in said
    assert [entry[2] for entry in naive_model(room / "out")[1].values()] == [
        pictures[2].with_suffix(".jpg").name
    ]
    pictures[2].unlink()
    assert main(["export", str(room), "--format", "colmap", "--out", str(room / "none")]) == 2
    assert "none of the photographs" in capsys.readouterr().err and not (room / "none").exists()


def test_missing_photographs_of_an_earlier_map_are_told(
    room: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    next((room / "map" / "images").glob("*.png")).unlink()
    (room / "next").mkdir()
    ImageSpool(room / "next", 100).take_over(room / "map")
    assert "1 of the 3 photographs" in capsys.readouterr().err
    assert len(list((room / "next").iterdir())) == 2


@pytest.mark.parametrize("name", ["laz", "colmap"])
def test_without_points_the_sentence_says_what_to_do(
    room: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (room / "map" / "points.bin").unlink()
    assert main(["export", str(room), "--format", name, "--out", str(room / "out")]) == 2
    assert "keeps no points" in capsys.readouterr().err
    assert not (room / "out").exists()


def test_colmap_without_images_says_so(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (room / "map" / INDEX).unlink()
    assert main(["export", str(room), "--format", "colmap", "--out", str(room / "out")]) == 2
    assert "keeps no images" in capsys.readouterr().err


def test_what_is_coloured_is_what_is_seen() -> None:
    camera = CameraModel(30, 20, 20.0, 20.0, 15.0, 10.0)
    rng = np.random.default_rng(0)
    points = rng.uniform([-3, -3, -1], [3, 3, 6], (300, 3)).astype(np.float32)
    points[3] = np.nan
    nearest, _ = blank(camera)
    nearest[:] = 3.0
    sums, seen = np.zeros((300, 3), np.float32), np.zeros(300, np.int64)
    image = np.full((20, 30, 3), 7, np.uint8)
    add_colours(points, np.eye(4), lens_of(camera), nearest, image, sums, seen)
    places = sees(points, np.eye(4), lens_of(camera), nearest)
    np.testing.assert_array_equal(seen == 1, np.isfinite(places[:, 0]))
    for k in range(300):
        x, y, z = points[k].astype(float)
        u, v = (20 * x / z + 15, 20 * y / z + 10) if z >= 0.05 else (np.nan, np.nan)
        expected = -0.5 <= u < 29.5 and -0.5 <= v < 19.5 and z <= 3.0 * 1.01 + 0.1
        assert expected == (seen[k] == 1)
        if expected:
            np.testing.assert_allclose(places[k], [u, v], rtol=1e-6)
