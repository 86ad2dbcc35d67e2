"""KITTI odometry and raw readers on made-up drives, and on real ones where ARTEMIS_DATA is set."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from artemis_edge.datasets import open_input
from artemis_edge.datasets.kitti import KittiSource, open_odometry, open_raw, turn_offset_s
from artemis_edge.errors import InputError
from artemis_edge.trajectory import inverse, matrix_from_quaternion, pose_per_frame, read_tum

DATA = Path(os.environ.get("ARTEMIS_DATA", "."))
needs_data = pytest.mark.skipif("ARTEMIS_DATA" not in os.environ, reason="needs ARTEMIS_DATA")
# Velodyne (x forward, y left) to camera (z forward, x right), with an offset.
R_CAM_VELO = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
POINTS = np.array([[5.0, 1.0, 0.5, 0.25], [-3.0, 2.0, 0.1, 1.0], [4.0, -4.0, -1.0, 0.0]], np.float32)


def _row(name: str, values: np.ndarray | list[float]) -> str:
    return f"{name}: " + " ".join(f"{v:.9e}" for v in np.asarray(values, float).ravel()) + "\n"


def _scan(path: Path, points: np.ndarray = POINTS) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    points.astype(np.float32).tofile(path)


def _image(path: Path, width: int = 64, height: int = 48) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((height, width, 3), 100, np.uint8))


def _sequence(root: Path, scans: int = 3) -> Path:
    folder = root / "sequences" / "00"
    for k in range(scans):
        _scan(folder / "velodyne" / f"{k:06d}.bin")
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.6e}\n" for k in range(scans)))
    Tr = np.hstack([R_CAM_VELO, [[0.0], [-0.1], [-0.3]]])
    P = np.array([[700.0, 0, 32, 70.0], [0, 700.0, 24, 0], [0, 0, 1, 0.0]])
    (folder / "calib.txt").write_text(_row("P0", P) + _row("P2", P) + _row("P3", P) + _row("Tr", Tr))
    return folder


def _drive(root: Path, scans: int = 4, step_s: float = 0.1037) -> Path:
    day = root / "2011_09_26"
    drive = day / "2011_09_26_drive_0001_sync"
    stamps = "".join(f"2011-09-26 13:00:{1 + step_s * k:012.9f}\n" for k in range(scans))
    for folder in ("velodyne_points", "oxts", "image_02"):
        (drive / folder / "data").mkdir(parents=True)
        (drive / folder / "timestamps.txt").write_text(stamps)
    for k in range(scans):
        _scan(drive / "velodyne_points" / "data" / f"{k:010d}.bin")
        row = np.zeros(30)
        row[11:14], row[17:20] = (k, 2.0, 9.8), (0.1, 0.2, 0.3)
        (drive / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(map(str, row)))
    R_rect = matrix_from_quaternion(np.zeros(3), np.array([0.01, 0.02, -0.01, 1.0]))[:3, :3]
    P2 = np.array([[700.0, 0, 32, 70.0], [0, 650.0, 24, 3.0], [0, 0, 1, 0.002]])
    (day / "calib_cam_to_cam.txt").write_text(
        "calib_time: 09-Jan-2012 13:57:47\n" + _row("R_rect_00", R_rect) + _row("P_rect_02", P2)
    )
    (day / "calib_velo_to_cam.txt").write_text(_row("R", R_CAM_VELO) + _row("T", [0.0, -0.1, -0.3]))
    (day / "calib_imu_to_velo.txt").write_text(
        _row("R", [0, 1, 0, -1, 0, 0, 0, 0, 1]) + _row("T", [-0.8, 0.3, -0.8])
    )
    return drive


def test_odometry_sequence(tmp_path: Path) -> None:
    source = open_input(_sequence(tmp_path))
    frames = list(source.frames())
    assert (len(source), source.name, source.poses) == (3, "00", None)
    assert source.input_hz == pytest.approx(10.0)
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.stamp_ns for frame in frames] == [0, 100_000_000, 200_000_000]
    scan = frames[1].scans[0]
    assert np.array_equal(scan.points, POINTS[:, :3]) and scan.points.flags.c_contiguous
    assert scan.intensity is not None and scan.intensity.tolist() == [0.25, 1.0, 0.0]
    assert scan.offset_s is None
    assert np.array_equal(scan.T_lidar_sensor, np.eye(4))
    assert [frame.index for frame in source.frames(1, 99)] == [1, 2]
    assert (source.lost, source.warnings, frames[0].lost) == ({}, [], {})


def test_odometry_poses_are_those_of_the_velodyne(tmp_path: Path) -> None:
    folder = _sequence(tmp_path)
    T_velo = matrix_from_quaternion(
        np.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0.5, 0]]),
        np.array([[0, 0, 0, 1.0], [0, 0, 0.1, 1], [0, 0, 0.2, 1]]),
    )
    T_cam_velo = np.eye(4)
    T_cam_velo[:3] = np.hstack([R_CAM_VELO, [[0.0], [-0.1], [-0.3]]])
    T_cam = T_cam_velo @ T_velo @ inverse(T_cam_velo)
    (tmp_path / "poses").mkdir()
    rows = "".join(" ".join(f"{v:.12e}" for v in T[:3].ravel()) + "\n" for T in T_cam)
    (tmp_path / "poses" / "00.txt").write_text(rows)
    poses = open_odometry(folder).poses
    assert poses is not None
    np.testing.assert_allclose(poses.T_world_lidar, T_velo, atol=1e-9)
    assert poses.stamp_ns.tolist() == [0, 100_000_000, 200_000_000]
    (tmp_path / "poses" / "00.txt").write_text(rows + "1 2 3\n")
    with pytest.raises(InputError, match="twelve finite numbers"):
        open_odometry(folder)
    (tmp_path / "poses" / "00.txt").write_text(rows.splitlines()[0] + "\n")
    with pytest.raises(InputError, match="1 rows for 3 scans"):
        open_odometry(folder)


def test_odometry_without_times_and_calibration(tmp_path: Path) -> None:
    folder = _sequence(tmp_path)
    (folder / "times.txt").unlink()
    (folder / "calib.txt").unlink()
    _image(folder / "image_2" / "000000.png")
    source = open_odometry(folder)
    assert source.stamp_ns.tolist() == [0, 100_000_000, 200_000_000]
    assert len(source.warnings) == 2 and "times.txt is missing" in source.warnings[0]
    assert all(not frame.images for frame in source.frames())


def test_odometry_images(tmp_path: Path) -> None:
    folder = _sequence(tmp_path)
    _image(folder / "image_2" / "000001.png")
    images = [frame.images for frame in open_odometry(folder).frames()]
    assert [len(i) for i in images] == [0, 1, 0]
    assert images[1][0].encoded == (folder / "image_2" / "000001.png").read_bytes()
    # K t = p4: 700 px focal length and 70 in the last column are a baseline of 0.1 m
    np.testing.assert_allclose(images[1][0].T_cam_lidar[:3, 3], [0.1, -0.1, -0.3], atol=1e-9)


def test_subset_of_a_sequence_takes_times_by_number(tmp_path: Path) -> None:
    folder = _sequence(tmp_path, scans=5)
    for k in (0, 2):
        (folder / "velodyne" / f"{k:06d}.bin").unlink()
    assert open_odometry(folder).stamp_ns.tolist() == [100_000_000, 300_000_000, 400_000_000]


def test_raw_drive(tmp_path: Path) -> None:
    source = open_input(_drive(tmp_path))
    frames = list(source.frames())
    assert (len(source), source.name, source.poses) == (4, "2011_09_26_drive_0001_sync", None)
    assert [frame.stamp_ns for frame in frames] == [0, 103_700_000, 207_400_000, 311_100_000]
    scan = frames[1].scans[0]
    assert scan.offset_s is not None and scan.offset_s.dtype == np.float32
    expected = [-0.5 * 0.1037 * np.arctan2(y, x) / np.pi for x, y in POINTS[:, :2].astype(float)]
    np.testing.assert_allclose(scan.offset_s, expected, rtol=1e-5)


def test_turn_is_clockwise_from_behind() -> None:
    """Behind left: first. Left: a quarter. Ahead: the stamp. Right: three quarters. Behind right: last."""
    points = np.array([[-1, 1e-6, 0], [0, 1, 0], [1, 0, 0], [0, -1, 0], [-1, -1e-6, 0]], np.float32)
    np.testing.assert_allclose(turn_offset_s(points, 0.1), [-0.05, -0.025, 0, 0.025, 0.05], atol=1e-6)
    assert len(turn_offset_s(np.empty((0, 3), np.float32), 0.1)) == 0


@pytest.mark.parametrize(("step_s", "turn_s"), [(0.1037, 0.1037), (0.2073, 0.1036), (0.02, 0.1036)])
def test_turn_from_the_interval_if_plausible(tmp_path: Path, step_s: float, turn_s: float) -> None:
    source = open_raw(_drive(tmp_path, step_s=step_s))
    assert source.turn_s is not None
    np.testing.assert_allclose(source.turn_s, turn_s, rtol=1e-6)


def test_turn_from_start_and_end(tmp_path: Path) -> None:
    drive = _drive(tmp_path)
    folder = drive / "velodyne_points"
    for name, shift in (("start", -0.05), ("end", 0.051)):
        times = [f"2011-09-26 13:00:{1 + 0.1037 * k + shift:012.9f}\n" for k in range(4)]
        (folder / f"timestamps_{name}.txt").write_text("".join(times))
    source = open_raw(drive)
    assert source.turn_s is not None
    np.testing.assert_allclose(source.turn_s, 0.101, rtol=1e-6)


def test_oxts_is_an_imu_in_velodyne_axes(tmp_path: Path) -> None:
    frames = list(open_raw(_drive(tmp_path)).frames())
    assert [len(frame.imu.stamp_ns) for frame in frames] == [1, 1, 1, 1]
    assert frames[2].imu.stamp_ns.tolist() == [207_400_000]
    # x_velo = y_imu, y_velo = -x_imu
    np.testing.assert_allclose(frames[2].imu.accel, [[2.0, -2.0, 9.8]], atol=1e-12)
    np.testing.assert_allclose(frames[2].imu.gyro, [[0.2, -0.1, 0.3]], atol=1e-12)


def test_broken_imu_rows_are_counted(tmp_path: Path) -> None:
    drive = _drive(tmp_path)
    (drive / "oxts" / "data" / "0000000001.txt").write_text("1 2 3")
    (drive / "oxts" / "data" / "0000000002.txt").write_text("nan " * 30)
    source = open_raw(drive)
    assert source.lost == {"imu_rows": 2} and "2 IMU rows" in source.warnings[0]
    assert [len(frame.imu.stamp_ns) for frame in source.frames()] == [1, 0, 0, 1]


def test_drive_without_imu(tmp_path: Path) -> None:
    drive = _drive(tmp_path)
    for file in (drive / "oxts" / "data").iterdir():
        file.unlink()
    assert all(len(frame.imu.stamp_ns) == 0 for frame in open_raw(drive).frames())


def test_raw_images_pair_by_number_and_project(tmp_path: Path) -> None:
    drive = _drive(tmp_path)
    for k in (1, 3, 7):
        _image(drive / "image_02" / "data" / f"{k:010d}.png")
    source = open_raw(drive)
    frames = list(source.frames())
    assert [len(frame.images) for frame in frames] == [0, 1, 0, 1]
    assert source.lost == {"images_without_scan": 1}
    image = frames[1].images[0]
    assert (image.name, image.stamp_ns, image.model.width, image.model.height) == (
        "image_02",
        103_700_000,
        64,
        48,
    )
    # the projection equation of the KITTI paper against ours
    R_rect, T_cam_velo, X = np.eye(4), np.eye(4), np.array([8.0, 1.0, 0.5, 1.0])
    R_rect[:3, :3] = matrix_from_quaternion(np.zeros(3), np.array([0.01, 0.02, -0.01, 1.0]))[:3, :3]
    T_cam_velo[:3] = np.hstack([R_CAM_VELO, [[0.0], [-0.1], [-0.3]]])
    P2 = np.array([[700.0, 0, 32, 70.0], [0, 650.0, 24, 3.0], [0, 0, 1, 0.002]])
    u, v, w = P2 @ R_rect @ T_cam_velo @ X
    x, y, z, _ = image.T_cam_lidar @ X
    model = image.model
    np.testing.assert_allclose(
        [model.fx * x / z + model.cx, model.fy * y / z + model.cy], [u / w, v / w], rtol=1e-7
    )


def test_images_without_calibration_are_left_out(tmp_path: Path) -> None:
    drive = _drive(tmp_path)
    _image(drive / "image_02" / "data" / "0000000001.png")
    (drive.parent / "calib_velo_to_cam.txt").unlink()
    source = open_raw(drive)
    assert "images are not used" in source.warnings[0]
    assert all(not frame.images for frame in source.frames())


def test_broken_calibration(tmp_path: Path) -> None:
    drive = _drive(tmp_path)
    _image(drive / "image_02" / "data" / "0000000001.png")
    (drive.parent / "calib_velo_to_cam.txt").write_text("R: 1 2 3\n")
    with pytest.raises(InputError, match="9 numbers for 'R'"):
        open_raw(drive)


def test_points_that_are_none(tmp_path: Path) -> None:
    folder = _sequence(tmp_path)
    bad = np.array(
        [
            [1, 2, 3, 0.5],
            [np.nan, 0, 0, 0.1],
            [0, 0, 0, 0],
            [1, np.inf, 1, 0],
            [4, 5, 6, np.nan],
            [0, 0, 0, 0.9],
        ]
    )
    _scan(folder / "velodyne" / "000001.bin", bad)
    _scan(folder / "velodyne" / "000002.bin", np.zeros((4, 4)))
    frames = list(open_odometry(folder).frames())
    assert frames[1].lost == {"nan_points": 2, "no_return": 2}
    assert frames[1].scans[0].points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert frames[1].scans[0].intensity is not None and frames[1].scans[0].intensity.tolist() == [0.5, 0.0]
    assert frames[2].scans == () and frames[2].lost == {"no_return": 4}


def test_reflectance_up_to_255_is_scaled(tmp_path: Path) -> None:
    folder = _sequence(tmp_path, scans=1)
    _scan(folder / "velodyne" / "000000.bin", POINTS * [1, 1, 1, 200])
    frame = next(open_odometry(folder).frames())
    assert frame.scans[0].intensity is not None
    np.testing.assert_allclose(frame.scans[0].intensity, POINTS[:, 3] * 200 / 255, rtol=1e-6)


def test_truncated_and_empty_scans(tmp_path: Path) -> None:
    folder = _sequence(tmp_path, scans=5)
    data = POINTS.tobytes()
    (folder / "velodyne" / "000001.bin").write_bytes(data[:-7])
    (folder / "velodyne" / "000002.bin").write_bytes(b"")
    (folder / "velodyne" / "000003.bin").write_bytes(b"123")
    source = open_odometry(folder)
    assert source.lost == {"truncated_file": 1, "empty_file": 2}
    assert any("000001.bin is cut off" in text for text in source.warnings)
    assert any("000002.bin (and 1 more) is empty" in text for text in source.warnings)
    frames = list(source.frames())
    assert [frame.stamp_ns for frame in frames] == [0, 100_000_000, 400_000_000]
    assert [len(frame.scans[0].points) for frame in frames] == [3, 2, 3]


def test_inputs_that_are_none(tmp_path: Path) -> None:
    cases = {
        "there is no": tmp_path / "missing",
        "is empty": tmp_path / "empty",
        "is no data set": tmp_path / "photos",
        "holds no .bin": tmp_path / "sequence",
        "every scan .* is empty": tmp_path / "hollow",
        "must hold one time": tmp_path / "drive",
        "holds 1; give .*sequences": tmp_path / "parent",
    }
    (tmp_path / "empty").mkdir()
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"x")
    (tmp_path / "sequence" / "velodyne").mkdir(parents=True)
    (tmp_path / "hollow" / "velodyne").mkdir(parents=True)
    (tmp_path / "hollow" / "velodyne" / "000000.bin").write_bytes(b"")
    _scan(tmp_path / "drive" / "velodyne_points" / "data" / "0.bin")
    (tmp_path / "drive" / "velodyne_points" / "timestamps.txt").write_text("yesterday\n")
    _scan(tmp_path / "parent" / "sequences" / "velodyne" / "0.bin")
    for says, path in cases.items():
        with pytest.raises(InputError, match=says) as caught:
            open_input(path)
        assert "\n" not in str(caught.value)


def test_times_that_are_wrong(tmp_path: Path) -> None:
    folder = _sequence(tmp_path)
    for text, says in [
        ("0\n", "1 rows for 3 scans"),
        ("0\n0.1\n0.1\n", "ascend"),
        ("0\nx\n1\n", "time in seconds"),
    ]:
        (folder / "times.txt").write_text(text)
        with pytest.raises(InputError, match=says):
            open_odometry(folder)
    drive = _drive(tmp_path)
    (drive / "velodyne_points" / "timestamps.txt").unlink()
    with pytest.raises(InputError, match="cannot read"):
        open_raw(drive)


@needs_data
@pytest.mark.data
def test_real_odometry_sequence() -> None:
    source = open_odometry(DATA / "kitti_odo_00" / "sequences" / "00")
    reference = read_tum(DATA / "kitti_odo_00" / "poses_velo_00.tum")
    assert source.poses is not None
    np.testing.assert_allclose(source.poses.T_world_lidar, reference.T_world_lidar, atol=2e-6)
    assert source.stamp_ns.tolist() == reference.stamp_ns.tolist()
    assert len(list(source.frames())) == 10


def _drives() -> list[Path]:
    return sorted(DATA.glob("kitti_raw_*/2011_09_26/*_sync")) if "ARTEMIS_DATA" in os.environ else []


@needs_data
@pytest.mark.data
@pytest.mark.parametrize("drive", _drives(), ids=lambda p: p.name)
def test_real_drives(drive: Path) -> None:
    source = open_raw(drive)
    assert isinstance(source, KittiSource) and (source.lost, source.warnings) == ({}, [])
    reference = read_tum(drive / "poses_velo.tum")
    assert len(source) == len(reference)
    np.testing.assert_allclose(source.stamp_ns, reference.stamp_ns, atol=1000)
    by_row = pose_per_frame(reference, source.stamp_ns)
    by_time = pose_per_frame(reference, source.stamp_ns[:-1])
    np.testing.assert_allclose(by_row.T_world_lidar[:-1], by_time.T_world_lidar, atol=1e-6)
    frame = next(source.frames(5))
    assert len(frame.scans[0].points) > 100_000
    images = {f.index for f in source.frames() if f.images}
    files = {int(p.stem) for p in drive.glob("image_02/data/*.png")}
    assert images == files
