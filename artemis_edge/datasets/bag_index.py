"""One pass over a recording: when and where everything is, and the small messages themselves.

Of clouds and images only the headers are read; they are fetched when their frame is asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from artemis_edge.datasets.bag import HEAD_BYTES, WHOLE, Bag, Connection, Entry
from artemis_edge.datasets.cameras import exposure_s
from artemis_edge.datasets.common import add_counts
from artemis_edge.datasets.tf_tree import TransformTree
from artemis_edge.frames import F64, I64
from artemis_edge.session.cdr import Buffer, CdrError
from artemis_edge.session.messages import (
    CameraExposure,
    CameraInfo,
    CompressedImage,
    Header,
    Image,
    Imu,
    LivoxCustomMsg,
    Message,
    Odometry,
    PointCloud2,
    TFMessage,
    TransformStamped,
)

CLOUDS: dict[str, type[PointCloud2 | LivoxCustomMsg]] = {
    PointCloud2.ROS_TYPE: PointCloud2,
    LivoxCustomMsg.ROS_TYPE: LivoxCustomMsg,
    "livox_ros_driver/msg/CustomMsg": LivoxCustomMsg,
    "livox_interfaces/msg/CustomMsg": LivoxCustomMsg,
}
IMAGES: dict[str, type[CompressedImage | Image]] = {
    CompressedImage.ROS_TYPE: CompressedImage,
    Image.ROS_TYPE: Image,
}
_M = TypeVar("_M", bound=Message)
_TRANSFORMS = (TFMessage.ROS_TYPE, "tf/msg/tfMessage")
# rad/s and m/s2: beyond it, and where it is NaN, a sample is garbage.
_IMU_LIMIT = 1e5
# A static transform stands in a message of its own topic, whatever the robot's prefix.
_STATIC_TOPIC = "tf_static"


@dataclass(frozen=True, slots=True)
class Reference:
    """A message that can be fetched."""

    bag: Bag
    connection: Connection
    where: Any

    def data(self) -> Buffer:
        """Its bytes; CdrError if they cannot be read."""
        return self.bag.fetch(self.where)


# Messages may overtake each other by less.
_SET_BACK_NS = 500_000_000


@dataclass(slots=True)
class Track:
    """The messages of one topic in order of their stamps; ``frame_id`` is that of the first."""

    topic: str
    ros_type: str
    frame_id: str
    stamps: list[int] = field(default_factory=list)
    logs: list[int] = field(default_factory=list)
    references: list[Reference] = field(default_factory=list)

    def stamp_ns(self) -> I64:
        """Stamps (n,); those of the recorder where the sensor left its own empty."""
        return _stamps(self.stamps, self.logs)


def _stamps(stamps: list[int], logs: list[int]) -> I64:
    return np.array(stamps if any(stamps) else logs, np.int64)


@dataclass(slots=True)
class ImuTrack:
    """The samples of one IMU topic as they came: gyro and accel, six numbers a row."""

    frame_id: str
    stamps: list[int] = field(default_factory=list)
    logs: list[int] = field(default_factory=list)
    values: list[F64] = field(default_factory=list)

    def stamp_ns(self) -> I64:
        """Stamps (n,), those of the recorder where the sensor left its own empty."""
        return _stamps(self.stamps, self.logs)


@dataclass(slots=True)
class OdometryTrack:
    """The poses of one Odometry topic: position and quaternion, seven numbers a row."""

    frame_id: str
    child_frame_id: str
    stamps: list[int] = field(default_factory=list)
    values: list[F64] = field(default_factory=list)


class BagIndex:
    """What the files of a recording hold, by topic."""

    def __init__(self, bags: list[Bag]) -> None:
        self.clouds: dict[str, Track] = {}
        self.images: dict[str, Track] = {}
        self.imus: dict[str, ImuTrack] = {}
        self.odometries: dict[str, OdometryTrack] = {}
        self.infos: dict[str, CameraInfo] = {}
        self.exposures: dict[tuple[str, int], float] = {}  # seconds, by frame and stamp of the photograph
        self.tree = TransformTree()
        self.types: dict[str, str] = {}
        self.lost: dict[str, int] = {}
        self.warnings: list[str] = []
        for bag in bags:
            for entry in bag.scan(self._needed):
                self._enter(bag, entry)
            add_counts(self.lost, bag.lost)
            self.warnings += bag.warnings
        if self.tree.broken:
            add_counts(self.lost, {"broken_transforms": self.tree.broken})
            self.warnings.append(f"{self.tree.broken} transforms are not rigid and left out")
        if count := self.lost.get("undecodable_messages"):
            self.warnings.append(f"{count} messages cannot be decoded and are left out")
        for topic, track in (self.clouds | self.images | self.imus).items():
            self._tell_steps_back(topic, track.stamp_ns())

    def _tell_steps_back(self, topic: str, stamp_ns: I64) -> None:
        """A clock that was set while recording: what follows lies among, or before, what was recorded earlier."""
        steps = np.diff(stamp_ns)
        count = np.count_nonzero(steps < -_SET_BACK_NS)
        if count:
            times = "once" if count == 1 else f"{count} times"
            self.warnings.append(
                f"the stamps of {topic} go back {times}, by up to {-steps.min() / 1e9:.1f} s: its clock was set while "
                "recording; all is taken in order of the stamps"
            )

    def _needed(self, connection: Connection) -> int:
        self.types[connection.topic] = connection.ros_type
        if connection.ros_type in CLOUDS or connection.ros_type in IMAGES:
            return HEAD_BYTES
        return WHOLE if connection.ros_type in _READERS else 0

    def _enter(self, bag: Bag, entry: Entry) -> None:
        connection = entry.connection
        try:
            if connection.ros_type in CLOUDS:
                self._track(self.clouds, bag, entry)
            elif connection.ros_type in IMAGES:
                self._track(self.images, bag, entry)
            else:
                _READERS[connection.ros_type](self, connection, entry)
        except CdrError:
            add_counts(self.lost, {"undecodable_messages": 1})

    def _track(self, tracks: dict[str, Track], bag: Bag, entry: Entry) -> None:
        connection = entry.connection
        header = Header.read(connection.reader(entry.data))
        track = tracks.get(connection.topic)
        if track is None:
            track = tracks[connection.topic] = Track(connection.topic, connection.ros_type, header.frame_id)
        track.stamps.append(header.stamp_ns)
        track.logs.append(entry.log_ns)
        track.references.append(Reference(bag, connection, entry.where))

    def _imu(self, connection: Connection, entry: Entry) -> None:
        message = _read(Imu, connection, entry)
        value = np.concatenate([message.gyro, message.accel]).astype(np.float64)
        if not bool((np.abs(value) < _IMU_LIMIT).all()):
            raise CdrError("an IMU sample is not a measurement")
        track = self.imus.setdefault(connection.topic, ImuTrack(message.header.frame_id))
        track.stamps.append(message.header.stamp_ns)
        track.logs.append(entry.log_ns)
        track.values.append(value)

    def _info(self, connection: Connection, entry: Entry) -> None:
        if connection.topic not in self.infos:
            self.infos[connection.topic] = _read(CameraInfo, connection, entry)

    def _exposure(self, connection: Connection, entry: Entry) -> None:
        message = _read(CameraExposure, connection, entry)
        self.exposures[message.header.frame_id, message.header.stamp_ns] = exposure_s(message)

    def _transforms(self, connection: Connection, entry: Entry) -> None:
        moving = not connection.topic.endswith(_STATIC_TOPIC)
        for item in _read(TFMessage, connection, entry).transforms:
            self._transform(item, moving)

    def _transform(self, item: TransformStamped, moving: bool) -> None:
        header = item.header
        self.tree.add(
            header.frame_id,
            item.child_frame_id,
            header.stamp_ns,
            item.translation,
            item.rotation,
            moving=moving,
        )

    def _odometry(self, connection: Connection, entry: Entry) -> None:
        message = _read(Odometry, connection, entry)
        frame, child = message.header.frame_id, message.child_frame_id
        track = self.odometries.setdefault(connection.topic, OdometryTrack(frame, child))
        track.stamps.append(message.header.stamp_ns)
        track.values.append(np.concatenate([message.translation, message.rotation]).astype(np.float64))


def _read(kind: type[_M], connection: Connection, entry: Entry) -> _M:
    return kind.read(connection.reader(entry.data))


_READERS: dict[str, Callable[[BagIndex, Connection, Entry], None]] = {
    Imu.ROS_TYPE: BagIndex._imu,
    CameraInfo.ROS_TYPE: BagIndex._info,
    CameraExposure.ROS_TYPE: BagIndex._exposure,
    Odometry.ROS_TYPE: BagIndex._odometry,
    **dict.fromkeys(_TRANSFORMS, BagIndex._transforms),
}
