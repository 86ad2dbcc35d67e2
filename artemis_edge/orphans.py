"""What becomes of processes whose parent dies (Linux only; elsewhere they go on to their end)."""

from __future__ import annotations

import contextlib
import ctypes
import os

_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36


def end_with_the_parent(number: int, parent: int | None = None) -> None:
    """Have signal ``number`` end this process when its parent dies; at once where ``parent`` (pid) is dead already.

    A forked copy of this process does not inherit it.
    """
    _prctl(_PR_SET_PDEATHSIG, number)
    if parent is not None and os.getppid() != parent:  # it died while this one began
        os.kill(os.getpid(), number)


def adopt_orphans() -> None:
    """Become the parent of what descends from this process and has lost its own, so that it can be waited for."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)


def _prctl(option: int, value: int) -> None:
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(option, value)
