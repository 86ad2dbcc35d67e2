"""Writes a session: one MCAP file that ROS 2 tools, Foxglove and ``datasets/rosbag.py`` read back.

Profile ``ros2``, schemas ``ros2msg``, messages CDR, chunks of 1 MiB compressed with lz4. Configuration and
calibration go in front of the first message, so that they survive a crash; what is complete is pushed to the
disk once a second of receive time. ``log_time`` is the receive time of the host, ``publish_time`` and the
header's stamp are the sensor's time, both int64 ns of session time.

    with SessionWriter(path, attachments={"config.toml": text}, metadata={"device": {"serial": "1"}}) as out:
        out.write_tf_static(0, "lidar", "cam", T_lidar_cam)
        out.write_points(stamp_ns, points, intensity=intensity, offset_ns=offset_ns)
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from mcap.writer import CompressionType, Writer

from artemis_edge import topics
from artemis_edge.errors import RunError
from artemis_edge.frames import F32, F64, U8, CameraModel
from artemis_edge.session.cdr import Buffer
from artemis_edge.session.messages import (
    FIELD_TYPES,
    CameraExposure,
    CameraInfo,
    CompressedImage,
    Header,
    Image,
    Imu,
    Message,
    Odometry,
    PointCloud2,
    PointField,
    TFMessage,
    TransformStamped,
)
from artemis_edge.session.schemas import schema_text
from artemis_edge.trajectory import quaternion_from_matrix

CHUNK_BYTES = 1 << 20
# Metres, reflectivity 0..1, the Livox tag and line, and nanoseconds after the header's stamp.
POINT = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "<f4"),
        ("tag", "u1"),
        ("line", "u1"),
        ("t", "<u4"),
    ]
)
_SECOND_NS = 1_000_000_000
_SEQUENCES = 2**32  # MCAP numbers messages by a uint32


class SessionWriter:
    """Writer of one session file.

    ``path`` is the ``.mcap`` file; its folder is created and an existing file replaced. ``attachments`` maps
    file names to their content, ``metadata`` record names to key-value texts. Every ``write_*`` takes
    ``stamp_ns``, the sensor's time, and ``receive_ns``, the host's (None: the same). The same calls write the
    same bytes. Raises RunError, one sentence, when the disk refuses; what was complete stays readable.
    """

    def __init__(
        self,
        path: Path,
        *,
        attachments: Mapping[str, str | bytes] | None = None,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        sync_every_ns: int = _SECOND_NS,
    ) -> None:
        self.path = path
        self._sync_every_ns = sync_every_ns
        self._last_sync_ns: int | None = None
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, tuple[int, str]] = {}
        self._sequence: dict[str, int] = {}
        self._file = self._open()
        self._mcap = Writer(self._file, CHUNK_BYTES, CompressionType.LZ4)
        self._guard(lambda: self._start(attachments or {}, metadata or {}))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write_points(
        self,
        stamp_ns: int,
        points: F32,
        *,
        intensity: F32 | None = None,
        tag: U8 | None = None,
        line: U8 | None = None,
        offset_ns: np.ndarray[Any, Any] | None = None,
        receive_ns: int | None = None,
        frame_id: str = "lidar",
        topic: str = topics.LIDAR_POINTS.name,
    ) -> None:
        """A LiDAR window: ``points`` (n, 3) m, ``intensity`` (n,) 0..1, ``offset_ns`` (n,) from the stamp on.

        What is None is written as zero. ``tag`` and ``line`` are the bytes of the Livox protocol.
        """
        message = cloud_message(
            stamp_ns, points, intensity, tag=tag, line=line, offset_ns=offset_ns, frame_id=frame_id
        )
        self.write(topic, message, stamp_ns, receive_ns)

    def write_cloud(
        self,
        stamp_ns: int,
        cloud: np.ndarray[Any, Any],
        *,
        receive_ns: int | None = None,
        frame_id: str = "lidar",
        topic: str = topics.LIDAR_POINTS.name,
    ) -> None:
        """Rows of a structured array (n,), packed, as a PointCloud2 with the same fields."""
        self.write(topic, structured_cloud(stamp_ns, cloud, frame_id), stamp_ns, receive_ns)

    def write_imu(
        self,
        stamp_ns: int,
        gyro: F64,
        accel: F64,
        *,
        receive_ns: int | None = None,
        frame_id: str = "imu",
        topic: str = topics.IMU.name,
    ) -> None:
        """One sample: ``gyro`` (3,) rad/s and ``accel`` (3,) m/s2, axes of ``frame_id``."""
        message = Imu(Header(stamp_ns, frame_id), np.asarray(gyro, np.float64), np.asarray(accel, np.float64))
        self.write(topic, message, stamp_ns, receive_ns)

    def write_image(
        self,
        stamp_ns: int,
        encoded: bytes,
        *,
        encoding: str = "jpeg",
        receive_ns: int | None = None,
        frame_id: str = "cam",
        topic: str = topics.CAMERA_IMAGE.name,
    ) -> None:
        """An encoded photograph; ``stamp_ns`` is the middle of its exposure."""
        self.write(
            topic, CompressedImage(Header(stamp_ns, frame_id), encoding, encoded), stamp_ns, receive_ns
        )

    def write_raw_image(
        self,
        stamp_ns: int,
        data: bytes,
        model: CameraModel,
        *,
        encoding: str,
        receive_ns: int | None = None,
        frame_id: str = "cam",
        topic: str = topics.CAMERA_RAW.name,
    ) -> None:
        """A photograph row by row, one byte a pixel; ``encoding`` as ROS names it, for example bayer_rggb8."""
        header = Header(stamp_ns, frame_id)
        message = Image(header, model.height, model.width, encoding, model.width, data)
        self.write(topic, message, stamp_ns, receive_ns)

    def write_exposure(
        self,
        stamp_ns: int,
        exposure_s: float,
        gain: float,
        *,
        receive_ns: int | None = None,
        frame_id: str = "cam",
        topic: str = topics.CAMERA_EXPOSURE.name,
    ) -> None:
        """How the image of the same stamp was exposed: seconds, and gain (1: none)."""
        message = CameraExposure(Header(stamp_ns, frame_id), exposure_s, gain)
        self.write(topic, message, stamp_ns, receive_ns)

    def write_camera_info(
        self,
        stamp_ns: int,
        model: CameraModel,
        *,
        receive_ns: int | None = None,
        frame_id: str = "cam",
        topic: str = topics.CAMERA_INFO.name,
    ) -> None:
        """The camera's model, distortion in the order of ``plumb_bob``."""
        self.write(topic, camera_info(stamp_ns, model, frame_id), stamp_ns, receive_ns)

    def write_tf(
        self, stamp_ns: int, parent: str, child: str, T_parent_child: F64, *, receive_ns: int | None = None
    ) -> None:
        """A moving transform, for example world and lidar."""
        message = TFMessage((_transform(stamp_ns, parent, child, T_parent_child),))
        self.write(topics.TF.name, message, stamp_ns, receive_ns)

    def write_tf_static(
        self, stamp_ns: int, parent: str, child: str, T_parent_child: F64, *, receive_ns: int | None = None
    ) -> None:
        """A mounting, valid for the whole session."""
        message = TFMessage((_transform(stamp_ns, parent, child, T_parent_child),))
        self.write(topics.TF_STATIC.name, message, stamp_ns, receive_ns)

    def write_odometry(
        self,
        stamp_ns: int,
        T_parent_child: F64,
        *,
        linear: F64 | None = None,
        angular: F64 | None = None,
        receive_ns: int | None = None,
        parent: str = "odom",
        child: str = "lidar",
        topic: str = topics.ODOMETRY.name,
    ) -> None:
        """An estimated pose, with the twist of the child in its own axes (m/s, rad/s; None: zero)."""
        message = Odometry(
            Header(stamp_ns, parent),
            child,
            T_parent_child[:3, 3],
            quaternion_from_matrix(T_parent_child),
            linear=np.zeros(3) if linear is None else linear,
            angular=np.zeros(3) if angular is None else angular,
        )
        self.write(topic, message, stamp_ns, receive_ns)

    def write(self, topic: str, message: Message, stamp_ns: int, receive_ns: int | None = None) -> None:
        """Any message of ``session/messages.py``; the topic is declared when it first appears."""
        receive_ns = stamp_ns if receive_ns is None else receive_ns
        self._guard(lambda: self._add(topic, message, stamp_ns, receive_ns))

    def write_encoded(
        self, topic: str, ros_type: str, data: Buffer, stamp_ns: int, receive_ns: int, sequence: int
    ) -> None:
        """A message that is encoded already, with a sequence number of the caller's; whoever calls it also flushes."""
        self._guard(lambda: self._put(topic, ros_type, data, stamp_ns, receive_ns, sequence))

    def position(self) -> int:
        """Bytes of the file that are complete; what is in the open chunk comes on top."""
        return 0 if self._file.closed else self._file.tell()

    def flush(self) -> None:
        """Close the open chunk and push it to the disk."""
        self._guard(self._sync)

    def close(self) -> None:
        """Write the index and close the file; a second call does nothing."""
        if not self._file.closed:
            self._guard(self._finish)

    def _open(self) -> IO[bytes]:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            return self.path.open("wb")
        except OSError as error:
            raise self._refused(error) from None

    def _start(
        self, attachments: Mapping[str, str | bytes], metadata: Mapping[str, Mapping[str, str]]
    ) -> None:
        # Not the library's own name: it carries a version, and the same calls shall write the same bytes.
        self._mcap.start("ros2", "artemis-edge")
        for name, content in attachments.items():
            media = "application/toml" if name.endswith(".toml") else "application/octet-stream"
            data = content.encode() if isinstance(content, str) else content
            self._mcap.add_attachment(0, 0, name, media, data)
        for name, record in metadata.items():
            self._mcap.add_metadata(name, dict(record))
        self._sync()

    def _put(
        self, topic: str, ros_type: str, data: Buffer, stamp_ns: int, receive_ns: int, sequence: int
    ) -> None:
        channel = self._channel(topic, ros_type)
        self._mcap.add_message(channel, receive_ns, data, stamp_ns, sequence % _SEQUENCES)

    def _add(self, topic: str, message: Message, stamp_ns: int, receive_ns: int) -> None:
        sequence = self._sequence.get(topic, 0)
        self._sequence[topic] = sequence + 1
        self._put(topic, message.ROS_TYPE, message.encode(), stamp_ns, receive_ns, sequence)
        if self._last_sync_ns is None:
            self._last_sync_ns = receive_ns
        elif receive_ns - self._last_sync_ns >= self._sync_every_ns:
            self._sync()
            self._last_sync_ns = receive_ns

    def _channel(self, topic: str, ros_type: str) -> int:
        if topic not in self._channels:
            if ros_type not in self._schemas:
                text = schema_text(ros_type).encode()
                self._schemas[ros_type] = self._mcap.register_schema(ros_type, "ros2msg", text)
            channel = self._mcap.register_channel(topic, "cdr", self._schemas[ros_type])
            self._channels[topic] = (channel, ros_type)
        channel, declared = self._channels[topic]
        if declared != ros_type:
            raise ValueError(f"{topic} carries {declared}, not {ros_type}")
        return channel

    def _sync(self) -> None:
        self._mcap.flush()
        self._file.flush()
        os.fdatasync(self._file.fileno())

    def _finish(self) -> None:
        self._mcap.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def _guard(self, action: Callable[[], None]) -> None:
        """Run an action that writes; a full or removed disk ends the session with one sentence."""
        try:
            action()
        except OSError as error:
            self._abandon()
            raise self._refused(error) from None

    def _abandon(self) -> None:
        """Close the file although its buffer cannot be written."""
        try:
            self._file.close()
        except OSError:
            return

    def _refused(self, error: OSError) -> RunError:
        return RunError(
            f"cannot write the session {self.path}: {error.strerror}; free space or choose another disk"
        )


def camera_info(stamp_ns: int, model: CameraModel, frame_id: str) -> CameraInfo:
    """The message of a camera's model, distortion in the order of ``plumb_bob``."""
    K = np.array([model.fx, 0.0, model.cx, 0.0, model.fy, model.cy, 0.0, 0.0, 1.0])
    P = np.zeros((3, 4))
    P[:, :3] = K.reshape(3, 3)
    d, R, header = np.array(model.distortion, np.float64), np.eye(3).ravel(), Header(stamp_ns, frame_id)
    return CameraInfo(header, model.height, model.width, "plumb_bob", d, K, R, P.ravel())


def cloud_message(
    stamp_ns: int,
    points: F32,
    intensity: F32 | None = None,
    *,
    tag: U8 | None = None,
    line: U8 | None = None,
    offset_ns: np.ndarray[Any, Any] | None = None,
    frame_id: str = "lidar",
) -> PointCloud2:
    """A LiDAR window as ``SessionWriter.write_points`` takes it."""
    cloud = np.zeros(len(points), POINT)
    for axis, name in enumerate("xyz"):
        cloud[name] = points[:, axis]
    columns = {"intensity": intensity, "tag": tag, "line": line, "t": offset_ns}
    for name, values in columns.items():
        if values is not None:
            cloud[name] = values
    return structured_cloud(stamp_ns, cloud, frame_id)


def structured_cloud(stamp_ns: int, cloud: np.ndarray[Any, Any], frame_id: str) -> PointCloud2:
    """Rows of a structured array (n,), packed, with the same fields."""
    fields = tuple(
        PointField(name, offset, FIELD_TYPES[dtype.str[1:]])
        for name, (dtype, offset, *_) in (cloud.dtype.fields or {}).items()
    )
    step, header = cloud.dtype.itemsize, Header(stamp_ns, frame_id)
    data = np.ascontiguousarray(cloud).view(np.uint8).data
    return PointCloud2(header, 1, len(cloud), fields, step, cloud.nbytes, data)


def _transform(stamp_ns: int, parent: str, child: str, T: F64) -> TransformStamped:
    return TransformStamped(Header(stamp_ns, parent), child, T[:3, 3], quaternion_from_matrix(T))
