"""The trigger board behind a USB-CAN stick: its firmware, and the stick's slcan protocol on a pseudo terminal."""

from __future__ import annotations

import random
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from artemis_drivers.trigger import sdo
from artemis_drivers.trigger.messages import (
    CLOCK_MODULUS,
    COUNT_MODULUS,
    PPS_GENERATED,
    PPS_LOCKED,
    BadFrameError,
    BoardHealth,
    Command,
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
    Strobe,
    TrigEvent,
    default_dbc,
)
from artemis_drivers.trigger.settings import (
    CAMERA_MASK,
    CONFIG_CRC,
    DICTIONARY,
    FIRMWARE,
    PHASE,
    PPS_WIDTH,
    PULSE,
    RATE,
    SERIAL,
    Entry,
    config_crc,
)
from artemis_drivers.virtual.wire_device import WireDevice

_SECOND_US = 1_000_000
_HEARTBEAT_US = 500_000
_IDLE_S = 0.02
_LONGEST_LINE = 64  # of slcan; more is noise
_LAG_NS = 300_000  # from an edge to the bytes at the host, at least

#: Told of each edge: its count and its time by the truth clock, ns.
Edge = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class TriggerFaults:
    """Switches. ``skew_ppm`` of the board's clock, uniform ``jitter_ns`` of arrival, shares 0..1 of frames
    lost, sent twice or cut in half; where counts and the microsecond clock begin.
    """

    skew_ppm: float = 0.0
    jitter_ns: int = 0
    lose: float = 0.0
    duplicate: float = 0.0
    garble: float = 0.0
    first_count: int = 0
    first_us: int = 0


class Firmware:
    """What the board does, by its own microsecond clock; ``strobe_us``: delay and width, or None."""

    def __init__(self, faults: TriggerFaults, strobe_us: tuple[int, int] | None = None) -> None:
        self.faults = faults
        self.objects: dict[Entry, int] = {
            RATE: 10_000,
            PULSE: 1000,
            PHASE: 0,
            PPS_WIDTH: 100,
            CAMERA_MASK: 1,
            FIRMWARE: 0x00010000,
            SERIAL: 0xA7E315,
        }
        self.run_state = RunState.IDLE
        self.node_state = NodeState.PRE_OPERATIONAL
        self.led = self.buzzer = self.buttons = 0
        self.sounded: list[int] = []  # patterns of the buzzer so far
        self.pps_connected = True
        self.boot_ns = 0
        self._strobe = strobe_us
        self._triggers = self._pulses = faults.first_count
        self._next_pps = _SECOND_US
        self._next_trigger: int | None = None
        self._next_heartbeat = 0
        self._tell_health = True

    def power_on(self, truth_ns: int) -> Record:
        """Boot now; returns the boot-up message."""
        Firmware.__init__(self, self.faults, self._strobe)
        self.boot_ns = truth_ns
        return Heartbeat(NodeState.BOOT)

    def truth_ns(self, board_us: int) -> int:
        """Truth time of a reading of the board's clock (that starts at 0 when it boots)."""
        return self.boot_ns + round(board_us * 1000 / (1 + self.faults.skew_ppm * 1e-6))

    def press(self, button: int, *, down: bool) -> None:
        """A finger on a button."""
        self.buttons = self.buttons | 1 << button if down else self.buttons & ~(1 << button)
        self._tell_health = True

    def next_ns(self) -> int:
        """Truth time at which something happens next."""
        if self._tell_health:
            return self.boot_ns
        times = [self._next_pps, self._next_heartbeat]
        if self._next_trigger is not None:
            times.append(self._next_trigger)
        return self.truth_ns(min(times))

    def step(self, on_trigger: Edge, on_pps: Edge) -> list[Record]:
        """What happens at ``next_ns``, as messages."""
        if self._tell_health:
            self._tell_health = False
            return [self._health()]
        at = min(self._next_pps, self._next_heartbeat, self._next_trigger or self._next_pps)
        said: list[Record] = []
        if at == self._next_pps:
            said += self._pulse(at, on_pps)
        if at == self._next_trigger:
            said += self._trigger(at, on_trigger)
        if at == self._next_heartbeat:
            self._next_heartbeat += _HEARTBEAT_US
            said.append(Heartbeat(self.node_state))
        return said

    def hear(self, record: Record, truth_ns: int) -> list[Record]:
        """Answers to a message from the host."""
        if isinstance(record, SdoRequest):
            return [sdo.serve(record, self._read, self._write)]
        if isinstance(record, Nmt):
            return self._manage(record.nmt_command, truth_ns)
        if isinstance(record, Command):
            self._obey(record, truth_ns)
        return []

    def _stamp(self, board_us: int) -> int:
        return (board_us + self.faults.first_us) % CLOCK_MODULUS

    def _pulse(self, at: int, on_pps: Edge) -> list[Record]:
        self._next_pps += _SECOND_US
        if not self.pps_connected:
            return []
        count, self._pulses = self._pulses, self._pulses + 1
        on_pps(count, self.truth_ns(at))
        self._tell_health = True
        return [PpsEvent(count % COUNT_MODULUS, PPS_GENERATED, self._stamp(at))]

    def _trigger(self, at: int, on_trigger: Edge) -> list[Record]:
        count, self._triggers = self._triggers, self._triggers + 1
        self._next_trigger = self._after(at)
        on_trigger(count, self.truth_ns(at))
        raw = count % COUNT_MODULUS
        said: list[Record] = [TrigEvent(raw, PPS_LOCKED, self._stamp(at))]
        if self._strobe is not None:
            said.append(Strobe(raw, 0, *self._strobe))
        return said

    def _after(self, board_us: int) -> int:
        """First trigger after a time: at the phase after a whole second, and every period from there."""
        period = 1e9 / self.objects[RATE]
        phase = self.objects[PHASE]
        turn = (board_us - phase) // period + 1
        return round(phase + turn * period)

    def _health(self) -> BoardHealth:
        return BoardHealth(31.5, 14.8, -1.2, self.buttons, self.led, self.run_state, 0)

    def _manage(self, command: int, truth_ns: int) -> list[Record]:
        if command == NmtCommand.RESET:
            return [self.power_on(truth_ns)]
        states = {
            NmtCommand.START: NodeState.OPERATIONAL,
            NmtCommand.STOP: NodeState.STOPPED,
            NmtCommand.PRE_OPERATIONAL: NodeState.PRE_OPERATIONAL,
        }
        self.node_state = states.get(NmtCommand(command), self.node_state)
        return []

    def _obey(self, command: Command, truth_ns: int) -> None:
        now = round((truth_ns - self.boot_ns) * (1 + self.faults.skew_ppm * 1e-6) / 1000)
        if command.opcode == Opcode.ARM:
            self.run_state, self._next_trigger, self._triggers = RunState.ARMED, None, self.faults.first_count
        elif command.opcode == Opcode.RUN:
            self.run_state, self._next_trigger = RunState.RUNNING, self._after(now)
        elif command.opcode == Opcode.STOP:
            self.run_state, self._next_trigger = RunState.IDLE, None
        self.led, self.buzzer = command.led & 0xF, command.led >> 4
        self.sounded += [self.buzzer] if self.buzzer else []
        self._tell_health = True

    def _read(self, index: int, subindex: int) -> tuple[int, int]:
        entry = _entry(index, subindex)
        if entry == CONFIG_CRC:
            return config_crc(self.objects), entry.size
        return self.objects[entry], entry.size

    def _write(self, index: int, subindex: int, value: int, size: int) -> None:
        entry = _entry(index, subindex)
        if not entry.writable:
            raise sdo.SdoError(sdo.Abort.READ_ONLY)
        if size != entry.size:
            raise sdo.SdoError(sdo.Abort.WRONG_LENGTH)
        value = int.from_bytes(value.to_bytes(size, "little"), "little", signed=entry.signed)
        if value > entry.high:
            raise sdo.SdoError(sdo.Abort.TOO_HIGH)
        if value < entry.low:
            raise sdo.SdoError(sdo.Abort.TOO_LOW)
        self.objects[entry] = value


class WireTrigger(WireDevice):
    """Board and stick on a pseudo terminal at ``path``, driven by the truth clock ``now`` (ns).

    ``on_trigger`` and ``on_pps`` tell the virtual cameras and LiDAR of each edge.
    """

    def __init__(
        self,
        path: Path,
        faults: TriggerFaults | None = None,
        on_trigger: Edge = lambda count, truth_ns: None,
        on_pps: Edge = lambda count, truth_ns: None,
        strobe_us: tuple[int, int] | None = None,
        now: Callable[[], int] = time.monotonic_ns,
        seed: int = 0,
    ) -> None:
        super().__init__(path, "virtual trigger board")
        faults = faults or TriggerFaults()
        self.firmware = Firmware(faults, strobe_us)
        self.sent = self.lost = 0
        self.opened = False
        self._faults, self._now = faults, now
        self._on_trigger, self._on_pps = on_trigger, on_pps
        self._messages = Messages(default_dbc())
        self._random = random.Random(seed)
        self._heard = bytearray()
        self._outbox: deque[tuple[int, Record]] = deque()

    def start(self) -> None:
        """Plug in, power on and run in a thread."""
        self._queue(self.firmware.power_on(self._now()), self._now())
        super().start()

    def _unplugged(self) -> None:
        """Only the stick loses its power: the board goes on."""
        self.opened = False

    def power_cycle(self) -> None:
        """The board itself loses its power for a moment."""
        with self._lock:
            self._outbox.clear()
            self._queue(self.firmware.power_on(self._now()), self._now())

    def press(self, button: int, *, down: bool) -> None:
        """A finger on a button."""
        with self._lock:
            self.firmware.press(button, down=down)

    def cut_pps(self, *, connected: bool) -> None:
        """Pull or plug the cable of the pulse per second."""
        with self._lock:
            self.firmware.pps_connected = connected

    def _turn(self) -> float:
        now = self._now()
        while (at := self.firmware.next_ns()) <= now:
            for record in self.firmware.step(self._on_trigger, self._on_pps):
                self._queue(record, max(at, self.firmware.boot_ns))
        if self.port.plugged:
            for line in self._lines(self.port.read(0.0)):
                self._host_says(line)
        while self._outbox and self._outbox[0][0] <= now:
            self._send(self._outbox.popleft()[1])
        due = self._outbox[0][0] if self._outbox else at
        return min(_IDLE_S / 4, max(0, due - now) / 1e9)

    def _queue(self, record: Record, at_ns: int) -> None:
        """Frames keep their order on the bus."""
        due = at_ns + _LAG_NS + self._random.randrange(self._faults.jitter_ns + 1)
        self._outbox.append((max(due, self._outbox[-1][0]) if self._outbox else due, record))

    def _lines(self, data: bytes) -> list[bytes]:
        self._heard += data
        *lines, rest = bytes(self._heard).split(b"\r")
        self._heard = bytearray(rest[-_LONGEST_LINE:])
        return lines

    def _host_says(self, line: bytes) -> None:
        """slcan: C closes, S sets the bit rate, O opens, t sends."""
        if line[:1] == b"O":
            self.opened = True
        elif line[:1] == b"C":
            self.opened = False
        elif line[:1] == b"t" and self.opened:
            try:
                record = self._messages.decode(int(line[1:4], 16), bytes.fromhex(line[5:].decode()))
            except (ValueError, BadFrameError):
                self.port.write(b"\a")
                return
            if record is not None:
                for answer in self.firmware.hear(record, self._now()):
                    self._queue(answer, self._now())
        self.port.write(b"\r")

    def _send(self, record: Record) -> None:
        if not (self.port.plugged and self.opened):
            return
        frame_id, data = self._messages.encode(record)
        line = f"t{frame_id:03X}{len(data)}{data.hex().upper()}\r".encode()
        chance = self._random.random
        if chance() < self._faults.lose:
            self.lost += 1
            return
        if chance() < self._faults.garble:
            self.lost += 1
            line = line[: len(line) // 2] + b"\xff\r"
        elif chance() < self._faults.duplicate:
            line += line
        self.sent += 1
        self.port.write(line)


def _entry(index: int, subindex: int) -> Entry:
    for entry in DICTIONARY:
        if entry.index == index and subindex == 0:
            return entry
    raise sdo.SdoError(sdo.Abort.MISSING)
