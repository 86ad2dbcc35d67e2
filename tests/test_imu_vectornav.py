"""VectorNav binary messages and register lines."""

import math

import pytest
from artemis_drivers.imu_serial import vectornav
from artemis_drivers.imu_serial.mtdata2 import MalformedError
from artemis_drivers.imu_serial.stream import FrameSplitter
from artemis_drivers.imu_serial.vectornav import GROUPS, BinaryMessage, VectorNavFraming
from hypothesis import given
from hypothesis import strategies as st

REAL = [
    ("fa01080093502e42833ef13f48b504bb9288", (43.57868576049805, 1.8847202062606812, -0.0020249653607606888)),
    ("fa010800ae231dc32db117c001babc404848", (-157.13937377929688, -2.3701889514923096, 5.897705554962158)),
    ("fa01080008221dc31dc317c082c6bc4016ed", (-157.1329345703125, -2.371283769607544, 5.899231910705566)),
    ("fa0108009d211dc3db3e18c0bc8fbc407bc3", (-157.1313018798828, -2.3788363933563232, 5.892545700073242)),
]


@pytest.mark.parametrize(("text", "expected"), REAL)
def test_frames_of_real_devices(text: str, expected: tuple[float, ...]) -> None:
    frame = bytes.fromhex(text)
    message = vectornav.decode(frame)
    assert message.fields == {"common.yaw_pitch_roll_deg": expected}
    assert vectornav.encode(message) == frame


def test_sizes_of_all_fields() -> None:
    """The table of the manual, byte for byte."""
    sizes = [
        [8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8],
        [8, 8, 8, 2, 8, 8, 8, 4, 4, 1],
        [2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2, 40],
    ]
    for group, expected in enumerate(sizes):
        for bit, size in enumerate(expected):
            masks = [0, 0, 0]
            masks[group] = 1 << bit
            header = bytes([0xFA, 1 << group]) + masks[group].to_bytes(2, "little")
            assert VectorNavFraming().length(bytearray(header), 0) == 4 + size + 2


def test_header_of_several_fields() -> None:
    """FA 01 2901: startup time, yaw pitch roll, rate, acceleration."""
    assert VectorNavFraming().length(bytearray.fromhex("fa012901"), 0) == 4 + 8 + 12 + 12 + 12 + 2
    assert (
        vectornav.field_mask("time_startup_ns", "yaw_pitch_roll_deg", "angular_rate", "acceleration") == 0x129
    )


_NUMBER = {
    "Q": st.integers(0, 2**64 - 1),
    "I": st.integers(0, 2**32 - 1),
    "H": st.integers(0, 2**16 - 1),
    "B": st.integers(0, 255),
    "b": st.integers(-128, 127),
    "f": st.floats(width=32, allow_nan=False),
    "d": st.floats(allow_nan=False),
}


@st.composite
def messages(draw: st.DrawFn) -> BinaryMessage:
    masks = tuple(draw(st.integers(0, (1 << len(group)) - 1)) for group in GROUPS)
    fields = {}
    for name, group, mask in zip(vectornav.GROUP_NAMES, GROUPS, masks, strict=True):
        for bit, (field, code) in enumerate(group):
            if mask >> bit & 1:
                kinds = "bBBBBBH" if code == "b5BH" else int(code[:-1] or 1) * code[-1]
                fields[f"{name}.{field}"] = tuple(draw(_NUMBER[kind]) for kind in kinds)
    return BinaryMessage(masks, fields)


@given(messages())
def test_encoder_and_decoder_are_inverse(message: BinaryMessage) -> None:
    if not any(message.masks):
        return
    frame = vectornav.encode(message)
    assert vectornav.decode(frame) == message
    assert FrameSplitter(VectorNavFraming()).feed(frame) == [frame]


@given(st.binary(max_size=200))
def test_any_bytes_decode_or_are_refused(data: bytes) -> None:
    try:
        message = vectornav.decode(b"\xfa" + data)
    except MalformedError:
        return
    assert all(math.isfinite(len(values)) for values in message.fields.values())
    assert vectornav.encode(message)[:2] == (b"\xfa" + data)[:2]


def test_lines() -> None:
    assert vectornav.line("VNRRG,03") == b"$VNRRG,03*70\r\n"
    assert vectornav.line_text(b"$VNRRG,03*70\r\n") == "VNRRG,03"
    with pytest.raises(MalformedError):
        vectornav.line_text(b"VNRRG")


def test_lines_and_binary_messages_in_one_stream() -> None:
    frame, line = bytes.fromhex(REAL[0][0]), vectornav.line("VNRRG,75,1,2,01,0129")
    splitter = FrameSplitter(VectorNavFraming())
    assert splitter.feed(
        frame + line + b"noise$ $V" + frame + b"$VNWRG,06,0*XX\r\n" + b"$VNERR,3*00\r\n"
    ) == [
        frame,
        line,
        frame,
        b"$VNWRG,06,0*XX\r\n",
    ]
    assert splitter.counts.bad_checks == 1
