"""A few frames of a made-up room, as the messages of a session: every kernel can be compiled or loaded on them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from artemis_edge import topics
from artemis_edge.segmentation import attribute
from artemis_edge.segmentation.backend import DenseScores, Grid
from artemis_edge.session.asked import Asked
from artemis_edge.session.late_masks import pack
from artemis_edge.session.message_ring import Sent
from artemis_edge.session.messages import (
    CameraInfo,
    CompressedImage,
    Header,
    Imu,
    Message,
    Text,
    TFMessage,
    TransformStamped,
)
from artemis_edge.session.writer import SessionWriter, cloud_message

_FRAMES = 4
_FRAME_NS = 100_000_000


def messages(questions: bool) -> Iterator[Sent]:
    """In the order of their arrival; with ``questions`` also what is asked and masks."""
    for number, (topic, message) in enumerate(_room(questions)):
        yield Sent(number, topic, message.ROS_TYPE, 0, 0, message.encode())


def record(folder: Path) -> None:
    """The room as a session in ``folder``."""
    with SessionWriter(folder / "session.mcap") as file:
        for sent in messages(questions=False):
            file.write_encoded(sent.topic, sent.ros_type, sent.data, sent.stamp_ns, sent.log_ns, sent.number)


def _room(questions: bool) -> Iterator[tuple[str, Message]]:
    """Messages of a few frames in a room, of every kind that a frame can hold."""
    rng = np.random.default_rng(0)
    asked = Asked(attribute.manifest(), (), {1: "anything"})
    if questions:
        yield topics.QUESTIONS.name, Text(json.dumps(asked.plain()))
    yield topics.RIG.name, Text('{"topics": {}}')
    forward = np.array([-0.5, 0.5, -0.5, 0.5])  # quaternion of an optical frame that looks along x
    mount = TransformStamped(Header(0, "lidar"), "cam", np.zeros(3), forward)
    yield topics.TF_STATIC.name, TFMessage((mount,))
    K, P = np.array([60.0, 0, 32, 0, 60, 32, 0, 0, 1]), np.zeros(12)
    yield (
        topics.CAMERA_INFO.name,
        CameraInfo(Header(0, "cam"), 64, 64, "plumb_bob", np.zeros(5), K, np.eye(3).ravel(), P),
    )
    picture = cv2.imencode(".jpg", rng.integers(0, 255, (64, 64, 3)).astype(np.uint8))[1].tobytes()
    for k in range(_FRAMES):
        stamp = k * _FRAME_NS
        for sample in range(20):
            at = stamp + sample * _FRAME_NS // 20
            yield topics.IMU.name, Imu(Header(at, "lidar"), np.zeros(3), np.array([0.0, 0.0, 9.81]))
        yield (
            topics.CAMERA_IMAGE.name,
            CompressedImage(Header(stamp + _FRAME_NS // 2, "cam"), "jpeg", picture),
        )
        if questions:
            scores = DenseScores((0, 1), np.full((4, 4, 2), 127, np.uint8), Grid(0.05, 0.05, 0.0, 0.0))
            yield topics.MASKS.name, pack("cam", stamp + _FRAME_NS // 2, asked.prompts, scores)
        n = 6000
        points = rng.uniform([-6, -4, -1.5], [6, 4, 2.5], (n, 3)).astype(np.float32)
        wall = rng.integers(0, 3, n)
        points[wall == 0, 0], points[wall == 1, 1], points[wall == 2, 2] = 6.0, -4.0, -1.5
        offset = np.linspace(0, _FRAME_NS - 1, n).astype(np.uint32)
        yield (
            topics.LIDAR_POINTS.name,
            cloud_message(stamp, points, np.full(n, 0.5, np.float32), offset_ns=offset),
        )
    if questions:
        yield topics.QUESTIONS.name, Text(json.dumps(Asked(asked.model).plain()))
