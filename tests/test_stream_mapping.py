"""Frames from a stream of messages, and their mapping: the same whenever and however fast it is fed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from artemis_edge import topics
from artemis_edge.cli import main
from artemis_edge.config import Config
from artemis_edge.datasets import open_input
from artemis_edge.errors import InputError
from artemis_edge.frames import SyncedFrame
from artemis_edge.session import feed
from artemis_edge.session.assembly import FrameAssembler
from artemis_edge.session.files import Limits, SessionFiles
from artemis_edge.session.message_ring import MessageRing, Sent
from artemis_edge.session.messages import Text
from artemis_edge.session.replay import Pace, replay
from tests import small_session
from tests.conftest import FakeMapper
from tests.recordings import publish, sent
from tests.small_session import FRAME, START


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_session.write(tmp_path_factory.mktemp("small") / "walk", frames=6, points=500)


def _frames(path: Path) -> tuple[list[SyncedFrame], FrameAssembler]:
    assembler = FrameAssembler()
    found = [assembler.take(message) for message in feed.messages(path)]
    return [frame for frame in found if frame is not None], assembler


def test_frames_are_those_that_the_reader_of_recordings_gives(session: Path) -> None:
    frames, assembler = _frames(session)
    source = open_input(session)
    assert assembler.lost == {} and len(frames) == len(source) == 6
    for frame, other in zip(frames, source.frames(), strict=True):
        assert (frame.index, frame.stamp_ns, frame.lost) == (other.index, other.stamp_ns, other.lost)
        (scan,), (expected,) = frame.scans, other.scans
        assert np.array_equal(scan.points, expected.points) and np.array_equal(
            scan.offset_s, expected.offset_s
        )
        assert np.array_equal(frame.imu.stamp_ns, other.imu.stamp_ns)
        assert np.array_equal(frame.imu.accel, other.imu.accel)
        (photo,), (image,) = frame.images, other.images
        assert (photo.name, photo.stamp_ns, photo.encoded) == (image.name, image.stamp_ns, image.encoded)
        assert photo.model == image.model and np.allclose(photo.T_cam_lidar, image.T_cam_lidar)
        assert photo.exposure_s == image.exposure_s == 0.004


def test_what_cannot_be_used_is_counted() -> None:
    assembler = FrameAssembler()
    assembler.take(Sent(0, topics.CAMERA_IMAGE.name, topics.CAMERA_IMAGE.ros_type, 0, 0, b"\0\1\0\0"))
    assert assembler.lost == {"undecodable_messages": 1}
    text = Text(json.dumps({"cam_missing": 2})).encode()
    assembler.take(Sent(1, topics.LOST.name, Text.ROS_TYPE, 0, 0, text))
    assert assembler._counts == {"cam_missing": 2}


def test_the_rig_says_which_topics_count(session: Path) -> None:
    assembler = FrameAssembler()
    text = Text(json.dumps({"topics": {"lidars": ["/other"], "imu": "/imu", "cameras": []}})).encode()
    assembler.take(Sent(0, topics.RIG.name, Text.ROS_TYPE, 0, 0, text))
    assert all(assembler.take(message) is None for message in feed.messages(session))


def test_replay_maps_every_frame(session: Path, tmp_path: Path, fake_pipeline: list[FakeMapper]) -> None:
    saved = replay(session, tmp_path / "out", Config())
    assert saved["report"]["frames"] == 6 and saved["fault"] == ""
    assert {"mesh.ply", "trajectory.tum", "report.html", "map"} <= set(saved["kept"])
    path = np.loadtxt(tmp_path / "out" / "trajectory.tum")
    assert path[:, 0].tolist() == [(START + k * FRAME) / 1e9 for k in range(6)]


def test_a_frame_that_ends_the_process_is_left_out(
    session: Path, tmp_path: Path, fake_pipeline: list[FakeMapper]
) -> None:
    from artemis_edge.session.stream_mapping import StreamMapping

    mapping = StreamMapping(Config(), tmp_path)
    mapping.skip = {2}
    worked_on: list[int] = []
    mapping.before = worked_on.append
    taken = sum(mapping.take(message) for message in feed.messages(session))
    assert (taken, worked_on) == (6, list(range(6)))
    assert mapping.statistics.lost == {"frames_that_end_the_process": 1}
    assert len(mapping.mapper.trajectory) == 5


def test_pace() -> None:
    now, slept = [100.0], list[float]()

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        now[0] += seconds

    wait = Pace(2.0, sleep, lambda: now[0]).waiter()
    for log_ns in (5 * 10**9, 6 * 10**9, 6 * 10**9, 9 * 10**9):
        wait(log_ns)
    assert slept == [0.5, 1.5]
    Pace().waiter()(10**12)


def test_commands(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(tmp_path / "nothing")]) == 2
    assert main(["replay", str(session), "--speed", "0"]) == 2
    assert main(["replay", str(session), "--wire", "--speed", "2"]) == 2
    empty = tmp_path / "empty"
    empty.mkdir()
    assert main(["replay", str(empty)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 4


def test_a_live_feed_reads_from_the_files_what_the_ring_has_forgotten(tmp_path: Path) -> None:
    """Every message once and in order, wherever it comes from."""
    ring = MessageRing.create(0.066)
    files = SessionFiles(tmp_path, {}, {}, Limits(reserve_bytes=0))
    live = feed.LiveFeed(ring, tmp_path, 0)
    seen = []
    for k in range(200):
        message = sent(k, 1000)
        publish(ring, message)
        files.write(message)
        if k % 10 == 9:
            files.flush()
        if k in (20, 120):
            while (found := live.take()) is not None:
                seen.append(found)
    while (found := live.take()) is not None:
        seen.append(found)
    files.close()
    assert [message.number for message in seen] == list(range(200))
    assert all(message.data == sent(message.number, 1000).data for message in seen)
    assert live.from_files > 100 and live.missed == 0


def test_what_is_nowhere_is_counted(tmp_path: Path) -> None:
    ring = MessageRing.create(0.066)
    live = feed.LiveFeed(ring, tmp_path, 0)
    for k in range(100):
        publish(ring, sent(k, 2000))
    found = live.take()
    while found is None and live.next < 100:
        found = live.take()
    assert found is not None and found.number == live.missed == ring.oldest


def test_nothing_to_replay(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no MCAP file"):
        list(feed.messages(tmp_path))
