"""What a recording holds: ``artemis-edge session info``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from artemis_edge.datasets import open_input
from artemis_edge.datasets.bag import Bag, Connection, Entry
from artemis_edge.datasets.common import SECOND_NS, add_counts
from artemis_edge.datasets.rosbag import bag_files, open_bags
from artemis_edge.errors import UserError

_NEVER = " " * len("2026-01-01 00:00:00")
_DATED_NS = 946_684_800 * SECOND_NS  # the year 2000: an earlier time is none, but counts from a start


@dataclass(slots=True)
class Topic:
    """One topic: its type, how many messages, and when the first and last were received (ns)."""

    name: str
    type: str
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0

    def add(self, log_ns: int) -> None:
        """Count a message."""
        self.first_ns = log_ns if self.messages == 0 else min(self.first_ns, log_ns)
        self.last_ns = max(self.last_ns, log_ns)
        self.messages += 1

    def rate_hz(self) -> float:
        """Mean rate; 0 for fewer than two messages."""
        span_s = (self.last_ns - self.first_ns) / SECOND_NS
        return (self.messages - 1) / span_s if span_s > 0 else 0.0


@dataclass(frozen=True, slots=True)
class Catalog:
    """Content of a recording; ``frames`` 0 and ``problem`` a sentence where it cannot be mapped."""

    name: str
    bytes: int
    topics: list[Topic]
    frames: int
    duration_s: float
    has_poses: bool
    lost: dict[str, int]
    warnings: list[str]
    problem: str | None

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "name": self.name,
            "bytes": self.bytes,
            "duration_s": round(self.duration_s, 3),
            "frames": self.frames,
            "poses": self.has_poses,
            "topics": [
                {"name": t.name, "type": t.type, "messages": t.messages, "hz": round(t.rate_hz(), 3)}
                for t in self.topics
            ],
            "lost": self.lost,
            "warnings": self.warnings,
            "problem": self.problem,
        }


def catalog(path: Path) -> Catalog:
    """Look through the recording at ``path``; InputError if there is none."""
    files = bag_files(path)
    topics = _topics(open_bags(path)) if files else []
    try:
        source = open_input(path)
    except UserError as error:
        if not topics:
            raise
        return Catalog(path.name, _size(files), topics, 0, _duration_s(topics), False, {}, [], str(error))
    stamps = source.stamp_ns
    duration_s = _duration_s(topics) if topics else float(stamps[-1] - stamps[0]) / SECOND_NS
    size = _size(files) if files else _size(path.rglob("*"))
    has_poses = source.poses is not None and len(source.poses) > 0
    return Catalog(
        source.name, size, topics, len(source), duration_s, has_poses, source.lost, source.warnings, None
    )


def card(path: Path) -> dict[str, Any]:
    """A recording in a list: name, when recorded, length, size, what is lost, and a sentence if it cannot be read."""
    files = bag_files(path)
    found: dict[str, Any] = {"name": path.name, "path": str(path), "bytes": _size(files), "problem": None}
    found["lost"] = {}
    try:
        bags = open_bags(path)
        topics = _topics(bags)
    except UserError as error:
        return {**found, "recorded": _NEVER, "duration_s": 0.0, "messages": 0, "problem": str(error)}
    for bag in bags:
        add_counts(found["lost"], bag.lost)
    first = min((topic.first_ns for topic in topics), default=0)
    recorded = datetime.fromtimestamp(first / SECOND_NS, UTC).strftime("%Y-%m-%d %H:%M:%S")
    return {
        **found,
        "recorded": recorded if first > _DATED_NS else _NEVER,
        "duration_s": round(_duration_s(topics), 3),
        "messages": sum(topic.messages for topic in topics),
    }


def to_text(catalog: Catalog) -> str:
    """The catalogue for people."""
    what = f"{catalog.frames} LiDAR frames, {'with' if catalog.has_poses else 'without'} poses"
    lines = [f"{catalog.name}: {catalog.duration_s:.1f} s, {catalog.bytes / 1e6:.1f} MB", what]
    width = max((len(topic.name) for topic in catalog.topics), default=0)
    lines += [
        f"  {t.name:<{width}}  {t.messages:>7}  {t.rate_hz():>7.1f} Hz  {t.type}" for t in catalog.topics
    ]
    lines += [f"lost: {count} {reason}" for reason, count in sorted(catalog.lost.items())]
    lines += catalog.warnings
    if catalog.problem is not None:
        lines.append(f"cannot be mapped: {catalog.problem}")
    return "\n".join(lines)


def _topics(bags: Iterable[Bag]) -> list[Topic]:
    topics: dict[str, Topic] = {}
    for bag in bags:
        entries: Iterable[Entry] = bag.scan(_glance)
        for entry in entries:
            name = entry.connection.topic
            topic = topics.setdefault(name, Topic(name, entry.connection.ros_type))
            topic.add(entry.log_ns)
    return [topics[name] for name in sorted(topics)]


def _glance(connection: Connection) -> int:
    return 1  # byte of each message: none would pass over them


def _duration_s(topics: list[Topic]) -> float:
    first = min((topic.first_ns for topic in topics), default=0)
    return (max((topic.last_ns for topic in topics), default=first) - first) / SECOND_NS


def _size(files: Iterable[Path]) -> int:
    return sum(file.stat().st_size for file in files if file.is_file())
