"""What the recorder costs: everything a rig sends, at its pace, into a recorder of its own process.

    python tests/bench/bench_recorder.py [--seconds 30] [--out DIR]

24,000 points and 250 raw packets every 100 ms, 400 IMU samples a second, ten JPEGs of 1280 x 1024 a second.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from artemis_edge import topics
from artemis_edge.service.children import Child
from artemis_edge.session.message_ring import MessageRing
from artemis_edge.session.messages import CompressedImage, Header, Imu, Message, RawPackets
from artemis_edge.session.recorder import RecorderTask
from artemis_edge.session.writer import cloud_message

_TENTH_NS = 100_000_000


def _messages(rng: np.random.Generator) -> list[tuple[str, Message]]:
    """A tenth of a second of a rig."""
    n = 24_000
    angle = np.linspace(0, 60, n)
    points = np.column_stack([8 + np.sin(angle), 5 * np.cos(angle), np.sin(angle * 3)])
    points += rng.normal(0, 0.02, points.shape)
    intensity, offset = rng.random(n).astype(np.float32), (np.arange(n) * 4167).astype(np.uint32)
    header = Header(0, "lidar")
    noise = cv2.GaussianBlur(rng.integers(0, 255, (1024, 1280, 3)).astype(np.uint8), (5, 5), 0)
    jpeg = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
    raw = np.rint(points * 1000).astype("<i4").tobytes() + rng.bytes(2 * n)
    packets = RawPackets(
        header,
        np.zeros(250, np.int64),
        np.zeros(250, np.uint32),
        np.full(250, len(raw) // 250, np.uint32),
        raw,
    )
    found: list[tuple[str, Message]] = [
        (topics.LIDAR_POINTS.name, cloud_message(0, points.astype(np.float32), intensity, offset_ns=offset)),
        (topics.CAMERA_IMAGE.name, CompressedImage(header, "jpeg", jpeg)),
        (topics.LIDAR_PACKETS.name, packets),
    ]
    return found + [(topics.IMU.name, Imu(header, rng.normal(size=3), rng.normal(size=3))) for _ in range(40)]


def main() -> int:
    """Record, and say what it took."""
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--seconds", type=float, default=30.0)
    options.add_argument("--out", type=Path)
    given = options.parse_args()
    messages = [(topic, m.ROS_TYPE, m.encode()) for topic, m in _messages(np.random.default_rng(1))]
    ring = MessageRing.create(96)
    with tempfile.TemporaryDirectory(dir=given.out) as folder:
        recorder = Child(
            "artemis_edge.session.recorder", [ring.descriptor], RecorderTask(folder, reserve_bytes=0)
        )
        while not recorder.latest:
            recorder.hear()
            time.sleep(0.01)
        start, cpu = time.monotonic(), recorder.latest["cpu_s"]
        fullest = 0.0
        for k in range(round(given.seconds * 10)):
            for topic, ros_type, data in messages:
                ring.publish(topic, ros_type, k * _TENTH_NS, k * _TENTH_NS, data)
            time.sleep(max(0.0, start + (k + 1) / 10 - time.monotonic()))
            recorder.hear()
            fullest = max(fullest, recorder.latest["ring"])
        recorder.tell("stop")
        recorder.wait(30.0)
        last = recorder.latest
        spent = time.monotonic() - start
        recorder.end(1.0)
    share = (last["cpu_s"] - cpu) / spent
    print(f"{last['messages']} messages, {last['bytes'] / 1e6 / spent:.1f} MB/s on the disk, {spent:.0f} s")
    print(
        f"recorder: {share:.1%} of a core; lost {last['lost']}, left out {last['left_out']}, ring {fullest:.0%} full"
    )
    return 0 if last["lost"] == last["left_out"] == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
