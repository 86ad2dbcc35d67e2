"""Session with one Mid-360: it is found by a search, told where to send, and asked every second how it is.

The protocol knows no handshake and no heartbeat. Where data go, what is sent and the work mode are values under
keys, set and read back one by one.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import NamedTuple

from artemis_drivers.base import Applied, State
from artemis_drivers.livox_dialogue import MS, Ask, Datagram, Script
from artemis_drivers.livox_mid360.protocol import (
    DEVICE_NAMES,
    DISCOVERY_PORT,
    IMU_PORT,
    MID360,
    POINT_PORT,
    PUSH_PORT,
    Cmd,
    Found,
    Frame,
    HostAddress,
    Key,
    Work,
    decode,
    decode_got,
    decode_values,
    encode,
    encode_keys,
    encode_values,
)
from artemis_drivers.livox_mid360.settings import PATTERNS, POINT_TYPES, Mid360Config
from artemis_drivers.livox_session import LOST_NS, UNHEARD_NS, LivoxSession
from artemis_drivers.udp import Interface, interfaces

POLL_NS = 1000 * MS
_TIME_OF_PULSE = 2  # type byte of command TIME: the pulse just passed has this time
_SYNC_NAMES = ("none", "ptp", "gps")


class Setting(NamedTuple):
    """One value to set and read back."""

    name: str
    requested: str
    key: Key
    value: bytes


class Mid360Session(LivoxSession):
    """State of one Mid-360 as the host sees it."""

    model = "Mid-360"
    seq_mask = 0xFFFFFFFF

    def __init__(
        self, config: Mid360Config, own_addresses: Callable[[], list[Interface]] = interfaces
    ) -> None:
        super().__init__(config.host_ip, own_addresses)
        self.config = config
        self.work_state = 0
        self.time_sync = 0
        self._command_port = self._polled = 0
        self._time_seq = -1

    # -- what the host calls ------------------------------------------------------------------------------------

    def begin_stop(self, now: int) -> None:
        """Put the device to idle; ``state`` is STOPPED when that is done or was not answered."""
        self._leaving = True
        if self.state in (State.RUNNING, State.SILENT, State.CONFIGURING):
            self._dialogue.start(self._farewell(), now)
        else:
            self._dialogue.cancel()
            self.state = State.STOPPED

    def wants(self, serial: str) -> bool:
        """Whether a serial number is this session's device."""
        mine = self.config.serial or self.serial
        return bool(mine) and serial == mine

    def searching(self) -> bool:
        """Whether a search should be sent."""
        return self.state in (State.SEARCHING, State.SILENT)

    def hear_found(self, found: Found, ip: str, now: int) -> bool:
        """A device answered the search; True when it is ours."""
        if self.state == State.STOPPED or self._leaving:
            return False
        if not self.wants(found.serial) and (self.config.serial or self.state != State.SEARCHING):
            return False
        if found.device != MID360:
            name = DEVICE_NAMES.get(found.device, f"type {found.device}")
            self.message = f"Livox {name} {found.serial} at {ip} is not a Mid-360: connect a Mid-360"
            return False
        if self.searching():
            self._connect(found, ip, now)
        return True

    def hear(self, datagram: bytes, ip: str, now: int) -> None:
        """A datagram on the command or push socket."""
        frames, skipped = decode(datagram)
        self.counters["control_bad_bytes"] += skipped
        if ip != self.device_ip:
            self.counters["control_foreign"] += 1
            return
        for frame in frames:
            if frame.cmd == Cmd.PUSH and frame.from_lidar:
                self._read(decode_values(frame.data))
            elif frame.is_answer:
                self._hear_answer(frame, now)

    def send_utc(self, unix_ns: int) -> None:
        """Name the PPS edge just passed."""
        if not self.device_ip:
            self.counters["utc_not_connected"] += 1
            return
        self._time_seq = self._next_seq()
        self._put_ask(Ask(Cmd.TIME, struct.pack("<BQ", _TIME_OF_PULSE, unix_ns)), self._time_seq)
        self.counters["utc_sent"] += 1

    def tick(self, now: int) -> None:
        """Whatever is due by the clock."""
        self._dialogue.tick(now)
        if self.state == State.SEARCHING and not self.message and now - self._began > UNHEARD_NS:
            self.message = (
                "no Livox Mid-360 answers the search: check its power, its cable, and that no firewall blocks "
                f"UDP port {DISCOVERY_PORT}"
            )
        if self._leaving or self.state not in (State.RUNNING, State.SILENT):
            return
        if now - self._polled >= POLL_NS:
            self._polled = now
            self._put_ask(
                Ask(Cmd.GET, encode_keys([Key.WORK_STATE, Key.TIME_SYNC, Key.FIRMWARE])), self._next_seq()
            )
        if now - max(self._heard, self._last_data) > LOST_NS:
            self._search(self._gone(), now)
        else:
            self._watch_data(now)

    def status(self) -> dict[str, str]:
        """The device's own status in words."""
        known = self.work_state in list(Work)
        sync = _SYNC_NAMES[self.time_sync] if self.time_sync < len(_SYNC_NAMES) else "unknown"
        return {"work_state": Work(self.work_state).name.lower() if known else "unknown", "sync": sync}

    # -- finding the device -------------------------------------------------------------------------------------

    def _connect(self, found: Found, ip: str, now: int) -> None:
        host = self._host_facing(found.serial, ip)
        if host is None:
            return
        self.serial, self.device_ip, self._command_port = found.serial, ip, found.command_port
        self._heard = now
        self.state, self.message = State.CONFIGURING, ""
        self.counters["sessions"] += 1
        self._dialogue.start(self._configuration(host), now)

    # -- what is said -------------------------------------------------------------------------------------------

    def _settings(self, host: str) -> list[Setting]:
        c = self.config
        targets = (
            ("state_host", Key.STATE_HOST, c.push_port, PUSH_PORT),
            ("point_host", Key.POINT_HOST, c.point_port, POINT_PORT),
            ("imu_host", Key.IMU_HOST, c.imu_port, IMU_PORT),
        )
        hosts = [
            Setting(name, f"{host}:{port}", key, HostAddress(host, port, own).encode())
            for name, key, port, own in targets
        ]
        return [
            *hosts,
            Setting("point_type", c.point_type, Key.POINT_TYPE, bytes([POINT_TYPES[c.point_type]])),
            Setting("pattern", c.pattern, Key.PATTERN, bytes([PATTERNS[c.pattern]])),
            Setting("imu", str(c.imu), Key.IMU_ON, bytes([c.imu])),
            Setting("work_mode", "sampling", Key.WORK_MODE, bytes([Work.SAMPLING])),
        ]

    def _configuration(self, host: str) -> Script:
        for setting in self._settings(host):
            yield from self._apply(setting)
        if any(a.read_back == "no answer" for a in self.applied.values()):
            self._search(
                f"the Livox Mid-360 {self.serial} at {self.device_ip} does not answer commands: let UDP ports "
                f"{self._command_port} and {self.config.command_port} through the firewall",
                self._heard,
            )
            return
        self._running_since = self._heard
        self.state, self.message = State.RUNNING, self._advice()

    def _apply(self, setting: Setting) -> Script:
        began = self._heard
        answer = yield Ask(Cmd.SET, encode_values({setting.key: setting.value}))
        if answer is None:
            status, read_back = "refused", "no answer"
        elif answer[:1] != b"\0":
            status, read_back = "refused", f"error {answer.hex()}"
        else:
            back = yield Ask(Cmd.GET, encode_keys([setting.key]))
            got = None if back is None else decode_got(back)
            value = None if got is None else got.get(setting.key)
            status = "unreadable" if value is None else "ok" if value == setting.value else "refused"
            read_back = setting.requested if status == "ok" else "" if value is None else value.hex()
        ms = (self._heard - began) / MS
        self.applied[setting.name] = Applied(setting.name, setting.requested, read_back, status, 1, ms)

    def _farewell(self) -> Script:
        yield Ask(Cmd.SET, encode_values({Key.WORK_MODE: bytes([Work.IDLE])}), tries=2)
        self.state, self.message = State.STOPPED, ""

    # -- what is heard ------------------------------------------------------------------------------------------

    def _hear_answer(self, frame: Frame, now: int) -> None:
        self._heard = now
        if frame.cmd == Cmd.TIME and frame.seq == self._time_seq:
            self._count_utc(frame.data)
        elif not self._dialogue.answer(frame.seq, frame.cmd, frame.data, now):
            self._read(decode_got(frame.data) or {} if frame.cmd == Cmd.GET else {})

    def _read(self, values: dict[int, bytes]) -> None:
        if Key.FIRMWARE in values and len(values[Key.FIRMWARE]) >= 4:
            self.firmware = ".".join(f"{b:02d}" for b in values[Key.FIRMWARE][:4])
        if values.get(Key.TIME_SYNC):
            self.time_sync = values[Key.TIME_SYNC][0]
        if values.get(Key.WORK_STATE):
            self.work_state = values[Key.WORK_STATE][0]
        if self.state == State.RUNNING:
            self.message = self._advice()

    def _faults(self) -> list[str]:
        return ["the device reports an error state"] if self.work_state == Work.ERROR else []

    # -- sending ------------------------------------------------------------------------------------------------

    def _put_ask(self, ask: Ask, seq: int) -> None:
        frame = Frame(seq, ask.command, is_answer=False, from_lidar=False, data=ask.payload)
        self.outbox.append(Datagram(encode(frame), (self.device_ip, self._command_port)))
