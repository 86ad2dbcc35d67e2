"""Discovery and assembly of Livox Avias for the driver (livox.py)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec

from artemis_drivers.livox_avia.control import AviaSession
from artemis_drivers.livox_avia.payloads import Broadcast
from artemis_drivers.livox_avia.points import Decoder
from artemis_drivers.livox_avia.protocol import DISCOVERY_PORT, General, Kind, decode
from artemis_drivers.livox_avia.settings import AviaConfig
from artemis_drivers.livox_dialogue import Datagram
from artemis_drivers.livox_host import LivoxLidar, Ports, rings
from artemis_drivers.ring import RingMaker, private_ring
from artemis_drivers.udp import Interface, interfaces


class AviaFinder:
    """Hears broadcasts and gives each to the session it belongs to, or to the first that wants any device."""

    port = DISCOVERY_PORT

    def __init__(self, sessions: Sequence[AviaSession]) -> None:
        self._sessions = sessions

    def hear(self, datagram: bytes, ip: str, now: int) -> None:
        """A datagram on the discovery port."""
        for frame in decode(datagram)[0]:
            broadcast = Broadcast.decode(frame.payload)
            if (frame.kind, frame.cmd_set, frame.cmd_id) != (
                Kind.MSG,
                0,
                General.BROADCAST,
            ) or broadcast is None:
                continue
            by_name = sorted(self._sessions, key=lambda s: not s.wants(broadcast.code))
            for session in by_name:
                if session.hear_broadcast(broadcast, ip, now):
                    break

    def due(self, now: int) -> list[Datagram]:
        """Nothing: Avias announce themselves."""
        return []


def avia_lidar(
    config: AviaConfig,
    own_addresses: Callable[[], list[Interface]] = interfaces,
    make_ring: RingMaker = private_ring,
) -> tuple[LivoxLidar, AviaSession]:
    """One Avia for a LivoxHost, and its session for the AviaFinder."""
    session = AviaSession(config, own_addresses)
    ports = Ports((config.command_port,), (config.data_port,))
    return LivoxLidar(config.name, ports, session, Decoder(*rings(config.name, make_ring))), session


def spread_ports(configs: Sequence[AviaConfig]) -> list[AviaConfig]:
    """Ports of the n-th LiDAR moved on as the official SDK does where they would collide."""
    used: set[int] = set()
    spread = []
    for config in configs:
        command_port, data_port = config.command_port, config.data_port
        while command_port in used:
            command_port += 1
        while data_port in used:
            data_port += 1
        used |= {command_port, data_port}
        spread.append(msgspec.structs.replace(config, command_port=command_port, data_port=data_port))
    return spread
