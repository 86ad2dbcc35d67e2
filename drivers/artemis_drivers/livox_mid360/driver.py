"""Discovery and assembly of Livox Mid-360 for the driver (livox.py)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from artemis_drivers.livox_dialogue import MS, Datagram
from artemis_drivers.livox_host import LivoxLidar, Ports, rings
from artemis_drivers.livox_mid360.control import Mid360Session
from artemis_drivers.livox_mid360.points import Decoder
from artemis_drivers.livox_mid360.protocol import DISCOVERY_PORT, Cmd, Found, Frame, decode, encode
from artemis_drivers.livox_mid360.settings import Mid360Config
from artemis_drivers.ring import RingMaker, private_ring
from artemis_drivers.udp import Interface, interfaces

SEARCH_EVERY_NS = 1000 * MS
EVERYBODY = "255.255.255.255"


class Mid360Finder:
    """Searches while a session lacks its device, and gives each answer to the session it belongs to."""

    port = DISCOVERY_PORT

    def __init__(self, sessions: Sequence[Mid360Session], search_address: str = EVERYBODY) -> None:
        self._sessions, self._address = sessions, search_address
        self._searched = -SEARCH_EVERY_NS
        self._seq = 0

    def hear(self, datagram: bytes, ip: str, now: int) -> None:
        """A datagram on the discovery port (our own search comes back too)."""
        for frame in decode(datagram)[0]:
            found = Found.decode(frame.data)
            if frame.cmd != Cmd.SEARCH or not frame.is_answer or found is None or found.ret != 0:
                continue
            for session in sorted(self._sessions, key=lambda s: not s.wants(found.serial)):
                if session.hear_found(found, ip, now):
                    break

    def due(self, now: int) -> list[Datagram]:
        """A search, once a second while somebody is missing."""
        if now - self._searched < SEARCH_EVERY_NS or not any(s.searching() for s in self._sessions):
            return []
        self._searched = now
        self._seq += 1
        frame = Frame(self._seq & 0xFFFFFFFF, Cmd.SEARCH, is_answer=False, from_lidar=False)
        return [Datagram(encode(frame), (self._address, DISCOVERY_PORT))]


def mid360_lidar(
    config: Mid360Config,
    own_addresses: Callable[[], list[Interface]] = interfaces,
    make_ring: RingMaker = private_ring,
) -> tuple[LivoxLidar, Mid360Session]:
    """One Mid-360 for a LivoxHost, and its session for the Mid360Finder."""
    session = Mid360Session(config, own_addresses)
    ports = Ports((config.command_port, config.push_port), (config.point_port, config.imu_port))
    return LivoxLidar(config.name, ports, session, Decoder(*rings(config.name, make_ring))), session
