"""The life of a virtual device behind a pseudo terminal: its thread, and being unplugged and plugged in again."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from pathlib import Path

from artemis_drivers.virtual.wire_port import WirePort


class WireDevice(ABC):
    """A device on a pseudo terminal at ``path``. ``_lock`` is held in ``_turn``; others may call any time."""

    def __init__(self, path: Path, name: str) -> None:
        self.port = WirePort(path)
        self._name = name
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @abstractmethod
    def _turn(self) -> float:
        """Do what is due; returns for how many seconds there is nothing to do."""

    @abstractmethod
    def _unplugged(self) -> None:
        """What the device loses with its port."""

    def start(self) -> None:
        """Plug in and run in a thread."""
        self.port.plug()
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Unplug and end the thread."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self.unplug()

    def unplug(self) -> None:
        """The port vanishes."""
        with self._lock:
            self.port.unplug()
            self._unplugged()

    def replug(self) -> None:
        """The port is back."""
        with self._lock:
            self.port.plug()

    def _run(self) -> None:
        while not self._stop.is_set():
            with self._lock:
                wait_s = self._turn()
            self._stop.wait(wait_s)
