"""The recorder: everything is written, in order, in time, and the disk is never filled."""

from __future__ import annotations

import random
import resource
import signal
import socket
import time
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from artemis_edge.session import verify
from artemis_edge.session.feed import next_number
from artemis_edge.session.files import FLUSH_S, Limits, SessionFiles
from artemis_edge.session.line_channel import LineChannel
from artemis_edge.session.mcap_file import GrowingFile
from artemis_edge.session.message_ring import MessageRing
from artemis_edge.session.recorder import Recorder, RecorderTask
from artemis_edge.session.recover import recover
from artemis_edge.topics import LIDAR_PACKETS, TF_STATIC
from tests.recordings import START, numbers, publish, sent, start_recorder
from tests.waiting import until


def _files(folder: Path, split: int = 1 << 30, reserve: int = 0, free: int = 1 << 40) -> SessionFiles:
    folder.mkdir(exist_ok=True)
    limits = Limits(split, reserve)
    return SessionFiles(folder, {"config.toml": "[a]\n"}, {"d": {"serial": "7"}}, limits, lambda path: free)


def test_a_recording_holds_every_message_and_others_read_it(tmp_path: Path) -> None:
    ring = MessageRing.create(4)
    recorder = start_recorder(ring, tmp_path)
    for k in range(300):
        publish(ring, sent(k))
    recorder.tell("stop")
    recorder.end(20.0)
    assert recorder.process.returncode == 0
    assert recorder.latest["state"] == "closed" and recorder.latest["lost"] == 0
    assert recorder.latest["topics"]["/numbers"]["messages"] == 300
    (path,) = tmp_path.glob("*.mcap")
    assert numbers(path) == list(range(300))
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert sum(summary.statistics.channel_message_counts.values()) == 300
        assert [a.data for a in reader.iter_attachments()] == [b"[a]\n"]
        assert [(m.name, m.metadata) for m in reader.iter_metadata()] == [("device", {"serial": "7"})]
    with AnyReader([path]) as bag:
        first = next(iter(bag.messages()))
        assert bag.deserialize(first[2], first[0].msgtype).data.startswith('{"number": 0')
    assert verify.verify(tmp_path)[0].problems == []


def test_when_the_service_dies_the_recorder_closes_the_file(tmp_path: Path) -> None:
    ring = MessageRing.create(4)
    recorder = start_recorder(ring, tmp_path)
    for k in range(100):
        publish(ring, sent(k))
    recorder.channel.socket.close()
    recorder.process.wait(20.0)
    assert recorder.process.returncode == 0
    assert numbers(tmp_path / "session_000.mcap") == list(range(100))


def test_another_recorder_goes_on_where_a_killed_one_ends(tmp_path: Path) -> None:
    """In a new file that stands alone; nothing twice, nothing missing, also what was published meanwhile."""
    ring = MessageRing.create(4)
    first = start_recorder(ring, tmp_path, first=3)
    for k in range(3):
        publish(ring, sent(k))
    publish(ring, sent(3, topic=TF_STATIC.name))
    for k in range(4, 200):
        publish(ring, sent(k))

    def all_written() -> bool:
        first.hear()
        return int(first.latest.get("messages", 0)) == 197

    assert until(all_written, 90.0)
    assert until(lambda: GrowingFile(tmp_path / "session_000.mcap").latest_number() >= 0, 90.0)
    first.process.kill()
    first.end(20.0)
    for k in range(200, 260):
        publish(ring, sent(k))
    second = start_recorder(ring, tmp_path, first=3, resume=True)
    second.tell("stop")
    second.end(90.0)
    assert second.process.returncode == 0 and second.latest["lost"] == 0
    kept, rest = (numbers(tmp_path / f"session_00{k}.mcap") for k in range(2))
    assert kept[0] == rest[0] == 3 and kept + rest[1:] == list(range(3, 260))
    assert next_number(tmp_path, 0) == 260 and next_number(tmp_path, 300) == 300


@pytest.mark.parametrize("after_s", [0.4, 1.7])
def test_what_is_older_than_a_second_and_a_half_survives_a_kill(tmp_path: Path, after_s: float) -> None:
    ring = MessageRing.create(4)
    recorder = start_recorder(ring, tmp_path)
    assert until(lambda: bool(recorder.hear() or recorder.latest), 20.0)
    times, start = [], time.monotonic()
    while time.monotonic() - start < after_s:
        publish(ring, sent(len(times), log_ns=START + len(times)))
        times.append(time.monotonic())
        time.sleep(0.005)
    killed = time.monotonic()
    recorder.process.send_signal(signal.SIGKILL)
    recorder.process.wait()
    due = sum(killed - at > 1.5 for at in times)
    paths = list(tmp_path.glob("*.mcap"))
    before = [path.read_bytes() for path in paths]
    kept = [
        number
        for path in paths
        for number in numbers(recover(path, tmp_path / f"{path.stem}_whole.mcap").copy)
    ]
    assert kept == list(range(len(kept))) and len(kept) >= due
    assert [path.read_bytes() for path in paths] == before
    recorder.channel.socket.close()


def test_files_are_split_by_size_and_each_stands_alone(tmp_path: Path) -> None:
    now = 0.0
    files = _files(tmp_path, split=100_000)
    files._clock = lambda: now
    files.write(sent(0, topic=TF_STATIC.name))
    rng = random.Random(1)
    for k in range(1, 400):
        text = sent(k)
        files.write(
            type(text)(
                k, text.topic, text.ros_type, text.log_ns, text.stamp_ns, text.data + rng.randbytes(900)
            )
        )
        now += 0.3
        files.tend()
    files.close()
    paths = sorted(tmp_path.glob("*.mcap"))
    assert len(paths) > 2 and all(path.stat().st_size < 160_000 for path in paths)
    for path in paths[1:]:
        assert numbers(path)[0] == 0, "what readers need first stands at the start of every file"
    assert [n for path in paths for n in numbers(path) if n] == list(range(1, 400))
    assert all(v.problems == [] and v.attachments == 0 for v in verify.verify(tmp_path))
    assert files.bytes == sum(path.stat().st_size for path in paths)


def test_what_waits_is_flushed_in_time(tmp_path: Path) -> None:
    now = 10.0
    files = _files(tmp_path)
    files._clock = lambda: now
    files.write(sent(0))
    files.tend()
    path = tmp_path / "session_000.mcap"
    assert numbers(path) == []
    now += FLUSH_S
    files.tend()
    assert numbers(path) == [0]
    files.close()


def test_a_full_disk_stops_the_recording_which_stays_whole(tmp_path: Path) -> None:
    free = 5_000_000
    files = _files(tmp_path, reserve=1_000_000)
    now = 0.0
    files._clock, files._free = lambda: now, lambda path: free
    for k in range(100):
        files.write(sent(k))
        now += 0.1
        files.tend()
        free -= 100_000
    assert "less than 1 MB are free" in files.full and "start again" in files.full
    written = files.messages["/numbers"]
    assert 0 < written < 100 and files.refused == 100 - written
    assert verify.verify(tmp_path)[0].problems == []
    assert numbers(tmp_path / "session_000.mcap") == list(range(written))


def test_a_disk_that_refuses_in_the_middle_of_a_chunk(tmp_path: Path) -> None:
    """The reserve was taken by somebody else: what was flushed is there."""
    files = _files(tmp_path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
        rng = random.Random(1)
        for k in range(60):
            message = sent(k)
            data = message.data + rng.randbytes(5000)
            files.write(type(message)(k, "/numbers", message.ros_type, message.log_ns, 0, data))
            if k == 9:
                files.flush()
            if k > 9 and not files.full:
                files._dirty_since = -1e9
                files.tend()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    assert "cannot write the session" in files.full and files.refused > 0
    whole = recover(tmp_path / "session_000.mcap").copy
    assert numbers(whole)[:10] == list(range(10))


def test_raw_packets_give_way_when_the_disk_is_slow(tmp_path: Path) -> None:
    ours, theirs = socket.socketpair()
    ring = MessageRing.create(0.2)
    recorder = Recorder(RecorderTask(str(tmp_path), reserve_bytes=0), ring, LineChannel(ours))
    for k in range(100):
        raw = k % 2 == 0
        publish(
            ring,
            sent(k, 1500, "/raw" if raw else "/numbers", LIDAR_PACKETS.ros_type if raw else sent(0).ros_type),
        )
    theirs.close()
    recorder.run()
    ours.close()
    assert recorder.left_out > 0 and recorder.reader.lost == 0
    kept = numbers(tmp_path / "session_000.mcap")
    assert [k for k in kept if k % 2] == list(range(1, 100, 2))
    assert len(kept) + recorder.left_out == 100


def test_a_slow_disk_is_given_time_at_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("artemis_edge.session.recorder._PATIENCE_S", 0.05)
    monkeypatch.setattr("artemis_edge.session.recorder._BATCH", 5)
    ours, theirs = socket.socketpair()
    ring = MessageRing.create(4)
    recorder = Recorder(RecorderTask(str(tmp_path), reserve_bytes=0), ring, LineChannel(ours))
    for k in range(60):
        publish(ring, sent(k))
    theirs.close()
    tend = recorder.files.tend

    def slowly(files: SessionFiles) -> None:
        time.sleep(0.02)
        tend()

    monkeypatch.setattr(SessionFiles, "tend", slowly)
    recorder.run()
    ours.close()
    assert numbers(tmp_path / "session_000.mcap") == list(range(60))
