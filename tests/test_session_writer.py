"""The session writer: what it writes, other libraries read with equal values."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from artemis_edge import topics
from artemis_edge.errors import RunError
from artemis_edge.frames import CameraModel
from artemis_edge.session import writer as session_writer
from artemis_edge.session.messages import PointCloud2
from artemis_edge.session.schemas import schema_text
from artemis_edge.session.writer import POINT, SessionWriter
from artemis_edge.trajectory import matrix_from_quaternion

MODEL = CameraModel(640, 480, 500.0, 501.0, 320.0, 240.0, (0.1, -0.2, 0.001, 0.002, 0.05))
T = matrix_from_quaternion(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.6, 0.0, 0.8]))
SECOND = 1_000_000_000


def _write(path: Path, frames: int = 3) -> Path:
    rng = np.random.default_rng(0)
    with SessionWriter(
        path,
        attachments={"config.toml": "[a]\nb = 1\n", "raw": b"\0\1"},
        metadata={"device": {"serial": "7"}},
    ) as out:
        out.write_tf_static(0, "lidar", "cam", T)
        out.write_camera_info(0, MODEL)
        for k in range(frames):
            stamp = k * SECOND // 10
            points = rng.normal(size=(500, 3)).astype(np.float32)
            out.write_points(
                stamp,
                points,
                intensity=np.linspace(0, 1, 500, dtype=np.float32),
                tag=np.full(500, 16, np.uint8),
                line=(np.arange(500) % 6).astype(np.uint8),
                offset_ns=np.arange(500) * 4167,
                receive_ns=stamp + 5,
            )
            out.write_imu(stamp, np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.0, 9.81]))
            out.write_image(stamp, b"\xff\xd8 not really a jpeg")
            out.write_exposure(stamp, 0.004, 2.0 + k)
            out.write_tf(stamp, "map", "lidar", T)
            out.write_odometry(stamp, T, linear=np.array([1.0, 0.0, 0.0]))
    return path


def test_rosbags_reads_equal_values(tmp_path: Path) -> None:
    path = _write(tmp_path / "new" / "session.mcap")
    seen: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path]) as reader:
        for connection, log_ns, raw in reader.messages():
            seen.setdefault(connection.topic, []).append(
                (log_ns, reader.deserialize(raw, connection.msgtype))
            )
            assert connection.msgtype == {t.name: t.ros_type for t in topics.TOPICS}[connection.topic]
    assert {name: len(messages) for name, messages in seen.items()} == {
        "/tf_static": 1,
        "/camera/camera_info": 1,
        "/lidar/points": 3,
        "/imu": 3,
        "/camera/image/compressed": 3,
        "/camera/exposure": 3,
        "/tf": 3,
        "/odom": 3,
    }
    log_ns, cloud = seen["/lidar/points"][1]
    assert (log_ns, cloud.header.stamp.nanosec, cloud.header.frame_id) == (100_000_005, 100_000_000, "lidar")
    assert [(f.name, f.offset, f.datatype) for f in cloud.fields] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
        ("intensity", 12, 7),
        ("tag", 16, 2),
        ("line", 17, 2),
        ("t", 18, 6),
    ]
    points = np.frombuffer(cloud.data.tobytes(), POINT)
    assert (cloud.width, cloud.height, cloud.point_step) == (500, 1, POINT.itemsize)
    assert points["t"].tolist() == (np.arange(500) * 4167).tolist()
    assert points["line"].tolist() == (np.arange(500) % 6).tolist()
    info = seen["/camera/camera_info"][0][1]
    assert info.d.tolist() == list(MODEL.distortion)
    assert info.k.tolist() == [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]
    transform = seen["/tf"][0][1].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "lidar")
    assert (transform.transform.translation.z, transform.transform.rotation.w) == (3.0, pytest.approx(0.8))
    assert seen["/odom"][0][1].twist.twist.linear.x == 1.0
    assert seen["/imu"][0][1].linear_acceleration.z == 9.81
    assert (seen["/camera/exposure"][1][1].exposure_s, seen["/camera/exposure"][1][1].gain) == (0.004, 3.0)


def test_a_mosaic_is_an_image_that_others_read(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    model = CameraModel(4, 3, 5.0, 5.0, 2.0, 1.0)
    with SessionWriter(path) as out:
        out.write_raw_image(5, bytes(range(12)), model, encoding="bayer_rggb8")
    with AnyReader([path]) as reader:
        (image,) = (reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages())
    assert (image.width, image.height, image.step, image.encoding) == (4, 3, 4, "bayer_rggb8")
    assert image.data.tolist() == list(range(12))


def test_mcap_ros2_reads_it(tmp_path: Path) -> None:
    path = _write(tmp_path / "s.mcap")
    with path.open("rb") as stream:
        decoded = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert len(decoded) == 20
    clouds = [item for item in decoded if item[1].topic == "/lidar/points"]
    assert [item[2].log_time - item[2].publish_time for item in clouds] == [5, 5, 5]
    assert [item[2].sequence for item in clouds] == [0, 1, 2]
    assert clouds[0][3].width == 500


def test_layout_of_the_file(tmp_path: Path) -> None:
    path = _write(tmp_path / "s.mcap")
    with path.open("rb") as stream:
        kinds = [type(record).__name__ for record in StreamReader(stream, emit_chunks=True).records]
        stream.seek(0)
        reader = make_reader(stream)
        header, summary = reader.get_header(), reader.get_summary()
        attachments = {a.name: (a.media_type, a.data) for a in reader.iter_attachments()}
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert kinds[:5] == ["Header", "Attachment", "Attachment", "Metadata", "Chunk"]
    assert (header.profile, header.library) == ("ros2", "artemis-edge")
    assert attachments["config.toml"] == ("application/toml", b"[a]\nb = 1\n")
    assert metadata == {"device": {"serial": "7"}}
    assert summary is not None and {c.compression for c in summary.chunk_indexes} == {"lz4"}
    assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
    assert {c.message_encoding for c in summary.channels.values()} == {"cdr"}
    for schema in summary.schemas.values():
        assert schema.data.decode() == schema_text(schema.name)


def test_the_same_calls_write_the_same_bytes(tmp_path: Path) -> None:
    assert _write(tmp_path / "a.mcap").read_bytes() == _write(tmp_path / "b.mcap").read_bytes()


def test_every_second_reaches_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is more than a second of receive time old is complete in the file before it is closed."""
    synced: list[int] = []
    path = tmp_path / "s.mcap"
    monkeypatch.setattr(session_writer.os, "fdatasync", lambda _fd: synced.append(path.stat().st_size))
    out = SessionWriter(path)
    for k in range(35):
        out.write_imu(k * SECOND // 10, np.zeros(3), np.zeros(3))
    assert len(synced) == 1 + 3 and synced == sorted(set(synced)), "once at the start, then every second"
    (tmp_path / "copy.mcap").write_bytes(path.read_bytes())
    out.close()
    with (tmp_path / "copy.mcap").open("rb") as stream:
        messages = 0
        try:
            for record in StreamReader(stream).records:
                messages += type(record).__name__ == "Message"
        except Exception as error:  # the copy has no end
            assert "EndOfFile" in type(error).__name__
    assert messages == 31


def test_empty_cloud_and_defaults(tmp_path: Path) -> None:
    with SessionWriter(tmp_path / "s.mcap") as out:
        out.write_points(0, np.empty((0, 3), np.float32))
        out.write_points(1, np.ones((2, 3), np.float32))
    with AnyReader([tmp_path / "s.mcap"]) as reader:
        clouds = [PointCloud2.decode(raw) for _, _, raw in reader.messages()]
    assert [cloud.width for cloud in clouds] == [0, 2]
    assert np.frombuffer(clouds[1].data, POINT)["intensity"].tolist() == [0.0, 0.0]


def test_one_type_per_topic(tmp_path: Path) -> None:
    with SessionWriter(tmp_path / "s.mcap") as out:
        out.write_imu(0, np.zeros(3), np.zeros(3), topic="/a")
        with pytest.raises(ValueError, match="carries"):
            out.write_image(0, b"", topic="/a")


def test_closing_twice(tmp_path: Path) -> None:
    out = SessionWriter(tmp_path / "s.mcap")
    out.close()
    size = (tmp_path / "s.mcap").stat().st_size
    out.close()
    assert (tmp_path / "s.mcap").stat().st_size == size


def test_no_place_to_write(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="cannot write the session"):
        SessionWriter(tmp_path / "file" / "s.mcap")
    with pytest.raises(RunError, match="cannot write the session"):
        SessionWriter(tmp_path)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_full_disk() -> None:
    with pytest.raises(RunError, match="No space left on device") as caught:
        SessionWriter(Path("/dev/full"))
    assert "\n" not in str(caught.value)


def test_disk_that_fails_at_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_fd: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    out = SessionWriter(tmp_path / "s.mcap")
    out.write_imu(0, np.zeros(3), np.zeros(3))
    monkeypatch.setattr(session_writer.os, "fsync", fail)
    with pytest.raises(RunError, match="Input/output error"):
        out.close()
