"""What the terminal needs of whoever does the work; a service behind a socket, or a demo in a child process."""

from __future__ import annotations

from typing import Protocol

from artemis_edge.frames import MeshDelta
from artemis_edge.status import Status


class RemoteError(Exception):
    """The other side is gone or refused: one sentence for the operator."""


class Remote(Protocol):
    """Every call returns at once or within a fraction of a second; they are made in threads of their own."""

    name: str

    def status(self) -> Status:
        """The newest status; RemoteError when the other side does not answer."""
        ...

    def deltas(self) -> list[MeshDelta]:
        """What has changed in the map since the last call; the newest state of a block only."""
        ...

    def ask(self, text: str) -> str:
        """Add a live question; returns a sentence about it."""
        ...

    def forget(self, text: str) -> str:
        """Remove a live question."""
        ...

    def command(self, name: str) -> str:
        """``start``, ``stop``, ``mark`` ...; returns a sentence about what came of it."""
        ...

    def close(self) -> None:
        """Detach; the other side goes on, a demo ends."""
        ...
