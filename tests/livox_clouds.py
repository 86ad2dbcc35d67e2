"""Points collected from slots as a session holds them, in columns."""

import numpy as np
from artemis_drivers.livox_slots import Slots, collect

from artemis_edge.session.writer import POINT


def window(slots: Slots, start_ns: int, end_ns: int) -> np.ndarray:
    """Points of a time window of device time."""
    return collect([(slots, 0)], start_ns, end_ns, POINT)


def xyz(cloud: np.ndarray) -> np.ndarray:
    """Coordinates (n, 3)."""
    return np.column_stack([cloud[axis] for axis in "xyz"])
