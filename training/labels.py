"""The classes that the network tells apart, and which class of the worlds each is."""

from __future__ import annotations

import numpy as np
from artemis_drivers.virtual.mesh_builder import CLASS_NAMES
from numpy.typing import NDArray

IGNORED = 255
#: A beam passes a pane and meets what is behind it; a window is a part of its building.
_TAKEN_FOR = {"glass": "building"}
#: Background (the sky, or nothing) first.
NETWORK_CLASSES = tuple(name for name in CLASS_NAMES if name not in _TAKEN_FOR)


def to_network() -> NDArray[np.uint8]:
    """uint8 (256,): the network's class of each class of the worlds, IGNORED for all other numbers."""
    table = np.full(256, IGNORED, np.uint8)
    for k, name in enumerate(CLASS_NAMES):
        table[k] = NETWORK_CLASSES.index(_TAKEN_FOR.get(name, name))
    return table
