"""ROS 2 bags in SQLite (``.db3``): a table of topics and one of messages."""

from __future__ import annotations

import sqlite3
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from artemis_edge.datasets.bag import WHOLE, Connection, Entry, ros2_type
from artemis_edge.datasets.common import add_counts, one_line
from artemis_edge.errors import InputError
from artemis_edge.session.cdr import Buffer, CdrError

MAGIC = b"SQLite format 3\x00"


class SqliteBag:
    """Bag of one ``.db3`` file; InputError if it is no ROS 2 bag."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lost: dict[str, int] = {}
        self.warnings: list[str] = []
        try:
            # The frames may be read by another thread than the one that opened the file, one at a time.
            self._database = sqlite3.connect(
                f"{path.resolve().as_uri()}?mode=ro", uri=True, check_same_thread=False
            )
            weakref.finalize(self, self._database.close)
            rows = self._database.execute(
                "SELECT id, name, type, serialization_format FROM topics"
            ).fetchall()
        except (sqlite3.Error, UnicodeDecodeError) as error:
            raise InputError(
                f"{path} is not a ROS 2 bag in SQLite ({one_line(error)}); record or convert it again"
            ) from None
        self._topics = {row[0]: Connection(str(row[1]), ros2_type(str(row[2])), str(row[3])) for row in rows}

    def scan(self, needed: Callable[[Connection], int]) -> Iterator[Entry]:
        """Every message once, topic by topic."""
        for number, connection in self._topics.items():
            count = needed(connection)
            if count:
                column = "data" if count == WHOLE else f"substr(data, 1, {count})"
                yield from self._scan_topic(number, connection, column)

    def _scan_topic(self, number: int, connection: Connection, column: str) -> Iterator[Entry]:
        query = f"SELECT id, timestamp, {column} FROM messages WHERE topic_id = ? ORDER BY id"
        try:
            for row, log_ns, data in self._database.execute(query, (number,)):
                if isinstance(log_ns, int) and isinstance(data, bytes):
                    yield Entry(connection, log_ns, data, row)
                else:
                    add_counts(self.lost, {"undecodable_messages": 1})
        except (sqlite3.Error, UnicodeDecodeError) as error:
            add_counts(self.lost, {"truncated_file": 1})
            self.warnings.append(
                f"{self.path} is damaged ({one_line(error)}); part of {connection.topic} is missing"
            )

    def fetch(self, where: Any) -> Buffer:
        """The whole message with this id."""
        try:
            row = self._database.execute("SELECT data FROM messages WHERE id = ?", (where,)).fetchone()
        except (sqlite3.Error, UnicodeDecodeError) as error:
            raise CdrError(f"{self.path} is damaged: {error}") from None
        if row is None or not isinstance(row[0], bytes):
            raise CdrError(f"{self.path} has no message {where}")
        return bytes(row[0])
