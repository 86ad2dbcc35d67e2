"""Whether a recording is whole: ``artemis-edge session verify`` and ``session list``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Message

from artemis_edge.config import Config, from_toml
from artemis_edge.datasets.rosbag import bag_files
from artemis_edge.errors import InputError
from artemis_edge.session.mcap_file import McapFile

CONFIG_NAME = "mapping.toml"  # the attachment that holds the settings of the mapping
_SECOND_NS = 1_000_000_000


@dataclass(slots=True)
class Verdict:
    """A file: what is wrong with it (empty: nothing), and what it holds."""

    path: Path
    bytes: int = 0
    messages: int = 0
    chunks: int = 0
    attachments: int = 0
    first_ns: int = 0
    last_ns: int = 0
    topics: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "file": str(self.path),
            "bytes": self.bytes,
            "messages": self.messages,
            "chunks": self.chunks,
            "duration_s": round((self.last_ns - self.first_ns) / _SECOND_NS, 3),
            "topics": dict(sorted(self.topics.items())),
            "problems": self.problems,
        }


def verify(path: Path) -> list[Verdict]:
    """Every file of the recording at ``path``, read to its last byte; InputError if there is none."""
    files = [file for file in bag_files(path) if file.suffix == ".mcap"]
    if not files:
        raise InputError(f"{path} holds no MCAP file; give a session")
    return [_verdict(file) for file in files]


def _verdict(path: Path) -> Verdict:
    file, verdict = McapFile(path), Verdict(path)
    names: dict[int, str] = {}
    nameless = 0
    for _, record in file.records():
        if isinstance(record, Channel):
            names[record.id] = record.topic
        elif isinstance(record, Message):
            nameless += record.channel_id not in names
            verdict.topics[names.get(record.channel_id, "?")] += 1
            verdict.first_ns = (
                record.log_time if not verdict.messages else min(verdict.first_ns, record.log_time)
            )
            verdict.last_ns = max(verdict.last_ns, record.log_time)
            verdict.messages += 1
    verdict.bytes, verdict.chunks = file.size, file.chunks
    verdict.problems = [*_problems(file, nameless)]
    return verdict


def _problems(file: McapFile, nameless: int) -> Iterable[str]:
    yield from file.damaged
    if nameless:
        yield f"{nameless} messages belong to no topic"
    if not file.finished:
        yield (
            f"the recording was not closed ({file.torn_bytes} bytes of an incomplete chunk at the end): "
            f"'artemis-edge session recover {file.path}' makes a complete copy"
        )


def sessions_in(folder: Path) -> list[Path]:
    """Recordings in a folder and in the folders of it, the newest last; InputError if it is no folder."""
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; give the one in which sessions are kept")
    found = [place for place in folder.iterdir() if place.is_dir() and any(place.glob("*.mcap"))]
    found += [file for file in folder.glob("*.mcap") if file.is_file()]
    return sorted(found, key=lambda place: (place.stat().st_mtime_ns, place.name))


def session_config(path: Path) -> Config:
    """The mapping settings that were attached to a recording when it began, the defaults if there are none."""
    files = [file for file in bag_files(path) if file.suffix == ".mcap"]
    for file in files[:1]:
        for _, record in McapFile(file).records():
            if isinstance(record, Attachment) and record.name == CONFIG_NAME:
                return from_toml(bytes(record.data).decode())
            if isinstance(record, Message):
                break
    return Config()
