"""Decides how much the mapping may do (load.py): by how far it is behind, how hot the machine is, what the battery has.

A decision is a message of the session, and takes effect in its order: the replay does the same at the same frame. So
no further step is taken before the mapping has come to the last one and had time to show what it brought.
"""

from __future__ import annotations

from dataclasses import dataclass

from msgspec.structs import replace

from artemis_edge import health
from artemis_edge.load import LADDER, SAVING, Load

_BEHIND_S = 1.0  # the mapping is too slow
_LEVEL_S = 0.4  # it keeps up: a frame, and what waits for it
_PATIENCE_S = 1.0  # so long behind before a step
_EFFECT_S = 2.0  # after which a step shows
_CALM_S = 10.0  # so long level before a step back
_WARM_S = 10.0  # between two steps for warmth or the battery
_LOOK_S = 5.0  # between two looks at the machine
_COOL_C = 7.0  # below the limit before a step back


@dataclass(frozen=True, slots=True)
class Readings:
    """``behind_s`` the mapping is behind the newest message; ``reached``: it has come to the last decision.

    ``temperature_c`` and ``battery_percent`` are None where the machine does not tell; the latter also when it is
    charged.
    """

    behind_s: float
    reached: bool = True
    temperature_c: float | None = None
    battery_percent: float | None = None


@dataclass(slots=True)
class Machine:
    """What the machine tells of itself, looked at every few seconds."""

    temperature_c: float | None = None
    percent: float | None = None
    minutes: float | None = None
    _looked_s: float = float("-inf")

    def look(self, now_s: float) -> None:
        """Read again where it is time."""
        if now_s - self._looked_s < _LOOK_S:
            return
        self._looked_s = now_s
        self.temperature_c = health.temperature_c()
        battery = health.battery()
        self.percent = None if battery is None or battery.charging else battery.percent
        self.minutes = None if battery is None or battery.charging else battery.minutes

    def readings(self, behind_s: float, reached: bool) -> Readings:
        """With how the mapping does."""
        return Readings(behind_s, reached, self.temperature_c, self.percent)


class OverloadControl:
    """``look`` a few times a second; it returns a load when another one holds from now on."""

    def __init__(self, hot_c: float = 80.0, low_percent: float = 15.0) -> None:
        self.load = Load()
        self._hot_c, self._low_percent = hot_c, low_percent
        self._floor = 0
        self._floored_s = self._changed_s = float("-inf")
        self._level_since: float | None = None
        self._behind_since: float | None = None

    def look(self, now_s: float, readings: Readings) -> Load | None:
        """The load from now on where it changes, None where it stays; ``now_s`` by a monotonic clock."""
        self._judge_machine(now_s, readings)
        behind = readings.reached and readings.behind_s > _BEHIND_S
        self._behind_since = _since(self._behind_since, now_s) if behind else None
        self._level_since = _since(self._level_since, now_s) if readings.behind_s < _LEVEL_S else None
        step = self.load.level
        if step < self._floor:
            return self._take(self._floor, now_s, self._warm_reason(readings))
        if not readings.reached or now_s - self._changed_s < _EFFECT_S:
            return None
        if self._behind_since is not None and now_s - self._behind_since >= _PATIENCE_S:
            if step + 1 < len(LADDER):
                return self._take(step + 1, now_s, f"the mapping is {readings.behind_s:.1f} s behind")
        elif self._calm(now_s) and step > self._floor:
            return self._take(step - 1, now_s, "the mapping keeps up")
        return None

    def _calm(self, now_s: float) -> bool:
        since = self._level_since
        return since is not None and now_s - max(since, self._changed_s) >= _CALM_S

    def _take(self, step: int, now_s: float, why: str) -> Load:
        self._changed_s = now_s
        self._behind_since = None
        self.load = replace(LADDER[step], why=why)
        return self.load

    def _judge_machine(self, now_s: float, readings: Readings) -> None:
        """The least step, by warmth and battery; one at a time."""
        if now_s - self._floored_s < _WARM_S:
            return
        t, charge = readings.temperature_c, readings.battery_percent
        hot, low = t is not None and t >= self._hot_c, charge is not None and charge <= self._low_percent
        cool = t is None or t < self._hot_c - _COOL_C
        if (hot or low) and self._floor < SAVING:
            self._floor += 1
            self._floored_s = now_s
        elif cool and not low and self._floor > 0:
            self._floor -= 1
            self._floored_s = now_s

    def _warm_reason(self, readings: Readings) -> str:
        t, charge = readings.temperature_c, readings.battery_percent
        if t is not None and t >= self._hot_c:
            return f"the machine has {t:.0f} C"
        return f"the battery has {charge:.0f} %" if charge is not None else "the machine is warm"


def _since(before: float | None, now_s: float) -> float:
    return now_s if before is None else before
