"""Session with one Avia: discovery, handshake, heartbeat, configuration with read-back, sampling.

Sequence and times follow the official SDK v2.3.0: heartbeat every 800 ms, a device that does not answer for 3 s is
lost, a command is repeated after 500 ms.
"""

from __future__ import annotations

from collections.abc import Callable

from artemis_drivers.base import Applied, State
from artemis_drivers.livox_avia import payloads
from artemis_drivers.livox_avia.items import Item, command, items
from artemis_drivers.livox_avia.protocol import (
    AVIA,
    COMMAND_PORT,
    DEVICE_NAMES,
    DISCOVERY_PORT,
    Frame,
    General,
    Kind,
    Lidar,
    Ret,
    WorkState,
    decode,
    encode,
)
from artemis_drivers.livox_avia.settings import AviaConfig
from artemis_drivers.livox_avia.status import Status
from artemis_drivers.livox_dialogue import MS, Ask, Datagram, Script
from artemis_drivers.livox_session import LOST_NS, UNHEARD_NS, LivoxSession
from artemis_drivers.udp import Interface, interfaces

HEARTBEAT_NS = 800 * MS
RESTART_NS = 2000 * MS  # a device that answers but sends nothing is configured again
_INIT_POLL_NS = 50 * MS
_REFUSALS = 5  # a command is repeated so often before it counts as refused
_REFUSED_PAUSE_NS = 200 * MS
_ANSWERS_AGAIN_NS = 1000 * MS
_NOT_TAKEN = ("no answer", "error")


class AviaSession(LivoxSession):
    """State of one Avia as the host sees it; its serial number is its broadcast code."""

    model = "Avia"
    seq_mask = 0xFFFF

    def __init__(self, config: AviaConfig, own_addresses: Callable[[], list[Interface]] = interfaces) -> None:
        super().__init__(config.host_ip, own_addresses)
        self.config = config
        self.work_state = WorkState.INIT
        self.feature = 0
        self.status_code = 0
        self._utc_seq: set[int] = set()
        self._heartbeat_sent = 0
        self._in_session = False  # the device has been told where to send

    @property
    def connected(self) -> bool:
        """Whether the device is believed to be there (it may be starting up or silent for a moment)."""
        return self._in_session and self.state != State.SEARCHING

    # -- what the host calls ------------------------------------------------------------------------------------

    def begin_stop(self, now: int) -> None:
        """Stop sampling and take leave; ``state`` is STOPPED when that is done or was not answered."""
        self._leaving = True
        if self.connected and self.state != State.CONNECTING:
            self._dialogue.start(self._farewell(), now)
        else:
            self._dialogue.cancel()
            self.state = State.STOPPED

    def wants(self, code: str) -> bool:
        """Whether a broadcast code is this session's device."""
        mine = self._mine()
        return bool(mine) and code.startswith(mine)

    def _mine(self) -> str:
        """Code of the device sought; empty when any will do."""
        return self.config.broadcast_code or (self.serial if self.state != State.SEARCHING else "")

    def hear_broadcast(self, broadcast: payloads.Broadcast, ip: str, now: int) -> bool:
        """A device announced itself; True when it is (now) ours."""
        if self.state == State.STOPPED or self._leaving:
            return False
        if self._mine() and not self.wants(broadcast.code):
            if not self.connected and now - self._began > UNHEARD_NS:
                self.message = (
                    f"Livox {self._mine()} is not heard, but {broadcast.code} at {ip} is: "
                    f"correct broadcast_code of {self.config.name} or connect the other device"
                )
            return False
        if broadcast.device != AVIA:
            name = DEVICE_NAMES.get(broadcast.device, f"type {broadcast.device}")
            self.message = f"Livox {name} {broadcast.code} at {ip} is not an Avia: connect an Avia"
            return False
        if self.state != State.CONNECTING and (not self._in_session or self._forgotten(now)):
            self._connect(broadcast.code, ip, now)
        return True

    def hear(self, datagram: bytes, ip: str, now: int) -> None:
        """A datagram on the command socket."""
        frames, skipped = decode(datagram)
        self.counters["control_bad_bytes"] += skipped
        if ip != self.device_ip:
            self.counters["control_foreign"] += 1
            return
        for frame in frames:
            self._hear_frame(frame, now)

    def data_seen(self, now: int, data_type: int, status_code: int) -> None:
        """Data packets have arrived: they tell the coordinates in use."""
        self.status_code = status_code
        super().data_seen(now, data_type, status_code)
        if data_type and self.state == State.RUNNING:
            self._seen("coordinate", "spherical" if data_type in (3, 5, 8) else "cartesian")

    def send_utc(self, unix_ns: int) -> None:
        """Name the PPS edge just passed (10 to 500 ms ago, Avia user manual)."""
        if not self.connected:
            self.counters["utc_not_connected"] += 1
            return
        self._utc_seq = {self._put(Lidar.UTC, payloads.encode_utc(unix_ns))}
        self.counters["utc_sent"] += 1

    def tick(self, now: int) -> None:
        """Whatever is due by the clock."""
        self._dialogue.tick(now)
        if self._leaving or self.state in (State.STOPPED, State.CONNECTING):
            return
        if self._in_session:
            self._beat(now)
        if self.state == State.SEARCHING and not self.message and now - self._began > UNHEARD_NS:
            self.message = (
                f"no Livox Avia is heard on UDP port {DISCOVERY_PORT}: check its power, its cable, and that no "
                "firewall blocks the port"
            )
        if self.state in (State.RUNNING, State.SILENT):
            self._watch_data(now)

    # -- finding and losing the device --------------------------------------------------------------------------

    def _search(self, message: str, now: int) -> None:
        """Go back to listening for the device's broadcast."""
        self._in_session = False
        super()._search(message, now)

    def _beat(self, now: int) -> None:
        """Heartbeats go on when the device is lost: when only the cable was out it answers again at once."""
        if now - self._heartbeat_sent >= HEARTBEAT_NS:
            self._heartbeat_sent = now
            self._put(General.HEARTBEAT)
            self.counters["heartbeats"] += 1
        if now - self._heard > LOST_NS and self.state != State.SEARCHING:
            self._dialogue.cancel()
            self.state, self.message = State.SEARCHING, self._gone()

    def _forgotten(self, now: int) -> bool:
        """A connected device announces itself again and is silent otherwise: it has restarted."""
        quiet = now - max(self._heard, self._last_data, self._began)
        return self.state == State.SEARCHING or quiet > _ANSWERS_AGAIN_NS

    def _connect(self, code: str, ip: str, now: int) -> None:
        host = self._host_facing(code, ip)
        if host is None:
            return
        self.serial, self.device_ip = code, ip
        self._in_session = False
        self._began = self._heard = now
        self.state = State.CONNECTING  # an earlier message stands until the handshake has worked
        self._dialogue.start(self._greeting(host), now)

    def _watch_data(self, now: int) -> int:
        quiet = super()._watch_data(now)
        answering = now - self._heard < HEARTBEAT_NS + 500 * MS
        if self.state == State.SILENT and quiet > RESTART_NS and answering:
            self._dialogue.start(self._configuration(), now)
        return quiet

    def status(self) -> dict[str, str]:
        """The device's own status in words."""
        decoded = Status.decode(self.status_code)._asdict()
        return {"work_state": self.work_state.name.lower()} | {
            name: str(value) for name, value in decoded.items()
        }

    # -- what is said -------------------------------------------------------------------------------------------

    def _greeting(self, host: str) -> Script:
        port = self.config.data_port
        handshake = payloads.Handshake(host, port, self.config.command_port, port)
        answer = yield Ask(command(General.HANDSHAKE), handshake.encode(), tries=3)
        if answer is None:
            self._search(
                f"the Livox Avia {self.serial} at {self.device_ip} does not answer the handshake: let UDP ports "
                f"{COMMAND_PORT} and {self.config.command_port} through the firewall and check host_ip ({host})",
                self._began,
            )
            return
        if answer[:1] != bytes([Ret.OK]):
            self._search(
                f"the Livox Avia {self.serial} refuses the handshake: end the other program that uses it",
                self._began,
            )
            return
        self.counters["sessions"] += 1
        self.message = ""
        self._in_session = True
        self._heartbeat_sent = 0  # the first one at once: its answer tells the work state
        yield from self._configuration()

    def _configuration(self) -> Script:
        self.state = State.CONFIGURING
        self.work_state = WorkState.INIT
        while self.work_state != WorkState.NORMAL:
            if self.work_state in (WorkState.POWER_SAVING, WorkState.STANDBY):
                yield Ask(command(Lidar.MODE), bytes([WorkState.NORMAL]))
                yield HEARTBEAT_NS
            yield _INIT_POLL_NS
        info = yield Ask(command(General.DEVICE_INFO))
        if info is not None and len(info) >= 5:
            self.firmware = ".".join(f"{b:02d}" for b in info[1:5])
        for item in items(self.config):
            yield from self._apply(item)
        answer = yield Ask(command(General.SAMPLING), b"\1")
        if answer is None or answer[:1] != bytes([Ret.OK]):
            self._search(
                f"the Livox Avia {self.serial} does not start sampling: switch it off and on", self._heard
            )
            return
        self._running_since = self._heard
        self.state, self.message = State.RUNNING, self._advice()

    def _farewell(self) -> Script:
        yield Ask(command(General.SAMPLING), b"\0", tries=2)
        yield Ask(command(General.DISCONNECT), tries=1)
        self._in_session = False
        self.state, self.message = State.STOPPED, ""

    def _apply(self, item: Item) -> Script:
        began, tries = self._heard, 0
        answer: bytes | None = None
        while tries < _REFUSALS:
            tries += 1
            answer = yield item.ask
            if answer is None or answer[:1] == bytes([Ret.OK]):
                break
            yield _REFUSED_PAUSE_NS
        if answer is None or answer[:1] != bytes([Ret.OK]):
            status, read_back = (
                "refused",
                _NOT_TAKEN[0] if answer is None else f"{_NOT_TAKEN[1]} {answer.hex()}",
            )
        elif item.read is None:
            status, read_back = "unreadable", "accepted"
        else:
            back = yield item.read
            status = "unreadable" if back is None else "ok" if back.startswith(item.expected) else "refused"
            read_back = _NOT_TAKEN[0] if back is None else item.requested if status == "ok" else back.hex()
        ms = (self._heard - began) / MS
        self.applied[item.name] = Applied(item.name, item.requested, read_back, status, tries, ms)

    # -- what is heard ------------------------------------------------------------------------------------------

    def _hear_frame(self, frame: Frame, now: int) -> None:
        key = frame.cmd_set << 8 | frame.cmd_id
        if frame.kind == Kind.MSG and key == command(General.ABNORMAL) and len(frame.payload) >= 4:
            self.counters["abnormal_messages"] += 1
            self.status_code = int.from_bytes(frame.payload[:4], "little")
            self.message = self._advice()
        if frame.kind != Kind.ACK:
            return
        if key == command(General.HEARTBEAT):
            self._hear_heartbeat(frame.payload, now)
        elif key == command(Lidar.UTC) and frame.seq in self._utc_seq:
            self._utc_seq.clear()
            self._count_utc(frame.payload)
        else:
            self._heard = now
            if not self._dialogue.answer(frame.seq, key, frame.payload, now):
                self.counters["answers_unexpected"] += 1

    def _hear_heartbeat(self, payload: bytes, now: int) -> None:
        beat = payloads.HeartbeatAck.decode(payload)
        if beat is None or beat.ret != Ret.OK:
            self.counters["heartbeats_refused"] += 1
            return
        self._heard = now
        self.counters["heartbeats_answered"] += 1
        if self.state == State.SEARCHING and self._in_session and not self._leaving:
            self._dialogue.start(self._configuration(), now)
        self.feature = beat.feature
        self.work_state = (
            WorkState(beat.work_state) if beat.work_state in list(WorkState) else WorkState.ERROR
        )
        if self.work_state == WorkState.INIT:
            self.message = f"the Livox Avia {self.serial} is starting up: {beat.detail} %"
        else:
            self.status_code = beat.detail
            self._seen("rain_fog", str(bool(self.feature & 1)))
            if self.state in (State.RUNNING, State.CONFIGURING):
                self.message = self._advice()

    def _faults(self) -> list[str]:
        faults = Status.decode(self.status_code).faults()
        if self.work_state == WorkState.ERROR:
            faults.append("the device reports an error state")
        return faults

    def _seen(self, item: str, read_back: str) -> None:
        """Settings without a read command show in other messages."""
        was = self.applied.get(item)
        if was is not None and was.read_back != read_back and not was.read_back.startswith(_NOT_TAKEN):
            status = "ok" if was.requested == read_back else "refused"
            self.applied[item] = Applied(item, was.requested, read_back, status, was.tries, was.ms)
            self.message = self._advice()

    # -- sending ------------------------------------------------------------------------------------------------

    def _put(self, cmd: General | Lidar, payload: bytes = b"") -> int:
        seq = self._next_seq()
        self._put_ask(Ask(command(cmd), payload), seq)
        return seq

    def _put_ask(self, ask: Ask, seq: int) -> None:
        frame = Frame(Kind.CMD, seq, ask.command >> 8, ask.command & 0xFF, ask.payload)
        self.outbox.append(Datagram(encode(frame), (self.device_ip, COMMAND_PORT)))
