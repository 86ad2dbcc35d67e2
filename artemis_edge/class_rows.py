"""What a vertex' row of log-probabilities (``Store.attribute`` from ``LOG_CLASS`` on) says."""

from __future__ import annotations

import numpy as np

from artemis_edge._jit import kernel
from artemis_edge.block_store import CLASSES, LOG_CLASS
from artemis_edge.frames import F32

# A class is clear when it is so much more probable than any other (natural logarithm: nine times)
CLEAR_LOG = 2.2


@kernel
def is_blank(attribute: F32) -> bool:
    """Whether a vertex has no distribution yet."""
    for c in range(CLASSES):  # noqa: SIM110 (kernels have no generators)
        if attribute[LOG_CLASS + c] != 0.0:
            return False
    return True


@kernel
def best_class(attribute: F32) -> int:
    """The most probable class, active or not; of equals the first."""
    best = 0
    for c in range(1, CLASSES):
        if attribute[LOG_CLASS + c] > attribute[LOG_CLASS + best]:
            best = c
    return best


@kernel
def clear_class(attribute: F32) -> int:
    """The class that is clearly more probable than all others, -1 where there is none.

    Classes nobody asked for are as probable as background and count as it.
    """
    best, most, second = 0, np.float32(-np.inf), np.float32(-np.inf)
    for c in range(CLASSES):
        lam = attribute[LOG_CLASS + c]
        if lam > most:
            best, most, second = c, lam, most
        elif lam > second and lam < most:
            second = lam
    return best if second > -np.inf and most - second >= CLEAR_LOG else -1


@kernel
def are_two_objects(one: F32, other: F32) -> bool:
    """Whether two vertices clearly have different classes; never where the map has no classes."""
    if one.shape[0] <= LOG_CLASS:
        return False
    a, b = clear_class(one), clear_class(other)
    return bool(a >= 0 and b >= 0 and a != b)
