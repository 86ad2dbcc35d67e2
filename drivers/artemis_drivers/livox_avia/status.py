"""The 32-bit status code of Livox SDK 1 devices: in heartbeats, abnormal messages and every data packet."""

from __future__ import annotations

from typing import NamedTuple

_LEVEL = ("ok", "warning", "error", "error")
_SYNC = ("none", "ptp", "gps", "pps", "abnormal")
PPS_BIT = 1 << 9
SYNC_SHIFT = 14


def has_pulse(code: int) -> bool | None:
    """Whether time follows the pulse per second; None where the code does not say (0: also of an SDK 2 device)."""
    return {2: True, 3: True, 4: False}.get(code >> SYNC_SHIFT & 7)


class Status(NamedTuple):
    """Decoded status code; levels are ``ok``, ``warning`` or ``error``."""

    temperature: str
    voltage: str
    motor: str
    dirty: bool
    firmware_error: bool
    pps: bool
    end_of_life: bool
    fan_warning: bool
    self_heating: bool
    ptp: bool
    sync: str
    system: str

    @classmethod
    def decode(cls, code: int) -> Status:
        """Any 32-bit number decodes; unknown synchronisation states read ``unknown``."""
        sync = code >> SYNC_SHIFT & 7
        return cls(
            temperature=_LEVEL[code & 3],
            voltage=_LEVEL[code >> 2 & 3],
            motor=_LEVEL[code >> 4 & 3],
            dirty=code >> 6 & 3 > 0,
            firmware_error=bool(code >> 8 & 1),
            pps=bool(code >> 9 & 1),
            end_of_life=bool(code >> 10 & 1),
            fan_warning=bool(code >> 11 & 1),
            self_heating=bool(code >> 12 & 1),
            ptp=bool(code >> 13 & 1),
            sync=_SYNC[sync] if sync < len(_SYNC) else "unknown",
            system=_LEVEL[code >> 30 & 3],
        )

    def faults(self) -> list[str]:
        """What the user should know, in words; empty when all is well."""
        words = [
            f"{name} {level}"
            for name, level in (
                ("temperature", self.temperature),
                ("voltage", self.voltage),
                ("motor", self.motor),
                ("system", self.system),
            )
            if level != "ok"
        ]
        flags = (
            (self.dirty, "window dirty or blocked"),
            (self.firmware_error, "firmware error"),
            (self.end_of_life, "end of service life"),
            (self.fan_warning, "fan warning"),
            (self.sync == "abnormal", "time synchronisation abnormal"),
        )
        return words + [text for present, text in flags if present]
