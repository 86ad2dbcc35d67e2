"""CDR codec and messages against rosbags as the oracle, and against arbitrary bytes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from artemis_edge.session.cdr import CdrError, CdrReader, CdrWriter, Ros1Reader
from artemis_edge.session.messages import (
    CameraInfo,
    CompressedImage,
    Header,
    Image,
    Imu,
    ImuTemplate,
    LivoxCustomMsg,
    Message,
    Odometry,
    PointCloud2,
    PointField,
    TFMessage,
    TransformStamped,
)
from artemis_edge.session.schemas import schema_text

HEADER = Header(1_630_577_758_569_489_920, "lidar_ü")


def _livox_points(count: int) -> np.ndarray[Any, Any]:
    points = np.zeros(count, LivoxCustomMsg.POINT)
    points["offset_time"] = np.arange(count) * 4167
    for axis, name in enumerate("xyz"):
        points[name] = np.arange(count) + 0.25 * axis
    points["reflectivity"], points["tag"], points["line"] = 200, 16, 3
    return points


def _examples() -> list[Message]:
    cloud = np.arange(40, dtype=np.uint8).tobytes()
    fields = (PointField("x", 0, 7), PointField("intensity", 12, 2, 3))
    d = np.array([0.1, -0.2, 0.3, 0.4, -0.5])
    tf = TransformStamped(HEADER, "cam", np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.6, 0.0, 0.8]))
    tf2 = TransformStamped(Header(-1, "a"), "bcd", np.array([4.0, 5.0, 6.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    return [
        PointCloud2(HEADER, 2, 1, fields, 20, 20, cloud, is_dense=False),
        PointCloud2(Header(0, ""), 1, 0, (), 0, 0, b"", is_bigendian=True),
        Imu(HEADER, np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]), gyro_covariance=np.arange(9.0)),
        CompressedImage(HEADER, "jpeg", b"\xff\xd8\xff"),
        Image(HEADER, 2, 3, "bgr8", 10, bytes(20), True),
        CameraInfo(HEADER, 480, 640, "plumb_bob", d, np.arange(9.0), np.arange(9.0), np.arange(12.0), (1, 2)),
        CameraInfo(
            HEADER, 1, 1, "", np.empty(0), np.ones(9), np.ones(9), np.ones(12), (0, 0), (1, 2, 3, 4, True)
        ),
        TFMessage((tf, tf2)),
        TFMessage(()),
        Odometry(HEADER, "base", np.arange(3.0), np.array([0, 0, 0, 1.0]), np.arange(36.0), np.ones(3)),
        LivoxCustomMsg(HEADER, 12345678901234, _livox_points(3), 7),
        LivoxCustomMsg(HEADER, 5, _livox_points(0)),
        LivoxCustomMsg(HEADER, 5, _livox_points(1)),
    ]


EXAMPLES = _examples()
TYPES = sorted({type(message) for message in EXAMPLES}, key=lambda kind: kind.__name__)


@pytest.fixture(scope="module")
def store() -> Any:
    found = get_typestore(Stores.ROS2_HUMBLE)
    found.register(get_types_from_msg(schema_text(LivoxCustomMsg.ROS_TYPE), LivoxCustomMsg.ROS_TYPE))
    return found


def _same(a: Any, b: Any) -> bool:
    """Equal, field by field, arrays and buffers by content."""
    if isinstance(a, memoryview | bytes | bytearray):
        return bytes(a) == bytes(b)
    if isinstance(a, np.ndarray):
        return bool(np.array_equal(a, b))
    if isinstance(a, tuple):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b, strict=True))
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(_same(getattr(a, n), getattr(b, n)) for n in a.__dataclass_fields__)
    return bool(a == b)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
def test_decode_undoes_encode(message: Message) -> None:
    assert _same(type(message).decode(message.encode()), message)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
def test_bytes_are_those_of_rosbags(message: Message, store: Any) -> None:
    theirs = store.deserialize_cdr(message.encode(), message.ROS_TYPE)
    assert bytes(store.serialize_cdr(theirs, message.ROS_TYPE)) == message.encode()


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
def test_big_endian(message: Message, store: Any) -> None:
    theirs = store.deserialize_cdr(message.encode(), message.ROS_TYPE)
    big = bytes(store.serialize_cdr(theirs, message.ROS_TYPE, little_endian=False))
    assert big[:2] == b"\0\0"
    assert _same(type(message).decode(big), message)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
def test_ros1_bytes(message: Message, store: Any) -> None:
    if isinstance(message, TFMessage) and len(message.transforms) > 1:
        message = TFMessage(message.transforms[:1])  # ROS 1 has no time before 1970
    packed = bytes(store.cdr_to_ros1(message.encode(), message.ROS_TYPE))
    assert _same(type(message).read(Ros1Reader(packed)), message)


def test_values_reach_rosbags(store: Any) -> None:
    imu = store.deserialize_cdr(EXAMPLES[2].encode(), "sensor_msgs/msg/Imu")
    assert (imu.header.stamp.sec, imu.header.stamp.nanosec) == (1630577758, 569489920)
    assert imu.header.frame_id == "lidar_ü"
    assert (imu.angular_velocity.y, imu.linear_acceleration.z) == (2.0, 6.0)


@pytest.mark.parametrize("ros_type", sorted({kind.ROS_TYPE for kind in TYPES}))
def test_schemas_define_the_official_types(ros_type: str) -> None:
    """The RIHS01 hash covers every field name and type, also of the dependencies."""
    ours = get_typestore(Stores.EMPTY)
    ours.register(get_types_from_msg(schema_text(ros_type), ros_type))
    official = get_typestore(Stores.ROS2_HUMBLE)
    if "livox" in ros_type:
        assert [name for name, _ in ours.fielddefs["livox_ros_driver2/msg/CustomPoint"][1]] == list(
            LivoxCustomMsg.POINT.names or ()
        )
    else:
        assert ours.hash_rihs01(ros_type) == official.hash_rihs01(ros_type)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
def test_every_truncation_is_an_error(message: Message) -> None:
    data = message.encode()
    for length in range(len(data)):
        with pytest.raises(CdrError):
            type(message).decode(data[:length])


@pytest.mark.parametrize("kind", TYPES, ids=lambda kind: kind.__name__)
@given(data=st.binary(max_size=300), header=st.sampled_from([b"", b"\0\1\0\0", b"\0\0\0\0"]))
@settings(max_examples=60, deadline=None)
def test_arbitrary_bytes(kind: type[Message], data: bytes, header: bytes) -> None:
    try:
        kind.decode(header + data)
    except CdrError:
        return


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
@given(at=st.integers(0, 2**16), value=st.integers(0, 255))
@settings(max_examples=60, deadline=None)
def test_flipped_bytes(message: Message, at: int, value: int) -> None:
    data = bytearray(message.encode())
    data[at % len(data)] = value
    try:
        type(message).decode(bytes(data))
    except CdrError:
        return


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("B"), st.integers(0, 255)),
            st.tuples(st.just("h"), st.integers(-(2**15), 2**15 - 1)),
            st.tuples(st.just("I"), st.integers(0, 2**32 - 1)),
            st.tuples(st.just("q"), st.integers(-(2**63), 2**63 - 1)),
            st.tuples(st.just("d"), st.floats(allow_nan=False)),
            st.tuples(st.just("?"), st.booleans()),
            st.tuples(st.just("s"), st.text().filter(lambda t: not t.endswith("\0"))),
        )
    )
)
@settings(max_examples=100, deadline=None)
def test_any_sequence_of_primitives(items: list[tuple[str, Any]]) -> None:
    writer = CdrWriter()
    for code, value in items:
        writer.string(value) if code == "s" else writer.write(code, value)
    reader = CdrReader(writer.finish())
    assert [reader.string() if code == "s" else reader.read(code) for code, _ in items] == [
        v for _, v in items
    ]


def test_announced_sizes_are_not_believed() -> None:
    """A count of four thousand million must fail before anything is reserved."""
    writer = CdrWriter()
    HEADER.write(writer)
    for value in (1, 1, 0xFFFFFFFF):
        writer.write("I", value)
    with pytest.raises(CdrError, match="announced"):
        PointCloud2.decode(writer.finish())
    writer = CdrWriter()
    writer.write("I", 0xFFFFFFFF)
    with pytest.raises(CdrError):
        CdrReader(writer.finish()).sequence("d")


def test_clouds_are_views() -> None:
    data = EXAMPLES[0].encode()
    decoded = PointCloud2.decode(data)
    assert isinstance(decoded.data, memoryview) and decoded.data.obj is data


def test_other_encapsulations_are_refused() -> None:
    with pytest.raises(CdrError, match="not plain CDR"):
        CdrReader(b"\x00\x03\x00\x00abcd")
    with pytest.raises(CdrError, match="nothing"):
        CdrReader(b"")


def test_samples_by_their_template_are_the_same_bytes() -> None:
    template = ImuTemplate("imu")
    rng = np.random.default_rng(4)
    for stamp_ns in (0, 1_700_000_000_123_456_789, 5):
        gyro, accel = rng.normal(size=(2, 3))
        expected = Imu(Header(stamp_ns, "imu"), gyro, accel).encode()
        assert template.encode(stamp_ns, gyro.tolist(), accel.tolist()) == expected
