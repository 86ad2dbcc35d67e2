"""Writes the configuration of a serial IMU, reads it back and says what became of each item."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable

from artemis_drivers.base import Applied, DriverError
from artemis_drivers.imu_serial import mtdata2, vectornav
from artemis_drivers.imu_serial.link import Link, Port
from artemis_drivers.imu_serial.mtdata2 import Message, Mid
from artemis_drivers.imu_serial.settings import XSENS_BAUD_IDS, MtiSettings, SyncSetting, VectorNavSettings

_TRIES = 3
_ANSWER_S = 0.5
_FIND_S = 0.15  # per attempt while the baud rate is searched
_VECTORNAV_BAUDS = (115_200, 921_600, 460_800, 230_400)
_XBUS_ERRORS = {0x03: "period out of range", 0x04: "message invalid", 0x1E: "timer overflow"}
_XBUS_ERRORS |= {0x20: "baud rate invalid", 0x21: "parameter invalid", 0x28: "device error"}

Ask = Callable[[bytes, Callable[[bytes], bool]], bytes | None]


class _Attempts:
    """Repeats a question until it is answered, and keeps the books for Applied."""

    def __init__(self, link: Link, timeout_s: float = _ANSWER_S, tries: int = _TRIES) -> None:
        self._link, self._timeout_s, self._most = link, timeout_s, tries
        self._start = time.monotonic()
        self.tries = 0

    def ask(self, request: bytes, answers: Callable[[bytes], bool]) -> bytes | None:
        """The answer, or None."""
        for _ in range(self._most):
            self.tries += 1
            frame = self._link.ask(request, answers, self._timeout_s)
            if frame is not None:
                return frame
        return None

    def applied(self, item: str, requested: str, read_back: str, status: str) -> Applied:
        """The entry of the report."""
        ms = (time.monotonic() - self._start) * 1e3
        return Applied(item, requested, read_back, status, self.tries, round(ms, 3))


# --- Xsens ---------------------------------------------------------------------------------------------------


def configure_mti(port: Port, settings: MtiSettings) -> tuple[Applied, ...]:
    """Baud, config mode, identity, outputs, synchronisation, measurement mode; DriverError if it is silent."""
    settings.require_room()
    link = Link(port, mtdata2.XbusFraming())
    results = [_find_mti(link, settings), _identify_mti(link), _set_outputs(link, settings)]
    if settings.sync:
        results.append(_set_sync(link, settings.sync))
    attempts = _Attempts(link)
    _require(_exchange(attempts, Mid.GOTO_MEASUREMENT), f"{settings.name} does not start measuring")
    results.append(attempts.applied("mode", "measurement", "measurement", "ok"))
    return tuple(results)


def _find_mti(link: Link, settings: MtiSettings) -> Applied:
    """Reach config mode, at the configured baud rate or at another one that is then changed."""
    books = _Attempts(link)
    for baud in (settings.baud, *(b for b in XSENS_BAUD_IDS if b != settings.baud)):
        link.port.baudrate = baud
        attempts = _Attempts(link, _FIND_S)
        found = _exchange(attempts, Mid.GOTO_CONFIG)
        books.tries += attempts.tries
        if found is None:
            continue
        if baud == settings.baud:
            return books.applied("baud", str(baud), str(baud), "ok")
        if _change_baud(link, settings.baud):
            return books.applied("baud", str(settings.baud), str(settings.baud), "ok")
        link.port.baudrate = baud
        _require(
            _exchange(_Attempts(link), Mid.GOTO_CONFIG), f"{settings.name} is lost after changing its baud"
        )
        return books.applied("baud", str(settings.baud), str(baud), "refused")
    raise DriverError(
        f"{settings.name}: nothing answers at {settings.port}: is it an Xsens MTi, is it powered?"
    )


def _change_baud(link: Link, baud: int) -> bool:
    """The new rate holds from the next reset on."""
    if _exchange(_Attempts(link), Mid.SET_BAUDRATE, bytes([XSENS_BAUD_IDS[baud]])) is None:
        return False
    if _exchange(_Attempts(link), Mid.RESET) is None:
        return False
    link.port.baudrate = baud
    return _exchange(_Attempts(link, tries=2 * _TRIES), Mid.GOTO_CONFIG) is not None


def _identify_mti(link: Link) -> Applied:
    attempts = _Attempts(link)
    answer = _exchange(attempts, Mid.REQ_DID)
    if answer is None or answer.mid == Mid.ERROR:
        return attempts.applied("device id", "any", "", "unreadable")
    return attempts.applied("device id", "any", answer.data.hex().upper(), "ok")


def _set_outputs(link: Link, settings: MtiSettings) -> Applied:
    """Write the list, compare the echo, then read it once more."""
    wanted = encode_outputs(settings.outputs)
    attempts = _Attempts(link)
    echo = _exchange(attempts, Mid.SET_OUTPUT_CONFIGURATION, wanted)
    requested = _outputs_text(wanted)
    if echo is None:
        raise DriverError(
            f"{settings.name} does not answer the output configuration: unplug it and plug it in"
        )
    if echo.mid == Mid.ERROR:
        return attempts.applied("outputs", requested, _error_text(echo), "refused")
    kept = _exchange(attempts, Mid.SET_OUTPUT_CONFIGURATION)
    if kept is None or kept.mid == Mid.ERROR:
        return attempts.applied("outputs", requested, _outputs_text(echo.data), "unreadable")
    status = _compare_outputs(wanted, kept.data)
    return attempts.applied("outputs", requested, _outputs_text(kept.data), status)


def _set_sync(link: Link, sync: tuple[SyncSetting, ...]) -> Applied:
    wanted = b"".join(encode_sync(setting) for setting in sync)
    attempts = _Attempts(link)
    echo = _exchange(attempts, Mid.SET_SYNC_SETTINGS, wanted)
    if echo is None or echo.mid == Mid.ERROR:
        detail = "no answer" if echo is None else _error_text(echo)
        return attempts.applied("sync", wanted.hex(), detail, "refused")
    kept = _exchange(attempts, Mid.SET_SYNC_SETTINGS)
    if kept is None or kept.mid == Mid.ERROR:
        return attempts.applied("sync", wanted.hex(), "", "unreadable")
    same = kept.data == wanted
    return attempts.applied("sync", wanted.hex(), kept.data.hex(), "ok" if same else "rounded")


def encode_outputs(outputs: tuple[tuple[int, int], ...]) -> bytes:
    """Data of SetOutputConfiguration: id and rate of each item."""
    return b"".join(struct.pack(">HH", data_id, rate) for data_id, rate in outputs)


def decode_outputs(data: bytes) -> tuple[tuple[int, int], ...]:
    """Inverse of encode_outputs; a rest that is no pair is left out."""
    return tuple(struct.iter_unpack(">HH", data[: len(data) // 4 * 4]))


def encode_sync(setting: SyncSetting) -> bytes:
    """The 12 bytes of one entry of SetSyncSettings."""
    s = setting
    return struct.pack(
        ">BBBBHHHH",
        s.function,
        s.line,
        s.polarity,
        s.ignore_first,
        s.skip_first,
        s.skip_factor,
        s.pulse_width,
        s.delay,
    )


def _exchange(attempts: _Attempts, mid: Mid, data: bytes = b"") -> Message | None:
    """The acknowledgement, or the device's error message, or None."""

    def answers(frame: bytes) -> bool:
        return frame[2] in (mid + 1, Mid.ERROR)

    frame = attempts.ask(mtdata2.encode(Message(mid, data)), answers)
    return None if frame is None else mtdata2.decode(frame)


def _compare_outputs(wanted: bytes, kept: bytes) -> str:
    if wanted == kept:
        return "ok"
    same_items = [i for i, _ in decode_outputs(wanted)] == [i for i, _ in decode_outputs(kept)]
    return "rounded" if same_items else "refused"


def _outputs_text(data: bytes) -> str:
    return " ".join(f"{data_id:04X}@{rate}" for data_id, rate in decode_outputs(data))


def _error_text(message: Message) -> str:
    code = message.data[0] if message.data else 0
    return f"error {code:#04x}: {_XBUS_ERRORS.get(code, 'unknown')}"


def _require(answer: Message | None, sentence: str) -> None:
    if answer is None or answer.mid == Mid.ERROR:
        raise DriverError(f"{sentence}: unplug it and plug it in")


# --- VectorNav -----------------------------------------------------------------------------------------------

VECTORNAV_FIELDS = vectornav.field_mask(
    "time_startup_ns", "time_sync_in_ns", "angular_rate", "acceleration", "sync_in_count"
)


def configure_vectornav(port: Port, settings: VectorNavSettings) -> tuple[Applied, ...]:
    """Baud, identity, ASCII output off, binary output; DriverError if it is silent."""
    link = Link(port, vectornav.VectorNavFraming())
    binary = f"{settings.serial_port},{settings.divisor()},01,{VECTORNAV_FIELDS:04X}"
    results = [_find_vectornav(link, settings)]
    results.append(_set_register(link, 6, "0", "ascii output", f"{settings.serial_port}"))
    results.append(_set_register(link, 75, binary, "binary output"))
    return tuple(results)


def _find_vectornav(link: Link, settings: VectorNavSettings) -> Applied:
    books = _Attempts(link)
    for baud in (settings.baud, *(b for b in _VECTORNAV_BAUDS if b != settings.baud)):
        link.port.baudrate = baud
        attempts = _Attempts(link, _FIND_S)
        found = _command(attempts, "VNRRG,03")
        books.tries += attempts.tries
        if found is None:
            continue
        if baud != settings.baud:
            if _command(_Attempts(link), f"VNWRG,05,{settings.baud}") is None:
                return books.applied("baud", str(settings.baud), str(baud), "refused")
            link.port.baudrate = settings.baud
        serial = found.partition(",")[2].partition(",")[2]
        return books.applied("baud", str(settings.baud), f"{settings.baud} (serial number {serial})", "ok")
    raise DriverError(
        f"{settings.name}: nothing answers at {settings.port}: is it a VectorNav, is it powered?"
    )


def _set_register(link: Link, register: int, value: str, item: str, suffix: str = "") -> Applied:
    """Write, then read back and compare field by field."""
    attempts = _Attempts(link)
    tail = f",{suffix}" if suffix else ""
    written = _command(attempts, f"VNWRG,{register:02d},{value}{tail}")
    if written is None or written.startswith("VNERR"):
        return attempts.applied(item, value, written or "no answer", "refused")
    read = _command(attempts, f"VNRRG,{register:02d}{tail}")
    if read is None or read.startswith("VNERR"):
        return attempts.applied(item, value, "", "unreadable")
    kept = read.split(",", 2)[2] if read.count(",") >= 2 else ""
    same = _numbers(kept)[: len(_numbers(value))] == _numbers(value)
    return attempts.applied(item, value, kept, "ok" if same else "rounded")


def _command(attempts: _Attempts, text: str) -> str | None:
    """The line that answers (VNRRG, VNWRG of the same register, or VNERR), or None."""
    name, _, rest = text.partition(",")
    register = int(rest.partition(",")[0])

    def answers(frame: bytes) -> bool:
        if frame[:1] != b"$":
            return False
        got, _, tail = vectornav.line_text(frame).partition(",")
        number = tail.partition(",")[0]
        return got == "VNERR" or (got == name and number.isdigit() and int(number) == register)

    frame = attempts.ask(vectornav.line(text), answers)
    return None if frame is None else vectornav.line_text(frame)


def _numbers(text: str) -> list[str]:
    """Fields without leading zeros: the device writes 01 where 1 was asked."""
    return [part.strip().lstrip("0").upper() or "0" for part in text.split(",")]
