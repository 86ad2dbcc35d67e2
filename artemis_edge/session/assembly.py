"""Frames from the messages of a session in the order in which they came.

A frame is complete when the cloud of the primary LiDAR comes: it has the clouds of the other LiDARs, the photographs
and the samples that came since the cloud before. Whoever sends the messages (service/capture.py) waits with the cloud
for what belongs to it. So the frames follow from the messages alone: live and in replay they are the same.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
from msgspec import Struct, convert

from artemis_edge import topics
from artemis_edge.datasets.bag_index import CLOUDS, IMAGES
from artemis_edge.datasets.cameras import camera_model, encoded_image, exposure_s, info_topics
from artemis_edge.datasets.clouds import CloudFormat, decode_cloud, point_records, settle_format
from artemis_edge.datasets.common import add_counts
from artemis_edge.datasets.tf_tree import TransformTree
from artemis_edge.frames import F64, CameraImage, CameraModel, ImuSamples, LidarScan, SyncedFrame
from artemis_edge.session.cdr import CdrError
from artemis_edge.session.message_ring import Sent
from artemis_edge.session.messages import (
    CameraExposure,
    CameraInfo,
    CompressedImage,
    Header,
    Image,
    Imu,
    LivoxCustomMsg,
    PointCloud2,
    Text,
    TFMessage,
)


class RigTopics(Struct, frozen=True):
    """Which topics make a frame: the message of topics.RIG. The defaults are those of ``simulate``."""

    lidars: tuple[str, ...] = (topics.LIDAR_POINTS.name,)
    imu: str = topics.IMU.name
    cameras: tuple[str, ...] = (topics.CAMERA_IMAGE.name, topics.CAMERA_RAW.name)


@dataclass(slots=True)
class _Photo:
    topic: str
    frame_id: str
    stamp_ns: int
    encoded: bytes


class FrameAssembler:
    """``take`` the messages one by one. ``lost`` counts by reason what no frame got.

    ``next_index`` is the index of the next frame, ``models`` are the cameras by the topic of their CameraInfo.
    """

    def __init__(self) -> None:
        self.rig = RigTopics()
        self.next_index = 0
        self.lost: dict[str, int] = {}
        self._tree = TransformTree()
        self.models: dict[str, CameraModel] = {}
        self._formats: dict[str, CloudFormat] = {}
        self._begin()

    def take(self, sent: Sent) -> SyncedFrame | None:
        """The frame that a message completes, None for others. What cannot be decoded is counted."""
        try:
            return self._take(sent)
        except CdrError:
            self._count("undecodable_messages")
            return None

    def _begin(self) -> None:
        self._scans: list[tuple[Header, LidarScan]] = []
        self._photos: list[_Photo] = []
        self._exposure: dict[tuple[str, int], float] = {}
        self._samples: list[tuple[int, F64]] = []
        self._imu_frame = ""
        self._counts: dict[str, int] = {}

    def _take(self, sent: Sent) -> SyncedFrame | None:
        kind = sent.ros_type
        if kind in CLOUDS and sent.topic in self.rig.lidars:
            header = self._cloud(sent)
            return self._complete(header) if sent.topic == self.rig.lidars[0] else None
        if kind == Imu.ROS_TYPE and sent.topic == self.rig.imu:
            sample = Imu.decode(sent.data)
            self._imu_frame = sample.header.frame_id
            self._samples.append((sample.header.stamp_ns, np.concatenate([sample.gyro, sample.accel])))
        elif kind in IMAGES and sent.topic in self.rig.cameras:
            self._photo(sent.topic, IMAGES[kind].decode(sent.data))
        elif kind == CameraExposure.ROS_TYPE:
            exposure = CameraExposure.decode(sent.data)
            self._exposure[exposure.header.frame_id, exposure.header.stamp_ns] = exposure_s(exposure)
        else:
            self._note(sent)
        return None

    def _note(self, sent: Sent) -> None:
        """What holds from now on."""
        if sent.ros_type == CameraInfo.ROS_TYPE:
            model = camera_model(CameraInfo.decode(sent.data), rectified=False)
            if model is not None:
                self.models[sent.topic] = model
        elif sent.topic == topics.TF_STATIC.name:
            for item in TFMessage.decode(sent.data).transforms:
                self._tree.add(
                    item.header.frame_id,
                    item.child_frame_id,
                    item.header.stamp_ns,
                    item.translation,
                    item.rotation,
                    moving=False,
                )
        elif sent.topic == topics.RIG.name:
            self.rig = convert(json.loads(Text.decode(sent.data).text)["topics"], RigTopics)
        elif sent.topic == topics.LOST.name:
            add_counts(self._counts, json.loads(Text.decode(sent.data).text))

    def _cloud(self, sent: Sent) -> Header:
        message: PointCloud2 | LivoxCustomMsg = CLOUDS[sent.ros_type].decode(sent.data)
        header = message.header
        if sent.topic not in self._formats and len(point_records(message)):
            self._formats[sent.topic] = settle_format(message)
        points = decode_cloud(message, self._formats.get(sent.topic, CloudFormat()))
        add_counts(self._counts, points.lost)
        scan = LidarScan(
            points.points, header.stamp_ns, points.offset_s, points.intensity, name=header.frame_id
        )
        if len(points.points):
            self._scans.append((header, scan))
        return header

    def _photo(self, topic: str, message: CompressedImage | Image) -> None:
        self._photos.append(
            _Photo(topic, message.header.frame_id, message.header.stamp_ns, encoded_image(message))
        )

    def _complete(self, header: Header) -> SyncedFrame:
        lidar = header.frame_id
        scans = tuple(scan for place, scan in self._mounted(lidar) if place is not None)
        images = tuple(image for photo in self._photos if (image := self._image(photo, lidar)) is not None)
        frame = SyncedFrame(self.next_index, header.stamp_ns, scans, images, self._imu(lidar), self._counts)
        self.next_index += 1
        self._begin()
        return frame

    def _mounted(self, lidar: str) -> list[tuple[F64 | None, LidarScan]]:
        """Scans with their mounting, the primary first."""
        found = []
        for header, scan in sorted(self._scans, key=lambda pair: pair[0].frame_id != lidar):
            T = self.mounting(lidar, header.frame_id)
            if T is None:
                self._count("clouds_without_mounting")
            else:
                scan = LidarScan(scan.points, scan.stamp_ns, scan.offset_s, scan.intensity, T, scan.name)
            found.append((T, scan))
        return found

    def _image(self, photo: _Photo, lidar: str) -> CameraImage | None:
        model = next((self.models[name] for name in info_topics(photo.topic) if name in self.models), None)
        T = self.mounting(photo.frame_id, lidar)
        if model is None or T is None:
            self._count("images_uncalibrated" if model is None else "images_without_mounting")
            return None
        exposure = self._exposure.get((photo.frame_id, photo.stamp_ns), 0.0)
        return CameraImage(photo.frame_id, photo.stamp_ns, photo.encoded, model, T, exposure)

    def _imu(self, lidar: str) -> ImuSamples:
        """Samples in the axes of the primary LiDAR, in order of time."""
        if not self._samples:
            return ImuSamples.empty()
        T = self.mounting(lidar, self._imu_frame)
        R = np.eye(3) if T is None else T[:3, :3]
        stamps = np.array([stamp for stamp, _ in self._samples], np.int64)
        values = np.array([value for _, value in self._samples])
        order = np.argsort(stamps, kind="stable")
        return ImuSamples(stamps[order], values[order, :3] @ R.T, values[order, 3:] @ R.T)

    def mounting(self, target: str, source: str) -> F64 | None:
        """T_target_source (4, 4), None where tf does not join them."""
        if target == source:
            return np.eye(4)
        T, known = self._tree.lookup(target, source, np.zeros(1, np.int64))
        return T[0] if known[0] else None

    def _count(self, reason: str) -> None:
        add_counts(self.lost, {reason: 1})
