"""A serial device on a pseudo terminal that can be unplugged and plugged in again under the same name."""

from __future__ import annotations

import os
import select
import termios
import tty
from pathlib import Path

_SPEEDS = {
    termios.B115200: 115_200,
    termios.B230400: 230_400,
    termios.B460800: 460_800,
    termios.B921600: 921_600,
    termios.B2000000: 2_000_000,
}


class WirePort:
    """The device's end. ``path`` is a symbolic link, as those of /dev/serial/by-id, that drivers open."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.overrun_bytes = 0  # bytes nobody read, as on a UART
        self._master = self._slave = -1

    @property
    def plugged(self) -> bool:
        """Whether the port exists."""
        return self._master >= 0

    def plug(self) -> None:
        """Make the port appear."""
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        """Make it disappear: whoever has it open gets an input/output error."""
        if self.plugged:
            self.path.unlink(missing_ok=True)
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1

    def baud(self) -> int:
        """The speed that the other end has set; 0 for one we do not know."""
        return _SPEEDS.get(termios.tcgetattr(self._master)[4], 0)

    def write(self, data: bytes) -> None:
        """Send without waiting; what does not fit is lost and counted."""
        try:
            sent = os.write(self._master, data)
        except BlockingIOError:
            sent = 0
        self.overrun_bytes += len(data) - sent

    def read(self, timeout_s: float) -> bytes:
        """What the other end has sent, waiting up to ``timeout_s``."""
        ready, _, _ = select.select([self._master], [], [], max(0.0, timeout_s))
        return os.read(self._master, 4096) if ready else b""
