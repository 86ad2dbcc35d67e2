"""The messages of a session one after the other: from its files, and live from the ring as well."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from artemis_edge.datasets.bag import Connection
from artemis_edge.datasets.mcap_bag import McapBag
from artemis_edge.datasets.rosbag import bag_files
from artemis_edge.errors import InputError
from artemis_edge.session.cdr import CdrError
from artemis_edge.session.mcap_file import GrowingFile
from artemis_edge.session.message_ring import MessageRing, OverwrittenError, Sent

_WHOLE = -1
_NS = 1e9


def messages(path: Path) -> Iterator[Sent]:
    """All messages of the recording at ``path``, numbered as they come; InputError if there is none."""
    files = [file for file in bag_files(path) if file.suffix == ".mcap"]
    if not files:
        raise InputError(f"{path} holds no MCAP file; give a session")
    return _all(files)


def _all(files: list[Path]) -> Iterator[Sent]:
    number = 0
    for file in files:
        bag = McapBag(file)
        for entry in bag.scan(_everything):
            yield _sent(number, entry.connection, entry.log_ns, bytes(entry.data))
            number += 1


def _everything(connection: Connection) -> int:
    return _WHOLE


def _sent(number: int, connection: Connection, log_ns: int, data: bytes) -> Sent:
    if connection.encoding != "cdr":
        raise CdrError(f"messages of {connection.topic} are encoded as '{connection.encoding}'")
    return Sent(number, connection.topic, connection.ros_type, log_ns, log_ns, data)


class LiveFeed:
    """Messages as they are published; those that the ring no longer has come from the files being recorded.

    ``next`` is the number of the next message; ``from_files`` counts those that were read from the files, ``missed``
    those that were neither in the ring nor recorded.
    """

    def __init__(self, ring: MessageRing, folder: Path, first: int) -> None:
        self.ring, self.folder = ring, folder
        self.next = first
        self.from_files = self.missed = 0
        self.log_ns = 0  # of the message that was taken last
        self._filed: Iterator[Sent] | None = None

    def take(self) -> Sent | None:
        """The next message, None if there is none yet."""
        sent = self._ahead() if self._filed is not None else None
        if sent is None:
            try:
                sent = self.ring.read(self.next)
            except OverwrittenError as gone:
                sent = self._recorded(gone.oldest)
        if sent is not None:
            self.missed += sent.number - self.next
            self.next = sent.number + 1
            self.log_ns = sent.log_ns
        return sent

    def behind_s(self) -> float:
        """Between the newest message and the one that was taken last; 0 before there is any."""
        latest = self.ring.latest_log_ns()
        if latest is None or not self.log_ns or self.next >= self.ring.published:
            return 0.0
        return (latest - self.log_ns) / _NS

    def _recorded(self, oldest: int) -> Sent | None:
        """From the files; what they do not have either is passed over."""
        self._filed = recorded(self.folder, self.next)
        sent = self._ahead()
        if sent is None:
            self.missed += max(0, oldest - self.next)
            self.next = max(self.next, oldest)
        return sent

    def _ahead(self) -> Sent | None:
        assert self._filed is not None
        sent = next(self._filed, None)
        if sent is None:
            self._filed = None
        else:
            self.from_files += 1
        return sent


def next_number(folder: Path, first: int) -> int:
    """Number of the message after the last one on the disk, ``first`` if that is later."""
    return max([first, *(GrowingFile(path).latest_number() + 1 for path in bag_files(folder))])


def recorded(folder: Path, first: int) -> Iterator[Sent]:
    """Messages from number ``first`` on of the files in ``folder`` that a recorder is writing."""
    wanted = first
    for path in bag_files(folder):
        for sent in GrowingFile(path).messages():
            if sent.number >= wanted:
                wanted = sent.number + 1
                yield sent
