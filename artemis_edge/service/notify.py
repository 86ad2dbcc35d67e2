"""What systemd is told (sd_notify(3)): datagrams to the socket named by NOTIFY_SOCKET, nothing without it."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Mapping

_SECOND_US = 1_000_000
_STATUS_S = 1.0


class Notifier:
    """``beat_s`` is half the watchdog's period, None without a watchdog."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        ours = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        period = environment.get("WATCHDOG_USEC", "")
        self.beat_s = int(period) / _SECOND_US / 2 if period.isdecimal() and int(period) and ours else None
        self._beaten = float("-inf")
        self._stated = float("-inf")
        self._status = ""

    def ready(self) -> None:
        """The service does its work."""
        self._send("READY=1")

    def status(self, sentence: str) -> None:
        """One line for people, sent when it is another one, once a second at most."""
        now = time.monotonic()
        if sentence != self._status and now - self._stated >= _STATUS_S:
            self._status, self._stated = sentence, now
            self._send(f"STATUS={sentence}")

    def beat(self) -> None:
        """All is well; call it often, it is told at half the watchdog's period."""
        now = time.monotonic()
        if self.beat_s is not None and now - self._beaten >= self.beat_s * 0.8:
            self._beaten = now
            self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """The service is about to end."""
        self._send("STOPPING=1")

    def extend(self, seconds: float) -> None:
        """Ask for so much more time, from now on."""
        self._send(f"EXTEND_TIMEOUT_USEC={round(seconds * _SECOND_US)}")

    def _send(self, text: str) -> None:
        if not self._address:
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            # systemd may be busy: this service is not to wait for it
            sock.sendto(text.encode(), socket.MSG_DONTWAIT, self._address)
