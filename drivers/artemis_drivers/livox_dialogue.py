"""A script of questions to a device over a lossy link, without any input or output of its own.

A script is a generator: it yields an ``Ask`` and is resumed with the answer's payload, or with None when the
device stayed silent through all tries; or it yields a number of nanoseconds to wait. This keeps a session
readable from top to bottom although it never blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import NamedTuple

ANSWER_TIMEOUT_NS = 500_000_000  # as the official SDK
MS = 1_000_000


class Datagram(NamedTuple):
    """Something to be sent."""

    data: bytes
    address: tuple[str, int]


class Ask(NamedTuple):
    """A command and its payload; sent again after each ``ANSWER_TIMEOUT_NS``, ``tries`` times in all."""

    command: int
    payload: bytes = b""
    tries: int = 5


Script = Generator[Ask | int, bytes | None, None]


class Dialogue:
    """Runs one script at a time. ``send(ask, seq)`` must put the question on the wire."""

    def __init__(self, send: Callable[[Ask, int], None], next_seq: Callable[[], int]) -> None:
        self._send, self._next_seq = send, next_seq
        self._script: Script | None = None
        self._ask: Ask | None = None
        self._seq = 0
        self._sent = 0
        self._due = 0
        self._stepping = False
        self.resent = 0
        self.unanswered = 0

    @property
    def running(self) -> bool:
        """Whether a script is under way."""
        return self._script is not None

    def start(self, script: Script, now: int) -> None:
        """Begin a script in place of the one that may be running."""
        self.cancel()
        self._script = script
        self._advance(None, now)

    def cancel(self) -> None:
        """Forget the script."""
        if self._script is not None and not self._stepping:
            self._script.close()
        self._script = self._ask = None

    def answer(self, seq: int, command: int, payload: bytes, now: int) -> bool:
        """Hand in an answer; False when nobody waits for it (late or repeated)."""
        if self._ask is None or seq != self._seq or command != self._ask.command:
            return False
        self._advance(payload, now)
        return True

    def tick(self, now: int) -> None:
        """Resend what is overdue, go on after a wait."""
        if self._script is None or now < self._due:
            return
        if self._ask is None:
            self._advance(None, now)
        elif self._sent < self._ask.tries:
            self.resent += 1
            self._put(self._ask, now)
        else:
            self.unanswered += 1
            self._advance(None, now)

    def _advance(self, payload: bytes | None, now: int) -> None:
        script = self._script
        if script is None:
            return
        self._ask, self._stepping = None, True
        try:
            wanted = script.send(payload)
        except StopIteration:
            if self._script is script:
                self._script = None
            return
        finally:
            self._stepping = False
        if self._script is not script:  # the step itself gave up or began another script
            script.close()
        elif isinstance(wanted, Ask):
            self._ask, self._seq, self._sent = wanted, self._next_seq(), 0
            self._put(wanted, now)
        else:
            self._due = now + wanted

    def _put(self, ask: Ask, now: int) -> None:
        self._sent += 1
        self._due = now + ANSWER_TIMEOUT_NS
        self._send(ask, self._seq)
