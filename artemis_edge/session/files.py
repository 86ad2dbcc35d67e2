"""The files of one recording: ``session_000.mcap`` and so on, begun anew at a size, never filling the disk."""

from __future__ import annotations

import os
import shutil
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from artemis_edge import topics
from artemis_edge.errors import RunError
from artemis_edge.session.message_ring import Sent
from artemis_edge.session.writer import SessionWriter

NAME = "session_{:03d}.mcap"
FLUSH_S = 0.9  # a chunk is on the disk at most so long after its first message
_LOOK_S = 1.0  # between two looks at the disk
_OF_INDEX = 0.02  # share of a file that its index takes, at most, when it is finished

#: Free bytes in the file system of a folder.
FreeBytes = Callable[[Path], int]


@dataclass(frozen=True, slots=True)
class Limits:
    """``split_bytes`` of one file; ``reserve_bytes`` of the disk are left free."""

    split_bytes: int = 4 << 30
    reserve_bytes: int = 1 << 30


def free_bytes(folder: Path) -> int:
    """Free bytes in the file system of a folder."""
    return shutil.disk_usage(folder).free


class SessionFiles:
    """Writes messages to the files of ``folder``.

    ``attachments`` and ``metadata`` stand at the start of every file, and so do the latest messages of
    topics.LATCHED. ``full`` is a sentence once the disk has no more room: what was written is complete and closed, and
    messages are counted in ``refused``. ``messages`` and ``message_bytes`` count by topic what was written.
    """

    def __init__(
        self,
        folder: Path,
        attachments: Mapping[str, str | bytes],
        metadata: Mapping[str, Mapping[str, str]],
        limits: Limits,
        free: FreeBytes = free_bytes,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.folder, self.limits = folder, limits
        self.full = ""
        self.refused = self.closed_bytes = 0
        self.messages: Counter[str] = Counter()
        self.message_bytes: Counter[str] = Counter()
        self._attachments, self._metadata = dict(attachments), dict(metadata)
        self._free, self._clock = free, clock
        self._latched: dict[tuple[str, bytes], Sent] = {}
        self._writer: SessionWriter | None = None
        self._dirty_since: float | None = None
        self._looked = -_LOOK_S
        self._number = len(list(folder.glob(NAME.replace("{:03d}", "*"))))

    @property
    def bytes(self) -> int:
        """Bytes on the disk."""
        return self.closed_bytes + (self._writer.position() if self._writer is not None else 0)

    def write(self, sent: Sent) -> None:
        """A message; it is on the disk about a second later at the latest, if ``tend`` is called."""
        if self.full:
            self.refused += 1
            return
        try:
            self._write(sent)
        except RunError as error:
            self._stop(str(error))

    def latch(self, sent: Sent) -> None:
        """Keep a message, if it is one that readers need first, for the start of every further file."""
        if sent.topic in topics.LATCHED or sent.ros_type == topics.CAMERA_INFO.ros_type:
            self._latched[sent.topic, sent.data] = sent

    def tend(self) -> None:
        """To be called often: flushes what has waited, begins a new file, watches the disk."""
        if self.full:
            return
        now = self._clock()
        try:
            if self._dirty_since is not None and now - self._dirty_since >= FLUSH_S:
                self.flush()
            if now - self._looked >= _LOOK_S:
                self._looked = now
                self._look()
        except RunError as error:
            self._stop(str(error))

    def flush(self) -> None:
        """Push everything to the disk."""
        if self._writer is not None:
            self._writer.flush()
        self._dirty_since = None

    def close(self) -> None:
        """Finish the file with its index, and the folder."""
        try:
            self._close()
        except RunError as error:
            self._stop(str(error))

    def _write(self, sent: Sent) -> None:
        if self._writer is None:
            self._open(sent.log_ns)
        assert self._writer is not None
        self.latch(sent)
        self._put(self._writer, sent)
        self.messages[sent.topic] += 1
        self.message_bytes[sent.topic] += len(sent.data)
        if self._dirty_since is None:
            self._dirty_since = self._clock()

    def _put(self, writer: SessionWriter, sent: Sent, log_ns: int | None = None) -> None:
        log = sent.log_ns if log_ns is None else log_ns
        writer.write_encoded(sent.topic, sent.ros_type, sent.data, sent.stamp_ns, log, sent.number)

    def _open(self, log_ns: int) -> None:
        path = self.folder / NAME.format(self._number)
        self._number += 1
        self._writer = SessionWriter(path, attachments=self._attachments, metadata=self._metadata)
        for sent in self._latched.values():
            self._put(self._writer, sent, log_ns)

    def _look(self) -> None:
        written = self._writer.position() if self._writer is not None else 0
        if self._free(self.folder) - _OF_INDEX * written < self.limits.reserve_bytes:
            room = f"{self.limits.reserve_bytes / 1e6:.0f} MB"
            self._stop(
                f"recording stopped: less than {room} are free in {self.folder}; free space and start again"
            )
        elif written >= self.limits.split_bytes:
            self._close()

    def _close(self) -> None:
        if self._writer is None:
            return
        writer, self._writer = self._writer, None
        self._dirty_since = None
        writer.close()
        self.closed_bytes += writer.path.stat().st_size
        _sync_folder(self.folder)

    def _stop(self, why: str) -> None:
        self.full = self.full or why
        self.close()


def _sync_folder(folder: Path) -> None:
    """The names of new files are on the disk as well."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
