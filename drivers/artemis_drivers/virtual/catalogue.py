"""The virtual worlds by name."""

from __future__ import annotations

from collections.abc import Callable

from artemis_drivers.virtual import corridor, courtyard, hall, street
from artemis_drivers.virtual.world import World

#: Builds a world from (seed, length of path in metres that a walk needs at least).
BuildWorld = Callable[[int, float], World]


def worlds() -> dict[str, BuildWorld]:
    """All worlds; each is built with ``worlds()[name](seed, length_m)``."""
    return {
        "street": street.build,
        "courtyard": courtyard.build,
        "hall": hall.build,
        "corridor": corridor.build_corridor,
        "facade": corridor.build_facade,
    }
