"""A set of block keys that kernels look up: which blocks are on disk, asked a thousand times a frame."""

from __future__ import annotations

import numpy as np

from artemis_edge._jit import kernel
from artemis_edge.block_store import EMPTY_KEY, block_key, find_slot, remove_key
from artemis_edge.frames import I32, I64

_FIRST_ROOM = 1 << 10
_AROUND = 27  # a block and its neighbours


class KeySet:
    """Keys of blocks (``block_store.block_key``) in an open-addressing table that doubles when it is half full."""

    def __init__(self) -> None:
        self._key = np.full(_FIRST_ROOM, EMPTY_KEY, np.int64)
        self._unused = np.zeros(_FIRST_ROOM, np.int32)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def __contains__(self, key: int) -> bool:
        return bool(self._key[find_slot(self._key, key)] == key)

    def add(self, key: int) -> None:
        """Take a key in, if it is not there."""
        if key in self:
            return
        if 2 * (self._count + 1) > len(self._key):
            self._grow()
        self._key[find_slot(self._key, key)] = key
        self._count += 1

    def remove(self, key: int) -> None:
        """Take out a key that is there."""
        remove_key(self._key, self._unused, find_slot(self._key, key))
        self._count -= 1

    def around(self, block: I32) -> I64:
        """Which of the blocks ``block`` (n, 3) and of their neighbours are in the set: their keys, sorted."""
        found = np.empty(_AROUND * len(block), np.int64)
        return np.unique(found[: list_around(self._key, block, found)])

    def _grow(self) -> None:
        known = self._key[self._key != EMPTY_KEY]
        self._key = np.full(2 * len(self._key), EMPTY_KEY, np.int64)
        self._unused = np.zeros(len(self._key), np.int32)
        for key in known.tolist():
            self._key[find_slot(self._key, key)] = key


@kernel
def list_around(hash_key: I64, block: I32, found: I64) -> int:
    """Kernel of :meth:`KeySet.around`; keys come as often as blocks lie around them. Returns how many."""
    n = 0
    for i in range(block.shape[0]):
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    key = block_key(block[i, 0] + dx, block[i, 1] + dy, block[i, 2] + dz)
                    if hash_key[find_slot(hash_key, key)] == key:
                        found[n] = key
                        n += 1
    return n
