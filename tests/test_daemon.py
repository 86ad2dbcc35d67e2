"""The service's own turns: lights, buttons and marks through the virtual trigger board, beats to systemd."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from artemis_drivers.trigger.settings import TriggerSettings
from artemis_drivers.virtual.wire_trigger import WireTrigger

from artemis_edge.service import daemon as daemon_module
from artemis_edge.service.daemon import Daemon
from artemis_edge.service.lights import BUZZER, LED, MARKED, Phase
from artemis_edge.service.settings import RunConfig, ServiceSettings
from artemis_edge.session.feed import messages
from tests.livox_ports import reserved
from tests.waiting import until

_PATIENCE_S = 90.0


def _config(tmp: Path, trigger: TriggerSettings | None = None) -> RunConfig:
    service = ServiceSettings(
        sessions=str(tmp / "sessions"), socket=str(tmp / "s"), record_at_start=False, start_patience_s=0.0,
        mapping=False, reserve_mb=0, ring_mb=8.0,
    )  # fmt: skip
    return RunConfig(trigger=trigger, service=service)


class Turned:
    """A service whose turns are taken by the test; its LiDAR is not there."""

    def __init__(self, config: RunConfig) -> None:
        self.log: list[str] = []
        self.service = Daemon(config, own_addresses=lambda: [], log=self.log.append)
        self.service.rig.start()
        self.service.capture.start()

    def end(self) -> None:
        """Whatever the test has come to."""
        self.service._signals = 1
        try:
            assert self.service._stop() == 0
        finally:
            self.service.control.close()

    def until(self, true: Callable[[], bool]) -> bool:
        end = time.monotonic() + _PATIENCE_S
        while not true() and time.monotonic() < end:
            self.service._turn()
        return true()


@pytest.fixture
def board(tmp_path: Path) -> Iterator[WireTrigger]:
    """And nobody else at the LiDAR's ports, which the service opens."""
    wire = WireTrigger(tmp_path / "can")
    with reserved():
        wire.start()
        yield wire
        wire.stop()


def test_buttons_lights_and_marks(board: WireTrigger, tmp_path: Path) -> None:
    turned = Turned(_config(tmp_path, TriggerSettings("slcan", str(tmp_path / "can"))))
    service, firmware = turned.service, board.firmware

    def press(button: int) -> None:
        board.press(button, down=True)
        turned.until(lambda: firmware.buttons == 0 or time.monotonic() > end)
        board.press(button, down=False)

    try:
        assert turned.until(lambda: firmware.led == LED[Phase.IDLE]), "it is shown from the start"
        end = time.monotonic() + 0.3
        press(1)
        assert turned.until(lambda: any("a mark belongs to a recording" in line for line in turned.log))
        end = time.monotonic() + 0.3
        press(0)
        assert turned.until(lambda: service.phase == Phase.RECORDING)
        assert turned.until(lambda: firmware.led == LED[Phase.RECORDING])
        assert turned.until(lambda: firmware.sounded == [BUZZER[Phase.RECORDING]])
        end = time.monotonic() + 0.3
        press(1)
        assert turned.until(lambda: MARKED in firmware.sounded) and firmware.led == LED[Phase.RECORDING]
        firmware.led = 0  # as after a restart of the board
        firmware._tell_health = True
        assert turned.until(lambda: firmware.led == LED[Phase.RECORDING]), "told again"
        end = time.monotonic() + 0.3
        press(0)
        assert turned.until(lambda: service.phase in (Phase.SAVING, Phase.IDLE))
        assert turned.until(lambda: service.phase == Phase.IDLE)
        assert turned.until(lambda: firmware.led == LED[Phase.IDLE])
        (session,) = (tmp_path / "sessions").iterdir()
        events = [message.data for message in messages(session) if message.topic == "/artemis/events"]
        assert sum(b'"mark"' in event for event in events) == 1
        assert any(b'"button"' in event for event in events)
    finally:
        turned.end()
    assert until(lambda: firmware.led == 0), "nobody is there any more"


class _Stage:
    """A process of the session, as far as the watchdog looks at it."""

    def __init__(self) -> None:
        self.heard_s = time.monotonic()


def test_beats_come_at_half_period_and_only_while_every_stage_lives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "400000")
        for name in ("_CAPTURE_STALE_S", "_RECORDER_STALE_S", "_MAPPER_STALE_S"):
            monkeypatch.setattr(daemon_module, name, 0.5)
        monkeypatch.setattr(daemon_module, "_TURN_S", 0.01)
        service = Daemon(_config(tmp_path), own_addresses=lambda: [], log=lambda line: None)
        stages = SimpleNamespace(
            turn=lambda: None, ended_s=None, over=False, recorder=_Stage(), mapper=_Stage(),
            folder=tmp_path, state=lambda: {"folder": "s", "mapping": {}, "recorder": {}, "seconds": 1.0},
        )  # fmt: skip
        stages.recorder.latest = {}
        service.session = stages  # type: ignore[assignment]

        def beats(seconds: float, stalled: str = "") -> int:
            end = time.monotonic() + seconds
            count = 0
            while time.monotonic() < end:
                now = time.monotonic()
                if stalled != "capture":
                    service.capture.turn_s = now
                for name in ("recorder", "mapper"):
                    if stalled != name:
                        getattr(stages, name).heard_s = now
                service._turn()
                count += _heard(systemd).count("WATCHDOG=1")
            return count

        try:
            assert 3 <= beats(1.0) <= 7, "one in 0.2 s, or a little sooner"
            for stage in ("capture", "recorder", "mapper"):
                beats(0.7, stage)  # until it is noticed
                assert beats(0.6, stage) == 0, stage
                assert beats(0.5) >= 1, f"{stage} is back"
        finally:
            service.session = None
            service.control.close()


def _heard(systemd: socket.socket) -> list[str]:
    said = []
    try:
        while True:
            said.append(systemd.recv(4096).decode())
    except BlockingIOError:
        return said


def test_a_status_for_clients_names_the_report(tmp_path: Path) -> None:
    service = Daemon(_config(tmp_path), own_addresses=lambda: [], log=lambda line: None)
    try:
        assert service._told()["report"] == ""
        report = tmp_path / "report.html"
        report.write_text("<html/>")
        service._ended_sessions.append({"fault": "", "report": str(report)})
        service._known = None
        assert msgspec.json.encode(service._told()) and service._told()["report"] == str(report)
        told: dict[str, Any] = service.state()
        assert told["phase"] == "idle"
    finally:
        service.control.close()


def test_ended_before_its_devices_were_there(tmp_path: Path) -> None:
    """Its time is over while it waits: it has fallen short, and says so; a signal is no fault."""
    config = msgspec.structs.replace(
        _config(tmp_path), service=msgspec.structs.replace(_config(tmp_path).service, start_patience_s=60.0)
    )
    for signals, code in ((0, 1), (1, 0)):
        with reserved():
            turned = Turned(config)
            turned.service._begin_checking(None)
            turned.service._turn()
            turned.service._signals = signals
            assert turned.service._stop() == code
            turned.service.control.close()
        assert any("nothing was recorded: still waiting for lidar" in line for line in turned.log)
