"""What the board reports, as rows of rings."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Kind(IntEnum):
    """What an event is: field ``kind`` of TRIGGER_EVENT."""

    TRIGGER = 1
    PPS = 2
    STROBE = 3
    BUTTON = 4


TRIGGER_EVENT = np.dtype(
    [
        ("kind", "u1"),
        ("count", "i8"),
        ("series", "i4"),
        ("t_us", "u4"),
        ("board_ns", "i8"),
        ("boot", "i4"),
        ("rx_ns", "i8"),
        ("flags", "u1"),
        ("camera", "u1"),
        ("delay_us", "u2"),
        ("width_us", "u2"),
    ]
)
"""An edge: count of its kind without wraps (a new ``series`` counts from 0), capture as sent and as board
time without wraps (times of different ``boot`` cannot be compared), host time of arrival. A strobe names the
trigger's count, camera, delay and width; a button its number as count and 1 for pressed as flags."""

CAN_FRAME = np.dtype([("rx_ns", "i8"), ("id", "u4"), ("size", "u1"), ("data", "u1", (8,))])
"""A frame as received."""
EVENTS_SLOTS = 4096
