"""A sample read by the layout of the frame before, against each item read for itself."""

from collections.abc import Callable

import pytest
from artemis_drivers.imu_serial import mtdata2
from artemis_drivers.imu_serial.mtdata2 import Item, MalformedError, Message, Mid, Precision, Type
from artemis_drivers.imu_serial.samples import MtiReader, Sample, mti_sample
from hypothesis import given, settings
from hypothesis import strategies as st

VALUES: dict[int, tuple[float, ...]] = {
    Type.PACKET_COUNTER: (7,),
    Type.SAMPLE_TIME_FINE: (123456,),
    Type.ACCELERATION: (0.5, -9.75, 1.25),
    Type.ACCELERATION_HR: (1.5, 2.5, -3.5),
    Type.RATE_OF_TURN: (0.125, -0.25, 2.0),
    Type.RATE_OF_TURN_HR: (4.0, 5.0, 6.0),
    Type.STATUS_WORD: (3,),
    Type.TEMPERATURE: (31.5,),
    Type.QUATERNION: (1.0, 0.0, 0.0, 0.0),
}
REALS = {
    kind for kind in VALUES if kind not in (Type.PACKET_COUNTER, Type.SAMPLE_TIME_FINE, Type.STATUS_WORD)
}


def frame(kinds: list[tuple[int, Precision]], count: int = 0) -> bytes:
    items = [
        Item(
            kind | (precision if kind in REALS else 0),
            (count,) if kind == Type.PACKET_COUNTER else VALUES[kind],
        )
        for kind, precision in kinds
    ]
    return mtdata2.encode(Message(Mid.MTDATA2, mtdata2.encode_items(items)))


def outcome(read: Callable[[bytes], Sample | None], data: bytes) -> object:
    try:
        return read(data)
    except MalformedError:
        return "malformed"


layouts = st.lists(
    st.tuples(st.sampled_from(sorted(VALUES)), st.sampled_from(Precision)),
    max_size=9,
    unique_by=lambda k: k[0],
)


@given(st.lists(st.tuples(layouts, st.integers(1, 3)), max_size=6))
@settings(max_examples=60, deadline=None)
def test_a_stream_of_any_frames_gives_the_same_samples(
    stream: list[tuple[list[tuple[int, Precision]], int]],
) -> None:
    reader = MtiReader()
    for kinds, times in stream:
        for count in range(times):
            data = frame(kinds, count)
            assert outcome(reader, data) == outcome(mti_sample, data)


USUAL = [
    (kind, Precision.FLOAT32)
    for kind in (
        Type.PACKET_COUNTER,
        Type.SAMPLE_TIME_FINE,
        Type.ACCELERATION,
        Type.RATE_OF_TURN,
        Type.STATUS_WORD,
    )
]


def test_a_frame_of_the_same_length_but_other_items_is_read_for_itself() -> None:
    reader = MtiReader()
    assert reader(frame(USUAL)) == mti_sample(frame(USUAL))
    swapped = [USUAL[k] for k in (0, 1, 3, 2, 4)]
    assert len(frame(swapped)) == len(frame(USUAL))
    assert reader(frame(swapped)) == mti_sample(frame(swapped)) == mti_sample(frame(USUAL))
    unknown = bytearray(frame(USUAL))
    assert mtdata2.encode(Message(Mid.REQ_DID, bytes(unknown[4:-1]))) != unknown
    assert reader(mtdata2.encode(Message(Mid.REQ_DID, bytes(unknown[4:-1])))) is None


def test_numbers_that_are_none_are_refused_by_both() -> None:
    reader = MtiReader()
    reader(frame(USUAL))
    items = [Item(kind, VALUES[kind]) for kind, _ in USUAL]
    items[2] = Item(Type.ACCELERATION, (float("nan"), 0.0, 0.0))
    data = mtdata2.encode(Message(Mid.MTDATA2, mtdata2.encode_items(items)))
    for read in (reader, mti_sample):
        with pytest.raises(MalformedError, match="no number"):
            read(data)
