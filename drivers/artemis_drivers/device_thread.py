"""A driver of one device that is read in a thread of its own, and looked for again whenever it is gone."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Mapping

from artemis_drivers.base import Applied, DriverError, Health, State

_RETRY_S = (0.1, 0.2, 0.4, 0.8)  # back-off; the last one holds


class DeviceThread(ABC):
    """The life of such a driver (base.Driver): thread, state, and what it says of itself."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._state, self._message = State.STOPPED, ""
        self._applied: tuple[Applied, ...] = ()
        self._last_data_ns = 0

    @abstractmethod
    def _run(self) -> None:
        """Until ``_stop`` is set: connect, read, and start over."""

    @abstractmethod
    def _counters(self) -> Mapping[str, int]:
        """For Health."""

    @abstractmethod
    def _status(self) -> Mapping[str, str]:
        """For Health."""

    def start(self) -> None:
        """Begin to look for the device; it may be plugged in later."""
        if self._thread is not None:
            raise DriverError(f"{self._name} runs already: stop it before starting it again")
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Send what is waiting, close the device and end the thread."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._become(State.STOPPED)

    def health(self) -> tuple[Health, ...]:
        """One device; its identity is what was read without being asked for a value."""
        identity = {item.item: item.read_back for item in self._applied if item.requested == "any"}
        return (
            Health(
                self._name,
                self._state,
                self._message,
                self._counters(),
                self._last_data_ns,
                identity,
                self._applied,
                self._status(),
            ),
        )

    def _become(self, state: State, message: str = "") -> None:
        self._state, self._message = state, message

    def _become_running(self) -> None:
        refused = [item.item for item in self._applied if item.status == "refused"]
        self._become(State.RUNNING, f"{self._name} refuses: {', '.join(refused)}" if refused else "")

    def _pause(self, failures: int) -> None:
        """Before the next attempt to connect, after so many that failed in a row."""
        self._stop.wait(_RETRY_S[min(failures, len(_RETRY_S) - 1)])
