"""Notices when a device goes and comes back, and says so."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from artemis_drivers.base import Health, State


class DeviceWatch:
    """``look`` at the devices often; ``latest`` is what they said, ``gaps`` how often each was away."""

    def __init__(self) -> None:
        self.latest: list[Health] = []
        self.gaps: dict[str, int] = {}
        self._state: dict[str, State] = {}
        self._gone_ns: dict[str, int] = {}

    def look(self, found: Sequence[Health], now_ns: int) -> list[dict[str, Any]]:
        """Events: a device changed its state; with the gap in its data when it runs again."""
        self.latest = list(found)
        events = []
        for health in found:
            before = self._state.get(health.name)
            if before == health.state:
                continue
            self._state[health.name] = health.state
            event: dict[str, Any] = {
                "kind": "device",
                "name": health.name,
                "state": str(health.state),
                "message": health.message,
            }
            if before == State.RUNNING:
                self._gone_ns[health.name] = health.last_data_ns or now_ns
                self.gaps[health.name] = self.gaps.get(health.name, 0) + 1
            if health.state == State.RUNNING and health.name in self._gone_ns:
                event |= {"kind": "gap", "gap_s": round((now_ns - self._gone_ns.pop(health.name)) / 1e9, 3)}
            events.append(event)
        return events
