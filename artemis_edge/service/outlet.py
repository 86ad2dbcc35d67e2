"""Where the messages of a session go: encoded once, into the ring, in order of their log time."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from typing import Any

import numpy as np

from artemis_edge import topics
from artemis_edge.frames import F64, CameraModel
from artemis_edge.service.settings import RunConfig, device_name
from artemis_edge.session.assembly import RigTopics
from artemis_edge.session.cdr import Buffer
from artemis_edge.session.message_ring import MessageRing
from artemis_edge.session.messages import Header, Message, RawPackets, Text, TFMessage, TransformStamped
from artemis_edge.session.writer import camera_info
from artemis_edge.trajectory import quaternion_from_matrix


class Outlet:
    """Publishes while a session is recorded (``open`` to ``close``), from one thread; events from any.

    The log time of a message is the host's monotonic clock plus ``wall_ns``, the wall clock's lead when the service
    began: it never jumps. ``lost`` counts messages that can never fit the ring.
    """

    def __init__(self, ring: MessageRing) -> None:
        self.ring = ring
        self.wall_ns = time.time_ns() - time.monotonic_ns()
        self.is_open = False
        self.lost: Counter[str] = Counter()
        self.sent: Counter[str] = Counter()
        self._last_ns = 0
        self._lock = threading.RLock()

    def send(self, topic: str, message: Message, stamp_ns: int, rx_ns: int | None = None) -> None:
        """A message measured at session time ``stamp_ns`` and received at host time ``rx_ns`` (None: now)."""
        if self.is_open:
            self.send_encoded(topic, message.ROS_TYPE, message.encode(), stamp_ns, rx_ns)

    def send_encoded(
        self, topic: str, ros_type: str, data: Buffer, stamp_ns: int, rx_ns: int | None = None
    ) -> None:
        """As ``send``, of a message that is encoded already."""
        if not self.is_open:
            return
        with self._lock:
            received = time.monotonic_ns() if rx_ns is None else rx_ns
            self._last_ns = max(self._last_ns, received + self.wall_ns)
            try:
                self.ring.publish(topic, ros_type, self._last_ns, stamp_ns, data)
            except ValueError:
                self.lost["messages_too_large"] += 1
                return
            self.sent[topic] += 1

    def say(self, topic: str, value: Any, rx_ns: int | None = None) -> None:
        """A JSON text."""
        now = time.monotonic_ns() if rx_ns is None else rx_ns
        self.send(topic, Text(json.dumps(value)), now + self.wall_ns, rx_ns)

    def raw(self, topic: str, device: str, rx_ns: Any, ids: Any, sizes: Any, data: Buffer) -> None:
        """What a device sent."""
        if self.is_open and len(rx_ns):
            last = int(rx_ns[-1])
            header = Header(last + self.wall_ns, device)
            self.send(
                topic,
                RawPackets(header, np.asarray(rx_ns), np.asarray(ids), np.asarray(sizes), data),
                last,
                last,
            )

    def open(self, config: RunConfig, about: dict[str, Any], asked: dict[str, Any] | None = None) -> int:
        """Begin a session with what readers need first; returns the number of its first message.

        ``asked`` are the questions to begin with, None where none can be asked.
        """
        with self._lock:  # before anything that is measured
            return self._open(config, about, asked)

    def _open(self, config: RunConfig, about: dict[str, Any], asked: dict[str, Any] | None) -> int:
        first = self.ring.published
        self.is_open = True
        self.sent.clear()
        topic_names = rig_topics(config)
        self.say(
            topics.RIG.name, {"topics": _plain(topic_names), "wall_minus_monotonic_ns": self.wall_ns, **about}
        )
        now = time.monotonic_ns() + self.wall_ns
        if asked is not None:
            self.say(topics.QUESTIONS.name, asked)
        for child, T in mounts(config):
            self.send(topics.TF_STATIC.name, TFMessage((_static(now, child, T),)), now)
        for entry, name in zip(config.camera, camera_prefixes(config), strict=True):
            self._camera(name, entry.device.name, entry.model(), now)
        return first

    def close(self) -> int:
        """End the session; returns the number of the message after its last."""
        with self._lock:
            self.is_open = False
            return self.ring.published

    def _camera(self, prefix: str, frame_id: str, model: CameraModel, now: int) -> None:
        self.send(f"{prefix}/camera_info", camera_info(now, model, frame_id), now)


def lidar_topic(number: int) -> str:
    """Topic of the n-th LiDAR's clouds."""
    return topics.LIDAR_POINTS.name if number == 0 else f"/lidar_{number}/points"


def lidar_frame(config: RunConfig, number: int) -> str:
    """Frame of the n-th LiDAR: the primary is ``lidar``."""
    return "lidar" if number == 0 else device_name(config.lidar[number])


def camera_prefixes(config: RunConfig) -> list[str]:
    """Where each camera's topics begin: /camera, and with several of them /camera/NAME."""
    if len(config.camera) == 1:
        return ["/camera"]
    return [f"/camera/{entry.device.name}" for entry in config.camera]


def rig_topics(config: RunConfig) -> RigTopics:
    """What makes a frame."""
    imu = topics.IMU.name if config.imu is not None else topics.LIDAR_IMU.name
    prefixes = camera_prefixes(config)
    cameras = [f"{prefix}/image{ending}" for prefix in prefixes for ending in ("/compressed", "")]
    return RigTopics(tuple(lidar_topic(k) for k in range(len(config.lidar))), imu, tuple(cameras))


def mounts(config: RunConfig) -> list[tuple[str, F64]]:
    """Every sensor with its place on the primary LiDAR: frame, T_lidar_frame."""
    found = [(lidar_frame(config, k), config.lidar[k].mount.matrix()) for k in range(1, len(config.lidar))]
    if config.imu is not None:
        found.append(("imu", config.imu.mount.matrix()))
    if config.lidar_imu:
        found.append(("lidar_imu", config.lidar_imu_mount.matrix()))
    return found + [(entry.device.name, entry.mount.matrix()) for entry in config.camera]


def _static(now: int, child: str, T: F64) -> TransformStamped:
    return TransformStamped(Header(now, "lidar"), child, T[:3, 3], quaternion_from_matrix(T))


def _plain(value: RigTopics) -> dict[str, Any]:
    return {"lidars": list(value.lidars), "imu": value.imu, "cameras": list(value.cameras)}
