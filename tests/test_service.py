"""The service end to end, against virtual devices on the wire: recorded, mapped, killed, stopped, replayed."""

from __future__ import annotations

import json
import os
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from artemis_edge import topics
from artemis_edge.config import Config
from artemis_edge.export.ply_reader import read_ply
from artemis_edge.segmentation.registry import STORE_VARIABLE, Addition, Registry, file_hash
from artemis_edge.service.control import default_path
from artemis_edge.session.feed import messages
from artemis_edge.session.replay import replay
from artemis_edge.session.stream_mapping import warm_up
from artemis_edge.session.verify import verify
from artemis_edge.session.wire_replay import WireRig, read
from tests import networks, small_session
from tests.control_client import ask
from tests.listening import listening
from tests.livox_ports import reserved
from tests.waiting import until
from tests.wire_service import Service

_PATIENCE_S = 300.0
_PICTURES = topics.CAMERA_IMAGE.name


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A network that calls what is red a car and what is green a person."""
    tmp = tmp_path_factory.mktemp("model")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(STORE_VARIABLE, str(tmp / "store"))
        path = networks.semantic(tmp / "colours.onnx")
        classes = ("background", *networks.CLASSES)
        Registry().add(Addition(path, {"model": file_hash(path)}, classes=classes, input_size=(64, 64)))
        yield


@pytest.fixture(scope="module")
def played(
    model: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Path, Service, dict[str, Any]]]:
    """One run for all: a walk of two seconds, the mapping killed in the middle of it."""
    tmp = tmp_path_factory.mktemp("run")
    red_and_green = np.zeros((48, 64, 3), np.uint8)  # BGR
    red_and_green[:, :28, 2] = red_and_green[:, 36:, 1] = 255
    walk = read(small_session.write(tmp / "walk", frames=25, points=9000, photograph=red_and_green))
    session, seen = tmp / "recorded", dict[str, Any]()
    warm_up(
        Config(), tmp / "warm-up", questions=True
    )  # nobody waits for compilers with a patience of its own
    with reserved(), WireRig(walk, tmp / "rig") as rig:
        _keep_few_images(rig.folder / "rig.toml")
        service = Service(rig, session, tmp)
        try:
            assert until(service.listens, _PATIENCE_S, 0.2), service.said()
            assert until(lambda: _mapped(service) > 3, _PATIENCE_S, 0.2), service.said()
            seen["status"] = ask(service.path, do="status")["result"]
            seen["listening"] = listening(service.process.pid)
            ask(service.path, do="mark", text="here")
            seen["asked"] = [
                ask(service.path, do="ask", text=text) for text in ("car", "green person", "giraffe", "")
            ]
            assert until(lambda: _found(service)["car"]["count"] > 0, _PATIENCE_S, 0.2), service.state()
            rig.begin(0.5)
            before = _mapped(service)
            assert until(lambda: _mapped(service) > before + 8, _PATIENCE_S, 0.2)
            seen["killed_at"] = _mapped(service)
            os.kill(service.state()["session"]["mapping"]["pid"], signal.SIGKILL)
            assert until(lambda: service.state()["session"]["mapping_restarts"] == 1, _PATIENCE_S, 0.2)
            ask(service.path, do="forget", text="car")
            assert rig.over.wait(_PATIENCE_S)
            assert until(lambda: _mapped(service) >= seen["killed_at"], _PATIENCE_S, 0.2)
            seen["state"] = service.state()
            seen["found"] = _found(service)
            seen["wire"] = dict(rig.avia.counters)
            service.process.send_signal(signal.SIGTERM)
            seen["code"] = service.process.wait(3 * _PATIENCE_S)
            service.heard()
            yield session, service, seen
        finally:
            service.end()


def test_nothing_listens_on_the_network(played: tuple[Path, Service, dict[str, Any]]) -> None:
    """Datagrams of the devices come in; but nobody can connect."""
    _, _, seen = played
    assert seen["listening"] == []
    with socket.create_server(("127.0.0.1", 0)) as server:
        assert len(listening(os.getpid())) >= 1, server


def _mapped(service: Service) -> int:
    state = service.state()
    return int(((state["session"] or {}).get("mapping") or {}).get("frames", 0))


def _keep_few_images(rig: Path) -> None:
    """Colouring all kept points by all kept images is most of what saving takes."""
    text = rig.read_text()
    assert "images = 300" in text
    rig.write_text(text.replace("images = 300", "images = 8"))


def _found(service: Service) -> dict[str, Any]:
    return {query["text"]: query for query in ask(service.path, do="queries")["result"]["queries"]}


def test_it_ends_well_and_tells_systemd(played: tuple[Path, Service, dict[str, Any]]) -> None:
    _, service, seen = played
    assert seen["code"] == 0, service.said()
    said = service.heard()
    assert said[0] == "READY=1" and "STOPPING=1" in said
    assert said.count("WATCHDOG=1") > 2 and any(line.startswith("EXTEND_TIMEOUT") for line in said)
    assert any(line.startswith("STATUS=recording") for line in said)
    assert not service.path.exists()


def test_nothing_recorded_is_lost_by_the_death_of_the_mapping(
    played: tuple[Path, Service, dict[str, Any]],
) -> None:
    session, _, seen = played
    assert [verdict.problems for verdict in verify(session)] == [[]]
    numbers = []
    with (session / "session_000.mcap").open("rb") as stream:
        numbers = [
            message.sequence for _, _, message in make_reader(stream).iter_messages(log_time_order=False)
        ]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert (
        seen["state"]["session"]["recorder"]["lost"] == seen["state"]["session"]["recorder"]["left_out"] == 0
    )
    assert seen["state"]["session"]["mapping"]["missed"] == 0


def test_replay_equals_live(played: tuple[Path, Service, dict[str, Any]], tmp_path: Path) -> None:
    """Byte for byte, although the live mapping died in the middle."""
    session, _, _ = played
    replay(session, tmp_path / "replayed")
    for name in ("mesh.ply", "trajectory.tum", "map/blocks.bin"):
        live, again = session / "result" / name, tmp_path / "replayed" / name
        assert live.read_bytes() == again.read_bytes(), name


def test_questions_come_and_go_while_it_scans(played: tuple[Path, Service, dict[str, Any]]) -> None:
    session, _, seen = played
    car, person, giraffe, empty = seen["asked"]
    assert (car["result"]["status"], person["result"]["status"]) == ("searching", "searching")
    assert giraffe["result"]["status"] == "unsupported" and "giraffe" in giraffe["result"]["note"]
    assert not empty["ok"] and "write what to look for" in empty["error"]
    assert set(seen["found"]) == {"green person", "giraffe"}
    assert seen["state"]["session"]["mapping"]["masks"] > 3
    messages_of = [message.topic for message in messages(session)]
    assert messages_of.count(topics.QUESTIONS.name) == 5  # at the start, three that are asked, one forgotten
    assert messages_of.count(topics.MASKS.name) >= seen["state"]["session"]["mapping"]["masks"]
    mesh = read_ply(session / "result" / "mesh.ply")
    assert set(mesh.label_names.values()) == {"background", "person"}
    assert (mesh.labels > 0).any() and mesh.label_names[int(mesh.labels.max())] == "person"


def test_the_session_holds_what_it_should(played: tuple[Path, Service, dict[str, Any]]) -> None:
    session, _, _ = played
    (verdict,) = verify(session)
    expected = [topics.LIDAR_POINTS, topics.IMU, topics.CAMERA_STAMP, topics.CLOCKS]
    for name in [*expected, topics.LIDAR_PACKETS, topics.IMU_BYTES, topics.CAN_FRAMES]:
        assert verdict.topics[name.name] > 0, name
    assert verdict.topics[_PICTURES] == verdict.topics["/camera/exposure"] > 10
    events = [message for message in messages(session) if message.topic == topics.EVENTS.name]
    assert any(b'"mark"' in message.data and b"here" in message.data for message in events)
    assert any(b"mapping_restarted" in message.data for message in events)


def test_other_libraries_read_it(played: tuple[Path, Service, dict[str, Any]]) -> None:
    session, _, _ = played
    (verdict,) = verify(session)
    with AnyReader([session / "session_000.mcap"]) as bag:
        counts = {connection.topic: connection.msgcount for connection in bag.connections}
        stamps = [
            bag.deserialize(raw, connection.msgtype).header.stamp
            for connection, _, raw in bag.messages()
            if connection.topic == topics.LIDAR_POINTS.name
        ]
    assert counts == dict(verdict.topics)
    nanoseconds = [stamp.sec * 10**9 + stamp.nanosec for stamp in stamps]
    assert all(stamp % 10**8 == 0 for stamp in nanoseconds), "windows begin at whole tenths of session time"
    assert abs(nanoseconds[-1] / 1e9 - time.time()) < 600
    with (session / "session_000.mcap").open("rb") as stream:
        decoded = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert len(decoded) == verdict.messages


def test_clients_see_everything(played: tuple[Path, Service, dict[str, Any]]) -> None:
    _, _, seen = played
    status = seen["status"]
    assert status["state"] == "recording" and status["frames"] > 3
    assert {stream["name"] for stream in status["streams"]} == {"lidar_0", "imu", "cam_0", "trigger"}
    state = seen["state"]
    assert state["phase"] == "recording" and state["fault"] == ""
    assert state["pairing"]["cam_0"]["paired"] > 10
    assert json.loads(json.dumps(state)) == state
    assert default_path().name == "artemis.sock"
