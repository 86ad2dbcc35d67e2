"""``artemis-edge run`` in a process of its own, and what it says to a socket in systemd's place."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

from artemis_edge.session.wire_replay import WireRig
from tests.control_client import ask

PATIENCE_S = 180.0


class Service:
    """The service for the devices of a virtual rig, recording into ``session``; ``tmp`` takes its log."""

    def __init__(self, rig: WireRig, session: Path, tmp: Path) -> None:
        self.path = rig.folder / "control"
        self.notified: list[str] = []
        self._notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._notify.bind(str(tmp / "notify"))
        self._notify.setblocking(False)
        self.log = (tmp / "log").open("w+")
        words = ["run", "--config", str(rig.folder / "rig.toml"), "--session", str(session)]
        environment = {"NOTIFY_SOCKET": str(tmp / "notify"), "WATCHDOG_USEC": "2000000"}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "artemis_edge.cli", *words],
            env={**os.environ, **environment},
            stderr=self.log,
        )

    def state(self) -> dict[str, Any]:
        """Everything it tells clients."""
        self.heard()
        return dict(ask(self.path, do="state")["result"])

    def listens(self) -> bool:
        """Whether it has told systemd that it is ready."""
        return "READY=1" in self.heard() and self.process.poll() is None

    def heard(self) -> list[str]:
        """What systemd was told."""
        try:
            while True:
                self.notified.append(self._notify.recv(4096).decode())
        except BlockingIOError:
            return self.notified

    def said(self) -> str:
        """Its log."""
        self.log.flush()
        self.log.seek(0)
        return self.log.read()

    def end(self) -> None:
        """At once."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self.log.close()
        self._notify.close()
