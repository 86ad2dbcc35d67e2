"""The service's processes: started with what they inherit, heard and told by JSON lines."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

import msgspec
from msgspec import Struct

from artemis_edge.session.line_channel import LineChannel

# One thread each: a pool that spins takes the core that others need (docs/tuning.md).
_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


class Child:
    """A process of ours that runs a module; it is told its task and inherits the ``descriptors`` and a socket."""

    def __init__(self, module: str, descriptors: Sequence[int], task: Struct, nice: int = 0) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            inherited = [*descriptors, theirs.fileno()]
            words = [*map(str, inherited), msgspec.json.encode(task).decode()]
            self.process = subprocess.Popen(
                [sys.executable, "-m", module, *words],
                pass_fds=inherited,
                env={**os.environ, **_ENVIRONMENT},
                stdin=subprocess.DEVNULL,
                process_group=0,
            )
        if nice:
            os.setpriority(os.PRIO_PROCESS, self.process.pid, nice)
        self.module, self.channel = module, LineChannel(ours)
        self.latest: dict[str, Any] = {}
        self.heard_s = time.monotonic()

    def tell(self, what: str, **values: Any) -> None:
        """Send an order."""
        self.channel.say({"do": what, **values})

    def hear(self) -> list[dict[str, Any]]:
        """Lines that it has said; ``latest`` keeps the last that says its state."""
        lines = self.channel.lines()
        for line in lines:
            self.heard_s = time.monotonic()
            if "state" in line:
                self.latest = line
        return lines

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self.process.poll() is None

    def wait(self, seconds: float) -> bool:
        """Whether it ended in so many seconds."""
        end = time.monotonic() + seconds
        while self.alive and time.monotonic() < end:
            self.hear()
            time.sleep(0.01)
        self.hear()
        return not self.alive

    def end(self, seconds: float) -> None:
        """Wait for its own end, then end it."""
        if not self.wait(seconds):
            self.process.kill()
        self.process.wait()
        self.channel.socket.close()
