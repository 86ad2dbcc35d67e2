"""A rig without a trigger board: the host's own clock takes the place of the board's, and gives the pulse."""

from __future__ import annotations

from artemis_drivers.trigger.events import Kind
from artemis_drivers.trigger.messages import PPS_GENERATED

from artemis_edge.sync import BoardEvent

_SECOND_NS = 1_000_000_000


class HostPulse:
    """Pulses at whole seconds of the host's monotonic clock, as a board would report them."""

    def __init__(self) -> None:
        self._next: int | None = None

    def due(self, now_ns: int) -> list[BoardEvent]:
        """Pulses up to host time ``now_ns``."""
        if self._next is None:
            self._next = now_ns // _SECOND_NS
        found = []
        while self._next * _SECOND_NS <= now_ns:
            at = self._next * _SECOND_NS
            found.append(BoardEvent(Kind.PPS, self._next, 0, 0, at, at, PPS_GENERATED))
            self._next += 1
        return found
