"""ROS 1 bags (``.bag``), through the package rosbags of the extra ``import``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from artemis_edge.datasets.bag import WHOLE, Connection, Entry
from artemis_edge.errors import InputError
from artemis_edge.session.cdr import Buffer, CdrError

MAGIC = b"#ROSBAG V"


class Ros1Bag:
    """Bag of one ``.bag`` file; InputError if it cannot be read or rosbags is not installed."""

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.rosbag1 import Reader, ReaderError
        except ImportError:
            raise InputError(f"reading {path} needs rosbags; pip install 'artemis-edge[import]'") from None
        self.path = path
        self.lost: dict[str, int] = {}
        self.warnings: list[str] = []
        self._fault = ReaderError
        try:
            self._reader = Reader(path)
            self._reader.open()
        except (ReaderError, OSError) as error:
            raise InputError(f"{path} cannot be read ({error}); repair it with 'rosbag reindex'") from None

    def scan(self, needed: Callable[[Connection], int]) -> Iterator[Entry]:
        """Every message once, in the order of recording."""
        chosen = {c.id: Connection(c.topic, c.msgtype, "ros1") for c in self._reader.connections}
        wanted = {number: needed(connection) for number, connection in chosen.items()}
        connections = [c for c in self._reader.connections if wanted[c.id]]
        if not connections:
            return
        seen: dict[tuple[int, int], int] = {}
        try:
            for c, log_ns, data in self._reader.messages(connections):
                # Several messages of a topic may carry one receive time: the count tells them apart.
                nth = seen.get((c.id, log_ns), 0)
                seen[c.id, log_ns] = nth + 1
                count = wanted[c.id]
                yield Entry(chosen[c.id], log_ns, data if count == WHOLE else data[:count], (c, log_ns, nth))
        except (self._fault, OSError, EOFError, RuntimeError, ValueError) as error:
            self.lost["truncated_file"] = 1
            self.warnings.append(f"{self.path} is damaged ({error}); what was read up to there is used")

    def fetch(self, where: Any) -> Buffer:
        """The whole message of a topic at a receive time."""
        connection, log_ns, nth = where
        messages = self._reader.messages([connection], start=log_ns, stop=log_ns + 1)
        for k, (_, _, data) in enumerate(messages):
            if k == nth:
                return bytes(data)
        raise CdrError(f"{self.path} lacks the message of {connection.topic} at {log_ns} ns")
