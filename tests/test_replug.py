"""Each device pulled and plugged in again while the service records: noticed, marked, and nothing else is lost."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from artemis_drivers.imu_serial.mtdata2 import Mid, XbusFraming, decode
from artemis_drivers.imu_serial.stream import FrameSplitter

from artemis_edge import topics
from artemis_edge.session.feed import recorded
from artemis_edge.session.mcap_file import GrowingFile
from artemis_edge.session.message_ring import Sent
from artemis_edge.session.messages import Imu, PointCloud2, RawPackets, Text
from artemis_edge.session.verify import verify
from tests import replug
from tests.replug import OUT_S, Seen

DEVICES = ("lidar_0", "imu", "trigger", "cam_0")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Seen]]:
    """One recording for all: LiDAR, IMU, stick of the trigger board and camera in turn, recorder, board's power."""
    tmp, seen = tmp_path_factory.mktemp("replug"), Seen()
    with replug.recording_rig(tmp) as (rig, service):
        seen.packets_before = rig.avia.counters["packets_sent"]
        seen.pulled = replug.pull_each(rig, service)
        seen.killed = replug.kill_the_recorder(service)
        seen.powered = replug.lose_power(rig, service)
        replug.finish(service, rig, seen)
    yield tmp / "recorded", seen


@pytest.fixture(scope="module")
def found(run: tuple[Path, Seen]) -> dict[str, list[Sent]]:
    """What was recorded, by topic."""
    by_topic: dict[str, list[Sent]] = {}
    for sent in recorded(run[0], 0):
        by_topic.setdefault(sent.topic, []).append(sent)
    return by_topic


def events(found: dict[str, list[Sent]]) -> list[dict[str, object]]:
    return [json.loads(Text.decode(sent.data).text) for sent in found[topics.EVENTS.name]]


def test_each_is_noticed_and_told(run: tuple[Path, Seen]) -> None:
    _, seen = run
    assert tuple(seen.pulled) == DEVICES and seen.code == 0
    for name, pulled in seen.pulled.items():
        assert pulled.state in ("silent", "searching"), name
        assert any(word in pulled.message for word in ("check its cable", "plug", "start the camera")), name
    assert all(device["gaps"] >= 1 for device in seen.state["devices"])


def test_the_gaps_are_marked_in_the_session(found: dict[str, list[Sent]]) -> None:
    """With its length; a computer with other things to do may see further ones."""
    gaps = [event for event in events(found) if event["kind"] == "gap"]
    longest = {name: max(float(str(g["gap_s"])) for g in gaps if g["name"] == name) for name in DEVICES}
    assert all(gap_s > OUT_S - 0.2 for gap_s in longest.values())


def test_no_message_is_lost_although_the_recorder_was_killed(run: tuple[Path, Seen]) -> None:
    session, seen = run
    assert seen.killed
    files = sorted(session.glob("*.mcap"))
    assert len(files) == 2
    numbers = Counter(sent.number for file in files for sent in GrowingFile(file).messages())
    assert sorted(numbers) == list(range(len(numbers))), "none missing"
    again = sorted(number for number, count in numbers.items() if count > 1)
    starts = [sent.topic for sent in GrowingFile(files[1]).messages()][: len(again)]
    assert set(starts) == {topics.RIG.name, topics.TF_STATIC.name, topics.CAMERA_INFO.name}
    killed, whole = verify(session)
    assert any("was not closed" in problem for problem in killed.problems) and whole.problems == []


def stamps_of_imu(found: dict[str, list[Sent]]) -> np.ndarray:
    return np.array([Imu.decode(sent.data).header.stamp_ns for sent in found[topics.IMU.name]])


def test_the_imu_has_no_other_gap(found: dict[str, list[Sent]]) -> None:
    """Neither while other devices are away nor while the board starts."""
    steps = np.diff(stamps_of_imu(found))
    assert steps.min() >= 0
    longest = np.sort(steps)[::-1] * 1e-9
    assert longest[0] > OUT_S - 0.2
    assert (
        longest[1] <= 1.1 < longest[0] and longest[2] < 0.5
    )  # a board that has started begins at a whole second
    sent_by_it, splitter = 0, FrameSplitter(XbusFraming())
    for sent in found[topics.IMU_BYTES.name]:
        frames = splitter.feed(bytes(RawPackets.decode(sent.data).data))
        sent_by_it += sum(decode(frame).mid == Mid.MTDATA2 for frame in frames)
    assert abs(sent_by_it - len(steps) - 1) < 100, "bytes are recorded ten times a second, samples at once"


def test_every_pulse_is_named_when_the_lidar_takes_it(run: tuple[Path, Seen]) -> None:
    """Not before 10 ms after the edge; too late where this computer has other things to do."""
    named, early = run[1].pulses
    assert named > 3 and early == 0


def test_the_lidar_has_no_other_gap(run: tuple[Path, Seen], found: dict[str, list[Sent]]) -> None:
    _, seen = run
    packets = sum(len(RawPackets.decode(sent.data).size) for sent in found[topics.LIDAR_PACKETS.name])
    assert packets > 0.95 * (seen.packets["packets_sent"] - seen.packets_before)
    clouds = [PointCloud2.decode(sent.data) for sent in found[topics.LIDAR_POINTS.name]]
    assert sum(cloud.width == 0 for cloud in clouds) >= 10 * (OUT_S - 0.3), "its own gap"


def test_photographs_are_dated_while_the_board_is_not_heard(found: dict[str, list[Sent]]) -> None:
    """From the first trigger to the camera's own gap: one a tenth of a second, numbered without a hole."""
    stamps = [json.loads(Text.decode(sent.data).text) for sent in found[topics.CAMERA_STAMP.name]]
    sequences = [stamp["sequence"] for stamp in stamps]
    restart = next(k for k in range(1, len(sequences)) if sequences[k] < sequences[k - 1])
    assert sequences[:restart] == list(range(sequences[0], sequences[0] + restart))
    steps = np.diff([stamp["stamp_ns"] for stamp in stamps[:restart]])
    assert np.abs(steps - 100_000_000).max() < 100_000
    assert {"locked", "holdover"} == {stamp["state"] for stamp in stamps[:restart]}


def test_photographs_go_on_after_camera_and_board_began_anew(
    run: tuple[Path, Seen], found: dict[str, list[Sent]]
) -> None:
    _, seen = run
    assert seen.powered
    stamps = [json.loads(Text.decode(sent.data).text) for sent in found[topics.CAMERA_STAMP.name]]
    times = np.array([stamp["stamp_ns"] for stamp in stamps])
    assert (np.diff(times) > 0).all()
    assert stamps[-1]["trigger"] < len(stamps) - 20, "counts begin anew with the board"
    counts = seen.state["pairing"]["cam_0"]
    assert counts["restarts"] >= 1
    assert sum(count for name, count in counts.items() if name.startswith("unpaired")) <= 2
