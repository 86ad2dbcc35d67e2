"""Questions and answers on a serial port, while the device may be streaming."""

from __future__ import annotations

import contextlib
import os
import select
import termios
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

import serial

from artemis_drivers.base import DriverError
from artemis_drivers.imu_serial.stream import FrameSplitter, Framing

READ_TIMEOUT_S = 0.05
_CHUNK = 4096


class Port(Protocol):
    """A serial port. ``baudrate`` can be set while it is open."""

    baudrate: int

    def chunk(self, timeout_s: float = READ_TIMEOUT_S) -> bytes:
        """What has arrived, waiting up to ``timeout_s`` for the first byte; OSError if the device is gone."""
        ...

    def write(self, data: bytes) -> None:
        """Send."""
        ...

    def close(self) -> None:
        """Give the port back."""
        ...


class SerialPort:
    """A port of the operating system, for us alone, with the least latency it offers."""

    def __init__(self, path: str, baud: int) -> None:
        """DriverError if it cannot be opened."""
        try:
            self._port = serial.Serial(path, baud, timeout=0, write_timeout=1.0, exclusive=True)
        except (OSError, ValueError) as fault:
            raise DriverError(_why_not(path, fault)) from fault
        # USB converters otherwise hold bytes back for 16 ms; a pseudo terminal has no such mode
        with contextlib.suppress(OSError, ValueError, NotImplementedError):
            self._port.set_low_latency_mode(True)

    @property
    def baudrate(self) -> int:
        """Symbols a second."""
        return int(self._port.baudrate)

    @baudrate.setter
    def baudrate(self, value: int) -> None:
        try:
            self._port.baudrate = value
        except termios.error as fault:
            raise OSError(*fault.args) from fault

    def chunk(self, timeout_s: float = READ_TIMEOUT_S) -> bytes:
        """See Port. Read directly: pyserial asks the system five times for what takes two."""
        descriptor = self._port.fileno()
        ready, _, _ = select.select([descriptor], [], [], timeout_s)
        if not ready:
            return b""
        data = os.read(descriptor, _CHUNK)
        if not data:
            raise OSError("the device is gone")
        return data

    def write(self, data: bytes) -> None:
        """Send."""
        self._port.write(data)

    def close(self) -> None:
        """Give the port back."""
        self._port.close()


class Link:
    """Sends requests and waits for the frame that answers; frames in between are counted and dropped."""

    def __init__(self, port: Port, framing: Framing) -> None:
        self.port = port
        self.other_frames = 0
        self._splitter = FrameSplitter(framing)
        self._waiting: deque[bytes] = deque()

    def ask(self, request: bytes, answers: Callable[[bytes], bool], timeout_s: float) -> bytes | None:
        """The first frame for which ``answers`` is true, or None after the time has passed."""
        self.port.write(request)
        until = time.monotonic() + timeout_s
        while True:
            while self._waiting:
                frame = self._waiting.popleft()
                if answers(frame):
                    return frame
                self.other_frames += 1
            if time.monotonic() > until:
                return None
            chunk = self.port.chunk()
            self._waiting.extend(self._splitter.feed(chunk) if chunk else self._splitter.abandon())


def _why_not(path: str, fault: Exception) -> str:
    text = str(fault)
    if isinstance(fault, FileNotFoundError) or "No such file" in text:
        return f"{path} is not there: plug the IMU in, or correct port"
    if "Permission denied" in text:
        return f"{path} may not be opened: add this user to the group dialout, log out and in"
    if "exclusively lock" in text or "busy" in text:
        return f"{path} is used by another program: stop that one"
    return f"{path} cannot be opened: {text}"
