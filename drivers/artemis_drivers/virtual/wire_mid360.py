"""A virtual Livox Mid-360 on the wire: answers the search, keeps values under keys, streams when told where to.

Simpler than the virtual Avia: no faults of the network but a cable that is out.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterable

from artemis_drivers.livox_mid360.protocol import (
    COMMAND_PORT,
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
    decode_keys,
    decode_values,
    encode,
    encode_got,
    encode_values,
)

_WRITABLE = {
    *(Key.POINT_TYPE, Key.PATTERN, Key.STATE_HOST, Key.POINT_HOST, Key.IMU_HOST, Key.INSTALL),
    *(Key.WORK_MODE, Key.IMU_ON),
}
_UNKNOWN_KEY = b"\x20"
_PUSH_S = 1.0


class VirtualMid360:
    """One device on a loopback address of its own."""

    def __init__(self, serial: str = "47MDK1E0013601", ip: str = "127.0.0.60") -> None:
        self.serial, self.ip = serial, ip
        self.unplugged = False
        self.refuse: set[int] = set()
        self.counters: Counter[str] = Counter()
        self.values: dict[int, bytes] = {}
        self._ended = threading.Event()
        self._threads: list[threading.Thread] = []
        self._sockets: dict[int, socket.socket] = {}
        self._power_on()

    def _power_on(self) -> None:
        self.values = {
            Key.POINT_TYPE: b"\1",
            Key.PATTERN: b"\0",
            Key.WORK_MODE: bytes([Work.IDLE]),
            Key.WORK_STATE: bytes([Work.IDLE]),
            Key.IMU_ON: b"\1",
            Key.FIRMWARE: bytes([13, 18, 2, 37]),
            Key.TIME_SYNC: b"\0",
            Key.SERIAL: self.serial.encode().ljust(16, b"\0"),
        }

    def start(self) -> None:
        """Open the device's ports. Raises OSError when they are taken."""
        for port in (DISCOVERY_PORT, COMMAND_PORT, PUSH_PORT, POINT_PORT, IMU_PORT):
            sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._sockets[port] = sock
            # the host listens for answers on the same port number of all addresses of this computer
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind((self.ip, port))
            sock.settimeout(0.02)
        for port in (DISCOVERY_PORT, COMMAND_PORT):
            self._spawn(threading.Thread(target=self._serve, args=(port,), daemon=True))

    def stop(self) -> None:
        """Switch off."""
        self._ended.set()
        for thread in self._threads:
            thread.join()
        for sock in self._sockets.values():
            sock.close()

    def __enter__(self) -> VirtualMid360:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def reboot(self) -> None:
        """All values as after switching on."""
        self._power_on()

    def play(self, packets: Iterable[tuple[int, bytes]]) -> None:
        """Send packets in the background, each when the monotonic clock reaches its time (ns)."""
        self._spawn(threading.Thread(target=self._play, args=(packets,), daemon=True))

    def _spawn(self, thread: threading.Thread) -> None:
        self._threads.append(thread)
        thread.start()

    def _serve(self, port: int) -> None:
        sock, pushed = self._sockets[port], 0.0
        while not self._ended.is_set():
            with contextlib.suppress(TimeoutError, ConnectionRefusedError):
                datagram, source = sock.recvfrom(2048)
                for frame in decode(datagram)[0]:
                    if not frame.is_answer and not frame.from_lidar and not self.unplugged:
                        self._answer(sock, frame, source)
            host = HostAddress.decode(self.values.get(Key.STATE_HOST, b""))
            if port == COMMAND_PORT and host is not None and time.monotonic() - pushed > _PUSH_S:
                pushed = time.monotonic()
                state = {int(k): self.values[k] for k in (Key.WORK_STATE, Key.TIME_SYNC)}
                push = Frame(0, Cmd.PUSH, is_answer=False, from_lidar=True, data=encode_values(state))
                self._send(PUSH_PORT, encode(push), (host.ip, host.port))

    def _answer(self, sock: socket.socket, frame: Frame, source: tuple[str, int]) -> None:
        self.counters[f"command_{frame.cmd:04x}"] += 1
        match frame.cmd:
            case Cmd.SEARCH:
                data = Found(0, MID360, self.serial, self.ip, COMMAND_PORT).encode()
            case Cmd.SET:
                data = self._set(decode_values(frame.data))
            case Cmd.GET:
                keys = decode_keys(frame.data)
                data = encode_got(0, {k: self.values[k] for k in keys if k in self.values})
            case Cmd.TIME:
                self.values[Key.TIME_SYNC], data = b"\2", b"\0"
            case _:
                data = b"\1"
        answer = Frame(frame.seq, frame.cmd, is_answer=True, from_lidar=True, data=data)
        sock.sendto(encode(answer), source)

    def _set(self, values: dict[int, bytes]) -> bytes:
        for key, value in values.items():
            if key not in _WRITABLE or key in self.refuse:
                return _UNKNOWN_KEY + key.to_bytes(2, "little")
            self.values[key] = value
            if key == Key.WORK_MODE:
                self.values[Key.WORK_STATE] = value
        return b"\0\0\0"

    def _play(self, packets: Iterable[tuple[int, bytes]]) -> None:
        for due, data in packets:
            left = (due - time.monotonic_ns()) * 1e-9
            if left > 0 and self._ended.wait(left):
                return
            is_imu = data[10] == 0
            host = HostAddress.decode(self.values.get(Key.IMU_HOST if is_imu else Key.POINT_HOST, b""))
            if host is None or self.values[Key.WORK_STATE] != bytes([Work.SAMPLING]) or self.unplugged:
                self.counters["packets_not_sent"] += 1
                continue
            self._send(IMU_PORT if is_imu else POINT_PORT, data, (host.ip, host.port))
            self.counters["packets_sent"] += 1

    def _send(self, port: int, data: bytes, to: tuple[str, int]) -> None:
        if not self.unplugged:
            with contextlib.suppress(OSError):
                self._sockets[port].sendto(data, to)
