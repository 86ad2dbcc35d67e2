"""What all containers of ROS messages have in common: topics, a pass over the messages, single ones again."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from artemis_edge.session.cdr import Buffer, CdrError, CdrReader, Ros1Reader

# A header with its frame's name: enough of a message to know when and where it was taken.
HEAD_BYTES = 256
# For ``Bag.scan``: the whole message.
WHOLE = -1


@dataclass(frozen=True, slots=True)
class Connection:
    """A topic: ``ros_type`` such as ``sensor_msgs/msg/Imu``, ``encoding`` ``cdr``, ``ros1`` or another."""

    topic: str
    ros_type: str
    encoding: str

    def reader(self, data: Buffer) -> CdrReader:
        """Reader of a message of this topic; CdrError if the encoding is not known."""
        if self.encoding == "cdr":
            return CdrReader(data)
        if self.encoding == "ros1":
            return Ros1Reader(data)
        raise CdrError(f"messages of {self.topic} are encoded as '{self.encoding}'")


@dataclass(frozen=True, slots=True)
class Entry:
    """A message met by ``scan``: ``data`` as much of it as was asked for, ``where`` finds it again."""

    connection: Connection
    log_ns: int
    data: Buffer
    where: Any


class Bag(Protocol):
    """One file of recorded messages. ``lost`` and ``warnings`` say what could not be read."""

    lost: dict[str, int]
    warnings: list[str]

    def scan(self, needed: Callable[[Connection], int]) -> Iterator[Entry]:
        """Every message once, in the order of the file; ``needed`` bytes of each (0: pass over, or WHOLE)."""
        ...

    def fetch(self, where: Any) -> Buffer:
        """The whole message that ``scan`` met; CdrError if it cannot be read any more."""
        ...


def ros2_type(name: str) -> str:
    """A type name as ROS 2 writes it: ``sensor_msgs/Imu`` is ``sensor_msgs/msg/Imu``."""
    return re.sub(r"^(\w+)/(\w+)$", r"\1/msg/\2", name)
