"""The thread that serves all Livox LiDARs of the rig: sockets, decoding, sessions.

One thread is enough: it wakes every few milliseconds, drains the data sockets into rings of raw packets, has
compiled code decode them in batches (the interpreter's lock is free meanwhile), and lets the sessions speak.
"""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
import time
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple, Protocol

from artemis_drivers.base import Applied, DriverError, Health, State
from artemis_drivers.livox_dialogue import Datagram
from artemis_drivers.livox_slots import CLOCK_NAMES, IMU_SLOT, POINT_SLOT
from artemis_drivers.ring import Ring, RingMaker
from artemis_drivers.udp import (
    MOST_AT_A_TIME,
    PACKET,
    RECEIVE_BUFFER,
    PacketReceiver,
    open_udp,
    receive_buffer_warning,
)

POLL_S = 0.02  # 50 packets of an Avia; the kernel has stamped them on arrival
_STOP_S = 1.5
_UTC_FIRST, _UTC_END = 946_684_800 * 10**9, 9_025_257_600 * 10**9  # years 2000 to 2255, ns since 1970
PACKET_SLOTS = 8192  # 3.3 s of single returns, 1 s of triple returns
IMU_SLOTS = 2048


class Session(Protocol):
    """What the host thread needs of a session; see AviaSession."""

    state: State
    message: str
    outbox: list[Datagram]
    counters: Counter[str]
    applied: dict[str, Applied]
    device_ip: str

    def start(self, now: int) -> None: ...  # noqa: D102
    def begin_stop(self, now: int) -> None: ...  # noqa: D102
    def hear(self, datagram: bytes, ip: str, now: int) -> None: ...  # noqa: D102
    def data_seen(self, now: int, data_type: int, status_code: int) -> None: ...  # noqa: D102
    def send_utc(self, unix_ns: int) -> None: ...  # noqa: D102
    def tick(self, now: int) -> None: ...  # noqa: D102
    def identity(self) -> dict[str, str]: ...  # noqa: D102
    def status(self) -> dict[str, str]: ...  # noqa: D102
    def resent(self) -> int: ...  # noqa: D102


class Decoder(Protocol):
    """What the host thread needs of a decoder; see livox_avia.points.Decoder."""

    packets: Ring
    points: Ring
    imu: Ring

    def decode(self, first: int, count: int) -> None: ...  # noqa: D102
    def warm_up(self) -> None: ...  # noqa: D102
    def latest(self) -> tuple[int, int, int]: ...  # noqa: D102
    def counters(self) -> dict[str, int]: ...  # noqa: D102


class Finder(Protocol):
    """Discovery of devices on a port of its own."""

    port: int

    def hear(self, datagram: bytes, ip: str, now: int) -> None: ...  # noqa: D102
    def due(self, now: int) -> list[Datagram]: ...  # noqa: D102


class Ports(NamedTuple):
    """Own UDP ports of one LiDAR: for control (the first one sends), and for data."""

    control: tuple[int, ...]
    data: tuple[int, ...]


class LivoxLidar:
    """One LiDAR: its session, its decoder, its rings ``packets`` (raw), ``points`` and ``imu``."""

    def __init__(self, name: str, ports: Ports, session: Session, decoder: Decoder) -> None:
        self.name, self.ports, self.session, self.decoder = name, ports, session, decoder
        self.packets, self.points, self.imu = decoder.packets, decoder.points, decoder.imu
        self.warning = ""
        self._utc: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._control: list[socket.socket] = []
        self._receivers: list[PacketReceiver] = []
        self._last_data = 0

    def open(self) -> None:
        """Open the sockets. Raises DriverError when a port is taken."""
        self.decoder.warm_up()
        self._control.clear()
        self._receivers.clear()
        for port in self.ports.control:
            self._control.append(open_udp(port))
        for port in self.ports.data:
            sock = open_udp(port, receive_buffer=RECEIVE_BUFFER)
            self.warning = receive_buffer_warning(sock)
            self._receivers.append(PacketReceiver(sock, self.packets))

    def close(self) -> None:
        """Close the sockets; the counters stay readable."""
        for sock in [*self._control, *(r.sock for r in self._receivers)]:
            sock.close()

    def send_utc(self, unix_ns: int) -> None:
        """Ask that the PPS edge just passed be named ``unix_ns``; callable from any thread.

        Raises ValueError for times that the protocol cannot express.
        """
        if not _UTC_FIRST <= unix_ns < _UTC_END:
            raise ValueError(f"{unix_ns} ns since 1970 is outside the years 2000 to 2255")
        self._utc.put(unix_ns)

    def receive(self, now: int) -> None:
        """Take in and decode what has arrived."""
        arrived = 0
        for receiver in self._receivers:
            receiver.sender = self.session.device_ip or None
            for _ in range(PACKET_SLOTS // MOST_AT_A_TIME):  # a flood must not keep the session from speaking
                first = self.packets.published
                count = receiver.drain(MOST_AT_A_TIME)
                self.decoder.decode(first, count)
                arrived += count
                if count < MOST_AT_A_TIME:
                    break
        if arrived:
            self._last_data = now
            data_type, status_code, _ = self.decoder.latest()
            self.session.data_seen(now, data_type, status_code)

    def converse(self, now: int) -> None:
        """Let the session hear, think and speak."""
        for sock in self._control:
            for datagram, ip in _waiting(sock):
                self.session.hear(datagram, ip, now)
        with contextlib.suppress(queue.Empty):
            self.session.send_utc(self._utc.get_nowait())
        self.session.tick(now)
        _send(self._control[0], self.session.outbox, self.session.counters)
        self.session.outbox.clear()

    def health(self) -> Health:
        """State, losses and read-back of this LiDAR."""
        session, receivers = self.session, self._receivers
        counters = dict(session.counters) | self.decoder.counters()
        counters["commands_resent"] = session.resent()
        counters["kernel_drops"] = sum(r.kernel_drops for r in receivers)
        counters["packets_truncated"] = sum(r.truncated for r in receivers)
        counters["packets_foreign"] = sum(r.foreign for r in receivers)
        counters["host_clock_set"] = sum(r.clock_set for r in receivers)
        slow = ""
        if counters["kernel_drops"]:
            slow = f"{counters['kernel_drops']} packets came faster than this computer took them: end other programs"
        clock = CLOCK_NAMES.get(self.decoder.latest()[2], "unknown")
        return Health(
            name=self.name,
            state=session.state,
            message=session.message or slow or self.warning,
            counters=counters,
            last_data_ns=self._last_data,
            identity=session.identity(),
            applied=tuple(session.applied.values()),
            status=session.status() | {"clock": clock},
        )


class LivoxHost:
    """Driver of any number of Livox LiDARs of one protocol or both."""

    def __init__(self, lidars: Sequence[LivoxLidar], finders: Sequence[Finder]) -> None:
        self.lidars = tuple(lidars)
        self._finders = tuple(finders)
        self._sockets: list[socket.socket] = []
        self._ending = False
        self._thread: threading.Thread | None = None
        self._fault: BaseException | None = None
        self._finder_counters: Counter[str] = Counter()

    def start(self) -> None:
        """Open all sockets and begin to search. Raises DriverError, and then has opened nothing."""
        try:
            for finder in self._finders:
                sock = open_udp(finder.port)
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
                self._sockets.append(sock)
            for lidar in self.lidars:
                lidar.open()
        except DriverError:
            self._close()
            raise
        now = time.monotonic_ns()
        for lidar in self.lidars:
            lidar.session.start(now)
        self._ending = False
        self._thread = threading.Thread(target=self._run, name="livox", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop sampling, take leave of the devices, close."""
        if self._thread is not None:
            self._ending = True
            self._thread.join()
            self._thread = None
        self._close()

    def health(self) -> tuple[Health, ...]:
        """Health of each LiDAR. Raises what ended the thread, if anything did."""
        if self._fault is not None:
            raise self._fault
        return tuple(lidar.health() for lidar in self.lidars)

    def _run(self) -> None:
        try:
            while not self._ending:
                self._step()
                time.sleep(POLL_S)
            for lidar in self.lidars:
                lidar.session.begin_stop(time.monotonic_ns())
            end = time.monotonic() + _STOP_S
            while time.monotonic() < end and any(x.session.state != State.STOPPED for x in self.lidars):
                self._step()
                time.sleep(POLL_S)
        except BaseException as fault:
            self._fault = fault
            raise

    def _step(self) -> None:
        now = time.monotonic_ns()
        for finder, sock in zip(self._finders, self._sockets, strict=True):
            for datagram, ip in _waiting(sock):
                finder.hear(datagram, ip, now)
            _send(sock, finder.due(now), self._finder_counters)
        for lidar in self.lidars:
            lidar.receive(now)
            lidar.converse(now)

    def _close(self) -> None:
        for sock in self._sockets:
            sock.close()
        self._sockets.clear()
        for lidar in self.lidars:
            lidar.close()


def check_lidars(lidars: Sequence[LivoxLidar]) -> None:
    """Raises DriverError when two LiDARs share a name or a port."""
    names = Counter(lidar.name for lidar in lidars)
    ports = Counter(port for lidar in lidars for port in (*lidar.ports.control, *lidar.ports.data))
    for name, count in names.items():
        if count > 1:
            raise DriverError(f"{count} LiDARs have the same name {name}: give each its own")
    for port, count in ports.items():
        if count > 1:
            raise DriverError(f"{count} LiDARs use the same UDP port {port}: give each its own")


def rings(name: str, make_ring: RingMaker) -> tuple[Ring, Ring, Ring]:
    """Rings ``name.packets``, ``name.points`` and ``name.imu`` of one LiDAR."""
    return (
        make_ring(f"{name}.packets", PACKET, PACKET_SLOTS),
        make_ring(f"{name}.points", POINT_SLOT, PACKET_SLOTS),
        make_ring(f"{name}.imu", IMU_SLOT, IMU_SLOTS),
    )


def _waiting(sock: socket.socket, limit: int = 64) -> list[tuple[bytes, str]]:
    """Datagrams that wait on a control socket, and who sent them."""
    found = []
    for _ in range(limit):
        try:
            datagram, source = sock.recvfrom(2048)
        except BlockingIOError:
            break
        except ConnectionRefusedError:  # an earlier datagram of ours met a closed port
            continue
        found.append((datagram, str(source[0])))
    return found


def _send(sock: socket.socket, outbox: Sequence[Datagram], counters: Counter[str]) -> None:
    for data, address in outbox:
        try:
            sock.sendto(data, address)
        except OSError:  # the cable is out or the route is gone: the session's time-outs deal with it
            counters["send_failed"] += 1
