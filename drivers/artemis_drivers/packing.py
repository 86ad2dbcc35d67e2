"""What devices sent, one packet after the other: the filled parts of slots of a ring."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import njit


def joined_bytes(packets: dict[str, NDArray[np.generic]]) -> memoryview:
    """All packets read from a ring with fields ``size`` (n,) and ``data`` (n, bytes)."""
    size = packets["size"].astype(np.int64)
    joined = np.empty(int(size.sum()), np.uint8)
    _join(packets["data"].astype(np.uint8, copy=False), size, joined)
    return joined.data


@njit
def _join(data: NDArray[np.uint8], size: NDArray[np.int64], joined: NDArray[np.uint8]) -> None:
    at = 0
    for k in range(size.size):
        joined[at : at + size[k]] = data[k, : size[k]]
        at += size[k]
