"""The driver of all Livox LiDARs of a rig, Avia and Mid-360."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from artemis_drivers.livox_avia.driver import AviaFinder, avia_lidar, spread_ports
from artemis_drivers.livox_avia.settings import AviaConfig
from artemis_drivers.livox_host import Finder, LivoxHost, check_lidars
from artemis_drivers.livox_mid360.driver import EVERYBODY, Mid360Finder, mid360_lidar
from artemis_drivers.livox_mid360.settings import Mid360Config
from artemis_drivers.ring import RingMaker, private_ring
from artemis_drivers.udp import Interface, interfaces


def livox_driver(
    avias: Sequence[AviaConfig] = (),
    mid360s: Sequence[Mid360Config] = (),
    *,
    own_addresses: Callable[[], list[Interface]] = interfaces,
    search_address: str = EVERYBODY,
    make_ring: RingMaker = private_ring,
) -> LivoxHost:
    """Driver of all Livox LiDARs of a rig; ``make_ring`` may put their rings into shared memory.

    Raises DriverError when two configurations contradict each other.
    """
    first = [avia_lidar(c, own_addresses, make_ring) for c in spread_ports(avias)]
    second = [mid360_lidar(c, own_addresses, make_ring) for c in mid360s]
    lidars = [lidar for lidar, _ in first] + [lidar for lidar, _ in second]
    check_lidars(lidars)
    finders: list[Finder] = []
    if first:
        finders.append(AviaFinder([session for _, session in first]))
    if second:
        finders.append(Mid360Finder([session for _, session in second], search_address))
    return LivoxHost(lidars, finders)
