"""The trigger board's driver against the virtual board: slcan on a pseudo terminal, as a real USB stick."""

import time
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pytest
from artemis_drivers.base import DriverError, State
from artemis_drivers.ring import Ring, RingReader
from artemis_drivers.trigger.board import TriggerBoard
from artemis_drivers.trigger.bus import arrival_ns, open_bus
from artemis_drivers.trigger.events import CAN_FRAME, TRIGGER_EVENT, Kind
from artemis_drivers.trigger.messages import Opcode
from artemis_drivers.trigger.settings import DICTIONARY, PULSE, TriggerSettings
from artemis_drivers.virtual.wire_trigger import TriggerFaults, WireTrigger

from tests.waiting import until


class Rig:
    """A virtual board, its driver and the truth about its edges."""

    def __init__(self, folder: Path, faults: TriggerFaults | None = None, rate_hz: float = 50.0) -> None:
        self.triggers: dict[int, int] = {}
        self.pulses: dict[int, int] = {}
        path = folder / "can"
        self.wire = WireTrigger(
            path, faults, self.triggers.__setitem__, self.pulses.__setitem__, strobe_us=(37, 2500)
        )
        self.events, self.frames = Ring(TRIGGER_EVENT, 4096), Ring(CAN_FRAME, 4096)
        settings = TriggerSettings("slcan", str(path), rate_hz=rate_hz, phase_us=-1250)
        self.board = TriggerBoard(settings, self.events, self.frames)

    def __enter__(self) -> "Rig":
        self.wire.start()
        self.board.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.board.stop()
        self.wire.stop()

    def rows(self, kind: Kind) -> dict[str, np.ndarray]:
        _, rows = RingReader(self.events, from_oldest=True).read()
        return {name: values[rows["kind"] == kind] for name, values in rows.items()}

    @property
    def counters(self) -> dict[str, int]:
        return dict(self.board.health()[0].counters)


def running(rig: Rig) -> bool:
    return rig.board.health()[0].state == State.RUNNING


def test_events_through_a_bad_line(tmp_path: Path) -> None:
    """Lost, garbled and repeated frames, 2 ms of jitter; counts and clock wrap."""
    faults = TriggerFaults(
        100.0, 2_000_000, 0.05, 0.05, 0.03, first_count=2**24 - 10, first_us=2**32 - 1_200_000
    )
    with Rig(tmp_path, faults) as rig:
        assert until(lambda: running(rig))
        rig.board.command(Opcode.ARM)
        rig.board.command(Opcode.RUN, led=3, buzzer=1)
        assert until(lambda: rig.rows(Kind.TRIGGER)["count"].size > 60)
        assert until(lambda: rig.rows(Kind.PPS)["count"].size > 0)
        rows = rig.rows(Kind.TRIGGER)
        assert (rig.wire.firmware.led, rig.wire.firmware.buzzer) == (3, 1)
    truth = np.array([rig.triggers[count] for count in rows["count"].tolist()])
    steps = np.diff(rows["board_ns"])
    assert rows["count"][-1] > 2**24 > rows["count"][0]
    assert np.all(np.diff(rows["count"]) >= 1) and len(set(rows["series"])) == 1
    np.testing.assert_array_equal(steps, np.diff(rows["count"]) * 20_000_000)
    np.testing.assert_allclose(steps, np.diff(truth) * (1 + 100e-6), atol=10)
    assert np.all(rows["rx_ns"] > truth) and np.all(rows["flags"] == 1)
    assert rig.counters["triggers_lost"] == rows["count"][-1] - rows["count"][0] + 1 - len(rows["count"])
    assert 0 < rig.counters["triggers_lost"] <= rig.wire.lost
    assert rig.counters["bad_frames"] > 0 and rig.counters["events_repeated"] > 0
    assert rig.counters["unplugged"] == 0
    strobes = rig.rows(Kind.STROBE)
    assert set(strobes["delay_us"].tolist()) == {37} and set(strobes["width_us"].tolist()) == {2500}
    assert set(strobes["count"].tolist()) <= set(rig.triggers)


def test_settings_are_read_back_and_refusals_told(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        assert until(lambda: running(rig))
        (health,) = rig.board.health()
        assert {item.item for item in health.applied} == {entry.name for entry in DICTIONARY}
        assert {item.status for item in health.applied} == {"ok"}
        assert health.identity == {"serial": "00A7E315", "firmware": "00010000"}
        values = {entry.name: value for entry, value in rig.wire.firmware.objects.items()}
        assert (values["rate_mhz"], values["phase_us"], values["pulse_us"]) == (50_000, -1250, 500)
        assert until(lambda: rig.board.health()[0].status.get("battery") == "14.80 V -1.20 A")


def test_a_refused_setting_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Rig(tmp_path) as rig:
        monkeypatch.setattr(rig.wire.firmware, "_write", _refuse_pulse(rig.wire.firmware._write))
        assert until(lambda: running(rig))
        items = {item.item: item for item in rig.board.health()[0].applied}
        assert items["pulse_us"].status == "refused" and "too high" in items["pulse_us"].read_back
        assert items["config_crc"].status == "rounded"  # the board uses another pulse than we asked for
        assert "refuses: pulse_us" in rig.board.health()[0].message


def _refuse_pulse(write: Callable[[int, int, int, int], None]) -> Callable[[int, int, int, int], None]:
    from artemis_drivers.trigger.sdo import Abort, SdoError

    def refusing(index: int, subindex: int, value: int, size: int) -> None:
        if index == PULSE.index:
            raise SdoError(Abort.TOO_HIGH)
        write(index, subindex, value, size)

    return refusing


def test_buttons_and_reset_of_the_board(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        assert until(lambda: running(rig))
        rig.wire.press(2, down=True)
        assert until(lambda: rig.rows(Kind.BUTTON)["count"].tolist() == [2])
        rig.wire.press(2, down=False)
        assert until(lambda: rig.rows(Kind.BUTTON)["flags"].tolist() == [1, 0])
        assert until(lambda: rig.rows(Kind.PPS)["count"].size > 0)
        rig.board.reset()
        assert until(lambda: rig.counters["board_restarts"] == 1)
        assert until(lambda: 1 in rig.rows(Kind.PPS)["boot"])


def test_pulled_and_plugged_in_again(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        assert until(lambda: running(rig))
        rig.wire.unplug()
        assert until(lambda: rig.board.health()[0].state == State.SEARCHING)
        assert until(lambda: "plug the CAN adapter in" in rig.board.health()[0].message)
        rig.wire.replug()
        assert until(lambda: running(rig))
        assert rig.counters["unplugged"] == 1 and rig.counters["board_restarts"] == 0
        with pytest.raises(DriverError, match="runs already"):
            rig.board.start()


def test_a_silent_board_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Rig(tmp_path) as rig:
        assert until(lambda: running(rig))
        monkeypatch.setattr(rig.wire, "_send", lambda record: None)
        assert until(lambda: rig.counters["silent"] == 1)
        assert until(lambda: "does not answer" in rig.board.health()[0].message)


def test_frames_are_kept_as_they_came(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        assert until(lambda: rig.events.published > 2)
    again = TriggerBoard(rig.board.settings, Ring(TRIGGER_EVENT, 4096))
    _, raw = RingReader(rig.frames, from_oldest=True).read()
    for rx_ns, frame_id, size, data in zip(*(raw[name].tolist() for name in raw), strict=True):
        again.take(frame_id, bytes(data[:size]), rx_ns)
    for name, values in RingReader(again._events, from_oldest=True).read()[1].items():
        np.testing.assert_array_equal(values, rig.events.field[name][: len(values)])


def test_a_bus_that_cannot_be_opened_is_explained() -> None:
    with pytest.raises(DriverError, match="plug the CAN adapter in"):
        open_bus(TriggerSettings("slcan", "/dev/nowhere"))
    with pytest.raises(DriverError, match="check interface and channel"):
        open_bus(TriggerSettings("no such interface", "x"))


def test_arrival_is_host_monotonic_time() -> None:
    before = time.monotonic_ns()
    stamped = arrival_ns(can.Message(timestamp=time.time() - 0.01))
    assert before - 15_000_000 < stamped < before
    assert arrival_ns(can.Message(timestamp=time.time() - 100.0)) >= before  # the wall clock was set
