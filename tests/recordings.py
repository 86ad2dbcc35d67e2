"""Recordings in the making: a stream of small messages through the ring into a recorder of its own process."""

import json
from pathlib import Path
from typing import Any

from mcap.records import Message

from artemis_edge.service.children import Child
from artemis_edge.session.mcap_file import McapFile
from artemis_edge.session.message_ring import MessageRing, Sent
from artemis_edge.session.messages import Text
from artemis_edge.session.recorder import RecorderTask

SECOND = 10**9
START = 1_766_966_340 * SECOND
TYPE = Text.ROS_TYPE


def sent(
    number: int, size: int = 200, topic: str = "/numbers", ros_type: str = TYPE, log_ns: int | None = None
) -> Sent:
    text = json.dumps({"number": number, "fill": "x" * size})
    log = START + number * SECOND // 100 if log_ns is None else log_ns
    return Sent(number, topic, ros_type, log, log - 1000, Text(text).encode())


def publish(ring: MessageRing, message: Sent) -> int:
    return ring.publish(message.topic, message.ros_type, message.log_ns, message.stamp_ns, message.data)


def start_recorder(ring: MessageRing, folder: Path, **settings: Any) -> Child:
    task = RecorderTask(
        str(folder), attachments={"config.toml": "[a]\n"}, metadata={"device": {"serial": "7"}}, **settings
    )
    return Child("artemis_edge.session.recorder", [ring.descriptor], task)


def numbers(path: Path) -> list[int]:
    """The sequence numbers in a file, in its order."""
    return [record.sequence for _, record in McapFile(path).records() if isinstance(record, Message)]
