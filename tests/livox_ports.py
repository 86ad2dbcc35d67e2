"""The Livox protocols have fixed port numbers, so only one test run on a computer may use them at a time."""

import fcntl
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def reserved() -> Iterator[None]:
    """Wait for our turn, and keep others waiting meanwhile."""
    with (Path(tempfile.gettempdir()) / "artemis-edge-livox-ports.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
