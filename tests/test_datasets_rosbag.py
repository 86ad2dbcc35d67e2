"""Recordings as frames: containers, frames of several sensors, poses, damage, and the real bags."""

from __future__ import annotations

import builtins
import json
import os
import sqlite3
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from artemis_edge.config import InputConfig
from artemis_edge.datasets import lidar_poses, open_input
from artemis_edge.datasets.rosbag import RosbagSource
from artemis_edge.errors import InputError
from artemis_edge.frames import F64, CameraModel, SyncedFrame, Trajectory
from artemis_edge.session.messages import (
    CameraExposure,
    CameraInfo,
    CompressedImage,
    Header,
    Image,
    Imu,
    LivoxCustomMsg,
    Message,
    Odometry,
    PointCloud2,
    PointField,
    TFMessage,
    TransformStamped,
)
from artemis_edge.session.schemas import schema_text
from artemis_edge.session.writer import SessionWriter
from artemis_edge.trajectory import inverse, matrix_from_quaternion, quaternion_from_matrix

DATA = Path(os.environ.get("ARTEMIS_DATA", "."))
needs_data = pytest.mark.skipif("ARTEMIS_DATA" not in os.environ, reason="needs ARTEMIS_DATA")
MS = 1_000_000
SECOND = 1000 * MS
XYZ = tuple(PointField(name, 4 * k, 7) for k, name in enumerate("xyz"))
MODEL = CameraModel(64, 48, 50.0, 50.0, 32.0, 24.0)
JPEG = bytes(cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))[1])
Record = tuple[str, Message, int]


def _pose(x: float, y: float = 0.0, yaw: float = 0.0) -> F64:
    return matrix_from_quaternion(np.array([x, y, 0.0]), np.array([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]))


def _points(count: int = 5, value: float = 1.0) -> np.ndarray[Any, Any]:
    return np.full((count, 3), value, np.float32)


def _cloud(stamp: int, frame: str = "lidar", topic: str = "/lidar/points", value: float = 1.0) -> Record:
    data = _points(value=value).tobytes()
    return topic, PointCloud2(Header(stamp, frame), 1, 5, XYZ, 12, 60, data), stamp


def _tf(stamp: int, parent: str, child: str, T: F64, static: bool = False) -> Record:
    transform = TransformStamped(Header(stamp, parent), child, T[:3, 3], quaternion_from_matrix(T))
    return "/tf_static" if static else "/tf", TFMessage((transform,)), stamp


def _image(stamp: int, name: str = "cam") -> Record:
    return f"/{name}/image_raw/compressed", CompressedImage(Header(stamp, name), "jpeg", JPEG), stamp


def _info(name: str = "cam", **change: Any) -> Record:
    parts: dict[str, Any] = {
        "height": 48,
        "width": 64,
        "distortion_model": "plumb_bob",
        "d": np.zeros(5),
    } | change
    k, p = np.array([50.0, 0, 32, 0, 50, 24, 0, 0, 1]), np.array([50.0, 0, 32, 0, 0, 50, 24, 0, 0, 0, 1, 0])
    return f"/{name}/camera_info", CameraInfo(Header(0, name), k=k, r=np.eye(3).ravel(), p=p, **parts), 0


def _imu(stamp: int, accel: tuple[float, float, float] = (0.0, 0.0, 9.8), topic: str = "/imu") -> Record:
    return topic, Imu(Header(stamp, "imu"), np.array([0.1, 0.2, 0.3]), np.array(accel)), stamp


def _odometry(stamp: int, T: F64, child: str = "base") -> Record:
    return "/odom", Odometry(Header(stamp, "odom"), child, T[:3, 3], quaternion_from_matrix(T)), stamp


def _write(path: Path, records: Iterable[Record]) -> Path:
    with SessionWriter(path) as out:
        for topic, message, stamp in records:
            out.write(topic, message, stamp)
    return path


def _open(folder: Path, records: Iterable[Record], **topics: Any) -> RosbagSource:
    return RosbagSource(_write(folder / "a.mcap", records), InputConfig(**topics))


def _drive(scans: int = 4) -> list[Record]:
    """map -> base moving along x at 1 m/s, base -> lidar 1 m left and turned by 90 degrees, base -> cam."""
    records = [
        _tf(0, "base", "lidar", _pose(0, 1, np.pi / 2), True),
        _tf(0, "base", "cam", _pose(0, 0, 0), True),
        _tf(0, "lidar", "imu", _pose(0, 0, 0), True),
    ]
    records += [_tf(k * 50 * MS, "map", "base", _pose(0.05 * k)) for k in range(2 * scans)]
    records += [_cloud(k * 100 * MS + 10 * MS, value=k + 1) for k in range(scans)]
    records += [_imu(k * 10 * MS) for k in range(10 * scans)]
    records += [_info(), *[_image(k * 100 * MS + 12 * MS) for k in range(scans)]]
    return records


def _same_frames(a: Iterable[SyncedFrame], b: Iterable[SyncedFrame]) -> None:
    for one, two in zip(a, b, strict=True):
        assert (one.index, one.stamp_ns, one.lost) == (two.index, two.stamp_ns, two.lost)
        assert one.imu.stamp_ns.tolist() == two.imu.stamp_ns.tolist()
        assert [i.encoded for i in one.images] == [i.encoded for i in two.images]
        assert [i.T_cam_lidar.tolist() for i in one.images] == [i.T_cam_lidar.tolist() for i in two.images]
        assert [s.points.tolist() for s in one.scans] == [s.points.tolist() for s in two.scans]


# --- frames ---


def test_exposures_belong_to_the_photograph_of_their_camera_and_stamp(tmp_path: Path) -> None:
    records = _drive()
    stamps = [k * 100 * MS + 12 * MS for k in range(4)]
    for stamp, exposure in zip(stamps, (0.002, -1.0, float("nan")), strict=False):
        records.append(("/camera/exposure", CameraExposure(Header(stamp, "cam"), exposure, 1.0), stamp))
        records.append(("/camera/exposure", CameraExposure(Header(stamp, "other"), 0.004, 1.0), stamp))
    images = [image for frame in _open(tmp_path, records).frames() for image in frame.images]
    assert [image.exposure_s for image in images] == [0.002, 0.0, 0.0, 0.0]


def test_a_session_is_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(100, 3)).astype(np.float32)
    intensity, offset = rng.random(100, np.float32), np.arange(100) * MS
    T_lidar_cam = _pose(0.1, 0.2, 0.3)
    with SessionWriter(tmp_path / "walk" / "session.mcap", attachments={"config.toml": ""}) as out:
        out.write_tf_static(0, "lidar", "cam", T_lidar_cam)
        out.write_tf_static(0, "lidar", "imu", _pose(0, 0, np.pi / 2))
        out.write_camera_info(0, MODEL)
        for k in range(3):
            stamp = SECOND + k * 100 * MS
            out.write_tf(stamp, "world", "lidar", _pose(k))
            out.write_points(
                stamp, points + k, intensity=intensity, offset_ns=offset, receive_ns=stamp + 105 * MS
            )
            out.write_image(stamp + 20 * MS, JPEG)
            for j in range(20):
                out.write_imu(stamp + j * 5 * MS, np.array([1.0, 0, 0]), np.array([0.0, 2, 9.8]))
    source = open_input(tmp_path / "walk")
    assert (source.name, len(source), source.input_hz) == ("walk", 3, pytest.approx(10.0))
    assert (source.lost, source.warnings) == ({}, [])  # type: ignore[attr-defined]
    frames = list(source.frames())
    for k, frame in enumerate(frames):
        assert (frame.index, frame.stamp_ns, frame.lost) == (k, SECOND + k * 100 * MS, {})
        scan = frame.scans[0]
        assert np.array_equal(scan.points, points + k) and np.array_equal(scan.intensity, intensity)
        np.testing.assert_allclose(scan.offset_s, offset * 1e-9, rtol=1e-6)
        assert scan.name == "lidar"
        assert len(frame.imu.stamp_ns) == 20 and frame.imu.stamp_ns[0] == frame.stamp_ns
        np.testing.assert_allclose(frame.imu.gyro[0], [0, 1, 0], atol=1e-12)
        np.testing.assert_allclose(frame.imu.accel[0], [-2, 0, 9.8], atol=1e-12)
        assert (frame.images[0].encoded, frame.images[0].model) == (JPEG, MODEL)
        np.testing.assert_allclose(frame.images[0].T_cam_lidar, inverse(T_lidar_cam), atol=1e-12)
    assert source.poses is not None
    np.testing.assert_allclose(source.poses.T_world_lidar, [_pose(k) for k in range(3)], atol=1e-12)
    _same_frames(source.frames(1), frames[1:])


def test_poses_are_interpolated_in_the_root_of_tf(tmp_path: Path) -> None:
    source = _open(tmp_path, _drive())
    assert source.poses is not None and source.poses.stamp_ns.tolist() == source.stamp_ns.tolist()
    expected = [_pose(0.1 * k + 0.01) @ _pose(0, 1, np.pi / 2) for k in range(4)]
    np.testing.assert_allclose(source.poses.T_world_lidar, expected, atol=1e-12)


def test_poses_that_do_not_cover_all_frames(tmp_path: Path) -> None:
    source = _open(tmp_path, [*_drive(), _cloud(900 * MS)])
    assert source.poses is not None and len(source.poses) == 4 and len(source) == 5
    assert any("do not cover 1 of 5 frames" in text for text in source.warnings)


def test_odometry_where_tf_does_not_move(tmp_path: Path) -> None:
    records = [r for r in _drive() if r[0] != "/tf"]
    records += [_odometry(k * 100 * MS, _pose(k)) for k in range(6)]
    source = _open(tmp_path, records)
    assert source.poses is not None
    expected = [_pose(k + 0.1) @ _pose(0, 1, np.pi / 2) for k in range(4)]
    np.testing.assert_allclose(source.poses.T_world_lidar, expected, atol=1e-12)


def test_odometry_of_an_unknown_frame_is_taken_as_the_lidars(tmp_path: Path) -> None:
    records = [_cloud(0), _cloud(SECOND), *[_odometry(k * SECOND, _pose(k), "body") for k in range(2)]]
    source = _open(tmp_path, records)
    assert source.poses is not None
    np.testing.assert_allclose(source.poses.T_world_lidar, [_pose(0), _pose(1)], atol=1e-12)
    assert any("taken as one" in text for text in source.warnings)


def test_no_poses(tmp_path: Path) -> None:
    assert _open(tmp_path, [_cloud(0), _cloud(SECOND)]).poses is None


def test_given_poses_of_the_base_get_the_mounting(tmp_path: Path) -> None:
    source = _open(tmp_path, _drive())
    base = Trajectory(source.stamp_ns, np.array([_pose(0.1 * k + 0.01) for k in range(4)]))
    of_lidar = lidar_poses(source, base)
    assert source.poses is not None
    np.testing.assert_allclose(of_lidar.T_world_lidar, source.poses.T_world_lidar, atol=1e-9)
    assert any("those of base in tf" in text for text in source.warnings)
    count = len(source.warnings)
    np.testing.assert_allclose(
        lidar_poses(source, of_lidar).T_world_lidar, of_lidar.T_world_lidar, atol=1e-12
    )
    other = Trajectory(base.stamp_ns, _pose(0, 0, 1.0) @ base.T_world_lidar)
    assert lidar_poses(source, other) is other
    assert len(source.warnings) == count


def test_several_lidars_make_one_frame(tmp_path: Path) -> None:
    T_base = {"l0": _pose(1), "l1": _pose(0, 2, 1.0)}
    records = [_tf(0, "base", name, T, True) for name, T in T_base.items()]
    records += [_tf(k * SECOND, "map", "base", _pose(k)) for k in range(4)]
    for stamp, names in ((0, "01"), (SECOND, "1"), (2 * SECOND, "0")):
        records += [_cloud(stamp + int(n) * MS // 2, f"l{n}", f"/l{n}/points", 1 + int(n)) for n in names]
    source = _open(tmp_path, records)
    frames = list(source.frames())
    assert [[scan.name for scan in frame.scans] for frame in frames] == [["l0", "l1"], ["l1"], ["l0"]]
    # the stamp is the primary's, or that of whoever is there; each scan keeps its own
    assert [frame.stamp_ns for frame in frames] == [0, SECOND + MS // 2, 2 * SECOND]
    assert [scan.stamp_ns for scan in frames[0].scans] == [0, MS // 2]
    np.testing.assert_allclose(frames[0].scans[0].T_lidar_sensor, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(
        frames[1].scans[0].T_lidar_sensor, inverse(T_base["l0"]) @ T_base["l1"], atol=1e-12
    )
    assert source.poses is not None
    np.testing.assert_allclose(source.poses.T_world_lidar[1], _pose(1.0005) @ T_base["l0"], atol=1e-12)


def test_lidar_of_unknown_mounting_is_left_out_and_counted(tmp_path: Path) -> None:
    source = _open(tmp_path, [_cloud(0), _cloud(SECOND), _cloud(0, "other", "/other/points")])
    assert source.lost == {"clouds_without_mounting": 1}
    assert [len(frame.scans) for frame in source.frames()] == [1, 1]
    assert any("tf does not join other and lidar" in text for text in source.warnings)


def test_two_topics_of_one_lidar(tmp_path: Path) -> None:
    records = [_cloud(0), _cloud(SECOND), _cloud(0, topic="/lidar/filtered", value=9.0)]
    source = _open(tmp_path, records)
    assert len(source) == 1 and any("/lidar/points is left out" in text for text in source.warnings)
    chosen = _open(tmp_path, records, lidar_topics=("/lidar/points",))
    assert len(chosen) == 2 and chosen.warnings == []
    with pytest.raises(InputError, match=r"no topic /none .* it has /lidar/filtered, /lidar/points"):
        _open(tmp_path, records, lidar_topics=("/none",))


def test_a_map_is_no_sensor(tmp_path: Path) -> None:
    records = [*_drive(), _cloud(0, "map", "/a_map", 7.0)]
    source = _open(tmp_path, records)
    assert len(source) == 4 and any("/a_map is left out" in text for text in source.warnings)


def test_livox_messages(tmp_path: Path) -> None:
    points = np.zeros(3, LivoxCustomMsg.POINT)
    points["x"], points["offset_time"], points["reflectivity"] = [1, 0, 3], [0, 10, 50 * MS], 51
    message = LivoxCustomMsg(Header(SECOND, "livox_frame"), SECOND, points)
    frame = next(_open(tmp_path, [("/livox/lidar", message, SECOND)]).frames())
    assert frame.scans[0].points[:, 0].tolist() == [1, 3] and frame.lost == {"no_return": 1}
    np.testing.assert_allclose(frame.scans[0].offset_s, [0, 0.05])
    np.testing.assert_allclose(frame.scans[0].intensity, 0.2, rtol=1e-6)


def test_images_go_to_the_nearest_frame(tmp_path: Path) -> None:
    records = [r for r in _drive() if "image" not in r[0]]
    stamps = [MS, 40 * MS, 60 * MS, 61 * MS, 330 * MS]
    source = _open(tmp_path, [*records, *[_image(s) for s in stamps]])
    got = [[image.stamp_ns for image in frame.images] for frame in source.frames()]
    assert got == [[MS, 40 * MS], [60 * MS, 61 * MS], [], [330 * MS]]


def test_images_belong_to_the_window_they_were_taken_in(tmp_path: Path) -> None:
    """A stamp is the start of a timed window: an image of its middle is this frame's, not the next one's."""
    with SessionWriter(tmp_path / "a.mcap") as out:
        out.write_tf_static(0, "lidar", "cam", np.eye(4))
        out.write_camera_info(0, MODEL)
        for k in range(4):
            stamp = SECOND + k * 100 * MS
            out.write_points(stamp, _points(), offset_ns=np.linspace(0, 99 * MS, 5).astype(int))
            for share in (5, 50, 95):
                out.write_image(stamp + share * MS, JPEG)
    for frame in RosbagSource(tmp_path / "a.mcap").frames():
        assert [(i.stamp_ns - frame.stamp_ns) // MS for i in frame.images] == [5, 50, 95]


def test_an_image_far_from_every_frame_is_a_frame(tmp_path: Path) -> None:
    """A platform that stops, looks, and does not always scan."""
    records = [_tf(0, "lidar", name, np.eye(4), True) for name in ("cam", "cam2")]
    records += [_tf(k * SECOND, "map", "lidar", _pose(k)) for k in range(4)]
    records += [_info(), _info("cam2"), _cloud(SECOND), _cloud(3 * SECOND)]
    records += [_image(k * SECOND, name) for k in range(4) for name in ("cam", "cam2")]
    source = _open(tmp_path, records)
    frames = list(source.frames())
    assert [frame.stamp_ns for frame in frames] == [0, SECOND, 2 * SECOND, 3 * SECOND]
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert [(len(frame.scans), len(frame.images)) for frame in frames] == [(0, 2), (1, 2), (0, 2), (1, 2)]
    assert source.poses is not None and source.poses.T_world_lidar[:, 0, 3].tolist() == [0, 1, 2, 3]


def test_raw_images_become_png(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    message = Image(Header(0, "cam"), 48, 64, "rgb8", 192, pixels.tobytes())
    records = [_tf(0, "lidar", "cam", np.eye(4), True), _info(), _cloud(0), ("/cam/image_raw", message, 0)]
    frame = next(_open(tmp_path, records).frames())
    decoded = cv2.imdecode(np.frombuffer(frame.images[0].encoded, np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(decoded[..., ::-1], pixels)
    both = next(_open(tmp_path, [*records, _image(0)]).frames())
    assert [image.encoded for image in both.images] == [JPEG]  # the compressed topic of the same camera


@pytest.mark.parametrize(
    ("without", "extra", "says", "reason"),
    [
        ("camera_info", [], "there is no CameraInfo", "images_uncalibrated"),
        ("tf_static", [], "tf does not join cam and lidar", "images_without_mounting"),
        ("camera_info", [_info(distortion_model="equidistant")], "no pinhole", "images_uncalibrated"),
        ("camera_info", [_info(width=640)], "64 x 48 where CameraInfo says 640 x 48", "images_uncalibrated"),
        (
            "image",
            [("/cam/image_raw/compressed", CompressedImage(Header(0, "cam"), "jpeg", b"no"), 0)] * 4,
            "cannot be decoded",
            "images_undecodable",
        ),
    ],
)
def test_images_that_cannot_be_used(
    tmp_path: Path, without: str, extra: list[Record], says: str, reason: str
) -> None:
    records = [r for r in _drive() if without not in r[0]]
    source = _open(tmp_path, [*records, *extra])
    assert any(says in text for text in source.warnings), source.warnings
    assert source.lost == {reason: 4}
    assert all(not frame.images for frame in source.frames())


def test_one_image_that_cannot_be_used_does_not_cost_the_others(tmp_path: Path) -> None:
    records = [r for r in _drive() if r[0] != "/cam/image_raw/compressed"]
    topic, stamp = "/cam/image_raw/compressed", 12 * MS
    broken = (topic, CompressedImage(Header(stamp, "cam"), "jpeg", b""), stamp)
    source = _open(tmp_path, [*records, broken, *[_image(k * 100 * MS + stamp) for k in (1, 2, 3)]])
    assert sum(len(frame.images) for frame in source.frames()) == 4
    assert source.warnings == []  # whoever looks at it says which one


def test_a_clock_that_was_set_back_is_told(tmp_path: Path) -> None:
    source = _open(tmp_path, [_cloud(k) for k in (20 * SECOND, 21 * SECOND, 3 * SECOND, 4 * SECOND)])
    assert [frame.stamp_ns // SECOND for frame in source.frames()] == [3, 4, 20, 21]
    assert ["/lidar/points go back once, by up to 18.0 s" in text for text in source.warnings] == [True]


def test_every_imu_sample_belongs_to_one_frame(tmp_path: Path) -> None:
    records = [_cloud((k + 1) * 100 * MS) for k in range(3)] + [_imu(50 * MS + k * 7 * MS) for k in range(60)]
    frames = list(_open(tmp_path, records).frames())
    stamps = np.concatenate([frame.imu.stamp_ns for frame in frames])
    assert stamps.tolist() == [50 * MS + k * 7 * MS for k in range(60)]
    assert frames[1].imu.stamp_ns.min() >= 200 * MS and frames[1].imu.stamp_ns.max() < 300 * MS
    assert frames[1].imu.accel.shape == (len(frames[1].imu.stamp_ns), 3)


def test_accelerations_in_g(tmp_path: Path) -> None:
    source = _open(tmp_path, [_cloud(0), *[_imu(k, (0.0, 0.0, 1.01)) for k in range(3)]])
    np.testing.assert_allclose(next(source.frames()).imu.accel[:, 2], 1.01 * 9.80665)
    assert any("taken to be in g" in text for text in source.warnings)


def test_choice_of_the_imu(tmp_path: Path) -> None:
    records = [_cloud(0), _imu(0), _imu(1, topic="/lidar/imu"), _imu(2, topic="/lidar/imu")]
    first = _open(tmp_path, records)
    assert len(next(first.frames()).imu.stamp_ns) == 1 and any("input.imu_topic" in w for w in first.warnings)
    chosen = _open(tmp_path, records, imu_topic="/lidar/imu")
    assert len(next(chosen.frames()).imu.stamp_ns) == 2


def test_stamps_left_empty_are_those_of_the_recorder(tmp_path: Path) -> None:
    with SessionWriter(tmp_path / "a.mcap") as out:
        for k in range(3):
            topic, message, _ = _cloud(0)
            out.write(topic, message, 0, receive_ns=k * SECOND)
    assert RosbagSource(tmp_path / "a.mcap").stamp_ns.tolist() == [0, SECOND, 2 * SECOND]


def test_repeated_clouds_are_counted(tmp_path: Path) -> None:
    source = _open(tmp_path, [_cloud(SECOND), _cloud(SECOND), _cloud(2 * SECOND)])
    assert len(source) == 2 and source.lost == {"duplicate_clouds": 1}


def test_messages_out_of_order(tmp_path: Path) -> None:
    records = _drive()
    (tmp_path / "b").mkdir()
    _same_frames(_open(tmp_path, records).frames(), _open(tmp_path / "b", records[::-1]).frames())


def test_damaged_messages_are_counted(tmp_path: Path) -> None:
    class Garbage(PointCloud2):
        def encode(self) -> bytes:
            return super().encode()[:-20]

    good = _cloud(SECOND)[1]
    assert isinstance(good, PointCloud2)
    cut = Garbage(Header(2 * SECOND, "lidar"), 1, 5, XYZ, 12, 60, good.data)
    records = [_cloud(0), _cloud(SECOND), ("/lidar/points", cut, 2 * SECOND)]
    source = _open(tmp_path, records)
    assert [len(frame.scans) for frame in source.frames(0, 2)] == [1, 1]
    with pytest.raises(InputError, match=r"frame 2 of .* cannot be decoded"):
        next(source.frames(2))
    nan = Imu(Header(0, "imu"), np.full(3, np.nan), np.zeros(3))
    assert _open(tmp_path, [_cloud(0), ("/imu", nan, 0)]).lost == {"undecodable_messages": 1}


# --- containers ---


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunked", [True, False])
def test_mcap_flavours(tmp_path: Path, compression: CompressionType, chunked: bool) -> None:
    expected = list(_open(tmp_path, _drive()).frames())
    path = tmp_path / "b.mcap"
    with path.open("wb") as stream:
        out, channels = Writer(stream, 2000, compression, use_chunking=chunked), dict[str, int]()
        out.start("ros2", "x")
        for topic, message, stamp in _drive():
            if topic not in channels:
                text = schema_text(message.ROS_TYPE).encode()
                schema = out.register_schema(message.ROS_TYPE, "ros2msg", text)
                channels[topic] = out.register_channel(topic, "cdr", schema)
            out.add_message(channels[topic], max(stamp, 0), message.encode(), max(stamp, 0))
        out.finish()
    source = RosbagSource(path)
    assert (source.lost, source.warnings) == ({}, [])
    _same_frames(source.frames(), expected)
    assert list(source.frames())[1].images


def test_several_files_of_one_recording(tmp_path: Path) -> None:
    records = sorted(_drive(24), key=lambda record: record[2])
    expected = list(_open(tmp_path, records).frames())
    folder = tmp_path / "split"
    for k in range(12):
        part = len(records) // 12
        _write(folder / f"bag_{k}.mcap", records[k * part : (k + 1) * part if k < 11 else None])
    source = open_input(folder)
    assert len(source) == 24
    _same_frames(source.frames(), expected)


def _rosbag2(path: Path, records: list[Record], plugin: StoragePlugin) -> Path:
    store, connections = get_typestore(Stores.ROS2_HUMBLE), dict[str, Any]()
    store.register(get_types_from_msg(schema_text(LivoxCustomMsg.ROS_TYPE), LivoxCustomMsg.ROS_TYPE))
    with Ros2Writer(path, version=9, storage_plugin=plugin) as out:
        for topic, message, stamp in records:
            if topic not in connections:
                connections[topic] = out.add_connection(topic, message.ROS_TYPE, typestore=store)
            out.write(connections[topic], stamp, message.encode())
    return path


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_bags_that_rosbags_wrote(tmp_path: Path, plugin: StoragePlugin) -> None:
    expected = list(_open(tmp_path, _drive()).frames())
    source = open_input(_rosbag2(tmp_path / "bag", _drive(), plugin))
    assert source.poses is not None
    _same_frames(source.frames(), expected)


def _rosbag1(path: Path, records: list[Record]) -> Path:
    ros1, ros2, connections = (
        get_typestore(Stores.ROS1_NOETIC),
        get_typestore(Stores.ROS2_HUMBLE),
        dict[str, Any](),
    )
    for kind in (LivoxCustomMsg.ROS_TYPE, TFMessage.ROS_TYPE):
        types = get_types_from_msg(schema_text(kind), kind)
        package = kind.partition("/")[0]
        ros1.register({name: definition for name, definition in types.items() if package in name})
        ros2.register(types)
    with Ros1Writer(path) as out:
        for topic, message, stamp in records:
            if topic not in connections:
                connections[topic] = out.add_connection(topic, message.ROS_TYPE, typestore=ros1)
            out.write(
                connections[topic], stamp + SECOND, ros2.cdr_to_ros1(message.encode(), message.ROS_TYPE)
            )
    return path


def test_ros1_bags(tmp_path: Path) -> None:
    expected = list(_open(tmp_path, _drive()).frames())
    points = np.zeros(3, LivoxCustomMsg.POINT)
    points["x"], points["offset_time"] = [1, 2, 3], [0, 10, 50 * MS]
    livox = LivoxCustomMsg(Header(10 * MS, "lidar"), 0, points)
    source = open_input(_rosbag1(tmp_path / "a.bag", _drive()))
    assert source.poses is not None
    _same_frames(source.frames(), expected)
    frame = next(open_input(_rosbag1(tmp_path / "b.bag", [("/livox", livox, 0)])).frames())
    assert frame.scans[0].points[:, 0].tolist() == [1, 2, 3]
    np.testing.assert_allclose(frame.scans[0].offset_s, [0, 1e-8, 0.05])


def test_ros1_bags_need_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _rosbag1(tmp_path / "a.bag", _drive())
    real = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("rosbags"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"pip install 'artemis-edge\[import\]'"):
        open_input(path)


def test_files_that_are_none(tmp_path: Path) -> None:
    cases = {"a.mcap": b"", "b.mcap": b"not a recording", "c.db3": b"SQLite format 3\0" + b"x" * 100}
    cases |= {"d.bag": b"#ROSBAG V2.0\ngarbage", "e.txt": b"hello", "f.mcap": b"\x89MCAP0\r\n"}
    for name, content in cases.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(InputError) as caught:
            open_input(path)
        assert "\n" not in str(caught.value)
        assert str(tmp_path) in str(caught.value) or name == "f.mcap"
    empty = sqlite3.connect(tmp_path / "g.db3")
    empty.execute("CREATE TABLE something (id INTEGER)")
    empty.close()
    with pytest.raises(InputError, match="not a ROS 2 bag in SQLite"):
        open_input(tmp_path / "g.db3")


def test_a_recording_without_lidar(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no LiDAR clouds .* but /imu \(sensor_msgs/msg/Imu\)"):
        _open(tmp_path, [_imu(0)])


def test_ros1_messages_in_mcap(tmp_path: Path) -> None:
    """As converters of ROS 1 bags write them."""
    kind, ros2 = PointCloud2.ROS_TYPE, get_typestore(Stores.ROS2_HUMBLE)
    with (tmp_path / "a.mcap").open("wb") as stream:
        out = Writer(stream)
        out.start("ros1", "x")
        channel = out.register_channel(
            "/p", "ros1", out.register_schema("sensor_msgs/PointCloud2", "ros1msg", b"")
        )
        for k in range(3):
            data = bytes(ros2.cdr_to_ros1(_cloud(k * SECOND, value=k + 1)[1].encode(), kind))
            out.add_message(channel, k, data, k)
        out.finish()
    frames = list(open_input(tmp_path / "a.mcap").frames())
    assert [frame.stamp_ns for frame in frames] == [0, SECOND, 2 * SECOND]
    assert [frame.scans[0].points[0, 0] for frame in frames] == [1, 2, 3]


def test_other_encodings(tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as stream:
        out = Writer(stream)
        out.start("", "x")
        schema = out.register_schema("sensor_msgs/msg/PointCloud2", "jsonschema", b"{}")
        out.add_message(out.register_channel("/points", "json", schema), 0, b"{}", 0)
        out.finish()
    with pytest.raises(InputError, match="no LiDAR clouds"):
        open_input(tmp_path / "a.mcap")


@pytest.mark.parametrize("compression", [CompressionType.LZ4, CompressionType.NONE])
def test_cut_off_recordings(tmp_path: Path, compression: CompressionType) -> None:
    """Cut anywhere, a recording gives the frames of its complete chunks and says that it was cut."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        out = Writer(stream, 1 << 20, compression)
        out.start("ros2", "x")
        schema = out.register_schema(
            PointCloud2.ROS_TYPE, "ros2msg", schema_text(PointCloud2.ROS_TYPE).encode()
        )
        channel = out.register_channel("/p", "cdr", schema)
        ends = []
        for k in range(5):
            out.add_message(channel, k * SECOND, _cloud(k * SECOND)[1].encode(), 0)
            out.flush()
            ends.append(stream.tell())
        out.finish()
    whole = path.read_bytes()
    cut = tmp_path / "cut.mcap"
    for length in range(8, len(whole), 7):
        cut.write_bytes(whole[:length])
        # ``flush`` writes the index of a chunk after it: the chunk itself is complete a little earlier
        complete = sum(end <= length for end in ends)
        try:
            source = RosbagSource(cut)
        except InputError:
            assert complete == 0
            continue
        assert complete <= len(source) <= complete + 1
        assert len([frame for frame in source.frames() if frame.scans]) == len(source)
        if length < ends[-1]:
            assert source.lost["truncated_file"] == 1
            assert any("is cut off" in text for text in source.warnings)


def test_damaged_chunk_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with SessionWriter(path) as out:
        for k in range(3):
            topic, message, stamp = _cloud(k * SECOND)
            out.write(topic, message, stamp)
            out.flush()
    data = bytearray(path.read_bytes())
    middle = [i for i in range(len(data)) if data[i : i + 3] == b"lz4"][1]
    data[middle + 40] ^= 0xFF
    path.write_bytes(data)
    source = RosbagSource(path)
    assert source.stamp_ns.tolist() == [0, 2 * SECOND]
    assert source.lost == {"damaged_chunks": 1} and "a chunk of" in source.warnings[0]


@given(st.integers(0, 2**20), st.integers(0, 255), st.integers(0, 2**20), st.binary(max_size=8))
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_flipped_bytes_of_a_recording(tmp_path: Path, at: int, value: int, where: int, extra: bytes) -> None:
    """Whatever is wrong with a file: an InputError or fewer frames, never another error."""
    original = tmp_path / "original.mcap"
    if not original.exists():
        _write(original, _drive(2))
    data = bytearray(original.read_bytes())
    data[8 + at % (len(data) - 8)] = value
    where = 8 + where % (len(data) - 8)
    data[where : where + len(extra)] = extra
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    try:
        source = RosbagSource(path)
    except InputError:
        return
    for frame in source.frames():
        assert all(np.isfinite(scan.points).all() for scan in frame.scans)


@given(st.binary(max_size=400))
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_arbitrary_bytes(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "any.mcap"
    for start in (b"\x89MCAP0\r\n", b"SQLite format 3\0", b"#ROSBAG V2.0\n", b""):
        path.write_bytes(start + data)
        with pytest.raises(InputError):
            open_input(path)


def test_damaged_sqlite(tmp_path: Path) -> None:
    folder = _rosbag2(tmp_path / "bag", _drive(40), StoragePlugin.SQLITE3)
    file = next(folder.glob("*.db3"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    try:
        source = RosbagSource(file)
    except InputError as error:
        assert "SQLite" in str(error) or "no LiDAR" in str(error)
    else:
        assert source.lost["truncated_file"] >= 1


# --- real recordings ---


@needs_data
@pytest.mark.data
def test_real_livox_scene() -> None:
    source = RosbagSource(DATA / "livox_cam_hku" / "scene2")
    truth = json.loads((DATA / "livox_cam_hku" / "scene2_poses.json").read_text())
    assert (len(source), source.lost, source.warnings) == (22, {}, [])
    assert source.poses is not None and len(source.poses) == 22
    clouds = {(c["station"], f"lidar_{c['lidar']}"): c for c in truth["clouds"]}
    images = {(i["station"], f"cam_{i['camera']}"): i for i in truth["images"]}
    seen = 0
    for frame, T_world_lidar in zip(source.frames(), source.poses.T_world_lidar, strict=True):
        station = (frame.stamp_ns - 1000 * SECOND) // SECOND
        for scan in frame.scans:
            cloud = clouds[station, scan.name]
            np.testing.assert_allclose(T_world_lidar @ scan.T_lidar_sensor, cloud["T_world_lidar"], atol=2e-5)
            assert len(scan.points) + frame.lost.get("no_return", 0) == cloud["points"]
            seen += 1
        for image in frame.images:
            known = images[station, image.name]
            T_cam_world = image.T_cam_lidar @ inverse(T_world_lidar)
            np.testing.assert_allclose(T_cam_world, known["T_cam_world"], atol=2e-4)
            assert image.model.distortion == tuple(known["dist_k1k2p1p2k3"])
            seen += 1
    assert seen == 36 + 44


@needs_data
@pytest.mark.data
def test_real_base_poses() -> None:
    from artemis_edge.trajectory import pose_per_frame, read_tum

    source = RosbagSource(DATA / "livox_cam_hku" / "split" / "input")
    base = read_tum(DATA / "livox_cam_hku" / "split" / "input_base_poses.tum")
    of_lidar = lidar_poses(source, pose_per_frame(base, source.stamp_ns))
    assert source.poses is not None
    np.testing.assert_allclose(of_lidar.T_world_lidar, source.poses.T_world_lidar, atol=1e-4)


@needs_data
@pytest.mark.data
def test_real_hall() -> None:
    from artemis_edge.trajectory import read_tum

    source = RosbagSource(DATA / "hilti_os0_handheld" / "bag")
    reference = read_tum(DATA / "hilti_os0_handheld" / "poses.tum")
    assert (len(source), source.lost, source.warnings) == (90, {}, [])
    assert source.poses is not None
    np.testing.assert_allclose(source.poses.stamp_ns, reference.stamp_ns, atol=1000)
    np.testing.assert_allclose(source.poses.T_world_lidar, reference.T_world_lidar, atol=1e-5)
    frame = next(source.frames(40))
    assert frame.scans[0].intensity is not None and 0.05 < frame.scans[0].intensity.max() <= 1.0


@needs_data
@pytest.mark.data
@pytest.mark.parametrize("name", ["nav2_turtlebot.mcap", "tf_example", "tf_example.bag", "ROS_example.bag"])
def test_real_bags_without_lidar(name: str) -> None:
    from artemis_edge.datasets.bag import WHOLE
    from artemis_edge.datasets.rosbag import open_bags

    path = DATA / "evo_bags" / name
    with pytest.raises(InputError, match="no LiDAR clouds"):
        open_input(path)
    ours = sorted(
        (entry.connection.topic, entry.log_ns, bytes(entry.data)[:200])
        for bag in open_bags(path)
        for entry in bag.scan(lambda _connection: WHOLE)
    )
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        theirs = sorted((c.topic, log_ns, bytes(raw)[:200]) for c, log_ns, raw in reader.messages())
    assert ours == theirs and len(ours) > 10
