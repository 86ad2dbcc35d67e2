"""Writes the board's settings by SDO, reads them back and says what became of each."""

from __future__ import annotations

import time
from collections.abc import Callable

from artemis_drivers.base import Applied, DriverError
from artemis_drivers.trigger import sdo
from artemis_drivers.trigger.messages import SdoRequest, SdoResponse
from artemis_drivers.trigger.settings import (
    CONFIG_CRC,
    FIRMWARE,
    SERIAL,
    Entry,
    TriggerSettings,
    config_crc,
    wanted,
)

_TRIES = 3

Exchange = Callable[[SdoRequest], SdoResponse | None]


def configure(settings: TriggerSettings, exchange: Exchange) -> tuple[Applied, ...]:
    """Identity, then every setting, then the board's own CRC over them; DriverError if it is silent."""
    results = [_identify(entry, exchange) for entry in (SERIAL, FIRMWARE)]
    if results[0].status == "unreadable":
        raise DriverError(
            f"{settings.name} does not answer on {settings.channel}: check its power and the bus"
        )
    values = wanted(settings)
    results += [_apply(entry, value, exchange) for entry, value in values.items()]
    results.append(_check_crc(config_crc(values), exchange))
    return tuple(results)


class _Transfer:
    """SDO transfers with repeats, and the books for Applied."""

    def __init__(self, exchange: Exchange) -> None:
        self._exchange = exchange
        self._start = time.monotonic()
        self.tries = 0

    def __call__(self, request: SdoRequest, *, signed: bool = False) -> int | None:
        """The value, or None without answer; SdoError if refused."""
        for _ in range(_TRIES):
            self.tries += 1
            response = self._exchange(request)
            if response is not None:
                return sdo.value_of(response, signed=signed)
        return None

    def applied(self, entry: Entry, requested: str, read_back: str, status: str) -> Applied:
        """The entry of the report."""
        ms = round((time.monotonic() - self._start) * 1e3, 3)
        return Applied(entry.name, requested, read_back, status, self.tries, ms)


def _identify(entry: Entry, exchange: Exchange) -> Applied:
    transfer = _Transfer(exchange)
    try:
        value = transfer(sdo.read_request(entry.index))
    except sdo.SdoError as refusal:
        return transfer.applied(entry, "any", str(refusal), "refused")
    if value is None:
        return transfer.applied(entry, "any", "", "unreadable")
    return transfer.applied(entry, "any", f"{value:08X}", "ok")


def _apply(entry: Entry, value: int, exchange: Exchange) -> Applied:
    transfer = _Transfer(exchange)
    try:
        written = transfer(sdo.write_request(entry.index, value, entry.size))
    except sdo.SdoError as refusal:
        return transfer.applied(entry, str(value), str(refusal), "refused")
    try:
        kept = transfer(sdo.read_request(entry.index), signed=entry.signed)
    except sdo.SdoError as refusal:
        return transfer.applied(entry, str(value), str(refusal), "unreadable")
    if kept is None:
        return transfer.applied(entry, str(value), "", "unreadable" if written is not None else "refused")
    return transfer.applied(entry, str(value), str(kept), "ok" if kept == value else "rounded")


def _check_crc(expected: int, exchange: Exchange) -> Applied:
    """The board's CRC covers what it really uses."""
    transfer = _Transfer(exchange)
    requested = f"{expected:08X}"
    try:
        kept = transfer(sdo.read_request(CONFIG_CRC.index))
    except sdo.SdoError as refusal:
        return transfer.applied(CONFIG_CRC, requested, str(refusal), "unreadable")
    if kept is None:
        return transfer.applied(CONFIG_CRC, requested, "", "unreadable")
    return transfer.applied(CONFIG_CRC, requested, f"{kept:08X}", "ok" if kept == expected else "rounded")
