"""Xbus and MTData2: frames of real devices decode to their known values; encoder and decoder are inverse."""

import math
import struct

import pytest
from artemis_drivers.imu_serial import mtdata2
from artemis_drivers.imu_serial.mtdata2 import (
    Coordinates,
    Item,
    MalformedError,
    Message,
    Mid,
    Precision,
    Type,
    XbusFraming,
)
from artemis_drivers.imu_serial.stream import FrameSplitter
from hypothesis import given
from hypothesis import strategies as st

# frames of real devices and the values that independent decoders give for them
REAL = [
    (
        "faff3631102002dfc510600400459da040200cbedc9afa3f549f37411cbb7080200cbbaa5c803b8c5501bb813300e020040000008145",
        [
            (0x1020, (57285,)),
            (0x1060, (4562336,)),
            (0x4020, (-0.4308698773384094, 0.8305544257164001, 9.795761108398438)),
            (0x8020, (-0.005199015140533447, 0.004282594192773104, -0.00394284725189209)),
            (0xE020, (129,)),
        ],
    ),
    (
        "faff36262010103efc23423f00e028bf018fa73efeeeb1106004000af84ce02004000000021020021bc5d4",
        [
            (0x2010, (0.49245649576187134, 0.503420352935791, -0.506098210811615, 0.4979148209095001)),
            (0x1060, (718924,)),
            (0xE020, (2,)),
            (0x1020, (7109,)),
        ],
    ),
    (
        "faff3614102002000920300cbfbc67e03edfae8140a3a9dfa7",
        [(0x1020, (9,)), (0x2030, (-1.4719200134277344, 0.4368782341480255, 5.114486217498779))],
    ),
    (
        "faff360f80400c3b8bbc00bbe24f003b4e4a00af",
        [(0x8040, (0.004264354705810547, -0.006906390190124512, 0.003147721290588379))],
    ),
    ("faff3600cb", []),
]


@pytest.mark.parametrize(("text", "expected"), REAL)
def test_frames_of_real_devices(text: str, expected: list[tuple[int, tuple[float, ...]]]) -> None:
    frame = bytes.fromhex(text)
    message = mtdata2.decode(frame)
    items = mtdata2.decode_items(message.data)
    assert message.mid == Mid.MTDATA2
    assert [(item.data_id, item.values) for item in items] == expected
    assert mtdata2.encode(Message(Mid.MTDATA2, mtdata2.encode_items(items))) == frame


def test_acknowledgements() -> None:
    assert mtdata2.encode(Message(Mid.GOTO_CONFIG)).hex() == "faff3000d1"
    assert mtdata2.decode(bytes.fromhex("faff3100d0")) == Message(Mid.GOTO_CONFIG + 1)
    echo = mtdata2.decode(bytes.fromhex("faffc10410a000018b"))
    assert (echo.mid, echo.data.hex()) == (Mid.SET_OUTPUT_CONFIGURATION + 1, "10a00001")


# three items of one real device; the values as decimal text of another decoder
@pytest.mark.parametrize(
    ("text", "precision", "expected"),
    [
        (
            "0bd2d9600000bc86a000fff8c82ab000fffe",
            Precision.FP16_32,
            (0.04618605226278305, -7.263570785522461),
        ),
        ("00479ad20000006d5fbf0000ff0a3905ffff", Precision.FP16_32, (0.0010926020331680775,)),
        ("3f800000", Precision.FLOAT32, (1.0,)),
        ("fff80000", Precision.FP12_20, (-0.5,)),
        ("00000000fffe", Precision.FP16_32, (-2.0,)),
        ("80000000ffff", Precision.FP16_32, (-0.5,)),
        ("bff8000000000000", Precision.FLOAT64, (-1.5,)),
    ],
)
def test_number_formats(text: str, precision: Precision, expected: tuple[float, ...]) -> None:
    content = bytes.fromhex(text)
    values = mtdata2.decode_reals(content, precision)
    assert values[: len(expected)] == expected
    assert mtdata2.encode_reals(values, precision) == content


_RANGE = {
    Precision.FLOAT32: 1e30,
    Precision.FP12_20: 2047.0,
    Precision.FP16_32: 32767.0,
    Precision.FLOAT64: 1e300,
}
_RESOLUTION = {Precision.FP12_20: 2.0**-21, Precision.FP16_32: 2.0**-33}


@given(st.sampled_from(Precision), st.sampled_from(Coordinates), st.data())
def test_values_survive_in_every_precision(
    precision: Precision, where: Coordinates, data: st.DataObject
) -> None:
    limit = _RANGE[precision]
    width = 32 if precision == Precision.FLOAT32 else 64
    number = st.floats(
        -struct.unpack("f", struct.pack("f", limit))[0] if width == 32 else -limit, limit, width=64
    )
    values = tuple(data.draw(st.tuples(number, number, number)))
    item = Item(Type.ACCELERATION | where | precision, values)
    (back,) = mtdata2.decode_items(mtdata2.encode_items([item]))
    assert (back.type, back.precision, back.coordinates) == (Type.ACCELERATION, precision, where)
    for got, wanted in zip(back.values, values, strict=True):
        if precision in _RESOLUTION:
            assert abs(got - wanted) <= _RESOLUTION[precision] + 1e-16 * abs(wanted)
        else:
            assert got == pytest.approx(wanted, rel=6e-8 if width == 32 else 0, abs=1e-40)


def _has_no_nan(item: Item) -> bool:
    return not any(math.isnan(value) for value in item.values)


@given(st.lists(st.tuples(st.integers(0, 2**16 - 1), st.binary(max_size=40)), max_size=8))
def test_bytes_survive(parts: list[tuple[int, bytes]]) -> None:
    data = b"".join(struct.pack(">HB", i, len(content)) + content for i, content in parts)
    try:
        items = mtdata2.decode_items(data)
    except MalformedError:
        return
    if all(_has_no_nan(item) for item in items):  # the payload of a NaN is nobody's business
        assert mtdata2.encode_items(items) == data


@given(st.integers(0, 255), st.binary(max_size=700))
def test_messages_survive_with_and_without_extended_length(mid: int, data: bytes) -> None:
    message = Message(mid, data)
    frame = mtdata2.encode(message)
    assert (frame[3] == 0xFF) == (len(data) > 254)
    assert mtdata2.decode(frame) == message
    assert FrameSplitter(XbusFraming()).feed(frame) == [frame]


@pytest.mark.parametrize("data", ["10", "1020", "102002", "10200200", "40200100", "1060020000"])
def test_items_that_do_not_fit_are_refused(data: str) -> None:
    with pytest.raises(MalformedError):
        mtdata2.decode_items(bytes.fromhex(data))


@pytest.mark.parametrize("frame", ["", "fa", "faff3600cc", "fbff3600cb", "faff3601ca", "faff36ff00cc"])
def test_frames_that_are_none_are_refused(frame: str) -> None:
    with pytest.raises(MalformedError):
        mtdata2.decode(bytes.fromhex(frame))


def test_unknown_items_keep_their_bytes() -> None:
    (item,) = mtdata2.decode_items(bytes.fromhex("a0100301aaff"))
    assert (item.data_id, item.values, item.raw) == (0xA010, (), b"\x01\xaa\xff")


def test_a_message_that_is_too_long_is_refused() -> None:
    with pytest.raises(ValueError, match="do not fit"):
        mtdata2.encode(Message(Mid.MTDATA2, bytes(2049)))
