"""The ROS 2 messages of a session as typed records, and their CDR encoding.

``decode`` and ``encode`` are inverse. Arrays of a decoded message are read-only views of its bytes.
Quaternions are (x, y, z, w), covariances row-major, stamps int64 nanoseconds. A malformed message raises
CdrError.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from artemis_edge.frames import F64
from artemis_edge.session.cdr import Buffer, CdrReader, CdrWriter

_SECOND_NS = 1_000_000_000
_STAMP, _TRIPLE = struct.Struct("<iI"), struct.Struct("<3d")

# sensor_msgs/PointField datatype -> numpy code
FIELD_CODES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
FIELD_TYPES = {code: number for number, code in FIELD_CODES.items()}


class Message(ABC):
    """A message that can stand in a session; ``decode`` and ``encode`` are inverse."""

    __slots__ = ()
    ROS_TYPE: ClassVar[str]

    @abstractmethod
    def encode(self) -> bytes:
        """The CDR bytes."""

    @classmethod
    @abstractmethod
    def read(cls, cdr: CdrReader) -> Self:
        """From the position of a reader; CdrError if it is no such message."""

    @classmethod
    def decode(cls, data: Buffer) -> Self:
        """The message in CDR bytes; CdrError if they are none."""
        return cls.read(CdrReader(data))


@dataclass(frozen=True, slots=True)
class Header:
    """Time and coordinate frame of a message."""

    stamp_ns: int
    frame_id: str

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        """From the position of a reader."""
        seconds, nanoseconds = cdr.stamp()
        return cls(seconds * _SECOND_NS + nanoseconds, cdr.string())

    def write(self, cdr: CdrWriter) -> None:
        """To the position of a writer."""
        seconds, nanoseconds = divmod(self.stamp_ns, _SECOND_NS)
        cdr.write("i", seconds)
        cdr.write("I", nanoseconds)
        cdr.string(self.frame_id)


@dataclass(frozen=True, slots=True)
class PointField:
    """One field of a point: ``datatype`` is a key of FIELD_CODES, ``offset`` bytes from the point's start."""

    name: str
    offset: int
    datatype: int
    count: int = 1


@dataclass(frozen=True, slots=True)
class PointCloud2(Message):
    """sensor_msgs/msg/PointCloud2: ``data`` holds ``height`` rows of ``row_step`` bytes."""

    ROS_TYPE: ClassVar[str] = "sensor_msgs/msg/PointCloud2"
    header: Header
    height: int
    width: int
    fields: tuple[PointField, ...]
    point_step: int
    row_step: int
    data: Buffer
    is_bigendian: bool = False
    is_dense: bool = True

    def encode(self) -> bytes:
        """The CDR bytes."""
        cdr = CdrWriter()
        self.header.write(cdr)
        cdr.write("I", self.height)
        cdr.write("I", self.width)
        cdr.write("I", len(self.fields))
        for item in self.fields:
            cdr.string(item.name)
            cdr.write("I", item.offset)
            cdr.write("B", item.datatype)
            cdr.write("I", item.count)
        cdr.write("?", self.is_bigendian)
        cdr.write("I", self.point_step)
        cdr.write("I", self.row_step)
        cdr.write("I", len(self.data))
        cdr.octets(self.data)
        cdr.write("?", self.is_dense)
        return cdr.finish()

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        """From the position of a reader."""
        header, height, width = Header.read(cdr), cdr.read("I"), cdr.read("I")
        fields = tuple(
            PointField(cdr.string(), cdr.read("I"), cdr.read("B"), cdr.read("I"))
            for _ in range(cdr.count(smallest_item=13))
        )
        big, point_step, row_step = cdr.read("?"), cdr.read("I"), cdr.read("I")
        points = cdr.octets(cdr.read("I"))
        return cls(header, height, width, fields, point_step, row_step, points, big, cdr.read("?"))


@dataclass(frozen=True, slots=True)
class LivoxCustomMsg(Message):
    """livox_ros_driver2/msg/CustomMsg: ``points`` of dtype POINT, their times count from ``timebase_ns``."""

    ROS_TYPE: ClassVar[str] = "livox_ros_driver2/msg/CustomMsg"
    # A CustomPoint is 19 bytes, but each starts at a multiple of 4: the last one lacks the pad byte.
    POINT: ClassVar[np.dtype[Any]] = np.dtype(
        {
            "names": ["offset_time", "x", "y", "z", "reflectivity", "tag", "line"],
            "formats": ["<u4", "<f4", "<f4", "<f4", "u1", "u1", "u1"],
            "offsets": [0, 4, 8, 12, 16, 17, 18],
            "itemsize": 20,
        }
    )
    header: Header
    timebase_ns: int
    points: NDArray[Any]
    lidar_id: int = 0

    def encode(self) -> bytes:
        """The CDR bytes."""
        cdr = CdrWriter()
        self.header.write(cdr)
        cdr.write("Q", self.timebase_ns)
        cdr.write("I", len(self.points))
        cdr.write("B", self.lidar_id)
        cdr.octets(bytes(3))
        cdr.write("I", len(self.points))
        packed = np.zeros(len(self.points), self.POINT)
        for name in self.POINT.names or ():
            packed[name] = self.points[name]
        cdr.octets(packed.tobytes()[:-1])
        return cdr.finish()

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        """From the position of a reader."""
        header, timebase, _point_num = Header.read(cdr), cdr.read("Q"), cdr.read("I")
        lidar_id, _reserved = cdr.read("B"), cdr.octets(3)
        count = cdr.read("I")
        return cls(header, timebase, cdr.structures(cls.POINT, count, last_size=19), lidar_id)


@dataclass(frozen=True, slots=True)
class Imu(Message):
    """sensor_msgs/msg/Imu: ``gyro`` rad/s and ``accel`` m/s2, (3,) each; a covariance of -1 says unknown."""

    ROS_TYPE: ClassVar[str] = "sensor_msgs/msg/Imu"
    header: Header
    gyro: F64
    accel: F64
    orientation: F64 = field(default_factory=lambda: np.array([0.0, 0.0, 0.0, 1.0]))
    orientation_covariance: F64 = field(default_factory=lambda: np.array([-1.0] + [0.0] * 8))
    gyro_covariance: F64 = field(default_factory=lambda: np.zeros(9))
    accel_covariance: F64 = field(default_factory=lambda: np.zeros(9))

    def encode(self) -> bytes:
        """The CDR bytes."""
        cdr = CdrWriter()
        self.header.write(cdr)
        parts = (
            self.orientation,
            self.orientation_covariance,
            self.gyro,
            self.gyro_covariance,
            self.accel,
            self.accel_covariance,
        )
        cdr.array("d", np.concatenate(parts))
        return cdr.finish()

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        """From the position of a reader."""
        header, v = Header.read(cdr), cdr.array("d", 37)
        return cls(header, v[13:16], v[25:28], v[:4], v[4:13], v[16:25], v[28:37])


class ImuTemplate:
    """Samples of one IMU, encoded four times as fast as by ``Imu.encode``: only what differs is written."""

    def __init__(self, frame_id: str) -> None:
        empty = Imu(Header(0, frame_id), np.zeros(3), np.zeros(3)).encode()
        self._bytes = bytearray(empty)
        values = len(empty) - 37 * 8  # orientation, gyro, accel and their covariances
        self._gyro, self._accel = values + 13 * 8, values + 25 * 8

    def encode(self, stamp_ns: int, gyro: Sequence[float], accel: Sequence[float]) -> bytes:
        """The CDR bytes of the sample: rad/s and m/s2, three each."""
        _STAMP.pack_into(self._bytes, 4, *divmod(stamp_ns, _SECOND_NS))
        _TRIPLE.pack_into(self._bytes, self._gyro, *gyro)
        _TRIPLE.pack_into(self._bytes, self._accel, *accel)
        return bytes(self._bytes)


@dataclass(frozen=True, slots=True)
class CompressedImage(Message):
    """sensor_msgs/msg/CompressedImage: ``format`` such as ``jpeg``."""

    ROS_TYPE: ClassVar[str] = "sensor_msgs/msg/CompressedImage"
    header: Header
    format: str
    data: Buffer

    def encode(self) -> bytes:
        """The CDR bytes."""
        cdr = CdrWriter()
        self.header.write(cdr)
        cdr.string(self.format)
        cdr.write("I", len(self.data))
        cdr.octets(self.data)
        return cdr.finish()

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        """From the position of a reader."""
        return cls(Header.read(cdr), cdr.string(), cdr.octets(cdr.read("I")))


@dataclass(frozen=True, slots=True)
class Image(Message):
    """sensor_msgs/msg/Image: ``height`` rows of ``step`` bytes."""

    ROS_TYPE: ClassVar[str] = "sensor_msgs/msg/Image"
    header: Header
    height: int
    width: int
    encoding: str
    step: int
    data: Buffer
    is_bigendian: bool = False

    def encode(self) -> bytes:
        """The CDR bytes."""
        cdr = CdrWriter()
        self.header.write(cdr)
        cdr.write("I", self.height)
        cdr.write("I", self.width)
        cdr.string(self.encoding)
        cdr.write("B", self.is_bigendian)
        cdr.write("I", self.step)
        cdr.write("I", len(self.data))
        cdr.octets(self.data)
        return cdr.finish()

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        """From the position of a reader."""
        header, height, width, encoding = Header.read(cdr), cdr.read("I"), cdr.read("I"), cdr.string()
        big, step = bool(cdr.read("B")), cdr.read("I")
        return cls(header, height, width, encoding, step, cdr.octets(cdr.read("I")), big)


@dataclass(frozen=True, slots=True)
class CameraExposure(Message):
    """artemis_msgs/msg/CameraExposure: exposure time (s) and gain (1: none) of the image of the same stamp."""

    ROS_TYPE: ClassVar[str] = "artemis_msgs/msg/CameraExposure"
    header: Header
    exposure_s: float
    gain: float

    def encode(self) -> bytes:
        """The CDR bytes."""
        cdr = CdrWriter()
        self.header.write(cdr)
        cdr.write("d", self.exposure_s)
        cdr.write("d", self.gain)
        return cdr.finish()

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        """From the position of a reader."""
        return cls(Header.read(cdr), cdr.read("d"), cdr.read("d"))


@dataclass(frozen=True, slots=True)
class Text(Message):
    """std_msgs/msg/String: a text, here always JSON."""

    ROS_TYPE: ClassVar[str] = "std_msgs/msg/String"
    text: str

    def encode(self) -> bytes:
        """The CDR bytes."""
        cdr = CdrWriter()
        cdr.string(self.text)
        return cdr.finish()

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        """From the position of a reader."""
        return cls(cdr.string())


@dataclass(frozen=True, slots=True)
class RawPackets(Message):
    """artemis_msgs/msg/RawPackets: what a device sent, byte for byte, one after the other in ``data``.

    Of each packet ``receive_ns`` (n,) by the host's monotonic clock, ``id`` (n,) (of CAN frames; else 0), ``size``
    (n,) in bytes. The header names the device.
    """

    ROS_TYPE: ClassVar[str] = "artemis_msgs/msg/RawPackets"
    header: Header
    receive_ns: NDArray[Any]
    id: NDArray[Any]
    size: NDArray[Any]
    data: Buffer

    def encode(self) -> bytes:
        """The CDR bytes."""
        cdr = CdrWriter()
        self.header.write(cdr)
        cdr.sequence("q", self.receive_ns)
        cdr.sequence("I", self.id)
        cdr.sequence("I", self.size)
        cdr.write("I", len(self.data))
        cdr.octets(self.data)
        return cdr.finish()

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        """From the position of a reader."""
        header, receive = Header.read(cdr), cdr.sequence("q")
        ids, size = cdr.sequence("I"), cdr.sequence("I")
        return cls(header, receive, ids, size, cdr.octets(cdr.read("I")))

    def packets(self) -> list[bytes]:
        """The packets one by one."""
        ends = np.cumsum(self.size, dtype=np.int64).tolist()
        starts = [0, *ends[:-1]]
        return [bytes(self.data[a:b]) for a, b in zip(starts, ends, strict=True)]


@dataclass(frozen=True, slots=True)
class Mask(Message):
    """artemis_msgs/msg/Mask: what a network saw in the image that the header names, for each slot it was asked for.

    ``slot`` uint8 (l,) and ``text`` are the layers, 0 the background; ``score`` is deflated (zlib) uint8 (height,
    width, l), 255 is probability 1; ``grid`` float64 (4,): a cell is scale x, y times the pixel plus offset x, y.
    """

    ROS_TYPE: ClassVar[str] = "artemis_msgs/msg/Mask"
    header: Header
    slot: NDArray[Any]
    text: tuple[str, ...]
    height: int
    width: int
    grid: F64
    score: Buffer

    def encode(self) -> bytes:
        """The CDR bytes."""
        cdr = CdrWriter()
        self.header.write(cdr)
        cdr.sequence("B", self.slot)
        cdr.write("I", len(self.text))
        for text in self.text:
            cdr.string(text)
        cdr.write("I", self.height)
        cdr.write("I", self.width)
        cdr.array("d", self.grid)
        cdr.write("I", len(self.score))
        cdr.octets(self.score)
        return cdr.finish()

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        """From the position of a reader."""
        header, slot = Header.read(cdr), cdr.sequence("B")
        text = tuple(cdr.string() for _ in range(cdr.count(smallest_item=5)))
        height, width, grid = cdr.read("I"), cdr.read("I"), cdr.array("d", 4)
        return cls(header, slot, text, height, width, grid, cdr.octets(cdr.read("I")))


@dataclass(frozen=True, slots=True)
class CameraInfo(Message):
    """sensor_msgs/msg/CameraInfo: ``k`` (9,), ``r`` (9,), ``p`` (12,) row-major, ``d`` of the model."""

    ROS_TYPE: ClassVar[str] = "sensor_msgs/msg/CameraInfo"
    header: Header
    height: int
    width: int
    distortion_model: str
    d: F64
    k: F64
    r: F64
    p: F64
    binning: tuple[int, int] = (0, 0)
    roi: tuple[int, int, int, int, bool] = (0, 0, 0, 0, False)

    def encode(self) -> bytes:
        """The CDR bytes."""
        cdr = CdrWriter()
        self.header.write(cdr)
        cdr.write("I", self.height)
        cdr.write("I", self.width)
        cdr.string(self.distortion_model)
        cdr.sequence("d", self.d)
        cdr.array("d", np.concatenate([self.k, self.r, self.p]))
        for value in (*self.binning, *self.roi[:4]):
            cdr.write("I", value)
        cdr.write("?", self.roi[4])
        return cdr.finish()

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        """From the position of a reader."""
        header, height, width, model = Header.read(cdr), cdr.read("I"), cdr.read("I"), cdr.string()
        d, v = cdr.sequence("d"), cdr.array("d", 30)
        binning = cdr.read("I"), cdr.read("I")
        roi = cdr.read("I"), cdr.read("I"), cdr.read("I"), cdr.read("I"), cdr.read("?")
        return cls(header, height, width, model, d, v[:9], v[9:18], v[18:30], binning, roi)


@dataclass(frozen=True, slots=True)
class TransformStamped:
    """One transform: ``T_header.frame_id_child`` as ``translation`` (3,) m and ``rotation`` (4,)."""

    header: Header
    child_frame_id: str
    translation: F64
    rotation: F64


@dataclass(frozen=True, slots=True)
class TFMessage(Message):
    """tf2_msgs/msg/TFMessage."""

    ROS_TYPE: ClassVar[str] = "tf2_msgs/msg/TFMessage"
    transforms: tuple[TransformStamped, ...]

    def encode(self) -> bytes:
        """The CDR bytes."""
        cdr = CdrWriter()
        cdr.write("I", len(self.transforms))
        for item in self.transforms:
            item.header.write(cdr)
            cdr.string(item.child_frame_id)
            cdr.array("d", np.concatenate([item.translation, item.rotation]))
        return cdr.finish()

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        """From the position of a reader."""
        transforms = []
        for _ in range(cdr.count(smallest_item=72)):
            header, child, v = Header.read(cdr), cdr.string(), cdr.array("d", 7)
            transforms.append(TransformStamped(header, child, v[:3], v[3:]))
        return cls(tuple(transforms))


@dataclass(frozen=True, slots=True)
class Odometry(Message):
    """nav_msgs/msg/Odometry: pose of the child frame in the header's frame, twist in the child frame."""

    ROS_TYPE: ClassVar[str] = "nav_msgs/msg/Odometry"
    header: Header
    child_frame_id: str
    translation: F64
    rotation: F64
    pose_covariance: F64 = field(default_factory=lambda: np.zeros(36))
    linear: F64 = field(default_factory=lambda: np.zeros(3))
    angular: F64 = field(default_factory=lambda: np.zeros(3))
    twist_covariance: F64 = field(default_factory=lambda: np.zeros(36))

    def encode(self) -> bytes:
        """The CDR bytes."""
        cdr = CdrWriter()
        self.header.write(cdr)
        cdr.string(self.child_frame_id)
        parts = (
            self.translation,
            self.rotation,
            self.pose_covariance,
            self.linear,
            self.angular,
            self.twist_covariance,
        )
        cdr.array("d", np.concatenate(parts))
        return cdr.finish()

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        """From the position of a reader."""
        header, child, v = Header.read(cdr), cdr.string(), cdr.array("d", 85)
        return cls(header, child, v[:3], v[3:7], v[7:43], v[43:46], v[46:49], v[49:85])
