"""When the triggers are begun, begun anew after the board's power failed, and when a pulse is named."""

from __future__ import annotations

from pathlib import Path

import pytest
from artemis_drivers.base import Health, State
from artemis_drivers.camera.settings import SharedSettings
from artemis_drivers.livox_avia.settings import AviaConfig
from artemis_drivers.trigger.events import Kind
from artemis_drivers.trigger.messages import PPS_GENERATED, Opcode
from artemis_drivers.trigger.settings import TriggerSettings

from artemis_edge.service import capture as module
from artemis_edge.service.capture import Capture
from artemis_edge.service.outlet import Outlet
from artemis_edge.service.rig import make_rig
from artemis_edge.service.settings import CameraEntry, LidarEntry, RunConfig
from artemis_edge.session.message_ring import MessageRing
from artemis_edge.sync import BoardEvent

SECOND = 10**9
MS = 10**6


class Bench:
    """A capture thread that does not run, a board that does what it is told, and the clock in our hand."""

    def __init__(self, tmp: Path, patch: pytest.MonkeyPatch) -> None:
        camera = CameraEntry(SharedSettings(str(tmp / "cam"), most_bytes=1024), 50, 50, 32, 24, 64, 48)
        config = RunConfig((LidarEntry(avia=AviaConfig()),), None, (camera,), TriggerSettings())
        self.rig = make_rig(config)
        self.capture = Capture(self.rig, Outlet(MessageRing.create(1)))
        self.now_s, self.restarts = 100.0, 0
        self.commands: list[Opcode] = []
        self.named: list[int] = []
        assert self.rig.board is not None
        patch.setattr(module.time, "monotonic", lambda: self.now_s)
        patch.setattr(self.rig.board, "health", self.health)
        patch.setattr(self.rig.board, "command", self.commands.append)
        patch.setattr(self.rig.cameras[0], "health", self.health)
        patch.setattr(self.rig.livox.lidars[0], "send_utc", self.named.append)

    def health(self) -> tuple[Health, ...]:
        return (Health("device", State.RUNNING, "", {"board_restarts": self.restarts}, 0, {}),)

    def pulse(self, count: int, boot: int = 0) -> int:
        """A pulse is told; its host time in ns."""
        at = round(self.now_s * SECOND)
        self.capture._event(BoardEvent(Kind.PPS, count, 0, boot, count * SECOND, at, PPS_GENERATED))
        return at

    def turns(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.05)):
            self.now_s += 0.05
            self.capture._arm()


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(tmp_path, monkeypatch)


def test_triggers_stand_still_before_they_are_counted(bench: Bench) -> None:
    bench.turns(3)
    assert bench.commands == [], "without a pulse no photograph can be dated"
    bench.pulse(0)
    bench.turns(0.45)
    assert bench.commands == [Opcode.ARM] and not bench.rig.armed
    bench.turns(0.35)
    assert bench.commands == [Opcode.ARM, Opcode.RUN] and bench.rig.armed
    bench.turns(5)
    assert len(bench.commands) == 2


def test_a_board_that_lost_its_power_is_armed_again_after_its_first_pulse(bench: Bench) -> None:
    bench.pulse(0)
    bench.turns(1)
    bench.restarts = 1
    bench.turns(2)
    assert len(bench.commands) == 2 and not bench.rig.armed
    bench.pulse(0, boot=1)
    bench.turns(1)
    assert bench.commands == [Opcode.ARM, Opcode.RUN] * 2 and bench.rig.armed


def test_a_pulse_is_named_within_the_limits_of_the_avia_or_not_at_all(bench: Bench) -> None:
    told = bench.pulse(7)
    sync = bench.capture.sync
    assert sync is not None
    bench.capture._name_pulse(told + 20 * MS)
    assert bench.named == [], "too soon: it takes the time from 10 ms after the edge on"
    for _ in range(2):
        bench.capture._name_pulse(told + 75 * MS)
    assert bench.named == [sync.utc_of_pulse(7)], "once"
    bench.now_s += 1
    told = bench.pulse(8)
    bench.capture._name_pulse(told + 450 * MS)
    assert len(bench.named) == 1 and bench.capture.lost["pulses_not_named"] == 1
