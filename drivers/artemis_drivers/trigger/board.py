"""Reads the trigger board in a thread of its own: configures it, dates its events, notices when it is gone."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np

from artemis_drivers.base import DriverError, State
from artemis_drivers.device_thread import DeviceThread
from artemis_drivers.ring import Ring
from artemis_drivers.trigger.bus import Bus, arrival_ns, is_noise, open_bus, recover
from artemis_drivers.trigger.clock import BoardClock, EventCounter
from artemis_drivers.trigger.configure import configure
from artemis_drivers.trigger.events import CAN_FRAME, TRIGGER_EVENT, Kind
from artemis_drivers.trigger.messages import (
    BadFrameError,
    BoardHealth,
    Command,
    Emcy,
    Heartbeat,
    Messages,
    Nmt,
    NmtCommand,
    NodeState,
    Opcode,
    PpsEvent,
    Record,
    RunState,
    SdoRequest,
    SdoResponse,
    Strobe,
    TrigEvent,
    default_dbc,
)
from artemis_drivers.trigger.settings import TriggerSettings

SILENT_S = 0.75  # heartbeats come twice a second
_RECEIVE_S = 0.05
_SDO_S = 0.2
_BUTTONS = 4


class TriggerBoard(DeviceThread):
    """Driver (base.Driver). ``events`` is a ring of TRIGGER_EVENT, ``frames`` one of CAN_FRAME.

    Triggers go on when it stops: see ``command``.
    """

    def __init__(
        self,
        settings: TriggerSettings,
        events: Ring,
        frames: Ring | None = None,
        open_can: Callable[[TriggerSettings], Bus] = open_bus,
    ) -> None:
        if events.dtype != TRIGGER_EVENT or (frames is not None and frames.dtype != CAN_FRAME):
            raise ValueError("the rings of a trigger board hold TRIGGER_EVENT and CAN_FRAME")
        super().__init__(settings.name)
        self.settings = settings
        self.messages = Messages(Path(settings.dbc) if settings.dbc else default_dbc())
        self._events, self._frames, self._open = events, frames, open_can
        self._clock = BoardClock()
        self._triggers, self._pulses = EventCounter(), EventCounter()
        self._bus: Bus | None = None
        self._outbox: deque[Record] = deque()
        self._led = 0
        self._heard_s = 0.0
        self._health: BoardHealth | None = None
        self._fault: Emcy | None = None
        self._counts = {"unplugged": 0, "silent": 0, "bad_frames": 0, "other_frames": 0, "board_restarts": 0}
        self._counts |= {"overruns": 0, "unsent": 0}

    def command(self, opcode: Opcode, led: int | None = None, buzzer: int = 0) -> None:
        """Arm, run or stop the triggers, or only indicate: patterns 0..15 for LED (None: as before) and buzzer."""
        s = self.settings
        self._led = self._led if led is None else led & 0xF
        lights = self._led | (buzzer & 0xF) << 4
        self._outbox.append(Command(opcode, s.rate_hz, s.pulse_us, s.phase_us, lights))

    @property
    def led_shown(self) -> int | None:
        """The LED's pattern as the board tells it, None while it does not run."""
        running = self._state == State.RUNNING and self._health is not None
        return self._health.led_state if running and self._health is not None else None

    def reset(self) -> None:
        """Boot the board anew."""
        self._outbox.append(Nmt(NmtCommand.RESET, self.messages.node))

    def take(self, frame_id: int, data: bytes, rx_ns: int) -> Record | None:
        """Digest a frame that arrived at ``rx_ns``: its event goes to the ring."""
        self._last_data_ns = rx_ns
        self._keep(frame_id, data, rx_ns)
        try:
            record = self.messages.decode(frame_id, data)
        except BadFrameError:
            self._counts["bad_frames"] += 1
            return None
        match record:
            case TrigEvent() | PpsEvent():
                self._edge(record, rx_ns)
            case Strobe():
                self._strobe(record, rx_ns)
            case BoardHealth():
                self._note_health(record, rx_ns)
            case Heartbeat():
                self._note_heartbeat(record)
            case Emcy():
                self._fault = record if record.error_code else None
            case None:
                self._counts["other_frames"] += 1
        return record

    def _run(self) -> None:
        failures = 0
        while not self._stop.is_set():
            try:
                self._bus = self._connect()
                failures = 0
                self._receive(self._bus)
            except (DriverError, OSError, can.CanError) as fault:
                if self._state == State.RUNNING:
                    self._counts["unplugged"] += 1
                    self._become(State.SEARCHING, f"{self.settings.name} was unplugged: plug it in again")
                else:
                    self._become(State.SEARCHING, f"{self.settings.name}: {fault}")
                self._pause(failures)
                failures += 1
            finally:
                self._close()

    def _connect(self) -> Bus:
        self._become(State.CONNECTING)
        self._bus = bus = self._open(self.settings)
        self._become(State.CONFIGURING)
        self._applied = configure(self.settings, self._sdo)
        self._send(bus, Nmt(NmtCommand.START, self.messages.node))
        self._become_running()
        self._heard_s = time.monotonic()
        return bus

    def _receive(self, bus: Bus) -> None:
        """Until the board has been silent for too long; can.CanError when the adapter is gone."""
        while not self._stop.is_set():
            self._next(bus, _RECEIVE_S)
            while self._outbox:
                self._send(bus, self._outbox.popleft())
            if time.monotonic() - self._heard_s > SILENT_S:
                self._counts["silent"] += 1
                self._become(State.SILENT, f"{self.settings.name} sends nothing: check its power and the bus")
                return
        while self._outbox:
            self._send(bus, self._outbox.popleft())

    def _next(self, bus: Bus, timeout_s: float) -> Record | None:
        try:
            message = bus.recv(timeout_s)
        except (ValueError, IndexError, can.CanError) as fault:
            if not is_noise(fault):
                raise
            self._counts["bad_frames"] += 1
            recover(bus)
            return None
        if message is None:
            return None
        if message.is_error_frame or message.is_remote_frame or message.is_extended_id:
            self._counts["other_frames"] += 1
            return None
        self._heard_s = time.monotonic()
        return self.take(message.arbitration_id, bytes(message.data), arrival_ns(message))

    def _send(self, bus: Bus, record: Record) -> None:
        frame_id, data = self.messages.encode(record)
        bus.send(can.Message(arbitration_id=frame_id, data=data, is_extended_id=False), timeout=1.0)

    def _sdo(self, request: SdoRequest) -> SdoResponse | None:
        """One exchange; events that arrive meanwhile are kept."""
        bus = self._bus
        if bus is None:
            return None
        self._send(bus, request)
        until = time.monotonic() + _SDO_S
        while (left := until - time.monotonic()) > 0 and not self._stop.is_set():
            record = self._next(bus, left)
            same = isinstance(record, SdoResponse) and record.sdo_index == request.sdo_index
            if isinstance(record, SdoResponse) and same and record.sdo_subindex == request.sdo_subindex:
                return record
        return None

    def _close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is None:
            return
        try:
            bus.shutdown()
        except (OSError, can.CanError):  # the adapter is gone
            self._counts["unsent"] += len(self._outbox)
            self._outbox.clear()

    def _edge(self, event: TrigEvent | PpsEvent, rx_ns: int) -> None:
        if isinstance(event, TrigEvent):
            kind, counter, raw, flags = Kind.TRIGGER, self._triggers, event.trig_count, event.pulse_flags
            self._counts["overruns"] += flags >> 1 & 1
        else:
            kind, counter, raw, flags = Kind.PPS, self._pulses, event.pps_count, event.pps_flags
        boot = self._clock.boot
        board_ns = self._clock.read(event.t_us, rx_ns)
        if self._clock.boot != boot:
            self._restarted()
        count = counter.read(raw, event.t_us)
        if count is None:
            return
        self._append(kind, count, rx_ns, counter.series, t_us=event.t_us, board_ns=board_ns, flags=flags)

    def _strobe(self, strobe: Strobe, rx_ns: int) -> None:
        count = self._triggers.near(strobe.trig_count)
        self._append(
            Kind.STROBE,
            count,
            rx_ns,
            self._triggers.series,
            camera=strobe.cam_index,
            delay_us=strobe.strobe_delay_us,
            width_us=strobe.strobe_width_us,
        )

    def _note_health(self, health: BoardHealth, rx_ns: int) -> None:
        before = self._health.buttons if self._health is not None else 0
        for button in range(_BUTTONS):
            now = health.buttons >> button & 1
            if now != before >> button & 1:
                self._append(Kind.BUTTON, button, rx_ns, 0, flags=now)
        self._health = health

    def _note_heartbeat(self, heartbeat: Heartbeat) -> None:
        if heartbeat.state == NodeState.BOOT:
            boot = self._clock.boot
            self._clock.restart()
            if self._clock.boot != boot:
                self._restarted()

    def _restarted(self) -> None:
        self._triggers.restart()
        self._pulses.restart()
        self._counts["board_restarts"] += 1

    def _append(
        self,
        kind: Kind,
        count: int,
        rx_ns: int,
        series: int,
        *,
        t_us: int = 0,
        board_ns: int = 0,
        flags: int = 0,
        camera: int = 0,
        delay_us: int = 0,
        width_us: int = 0,
    ) -> None:
        self._events.append(
            {
                "kind": kind,
                "count": count,
                "series": series,
                "t_us": t_us,
                "board_ns": board_ns,
                "boot": self._clock.boot,
                "rx_ns": rx_ns,
                "flags": flags,
                "camera": camera,
                "delay_us": delay_us,
                "width_us": width_us,
            }
        )

    def _keep(self, frame_id: int, data: bytes, rx_ns: int) -> None:
        if self._frames is not None:
            padded = np.zeros(8, np.uint8)
            padded[: len(data)] = np.frombuffer(data[:8], np.uint8)
            self._frames.append({"rx_ns": rx_ns, "id": frame_id, "size": len(data), "data": padded})

    def _counters(self) -> dict[str, int]:
        return {
            "events": self._events.published,
            "triggers_lost": self._triggers.lost,
            "pps_lost": self._pulses.lost,
            "events_repeated": self._triggers.repeated + self._pulses.repeated,
            **self._counts,
        }

    def _status(self) -> dict[str, str]:
        if self._health is None:
            return {}
        h = self._health
        run = RunState(h.run_state).name.lower() if h.run_state in set(RunState) else str(h.run_state)
        status = {
            "temperature": f"{h.temp_board:.1f} degC",
            "battery": f"{h.v_batt:.2f} V {h.i_batt:.2f} A",
            "run_state": run,
            "led": str(h.led_state),
            "faults": f"{h.fault_bits:#x}",
        }
        if self._fault is not None:
            status["emergency"] = f"{self._fault.error_code:#06x} detail {self._fault.mfr_detail}"
        return status
