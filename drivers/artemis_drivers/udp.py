"""UDP sockets that say what is wrong: who holds a port, which subnet is missing, what the kernel dropped."""

from __future__ import annotations

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
from artemis_drivers.datagrams import SO_RXQ_OVFL, SO_TIMESTAMPNS, Datagrams
from artemis_drivers.ring import Ring

PACKET_BYTES = 1500  # one Ethernet frame; Livox packets have at most 1362 bytes
PACKET = np.dtype([("rx_ns", "i8"), ("size", "i4"), ("data", "u1", (PACKET_BYTES,))])
"""A datagram as received: ``rx_ns`` is the kernel's stamp, moved to the host's monotonic clock."""

RECEIVE_BUFFER = 8 << 20  # bytes: 1.5 s of 2500 packets/s, so that a pause of the interpreter costs nothing
_SIOCGIFADDR, _SIOCGIFNETMASK = 0x8915, 0x891B
_MAX_AGE_NS = 10_000_000_000  # an older kernel stamp means that the host's clock was set meanwhile
_AHEAD_NS = 1_000_000  # the two clocks are read one after the other
MOST_AT_A_TIME = 256


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
            sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
            sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
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
        self._datagrams = Datagrams(ring.field["data"], min(MOST_AT_A_TIME, ring.slots))

    def drain(self, limit: int) -> int:
        """Receive up to ``limit`` (MOST_AT_A_TIME) waiting datagrams; returns how many slots were published."""
        ring, got = self.ring, self._datagrams
        limit = min(limit, ring.slots, MOST_AT_A_TIME)
        first = ring.claim(limit)
        count = got.receive(self.sock, first % ring.slots, limit)
        if count == 0:
            ring.publish(0)
            return 0
        rows = (first + np.arange(count)) % ring.slots
        ring.field["rx_ns"][rows] = self._monotonic(got.stamps_ns(count))
        ring.field["size"][rows] = got.sizes(count)
        self.kernel_drops = got.drops(count) or self.kernel_drops
        wanted = self._wanted(count)
        kept = int(np.count_nonzero(wanted))
        if kept < count:
            for field in ring.field.values():
                field[rows[:kept]] = field[rows[wanted]]
        ring.publish(kept, touched=count)
        return kept

    def _wanted(self, count: int) -> NDArray[np.bool_]:
        """Which datagrams are whole and from the device."""
        truncated = self._datagrams.truncated(count)
        self.truncated += int(np.count_nonzero(truncated))
        if self.sender is None:
            return ~truncated
        own = np.frombuffer(socket.inet_aton(self.sender), np.uint8)
        foreign = (self._datagrams.senders(count) != own).any(axis=1) & ~truncated
        self.foreign += int(np.count_nonzero(foreign))
        wanted: NDArray[np.bool_] = ~(truncated | foreign)
        return wanted

    def _monotonic(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """When datagrams arrived by the monotonic clock; now, where the kernel's stamp cannot be."""
        now = time.monotonic_ns()
        arrived = stamps_ns - (time.time_ns() - now)
        known = (now - _MAX_AGE_NS < arrived) & (arrived <= now + _AHEAD_NS)
        self.clock_set += int(np.count_nonzero(~known))
        return np.where(known, np.minimum(arrived, now), now)


def packet_bytes(packets: dict[str, NDArray[np.generic]]) -> list[bytes]:
    """The datagrams of slots read from a packet ring, as bytes."""
    return [row[:n].tobytes() for row, n in zip(packets["data"], packets["size"].tolist(), strict=True)]
