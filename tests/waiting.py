"""Waiting for a thread or another process, with an end."""

import time
from collections.abc import Callable


def until(condition: Callable[[], bool], seconds: float = 10.0, every_s: float = 0.005) -> bool:
    """Whether the condition came true in time."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and not condition():
        time.sleep(every_s)
    return condition()
