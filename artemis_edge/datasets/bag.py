"""What all containers of ROS messages have in common: topics, a pass over the messages, single ones again."""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from artemis_edge.session.cdr import Buffer, CdrError, CdrReader, Ros1Reader

# A header with its frame's name: enough of a message to know when and where it was taken.
HEAD_BYTES = 256
# For ``Bag.scan``: the whole message.
WHOLE = -1
_CACHE_BYTES = 24 << 20


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


class ChunkCache:
    """Decompressed chunks by position, the least recently used dropped beyond 24 MB.

    The messages of one frame lie in a few neighbouring chunks.
    """

    def __init__(self) -> None:
        self._chunks: OrderedDict[int, bytes] = OrderedDict()

    def get(self, at: int, load: Callable[[int], bytes]) -> bytes:
        """The chunk at a position, loaded if it is not here."""
        if at not in self._chunks:
            self._chunks[at] = load(at)
            while len(self._chunks) > 1 and sum(map(len, self._chunks.values())) > _CACHE_BYTES:
                self._chunks.popitem(last=False)
        self._chunks.move_to_end(at)
        return self._chunks[at]


def ros2_type(name: str) -> str:
    """A type name as ROS 2 writes it: ``sensor_msgs/Imu`` is ``sensor_msgs/msg/Imu``."""
    return re.sub(r"^(\w+)/(\w+)$", r"\1/msg/\2", name)
