"""Checkpoints of the mapping: a forked copy of the process that sleeps, and goes on when the process dies.

A fork copies the whole state, whatever stages the pipeline has, in milliseconds, and memory only as it is changed
afterwards. The copy waits at a pipe whose other end only the working process holds: when that dies, however it does,
the pipe ends and the copy takes its place. What the copy inherits (the ring, the socket to the service) is shared.
A fork copies one thread only: the mapping process has no other.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import signal
import time
from collections.abc import Callable

import numpy as np

_DISMISSED = b"d"
_MOST_DEATHS = 4  # since the last checkpoint, before giving up


class Checkpoints:
    """``take`` one between two frames. ``deaths`` counts how often a copy took over, ``resumed`` since the last take.

    ``reopen`` is called in a copy that takes over, before anything else: for files of its own.
    """

    def __init__(self, reopen: Callable[[], None] = lambda: None) -> None:
        self.deaths = self.taken = 0
        self.fork_ms = 0.0
        self.fatal: set[int] = set()
        self._reopen = reopen
        self._died_at = -1
        self._row = 0
        self._guard: int | None = None
        self._copy = 0
        # what the dead one was doing, seen by its copy: frame index + 1, 0 for nothing
        self._busy = np.frombuffer(mmap.mmap(-1, mmap.PAGESIZE), np.int64, 1)

    def working_on(self, index: int) -> None:
        """Say which frame is about to be mapped; -1: none."""
        self._busy[0] = index + 1

    def take(self) -> bool:
        """Leave a copy behind, and let go of the last one. True in a copy that has taken over; then take again."""
        start = time.perf_counter()
        self._row = 0
        resumed = self._fork()
        if not resumed:
            self.taken += 1
            self.fork_ms = (time.perf_counter() - start) * 1e3
        return resumed

    def close(self) -> None:
        """Let go of the copy."""
        if self._guard is not None:
            with contextlib.suppress(OSError):
                os.write(self._guard, _DISMISSED)
            os.close(self._guard)
            with contextlib.suppress(ChildProcessError):
                os.waitpid(self._copy, 0)
            self._guard = None

    def _fork(self) -> bool:
        self.close()
        read, write = os.pipe()
        copy = os.fork()
        if copy:
            os.close(read)
            self._guard, self._copy = write, copy
            return False
        os.close(write)
        self._wait(read)
        return True

    def _wait(self, read: int) -> None:
        """In the copy: sleep until dismissed, which ends it, or until the other is dead, which returns."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if os.read(read, 1) == _DISMISSED:
            os._exit(0)
        os.close(read)
        self._guard = None
        self.deaths += 1
        self._row += 1
        # once is bad luck (somebody killed it), twice at the same frame is the frame
        index = int(self._busy[0]) - 1
        if index >= 0 and index == self._died_at:
            self.fatal.add(index)
        self._died_at = index
        if self._row > _MOST_DEATHS:
            os._exit(1)
        self._reopen()

    def guard_again(self) -> bool:
        """In a copy that has taken over: a copy of its own. True in that copy when it takes over in its turn."""
        return self._fork()
