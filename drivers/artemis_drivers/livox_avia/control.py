"""Session with one Avia: discovery, handshake, heartbeat, configuration with read-back, sampling.

Without input or output of its own: datagrams go in by ``hear_*``, time by ``tick``, datagrams to be sent come
out in ``outbox``. Sequence and times follow the official SDK v2.3.0: heartbeat every 800 ms, a device that does
not answer for 3 s is lost, a command is repeated after 500 ms.
"""

from __future__ import annotations

import ipaddress
from collections import Counter
from collections.abc import Callable, Iterator
from typing import NamedTuple

from artemis_drivers.base import Applied, State
from artemis_drivers.livox_avia import payloads
from artemis_drivers.livox_avia.protocol import (
    AVIA,
    COMMAND_PORT,
    DEVICE_NAMES,
    Frame,
    General,
    Kind,
    Lidar,
    Param,
    Ret,
    WorkState,
    decode,
    encode,
)
from artemis_drivers.livox_avia.settings import RETURN_MODES, AviaConfig
from artemis_drivers.livox_avia.status import Status
from artemis_drivers.livox_dialogue import MS, Ask, Dialogue, Script
from artemis_drivers.udp import Interface, address_facing, interfaces

HEARTBEAT_NS = 800 * MS
LOST_NS = 3000 * MS
SILENT_NS = 600 * MS  # 120 IMU periods without any data packet
RESTART_NS = 2000 * MS  # a device that answers but sends nothing is configured again
UNHEARD_NS = 5000 * MS
_INIT_POLL_NS = 50 * MS
_REFUSALS = 5  # a command is repeated so often before it counts as refused
_REFUSED_PAUSE_NS = 200 * MS
_ANSWERS_AGAIN_NS = 1000 * MS


class Outgoing(NamedTuple):
    """A datagram to be sent from the command socket."""

    data: bytes
    address: tuple[str, int]


class Item(NamedTuple):
    """One thing to configure. ``expected`` are the bytes a correct read-back begins with."""

    name: str
    requested: str
    ask: Ask
    read: Ask | None
    expected: bytes


def command(cmd: General | Lidar) -> int:
    """Command set and id as one number."""
    return (isinstance(cmd, Lidar) << 8) | cmd


class AviaSession:
    """State of one Avia as the host sees it."""

    def __init__(self, config: AviaConfig, own_addresses: Callable[[], list[Interface]] = interfaces) -> None:
        self.config = config
        self.state = State.STOPPED
        self.message = ""
        self.outbox: list[Outgoing] = []
        self.counters: Counter[str] = Counter()
        self.applied: dict[str, Applied] = {}
        self.code = ""
        self.device_ip = ""
        self.firmware = ""
        self.work_state = WorkState.INIT
        self.feature = 0
        self.status_code = 0
        self._own_addresses = own_addresses
        self._dialogue = Dialogue(self._put_ask, self._next_seq)
        self._seq = 0
        self._utc_seq: set[int] = set()
        self._began = self._heartbeat_sent = self._heard = self._last_data = self._running_since = 0
        self._connected = False

    # -- what the host calls ------------------------------------------------------------------------------------

    def start(self, now: int) -> None:
        """Begin to listen for the device."""
        self._search("", now)

    def begin_stop(self, now: int) -> None:
        """Stop sampling and take leave; ``state`` is STOPPED when that is done or was not answered."""
        if self._connected:
            self._dialogue.start(self._farewell(), now)
        else:
            self.state = State.STOPPED

    def wants(self, code: str) -> bool:
        """Whether a broadcast code is this session's device."""
        mine = self.code or self.config.broadcast_code
        return bool(mine) and code.startswith(mine)

    def hear_broadcast(self, broadcast: payloads.Broadcast, ip: str, now: int) -> bool:
        """A device announced itself; True when it is (now) ours."""
        if self.state == State.STOPPED:
            return False
        if not self.wants(broadcast.code) and (self.code or self.config.broadcast_code):
            if not self._connected:
                self.message = (
                    f"Livox {self.config.broadcast_code or self.code} is not heard, but {broadcast.code} at {ip} "
                    f"is: correct broadcast_code of {self.config.name} or connect the other device"
                )
            return False
        if broadcast.device != AVIA:
            name = DEVICE_NAMES.get(broadcast.device, f"type {broadcast.device}")
            self.message = f"Livox {name} {broadcast.code} at {ip} is not an Avia: connect an Avia"
            return False
        if not self._connected or self._forgotten(now):
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
        """Data packets have arrived; ``data_type`` of the latest points (0: none yet)."""
        self._last_data = now
        self.status_code = status_code
        if self.state == State.SILENT:
            self.state, self.message = State.RUNNING, self._advice()
        if data_type and self.state == State.RUNNING and self.applied["coordinate"].status == "unreadable":
            self._coordinate_seen(data_type)

    def send_utc(self, unix_ns: int) -> None:
        """Name the PPS edge just passed (10 to 500 ms ago, Avia user manual)."""
        if not self._connected:
            self.counters["utc_not_connected"] += 1
            return
        self._utc_seq = {self._put(Lidar.UTC, payloads.encode_utc(unix_ns))}
        self.counters["utc_sent"] += 1

    def tick(self, now: int) -> None:
        """Whatever is due by the clock."""
        self._dialogue.tick(now)
        if self.state == State.STOPPED:
            return
        if not self._connected:
            if now - self._began > UNHEARD_NS and not self.message:
                self.message = (
                    f"no Livox Avia is heard on UDP port 55000 for {(now - self._began) // 10**9} s: check its power, "
                    "its cable and that no firewall blocks the port"
                )
            return
        if self.state == State.CONNECTING:
            return
        if now - self._heartbeat_sent >= HEARTBEAT_NS:
            self._heartbeat_sent = now
            self._put(General.HEARTBEAT)
            self.counters["heartbeats"] += 1
        if now - self._heard > LOST_NS:
            self._search(
                f"the Livox Avia {self.code} does not answer any more: check its power and cable", now
            )
        elif self.state in (State.RUNNING, State.SILENT):
            self._watch_data(now)

    # -- finding and losing the device --------------------------------------------------------------------------

    def _search(self, message: str, now: int) -> None:
        self._dialogue.cancel()
        self._connected = False
        self.state, self.message, self._began = State.SEARCHING, message, now

    def _forgotten(self, now: int) -> bool:
        """A connected device announces itself again and is silent otherwise: it has restarted."""
        quiet = now - max(self._heard, self._last_data, self._began)
        return self.state != State.CONNECTING and quiet > _ANSWERS_AGAIN_NS

    def _connect(self, code: str, ip: str, now: int) -> None:
        host = self.config.host_ip or address_facing(ip, self._own_addresses())
        if host is None:
            network = ipaddress.IPv4Network(f"{ip}/24", strict=False)
            self.message = (
                f"the Livox Avia {code} is heard at {ip}, but this computer has no address in its network: "
                f"give the network port one, such as {network[50]}/24"
            )
            return
        if self._connected:
            self.counters["restarts"] += 1
        self.code, self.device_ip, self._connected = code, ip, True
        self._began = self._heard = now
        self.state, self.message = State.CONNECTING, ""
        self._dialogue.start(self._greeting(host, now), now)

    def _watch_data(self, now: int) -> None:
        quiet = now - max(self._last_data, self._running_since)
        if quiet > SILENT_NS and self.state == State.RUNNING:
            self.counters["silences"] += 1
            self.state = State.SILENT
        if self.state == State.SILENT:
            self.message = (
                f"no data from the Livox Avia {self.code} for {quiet / 1e9:.1f} s: check its cable and power"
            )
            answering = now - self._heard < HEARTBEAT_NS + 500 * MS
            if quiet > RESTART_NS and answering and not self._dialogue.running:
                self._dialogue.start(self._configuration(now), now)

    # -- what is said -------------------------------------------------------------------------------------------

    def _greeting(self, host: str, now: int) -> Script:
        port = self.config.data_port
        handshake = payloads.Handshake(host, port, self.config.command_port, port)
        answer = yield Ask(command(General.HANDSHAKE), handshake.encode(), tries=3)
        if answer is None:
            self._search(
                f"the Livox Avia {self.code} at {self.device_ip} does not answer the handshake: let UDP ports "
                f"{COMMAND_PORT} and {self.config.command_port} through the firewall and check host_ip ({host})",
                self._began,
            )
            return
        if answer[:1] != bytes([Ret.OK]):
            self._search(
                f"the Livox Avia {self.code} refuses the handshake: end the other program that uses it",
                self._began,
            )
            return
        self.counters["sessions"] += 1
        self.state = State.CONFIGURING
        self._heartbeat_sent = 0  # at once: it tells the work state
        yield from self._configuration(now)

    def _configuration(self, now: int) -> Script:
        self.state = State.CONFIGURING
        self.work_state = WorkState.INIT
        while self.work_state != WorkState.NORMAL:
            if self.work_state in (WorkState.POWER_SAVING, WorkState.STANDBY):
                yield Ask(command(Lidar.MODE), bytes([WorkState.NORMAL]))
            yield _INIT_POLL_NS
        info = yield Ask(command(General.DEVICE_INFO))
        if info is not None and len(info) >= 5:
            self.firmware = ".".join(f"{b:02d}" for b in info[1:5])
        for item in self._items():
            yield from self._apply(item)
        answer = yield Ask(command(General.SAMPLING), b"\1")
        if answer is None or answer[:1] != bytes([Ret.OK]):
            self._search(
                f"the Livox Avia {self.code} does not start sampling: switch it off and on", self._heard
            )
            return
        self._running_since = self._heard
        self.state, self.message = State.RUNNING, self._advice()

    def _farewell(self) -> Script:
        yield Ask(command(General.SAMPLING), b"\0", tries=2)
        yield Ask(command(General.DISCONNECT), tries=1)
        self._connected = False
        self.state, self.message = State.STOPPED, ""

    def _items(self) -> Iterator[Item]:
        c = self.config
        spherical = c.coordinate == "spherical"
        yield Item(
            "coordinate", c.coordinate, Ask(command(General.COORDINATE), bytes([spherical])), None, b""
        )
        mode = bytes([RETURN_MODES.index(c.return_mode)])
        yield self._item("return_mode", c.return_mode, Lidar.SET_RETURN_MODE, mode, Lidar.GET_RETURN_MODE)
        yield self._item("imu", str(c.imu), Lidar.SET_IMU_RATE, bytes([c.imu]), Lidar.GET_IMU_RATE)
        yield Item("rain_fog", str(c.rain_fog), Ask(command(Lidar.RAIN_FOG), bytes([c.rain_fog])), None, b"")
        if c.high_sensitivity is not None:
            yield self._param(
                "high_sensitivity", Param.HIGH_SENSITIVITY, c.high_sensitivity, str(c.high_sensitivity)
            )
        if c.scan_pattern is not None:
            yield self._param(
                "scan_pattern", Param.SCAN_PATTERN, c.scan_pattern == "repetitive", c.scan_pattern
            )
        if c.extrinsic is not None:
            e = c.extrinsic
            value = payloads.Extrinsic(e.roll_deg, e.pitch_deg, e.yaw_deg, e.x_mm, e.y_mm, e.z_mm).encode()
            yield self._item("extrinsic", str(e), Lidar.SET_EXTRINSIC, value, Lidar.GET_EXTRINSIC)

    @staticmethod
    def _item(name: str, requested: str, setter: Lidar, value: bytes, getter: Lidar) -> Item:
        return Item(name, requested, Ask(command(setter), value), Ask(command(getter)), b"\0" + value)

    @staticmethod
    def _param(name: str, key: Param, value: bool, requested: str) -> Item:
        pair = payloads.encode_params({key: bytes([value])})
        read = Ask(command(General.GET_PARAMS), payloads.encode_keys([key]))
        return Item(name, requested, Ask(command(General.SET_PARAMS), pair), read, b"\0\0\0\0" + pair)

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
            status, read_back = "refused", "no answer" if answer is None else f"error {answer.hex()}"
        elif item.read is None:
            status, read_back = "unreadable", "accepted"
        else:
            back = yield item.read
            status = "unreadable" if back is None else "ok" if back.startswith(item.expected) else "refused"
            read_back = "no answer" if back is None else item.requested if status == "ok" else back.hex()
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
            self.counters["utc_accepted" if frame.payload[:1] == b"\0" else "utc_refused"] += 1
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
        self.feature = beat.feature
        self.work_state = (
            WorkState(beat.work_state) if beat.work_state in list(WorkState) else WorkState.ERROR
        )
        if self.work_state == WorkState.INIT:
            self.message = f"the Livox Avia {self.code} is starting up: {beat.detail} %"
        else:
            self.status_code = beat.detail
            self._rain_fog_seen()
            if self.state in (State.RUNNING, State.CONFIGURING):
                self.message = self._advice()

    def _advice(self) -> str:
        """What is wrong while data flows: faults of the device, settings it did not take."""
        faults = Status.decode(self.status_code).faults()
        if self.work_state == WorkState.ERROR:
            faults.append("the device reports an error state")
        faults += [
            f"{a.item} = {a.requested} refused" for a in self.applied.values() if a.status == "refused"
        ]
        return f"Livox Avia {self.code}: {', '.join(faults)}" if faults else ""

    def _rain_fog_seen(self) -> None:
        self._seen("rain_fog", str(bool(self.feature & 1)))

    def _coordinate_seen(self, data_type: int) -> None:
        self._seen("coordinate", "spherical" if data_type in (3, 5, 8) else "cartesian")
        self.message = self._advice()

    def _seen(self, item: str, read_back: str) -> None:
        """Settings without a read command show in other messages."""
        was = self.applied.get(item)
        if was is not None and was.read_back != read_back and was.status != "refused":
            status = "ok" if was.requested == read_back else "refused"
            self.applied[item] = Applied(item, was.requested, read_back, status, was.tries, was.ms)

    # -- sending ------------------------------------------------------------------------------------------------

    def _next_seq(self) -> int:
        self._seq = (self._seq + 1) & 0xFFFF
        return self._seq

    def _put(self, cmd: General | Lidar, payload: bytes = b"") -> int:
        seq = self._next_seq()
        self._put_ask(Ask(command(cmd), payload), seq)
        return seq

    def _put_ask(self, ask: Ask, seq: int) -> None:
        frame = Frame(Kind.CMD, seq, ask.command >> 8, ask.command & 0xFF, ask.payload)
        self.outbox.append(Outgoing(encode(frame), (self.device_ip, COMMAND_PORT)))
