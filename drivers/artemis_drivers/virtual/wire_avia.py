"""A virtual Livox Avia on the wire: answers and streams as the real one does, on UDP of this computer.

It keeps the session rules of the SDK 1 protocol (broadcast once a second while nobody has shaken hands,
heartbeat time-out, work state with start-up progress, configuration that can be read back) and makes packets of
the shots it is given, stamped by its own clock: free running, PPS only, or PPS named by UTC commands. What a
cable and a careless network do can be switched on. Loopback addresses 127.0.0.x stand for several devices.

Not known of the real device and therefore parameters or choices of ours: the time-out after the last heartbeat
(5 s), the stamps while pulses are missing (the clock runs on, status says abnormal).
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import heapq
import socket
import struct
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from artemis_drivers.livox_avia import encode, payloads
from artemis_drivers.livox_avia.protocol import (
    AVIA,
    COMMAND_PORT,
    DISCOVERY_PORT,
    Frame,
    General,
    Kind,
    Lidar,
    Param,
    Ret,
    WorkState,
    decode,
)
from artemis_drivers.livox_avia.protocol import encode as encode_frame
from artemis_drivers.virtual.wire_clock import DeviceClock
from artemis_drivers.virtual.wire_stream import SHOTS_PER_S, ImuSample, Shots, body, steady_imu, steady_shots

_S = 1_000_000_000
_POINT_PORT, _IMU_PORT = 60001, 60003  # source ports of the real device, by an independent decoder


@dataclasses.dataclass
class Faults:
    """What goes wrong, by choice. Probabilities are per datagram, drawn with ``seed``."""

    seed: int = 0
    lose_data: float = 0.0
    duplicate_data: float = 0.0
    reorder_data: float = 0.0
    lose_replies: float = 0.0
    duplicate_replies: float = 0.0
    pack_replies: float = 0.0
    """A reply is held back and sent in one datagram with the next one, as seen of a Tele-15."""
    refuse: frozenset[tuple[int, int]] = frozenset()
    """(command set, command) answered with an error."""
    unplugged: bool = False
    """Neither hears nor speaks; its clock and its session go on."""


class VirtualAvia:
    """One device. ``start`` opens its ports; ``play`` streams; all public methods may be called from any thread.

    ``clock`` is the truth that everything in a virtual rig shares, in nanoseconds. ``announce_to`` is where
    broadcasts go: on loopback the host itself.
    """

    def __init__(
        self,
        code: str = "3JEDK1E001F6361",
        ip: str = "127.0.0.1",
        *,
        announce_to: str = "127.0.0.1",
        clock: Callable[[], int] = time.monotonic_ns,
        skew_ppm: float = 0.0,
        boot_s: float = 0.0,
        heartbeat_timeout_s: float = 5.0,
        announce_every_s: float = 1.0,
        faults: Faults | None = None,
    ) -> None:
        self.code, self.ip, self.faults = code, ip, faults or Faults()
        self.counters: Counter[str] = Counter()
        self.device_time = DeviceClock(clock(), skew_ppm)
        self._announce_to, self._clock, self._skew = announce_to, clock, skew_ppm
        self._boot_s, self._timeout_s, self._announce_s = boot_s, heartbeat_timeout_s, announce_every_s
        self._random = np.random.default_rng(self.faults.seed)
        self._params = {
            int(Param.HIGH_SENSITIVITY): b"\1",
            int(Param.SCAN_PATTERN): b"\0",
            int(Param.SLOT): b"\1",
        }
        self._extrinsic = bytes(24)
        self._lock = threading.RLock()
        self._ended = threading.Event()
        self._threads: list[threading.Thread] = []
        self._held_reply: bytes | None = None
        self._held_data: tuple[int, bytes, int] | None = None
        self._extra_status = 0
        self._power_on()

    # -- life ---------------------------------------------------------------------------------------------------

    def _power_on(self) -> None:
        """Volatile state as after switching on."""
        self._booted_at = time.monotonic() + self._boot_s
        self._mode = WorkState.NORMAL
        self._host: payloads.Handshake | None = None
        self._sampling = False
        self._coordinate = self._return_mode = self._imu_rate = self._rain_fog = self._fan = 0
        self._last_heartbeat = self._last_announce = 0.0
        self._seq = 0

    def start(self) -> None:
        """Open the device's ports. Raises OSError when another virtual device has this address."""
        self._control = _bound(self.ip, COMMAND_PORT)
        self._point_socket, self._imu_socket = _bound(self.ip, _POINT_PORT), _bound(self.ip, _IMU_PORT)
        self._control.settimeout(0.02)
        self._spawn(self._serve)

    def stop(self) -> None:
        """Switch off for good."""
        self._ended.set()
        for thread in self._threads:
            thread.join()
        for sock in (self._control, self._point_socket, self._imu_socket):
            sock.close()

    def __enter__(self) -> VirtualAvia:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def reboot(self) -> None:
        """As if the supply failed for a moment: session, volatile settings and time are lost."""
        with self._lock:
            self.device_time = DeviceClock(self._clock(), self._skew)
            self._power_on()

    def _spawn(self, target: Callable[..., None], *args: object) -> None:
        thread = threading.Thread(target=target, args=args, name=f"virtual avia {self.ip}", daemon=True)
        self._threads.append(thread)
        thread.start()

    # -- what others do to it -----------------------------------------------------------------------------------

    def pulse(self, true_ns: int) -> None:
        """Rising edge on the PPS input."""
        with self._lock:
            self.device_time.pulse(true_ns)

    def set_status(self, bits: int) -> None:
        """Report further status bits; any level other than 0 is also pushed as an abnormal message."""
        self._extra_status = bits

    def play(self, shots: Iterable[Shots], imu: Iterable[ImuSample] = ()) -> None:
        """Stream in the background, each packet when its last shot has been fired by the true clock."""
        self._spawn(self._play, iter(shots), iter(imu))

    @property
    def work_state(self) -> WorkState:
        """What the heartbeat says."""
        return WorkState.INIT if time.monotonic() < self._booted_at else self._mode

    # -- session ------------------------------------------------------------------------------------------------

    def _serve(self) -> None:
        next_abnormal = 0.0
        while not self._ended.is_set():
            with contextlib.suppress(TimeoutError, ConnectionRefusedError):
                datagram, source = self._control.recvfrom(2048)
                if not self.faults.unplugged:
                    with self._lock:
                        for frame in decode(datagram)[0]:
                            self._hear(frame, source)
            now = time.monotonic()
            with self._lock:
                self._expire(now)
                if self._host is None and now - self._last_announce >= self._announce_s:
                    self._last_announce = now
                    body = payloads.Broadcast(self.code, AVIA).encode()
                    self._message(General.BROADCAST, body, (self._announce_to, DISCOVERY_PORT))
                if self._host is not None and self._extra_status and now >= next_abnormal:
                    next_abnormal = now + 0.1
                    body = struct.pack("<I", self._status())
                    self._message(General.ABNORMAL, body, (self._host.host_ip, self._host.cmd_port))

    def _expire(self, now: float) -> None:
        if self._host is not None and now - self._last_heartbeat > self._timeout_s:
            self.counters["sessions_expired"] += 1
            self._host, self._sampling = None, False

    def _message(self, cmd: General, body: bytes, to: tuple[str, int]) -> None:
        self._seq = (self._seq + 1) & 0xFFFF
        self._send(encode_frame(Frame(Kind.MSG, self._seq, 0, cmd, body)), to)

    def _hear(self, frame: Frame, source: tuple[str, int]) -> None:
        handshake = (frame.cmd_set, frame.cmd_id) == (0, General.HANDSHAKE)
        # the official SDK sends the handshake as type 1
        if frame.kind != Kind.CMD and not (handshake and frame.kind == Kind.ACK):
            return
        self.counters["commands"] += 1
        if handshake:
            body = self._shake(frame.payload)
        elif self._host is None or source[0] != self._host.host_ip:
            self.counters["commands_without_session"] += 1
            return
        elif (frame.cmd_set, frame.cmd_id) in self.faults.refuse:
            body = bytes([Ret.FAIL])
        elif frame.cmd_set == 0:
            body = self._general(frame.cmd_id, frame.payload)
        else:
            body = self._lidar(frame.cmd_id, frame.payload)
        reply = encode_frame(Frame(Kind.ACK, frame.seq, frame.cmd_set, frame.cmd_id, body))
        self._reply(reply, source)
        if (frame.cmd_set, frame.cmd_id) == (0, General.DISCONNECT):
            self._host, self._sampling = None, False
        if (frame.cmd_set, frame.cmd_id) == (0, General.REBOOT):
            self.reboot()

    def _shake(self, payload: bytes) -> bytes:
        wanted = payloads.Handshake.decode(payload)
        if wanted is None:
            return bytes([Ret.FAIL])
        self._host, self._last_heartbeat = wanted, time.monotonic()
        return bytes([Ret.OK])

    def _general(self, cmd: int, payload: bytes) -> bytes:
        ok = bytes([Ret.OK])
        match cmd:
            case General.DEVICE_INFO:
                return ok + bytes([11, 8, 0, 6])
            case General.HEARTBEAT:
                self._last_heartbeat = time.monotonic()
                return payloads.HeartbeatAck(
                    Ret.OK, self.work_state, self._rain_fog, self._beat_detail()
                ).encode()
            case General.SAMPLING if payload:
                self._sampling = payload[0] == 1
            case General.COORDINATE if payload:
                self._coordinate = payload[0]
            case General.GET_IP:
                return ok + payloads.IpConfig(True, self.ip, "255.255.255.0", "0.0.0.0").encode()
            case General.SET_PARAMS:
                self._params |= payloads.decode_params(payload)
                return payloads.ParamsAck(Ret.OK, 0, 0, {}).encode()
            case General.GET_PARAMS:
                got = {k: self._params[k] for k in payloads.decode_keys(payload) if k in self._params}
                return payloads.ParamsAck(Ret.OK, 0, 0, got).encode()
            case General.DISCONNECT | General.REBOOT | General.SET_IP | General.RESET_PARAMS:
                pass
            case _:
                return bytes([Ret.FAIL])
        return ok

    def _lidar(self, cmd: int, payload: bytes) -> bytes:
        ok = bytes([Ret.OK])
        match cmd:
            case Lidar.MODE if payload and payload[0] in (1, 2, 3):
                self._mode = WorkState(payload[0])
            case Lidar.SET_EXTRINSIC if len(payload) == 24:
                self._extrinsic = payload
            case Lidar.GET_EXTRINSIC:
                return ok + self._extrinsic
            case Lidar.RAIN_FOG if payload:
                self._rain_fog = payload[0] & 1
            case Lidar.SET_RETURN_MODE if payload and payload[0] <= 3:
                self._return_mode = payload[0]
            case Lidar.GET_RETURN_MODE:
                return ok + bytes([self._return_mode])
            case Lidar.SET_IMU_RATE if payload and payload[0] <= 1:
                self._imu_rate = payload[0]
            case Lidar.GET_IMU_RATE:
                return ok + bytes([self._imu_rate])
            case Lidar.UTC:
                named = payloads.decode_utc(payload)
                if named is None:
                    return bytes([Ret.FAIL])
                self.device_time.name_edge(named, self._clock())
            case _:
                return bytes([Ret.FAIL])
        return ok

    def _beat_detail(self) -> int:
        if self.work_state != WorkState.INIT:
            return self._status()
        return max(0, min(99, round(100 * (1 - (self._booted_at - time.monotonic()) / self._boot_s))))

    def _status(self) -> int:
        return self.device_time.status(self._clock()) | self._extra_status

    def _reply(self, reply: bytes, to: tuple[str, int]) -> None:
        if self._random.random() < self.faults.lose_replies:
            self.counters["replies_lost"] += 1
            return
        if self._held_reply is None and self._random.random() < self.faults.pack_replies:
            self._held_reply = reply  # the host asks again meanwhile
            self.counters["replies_packed"] += 1
            return
        reply, self._held_reply = (self._held_reply or b"") + reply, None
        self._send(reply, to)
        if self._random.random() < self.faults.duplicate_replies:
            self._send(reply, to)

    def _send(self, data: bytes, to: tuple[str, int]) -> None:
        if not self.faults.unplugged:
            with contextlib.suppress(OSError):
                self._control.sendto(data, to)

    # -- stream -------------------------------------------------------------------------------------------------

    def _play(self, shots: Iterator[Shots], imu: Iterator[ImuSample]) -> None:
        points: Iterator[tuple[int, Shots | ImuSample]]
        samples: Iterator[tuple[int, Shots | ImuSample]]
        points = (item for batch in shots for item in self._cut(batch))
        samples = ((s.time_ns, s) for s in imu)
        for due, what in heapq.merge(points, samples, key=lambda pair: pair[0]):
            if not self._wait_until(due):
                return
            with self._lock:
                self._emit(what)
        with self._lock:
            self._flush_held()

    def _wait_until(self, due: int) -> bool:
        while (left := due - self._clock()) > 0:
            if self._ended.wait(min(left / _S, 0.05)):
                return False
        return not self._ended.is_set()

    def _cut(self, batch: Shots) -> Iterator[tuple[int, Shots]]:
        """A batch as pieces of one packet each, due when the last shot has been fired."""
        at = 0
        while at < len(batch.xyz):
            n = encode.SHOTS_PER_PACKET[self._data_type()]
            begin = batch.start_ns + at * _S // SHOTS_PER_S
            part = slice(at, at + n)
            yield (
                begin + n * _S // SHOTS_PER_S,
                Shots(begin, batch.xyz[part], batch.reflectivity[part], batch.tag[part]),
            )
            at += n

    def _data_type(self) -> int:
        returns = (1, 1, 2, 3)[self._return_mode]
        return {1: (2, 3), 2: (4, 5), 3: (7, 8)}[returns][self._coordinate & 1]

    def _emit(self, what: Shots | ImuSample) -> None:
        host = self._host
        if host is None or not self._sampling or self.work_state != WorkState.NORMAL:
            self.counters["packets_not_wanted"] += 1
            return
        if isinstance(what, ImuSample):
            if self._imu_rate and host.sensor_port is not None:
                clock, stamp = self.device_time.stamp(what.time_ns)
                data = encode.imu_packet(self._status(), clock, stamp, what.gyro, what.accel)
                self._send_data(_IMU_PORT, data, host.sensor_port)
            return
        data_type = self._data_type()
        for _, part in self._cut(what):  # once more: the return mode may have been changed since
            clock, stamp = self.device_time.stamp(part.start_ns)
            head = encode.header(self._status(), clock, data_type, stamp)
            self._send_data(_POINT_PORT, head + body(data_type, part), host.data_port)

    def _send_data(self, source_port: int, data: bytes, port: int) -> None:
        draw = self._random.random(3)
        self.counters["packets_made"] += 1
        if draw[0] < self.faults.lose_data:
            self.counters["packets_lost"] += 1
            return
        if draw[1] < self.faults.reorder_data and self._held_data is None:
            self._held_data = (source_port, data, port)
            self.counters["packets_reordered"] += 1
            return
        self._put_data(source_port, data, port)
        if draw[2] < self.faults.duplicate_data:
            self.counters["packets_duplicated"] += 1
            self._put_data(source_port, data, port)
        self._flush_held()

    def _flush_held(self) -> None:
        if self._held_data is not None:
            held, self._held_data = self._held_data, None
            self._put_data(*held)

    def _put_data(self, source_port: int, data: bytes, port: int) -> None:
        if self.faults.unplugged or self._host is None:
            self.counters["packets_unplugged"] += 1
            return
        sock = self._point_socket if source_port == _POINT_PORT else self._imu_socket
        with contextlib.suppress(OSError):
            sock.sendto(data, (self._host.host_ip, port))
            self.counters["packets_sent"] += 1


def _bound(ip: str, port: int) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    try:
        sock.bind((ip, port))
    except OSError:
        sock.close()
        raise
    return sock


def main() -> int:
    """A device for any program that speaks the protocol, such as the official SDK's samples."""
    args = argparse.ArgumentParser(description=main.__doc__)
    args.add_argument("--ip", default="127.0.0.1", help="address of the device")
    args.add_argument("--announce-to", default="127.0.0.1", help="where its broadcasts go")
    args.add_argument("--code", default="3JEDK1E001F6361", help="broadcast code")
    args.add_argument("--seconds", type=float, default=60.0)
    options = args.parse_args()
    with VirtualAvia(options.code, options.ip, announce_to=options.announce_to) as device:
        now = time.monotonic_ns()
        device.play(steady_shots(now, options.seconds, 3), steady_imu(now, options.seconds))
        time.sleep(options.seconds)
        print(dict(device.counters))
    return 0


if __name__ == "__main__":
    sys.exit(main())
