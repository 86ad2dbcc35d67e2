"""A ring of fixed slots between one producer and any number of readers, also across processes.

The producer never waits: when a reader is too slow the oldest slots are overwritten, and that reader's ``lost``
says how many it missed. Each field of a slot is an array of its own, (slots, ...), which compiled kernels fill
directly. Slots are numbered from 0 without end; slot ``n`` lives in row ``n % slots``.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LINE = 64  # bytes of a cache line: fields begin on one, and the header has one of its own
_CLAIMED, _PUBLISHED = 0, 1


def _aligned(size: int) -> int:
    return -(-size // _LINE) * _LINE


class Ring:
    """Slots described by a structured dtype, in ordinary or in shared memory.

    Two numbers keep reader and producer apart: slots below ``claimed - slots`` may be overwritten at any time,
    slots below ``published`` are complete. A reader copies first and afterwards discards what was claimed
    meanwhile.
    """

    def __init__(self, dtype: np.dtype[np.void], slots: int, buffer: memoryview | None = None) -> None:
        """``buffer`` must have ``nbytes(dtype, slots)`` bytes: zeros for a new ring, or that of a ring in use."""
        if slots < 1 or dtype.names is None:
            raise ValueError("a ring needs at least one slot and a structured dtype")
        memory = buffer if buffer is not None else memoryview(bytearray(self.nbytes(dtype, slots)))
        if memory.nbytes < self.nbytes(dtype, slots):
            raise ValueError(f"the ring needs {self.nbytes(dtype, slots)} bytes, got {memory.nbytes}")
        self.slots = slots
        self.dtype = dtype
        self._head: NDArray[np.int64] = np.frombuffer(memory, np.int64, 2)
        self.field: dict[str, NDArray[Any]] = {}
        offset = _LINE
        for name in dtype.names:
            sub = dtype[name]
            flat = np.frombuffer(memory, sub.base, slots * (sub.itemsize // sub.base.itemsize), offset)
            self.field[name] = flat.reshape(slots, *sub.shape)
            offset += _aligned(slots * sub.itemsize)
        # taking a lock orders memory on every CPU: slots are written before the number that announces them
        self._fence = threading.Lock()

    @staticmethod
    def nbytes(dtype: np.dtype[np.void], slots: int) -> int:
        """Bytes of memory of a ring."""
        return _LINE + sum(_aligned(slots * dtype[name].itemsize) for name in dtype.names or ())

    @property
    def published(self) -> int:
        """Number of slots ever published: the number of the next one."""
        return int(self._head[_PUBLISHED])

    def claim(self, count: int) -> int:
        """Announce that up to ``count`` slots are about to be written; returns the number of the first."""
        if not 0 <= count <= self.slots:
            raise ValueError(f"cannot claim {count} of {self.slots} slots")
        first = self.published
        with self._fence:
            self._head[_CLAIMED] = max(int(self._head[_CLAIMED]), first + count)
        return first

    def publish(self, count: int, *, touched: int = 0) -> None:
        """Give the first ``count`` claimed slots to the readers; the other claims lapse.

        ``touched``: how many of the claimed slots were written to, when that is more than are published.
        """
        first = self.published
        claimed = int(self._head[_CLAIMED])
        if not 0 <= count <= claimed - first:
            raise ValueError(f"cannot publish {count} slots that were not claimed")
        with self._fence:
            self._head[_PUBLISHED] = first + count
            self._head[_CLAIMED] = min(claimed, first + max(count, touched))

    def append(self, values: Mapping[str, Any]) -> None:
        """Write and publish one slot (for slow streams; fast ones claim, fill and publish many)."""
        row = self.claim(1) % self.slots
        for name, value in values.items():
            self.field[name][row] = value
        self.publish(1)

    def extend(self, rows: Sequence[Sequence[object]]) -> None:
        """Write and publish slots, each with its values in the order of the fields."""
        for begin in range(0, len(rows), self.slots):
            part = rows[begin : begin + self.slots]
            start = self.claim(len(part)) % self.slots
            head = min(len(part), self.slots - start)  # what is left goes to the first rows
            for array, column in zip(self.field.values(), zip(*part, strict=True), strict=True):
                array[start : start + head] = column[:head]
                if head < len(part):
                    array[: len(part) - head] = column[head:]
            self.publish(len(part))

    def oldest(self) -> int:
        """Number of the oldest slot that is certainly intact."""
        with self._fence:
            return max(0, int(self._head[_CLAIMED]) - self.slots)


RingMaker = Callable[[str, "np.dtype[np.void]", int], Ring]
"""Makes a ring from its name, slot type and number of slots; the name tells apart rings in shared memory."""


def private_ring(name: str, dtype: np.dtype[np.void], slots: int) -> Ring:
    """A RingMaker for rings that stay in this process."""
    return Ring(dtype, slots)


class RingReader:
    """A reader's place in a ring. ``lost`` counts slots overwritten before this reader came."""

    def __init__(self, ring: Ring, *, from_oldest: bool = False) -> None:
        self.ring = ring
        self.next = ring.oldest() if from_oldest else ring.published
        self.lost = 0

    def waiting(self) -> int:
        """Published slots not yet read, those already overwritten included."""
        return self.ring.published - self.next

    def read(self, limit: int | None = None) -> tuple[int, dict[str, NDArray[Any]]]:
        """Copies of up to ``limit`` next slots in order: number of the first, and an array (n, ...) a field."""
        ring = self.ring
        self._skip_to(ring.oldest())
        stop = ring.published if limit is None else min(ring.published, self.next + limit)
        first = self.next
        start, end = first % ring.slots, first % ring.slots + stop - first
        if end <= ring.slots:
            copy = {name: array[start:end].copy() for name, array in ring.field.items()}
        else:
            rows = np.arange(first, stop) % ring.slots
            copy = {name: array[rows] for name, array in ring.field.items()}
        overwritten = min(max(0, ring.oldest() - first), stop - first)
        self._skip_to(first + overwritten)
        self.next = max(self.next, stop)
        return first + overwritten, {name: array[overwritten:] for name, array in copy.items()}

    def _skip_to(self, number: int) -> None:
        if number > self.next:
            self.lost += number - self.next
            self.next = number
