"""What systemd is told, seen by a socket in its place."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from artemis_edge.service.notify import Notifier


def _drain(sock: socket.socket) -> list[str]:
    sock.setblocking(False)
    said = []
    try:
        while True:
            said.append(sock.recv(4096).decode())
    except BlockingIOError:
        return said


@pytest.mark.parametrize("abstract", [False, True])
def test_everything_is_told(tmp_path: Path, abstract: bool) -> None:
    name = f"@artemis-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind("\0" + name[1:] if abstract else name)
        notify = Notifier(
            {"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "60000000", "WATCHDOG_PID": str(os.getpid())}
        )
        notify.ready()
        notify.status("idle")
        notify.status("idle")
        notify.status("recording")  # too soon
        notify.beat()
        notify.beat()
        notify.extend(1.5)
        notify.stopping()
        assert _drain(sock) == [
            "READY=1",
            "STATUS=idle",
            "WATCHDOG=1",
            "EXTEND_TIMEOUT_USEC=1500000",
            "STOPPING=1",
        ]
    assert notify.beat_s == 30.0
    notify.ready()  # nobody listens any more


def test_without_systemd_nothing_is_told() -> None:
    notify = Notifier({})
    notify.ready()
    notify.beat()
    assert notify.beat_s is None
    assert Notifier({"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "5000000", "WATCHDOG_PID": "1"}).beat_s is None
    assert Notifier({"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "soon"}).beat_s is None
