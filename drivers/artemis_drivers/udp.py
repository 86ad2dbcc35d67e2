"""UDP sockets that say what is wrong: who holds a port, which subnet is missing, what the kernel dropped."""

from __future__ import annotations

import array
import errno
import fcntl
import ipaddress
import socket
import struct
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_drivers.base import DriverError
from artemis_drivers.ring import Ring

PACKET_BYTES = 1500  # one Ethernet frame; Livox packets have at most 1362 bytes
PACKET = np.dtype([("rx_ns", "i8"), ("size", "i4"), ("data", "u1", (PACKET_BYTES,))])
"""A datagram as received: ``rx_ns`` is the kernel's stamp, moved to the host's monotonic clock."""

RECEIVE_BUFFER = 8 << 20  # bytes: 1.5 s of 2500 packets/s, so that a pause of the interpreter costs nothing
_SO_RXQ_OVFL = 40
_SO_TIMESTAMPNS = 35
_SIOCGIFADDR, _SIOCGIFNETMASK = 0x8915, 0x891B
_ANCILLARY = socket.CMSG_SPACE(16) + socket.CMSG_SPACE(4)
_STAMP = struct.Struct("qq")
_TRUNCATED = int(socket.MSG_TRUNC)  # an enum's own bits are found ten times as slowly
_MAX_AGE_NS = 10_000_000_000  # an older kernel stamp means that the host's clock was set meanwhile


class Interface(NamedTuple):
    """An address of this computer: ``network`` as in 192.168.1.0/24."""

    name: str
    address: ipaddress.IPv4Address
    network: ipaddress.IPv4Network


def interfaces() -> list[Interface]:
    """IPv4 addresses of this computer's network interfaces (Linux)."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for _, name in socket.if_nameindex():
            request = struct.pack("256s", name.encode()[:15])
            try:
                address = fcntl.ioctl(sock, _SIOCGIFADDR, request)[20:24]
                mask = fcntl.ioctl(sock, _SIOCGIFNETMASK, request)[20:24]
            except OSError:  # an interface without an IPv4 address
                continue
            ip = ipaddress.IPv4Address(address)
            network = ipaddress.IPv4Network((ip, str(ipaddress.IPv4Address(mask))), strict=False)
            found.append(Interface(name, ip, network))
    return found


def address_facing(device: str, own: list[Interface]) -> str | None:
    """This computer's address in the network of ``device``, or None when it has none there."""
    ip = ipaddress.IPv4Address(device)
    facing = [i for i in own if ip in i.network]
    # the narrowest network is the one the kernel routes to
    return str(max(facing, key=lambda i: i.network.prefixlen).address) if facing else None


def port_holder(port: int) -> str:
    """Who has bound a UDP port: ``name (process id)``, or what is known of it."""
    inodes = set()
    for line in Path("/proc/net/udp").read_text().splitlines()[1:]:
        part = line.split()
        if int(part[1].rpartition(":")[2], 16) == port:
            inodes.add(f"socket:[{part[9]}]")
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if any(str(fd.readlink()) in inodes for fd in (process / "fd").iterdir()):
                return f"{(process / 'comm').read_text().strip()} (process {process.name})"
        except OSError:  # another user's process, or one that has just ended
            continue
    return "a process of another user" if inodes else "an unknown process"


def open_udp(port: int, address: str = "", *, receive_buffer: int = 0) -> socket.socket:
    """Bound, non-blocking UDP socket; with ``receive_buffer`` also kernel stamps and the drop counter.

    Raises DriverError when the port is taken (naming the holder) or may not be bound.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        if receive_buffer:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
            sock.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
            sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        sock.bind((address, port))
    except OSError as fault:
        sock.close()
        if fault.errno == errno.EADDRINUSE:
            raise DriverError(
                f"UDP port {port} is held by {port_holder(port)}: stop that program and start again"
            ) from fault
        if fault.errno == errno.EADDRNOTAVAIL:
            raise DriverError(
                f"{address} is no address of this computer: correct host_ip or give it to the network port"
            ) from fault
        raise DriverError(f"UDP port {port} cannot be opened: {fault.strerror or fault}") from fault
    sock.setblocking(False)
    return sock


def receive_buffer_warning(sock: socket.socket, wanted: int = RECEIVE_BUFFER) -> str:
    """A sentence when the kernel gave a smaller receive buffer than asked for, else an empty string."""
    got = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2  # the kernel doubles what it was asked
    if got >= min(wanted, RECEIVE_BUFFER // 2):
        return ""
    return (
        f"the kernel allows a receive buffer of {got // 1024} KiB only, so packets may be lost: "
        f"run 'sysctl -w net.core.rmem_max={4 * RECEIVE_BUFFER}'"
    )


class PacketReceiver:
    """Drains one data socket into a ring of ``PACKET`` slots.

    ``kernel_drops`` is the kernel's own count of datagrams it had to throw away; ``truncated`` counts
    datagrams longer than a slot, ``foreign`` those of another sender than ``sender``.
    """

    def __init__(self, sock: socket.socket, ring: Ring) -> None:
        self.sock = sock
        self.ring = ring
        self.sender: str | None = None
        self.kernel_drops = 0
        self.truncated = 0
        self.foreign = 0
        self.clock_set = 0
        self._rows = [memoryview(row) for row in ring.field["data"]]
        self._real_minus_monotonic = 0

    def drain(self, limit: int) -> int:
        """Receive up to ``limit`` waiting datagrams; returns how many slots were published."""
        ring, size, rx = self.ring, self.ring.field["size"], self.ring.field["rx_ns"]
        limit = min(limit, ring.slots)
        first = ring.claim(limit)
        began = time.monotonic_ns()
        self._real_minus_monotonic = time.time_ns() - began
        count = 0
        for _ in range(limit):
            row = (first + count) % ring.slots
            try:
                n, ancillary, flags, source = self.sock.recvmsg_into([self._rows[row]], _ANCILLARY)
            except BlockingIOError:
                break
            except ConnectionRefusedError:  # an earlier answer of ours met a closed port
                continue
            rx[row] = self._stamp(ancillary, began)
            if flags & _TRUNCATED:
                self.truncated += 1
            elif self.sender is not None and source[0] != self.sender:
                self.foreign += 1
            else:
                size[row] = n
                count += 1
        ring.publish(count, touched=count + 1)  # a datagram not taken lies in the next slot
        return count

    def _stamp(self, ancillary: list[tuple[int, int, bytes]], began: int) -> int:
        """When a datagram arrived; most of them before the draining ``began``."""
        stamp = 0
        for _, kind, data in ancillary:
            if kind == _SO_TIMESTAMPNS:
                seconds, nanoseconds = _STAMP.unpack(data)
                stamp = seconds * 1_000_000_000 + nanoseconds - self._real_minus_monotonic
            elif kind == _SO_RXQ_OVFL:
                self.kernel_drops = array.array("I", data)[0]
        if began - _MAX_AGE_NS < stamp <= began:
            return stamp
        now = time.monotonic_ns()
        if now - _MAX_AGE_NS < stamp <= now + 1_000_000:
            return min(stamp, now)
        self.clock_set += 1
        return now


def packet_bytes(packets: dict[str, NDArray[np.generic]]) -> list[bytes]:
    """The datagrams of slots read from a packet ring, as bytes."""
    return [row[:n].tobytes() for row, n in zip(packets["data"], packets["size"].tolist(), strict=True)]


def joined_bytes(packets: dict[str, NDArray[np.generic]]) -> bytes:
    """All of them, one after the other; in one copy where they are of one size, as a LiDAR's are."""
    size = packets["size"]
    if len(size) and bool((size == size[0]).all()):
        return packets["data"][:, : int(size[0])].tobytes()
    return b"".join(packet_bytes(packets))
