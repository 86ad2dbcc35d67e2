"""Copies of MCAP files: of one that was cut off, repaired; of a part of one, trimmed. The original is only read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from mcap.records import Attachment, Channel, Message, Metadata, Schema, Statistics
from mcap.writer import CompressionType, Writer

from artemis_edge import topics
from artemis_edge.datasets.bag import ros2_type
from artemis_edge.errors import InputError, RunError
from artemis_edge.export.atomic import disk_sentence, replacing
from artemis_edge.session.mcap_file import McapFile
from artemis_edge.session.writer import CHUNK_BYTES

SUFFIX = "_recovered"


@dataclass(slots=True)
class Copied:
    """What was copied from ``source`` to ``copy``. ``lost`` by reason; ``damaged`` a sentence each.

    ``recorded`` is how many messages the source's own end says it has; 0 where that end is missing.
    """

    source: Path
    copy: Path
    finished: bool = False
    messages: int = 0
    recorded: int = 0
    chunks: int = 0
    attachments: int = 0
    first_ns: int = 0
    last_ns: int = 0
    torn_bytes: int = 0
    damaged: list[str] = field(default_factory=list)
    lost: dict[str, int] = field(default_factory=dict)


def recover(source: Path, copy: Path | None = None) -> Copied:
    """A complete file with everything that is whole in ``source``: all complete chunks, all attachments.

    InputError if ``source`` is no MCAP file or the copy is there already, RunError if it cannot be written.
    """
    copy = source.with_name(f"{source.stem}{SUFFIX}{source.suffix}") if copy is None else copy
    return copied(source, copy, lambda message: True)


def trim(source: Path, copy: Path, start_ns: int, stop_ns: int) -> Copied:
    """A file with the messages received in ``start_ns <= log time < stop_ns``, and all that holds for the whole."""
    return copied(source, copy, lambda message: start_ns <= message.log_time < stop_ns)


def copied(source: Path, copy: Path, wanted: Callable[[Message], bool]) -> Copied:
    """A new file with the wanted messages, and those of latched topics, with attachments and metadata."""
    if copy.exists():
        raise InputError(f"{copy} is there already; remove it or give another --out")
    file = McapFile(source)
    declared = _declarations(file)
    report = Copied(source, copy)
    try:
        copy.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(disk_sentence(copy, error)) from None
    with replacing(copy) as stream:
        writer = Writer(stream, CHUNK_BYTES, CompressionType.LZ4)
        writer.start("ros2", "artemis-edge")
        again = McapFile(source)
        _copy(again, writer, declared, wanted, report)
        writer.finish()
    report.finished, report.chunks, report.torn_bytes = file.finished, file.chunks, file.torn_bytes
    report.damaged = file.damaged
    return report


def faults(report: Copied) -> list[str]:
    """What of the source could not be read, a sentence each; none where all of it could."""
    found = [*report.damaged]
    if not report.finished:
        found.append(f"{report.source} was cut off, {report.torn_bytes} bytes could not be used")
    found += [f"{n} {reason.replace('_', ' ')} are left out" for reason, n in report.lost.items()]
    return found


@dataclass(slots=True)
class _Declared:
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)


def _declarations(file: McapFile) -> _Declared:
    """Of the whole file: a channel may have been declared in a chunk that is damaged, and again at the end."""
    declared = _Declared()
    for _, record in file.records():
        if isinstance(record, Schema):
            declared.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            declared.channels.setdefault(record.id, record)
    return declared


def _copy(
    file: McapFile, writer: Writer, declared: _Declared, wanted: Callable[[Message], bool], report: Copied
) -> None:
    channels: dict[int, int] = {}
    schemas: dict[int, int] = {}
    for _, record in file.records():
        if isinstance(record, Attachment):
            report.attachments += 1
            writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        elif isinstance(record, Statistics):
            report.recorded = record.message_count
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Message):
            channel = declared.channels.get(record.channel_id)
            if channel is None:
                report.lost["messages_without_channel"] = report.lost.get("messages_without_channel", 0) + 1
            elif wanted(record) or _holds_for_all(channel, declared):
                if record.channel_id not in channels:
                    channels[record.channel_id] = _register(writer, channel, declared, schemas)
                _add(writer, channels[record.channel_id], record, report)


def _holds_for_all(channel: Channel, declared: _Declared) -> bool:
    schema = declared.schemas.get(channel.schema_id)
    calibration = schema is not None and ros2_type(schema.name) == topics.CAMERA_INFO.ros_type
    return calibration or channel.topic in topics.LATCHED


def _register(writer: Writer, channel: Channel, declared: _Declared, schemas: dict[int, int]) -> int:
    schema = declared.schemas.get(channel.schema_id)
    if schema is not None and schema.id not in schemas:
        schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
    schema_id = schemas.get(channel.schema_id, 0)
    number: int = writer.register_channel(
        channel.topic, channel.message_encoding, schema_id, channel.metadata
    )
    return number


def _add(writer: Writer, channel: int, message: Message, report: Copied) -> None:
    writer.add_message(channel, message.log_time, message.data, message.publish_time, message.sequence)
    report.first_ns = message.log_time if report.messages == 0 else min(report.first_ns, message.log_time)
    report.last_ns = max(report.last_ns, message.log_time)
    report.messages += 1
