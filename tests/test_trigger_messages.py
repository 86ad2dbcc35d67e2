"""The board's messages by its DBC, SDO transfers, counters and clock."""

from dataclasses import astuple, fields
from pathlib import Path

import pytest
from artemis_drivers.base import DriverError
from artemis_drivers.trigger import sdo
from artemis_drivers.trigger.clock import BoardClock, EventCounter
from artemis_drivers.trigger.messages import (
    BadFrameError,
    BoardHealth,
    Command,
    Emcy,
    Heartbeat,
    Messages,
    Nmt,
    NodeState,
    Opcode,
    PpsEvent,
    Record,
    RunState,
    SdoRequest,
    SdoResponse,
    Strobe,
    TrigEvent,
    default_dbc,
)
from hypothesis import given
from hypothesis import strategies as st

MESSAGES = Messages(default_dbc())

VECTORS = [
    (0x190, "0302010104030201", TrigEvent(66051, 1, 16909060)),
    (0x290, "07000003ffffffff", PpsEvent(7, 3, 2**32 - 1)),
    (0x390, "050000012500c409", Strobe(5, 1, 37, 2500)),
    (0x490, "83ffdc391efb1203", BoardHealth(-12.5, 14.812, -1.25, 2, 1, RunState.RUNNING, 0)),
    (0x210, "02e803f4011efb03", Command(Opcode.RUN, 10.0, 500, -1250, 3)),
    (0x710, "05", Heartbeat(NodeState.OPERATIONAL)),
    (0x090, "0031052a00000009", Emcy(0x3100, 5, 42, 9)),
    (0x610, "2300200010270000", SdoRequest(0x23, 0x2000, 0, 10_000)),
    (0x590, "4300200010270000", SdoResponse(0x43, 0x2000, 0, 10_000)),
    (0x000, "0110", Nmt(1, 0x10)),
]


@pytest.mark.parametrize(("frame_id", "text", "record"), VECTORS)
def test_vectors(frame_id: int, text: str, record: Record) -> None:
    decoded = MESSAGES.decode(frame_id, bytes.fromhex(text))
    assert type(decoded) is type(record)
    assert astuple(decoded) == pytest.approx(astuple(record))  # type: ignore[arg-type]
    assert MESSAGES.encode(record) == (frame_id, bytes.fromhex(text))
    assert MESSAGES.node == 0x10


@given(st.sampled_from(VECTORS), st.binary(min_size=8, max_size=8))
def test_bytes_survive(vector: tuple[int, str, Record], data: bytes) -> None:
    frame_id, text, _ = vector
    data = data[: len(text) // 2]
    record = MESSAGES.decode(frame_id, data)
    assert record is not None
    try:
        assert MESSAGES.encode(record) == (frame_id, data)
    except BadFrameError:  # outside the range that the DBC states, e.g. 3000 degrees
        assert isinstance(record, BoardHealth | Command | Nmt | Strobe)


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_any_frame_is_decoded_or_refused(frame_id: int, data: bytes) -> None:
    try:
        record = MESSAGES.decode(frame_id, data)
    except BadFrameError:
        return
    assert (record is None) == (frame_id not in {vector[0] for vector in VECTORS})


def test_values_that_do_not_fit_are_refused() -> None:
    with pytest.raises(BadFrameError):
        MESSAGES.encode(TrigEvent(2**24, 0, 0))


@pytest.mark.parametrize(("old", "new"), [("t_us", "time"), ("BO_ 1808 Heartbeat", "BO_ 1808 Pulse")])
def test_a_dbc_that_lacks_something_is_named(tmp_path: Path, old: str, new: str) -> None:
    changed = tmp_path / "other.dbc"
    changed.write_text(default_dbc().read_text().replace(old, new))
    with pytest.raises(DriverError, match="has no signal"):
        Messages(changed)


def test_a_file_that_is_no_dbc_is_named(tmp_path: Path) -> None:
    (tmp_path / "x.dbc").write_bytes(b"\xff\xfe no dbc")
    with pytest.raises(DriverError, match="cannot be read as a DBC"):
        Messages(tmp_path / "x.dbc")
    with pytest.raises(DriverError, match="cannot be read as a DBC"):
        Messages(tmp_path / "missing.dbc")


def test_sdo_bytes_of_the_standard() -> None:
    """The examples were made with another implementation of CiA 301."""
    assert MESSAGES.encode(sdo.write_request(0x2000, 10_000, 4))[1].hex() == "2300200010270000"
    assert MESSAGES.encode(sdo.read_request(0x2000))[1].hex() == "4000200000000000"
    acknowledged = MESSAGES.decode(0x590, bytes.fromhex("6000200000000000"))
    read = MESSAGES.decode(0x590, bytes.fromhex("4300200010270000"))
    abort = MESSAGES.decode(0x590, bytes.fromhex("8000300000000206"))
    assert isinstance(acknowledged, SdoResponse) and sdo.value_of(acknowledged) == 0
    assert isinstance(read, SdoResponse) and sdo.value_of(read) == 10_000
    assert isinstance(abort, SdoResponse)
    with pytest.raises(sdo.SdoError, match=r"0x06020000 \(missing\)") as refusal:
        sdo.value_of(abort)
    assert refusal.value.code == sdo.Abort.MISSING


@given(st.integers(1, 4), st.data())
def test_sdo_values_survive(size: int, data: st.DataObject) -> None:
    value = data.draw(st.integers(-(2 ** (8 * size - 1)), 2 ** (8 * size - 1) - 1))
    held: dict[tuple[int, int], tuple[int, int]] = {}

    def write(index: int, subindex: int, raw: int, length: int) -> None:
        held[index, subindex] = (raw, length)

    def read(index: int, subindex: int) -> tuple[int, int]:
        return held[index, subindex]

    done = sdo.serve(sdo.write_request(0x2002, value, size, 3), read, write)
    assert sdo.value_of(done) == 0
    request = sdo.read_request(0x2002, 3)
    response = sdo.serve(request, read, write)
    assert sdo.answers(request, response) and not sdo.answers(sdo.read_request(0x2002), response)
    assert sdo.value_of(response, signed=True) == value


@given(st.builds(SdoRequest, *(st.integers(0, 2**n - 1) for n in (8, 16, 8, 32))))
def test_any_sdo_request_is_answered(request_: SdoRequest) -> None:
    response = sdo.serve(request_, lambda index, sub: (7, 1), lambda *args: None)
    assert sdo.answers(request_, response)
    try:
        assert sdo.value_of(response) in (0, 7)
    except sdo.SdoError as refusal:
        assert refusal.code == sdo.Abort.UNKNOWN_COMMAND


def test_board_clock_wraps_and_bridges_silence() -> None:
    clock = BoardClock()
    turn_us, second = 2**32, 10**9
    assert clock.read(turn_us - 10, 0) == (turn_us - 10) * 1000
    assert clock.read(20, 30_000) == (turn_us + 20) * 1000
    later_us = 3 * 3600 * 10**6  # three hours of silence: two and a half turns
    read = clock.read((20 + later_us) % turn_us, 3 * 3600 * second + 50_000)
    assert (read, clock.boot) == ((turn_us + 20 + later_us) * 1000, 0)


def test_board_clock_notices_a_restart() -> None:
    clock = BoardClock()
    clock.read(100_000_000, 0)
    clock.read(99_999_000, 1000)  # reordered
    assert clock.boot == 0
    assert clock.read(5_000, 500_000_000) == 5_000_000
    assert clock.boot == 1
    clock.restart()
    clock.restart()
    assert clock.boot == 2
    # a reader that stalled for two seconds is no restart
    clock.read(0, 0)
    clock.read(2_000_000, 1000)
    assert clock.boot == 2


def test_events_are_counted_across_the_wrap() -> None:
    counter = EventCounter()
    assert [counter.read(raw, raw) for raw in (2**24 - 2, 2**24 - 1, 0, 0, 3)] == [
        2**24 - 2,
        2**24 - 1,
        2**24,
        None,
        2**24 + 3,
    ]
    assert (counter.lost, counter.repeated, counter.series) == (2, 1, 0)
    assert counter.near(4) == 2**24 + 4 and counter.near(2**24 - 1) == 2**24 - 1


def test_counting_from_0_again_is_a_new_series() -> None:
    counter = EventCounter()
    assert [counter.read(raw, k) for k, raw in enumerate((40, 41, 0, 0, 1))] == [40, 41, 0, 0, 1]
    assert (counter.series, counter.lost, counter.repeated) == (2, 0, 0)


def test_every_field_of_a_record_is_a_signal() -> None:
    for _, _, record in VECTORS:
        assert len(fields(record)) == len(astuple(record)) > 0
