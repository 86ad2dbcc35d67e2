"""The recorder: takes messages from the ring and writes them, in a process that nothing else can delay.

The service starts it with the ring and one end of a socket pair. On the socket it says once a second how it does, and
hears when to stop: after the last message that was published until then. When the service dies, what is in the ring is
still written and the file is closed.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from artemis_edge.session.feed import next_number, recorded
from artemis_edge.session.files import Limits, SessionFiles
from artemis_edge.session.line_channel import LineChannel
from artemis_edge.session.message_ring import MessageRing, RingReader
from artemis_edge.topics import RAW

_POLL_S = 0.02
_BATCH = 256
_SAY_S = 1.0
_BEGINNING = 200  # messages of a session, among which those are that readers need first
_CROWDED, _EASY = 0.5, 0.1  # fill of the ring at which raw packets are left out, and are taken again
_PATIENCE_S = 8.0  # for what is in the ring when it has to stop


class RecorderTask(Struct, frozen=True):
    """What the service tells a recorder: see SessionFiles; ``first`` is the number of the first message.

    ``resume``: another recorder has died; from the first message on that is not on the disk.
    """

    folder: str
    first: int = 0
    attachments: dict[str, str] = {}
    metadata: dict[str, dict[str, str]] = {}
    split_bytes: int = Limits().split_bytes
    reserve_bytes: int = Limits().reserve_bytes
    resume: bool = False


class Recorder:
    """The recorder's loop, without a process. ``left_out`` counts raw messages given up for the sake of the others."""

    def __init__(self, task: RecorderTask, ring: MessageRing, channel: LineChannel) -> None:
        limits = Limits(task.split_bytes, task.reserve_bytes)
        folder = Path(task.folder)
        self.files = SessionFiles(folder, task.attachments, task.metadata, limits)
        first = task.first
        if task.resume:
            for sent in islice(recorded(folder, first), _BEGINNING):
                self.files.latch(sent)
            first = next_number(folder, first)
        self.reader = RingReader(ring, first)
        self.left_out = 0
        self._channel = channel
        self._stop_at: int | None = None
        self._deadline = float("inf")
        self._crowded = False
        self._said = 0.0

    def run(self) -> None:
        """Until it is told to stop and everything until then is written."""
        while True:
            busy = self._take(_BATCH)
            self.files.tend()
            self._hear()
            now = time.monotonic()
            if busy and self._stop_at is not None:
                # a slow disk is given time as long as something is written
                self._deadline = now + _PATIENCE_S
            if now - self._said >= _SAY_S:
                self._said = now
                self._say("recording")
            if self._stop_at is not None and (self.reader.next >= self._stop_at or now > self._deadline):
                break
            if not busy:
                time.sleep(_POLL_S)
        self.files.close()
        self._say("closed")

    def stop(self) -> None:
        """Write what is published now, then end."""
        if self._stop_at is None:
            self._stop_at = self.reader.ring.published
            self._deadline = time.monotonic() + _PATIENCE_S

    def status(self) -> dict[str, Any]:
        """How it does."""
        files = self.files
        return {
            "bytes": files.bytes,
            "messages": sum(files.messages.values()),
            "topics": {
                name: {"messages": n, "bytes": files.message_bytes[name]}
                for name, n in files.messages.items()
            },
            "lost": self.reader.lost,
            "left_out": self.left_out,
            "refused": files.refused,
            "full": files.full,
            "ring": round(self.reader.fill(), 3),
            "next": self.reader.next,
            "pid": os.getpid(),
            "cpu_s": round(time.process_time(), 3),
        }

    def _take(self, most: int) -> bool:
        """Whether there was anything to write."""
        for k in range(most):
            sent = self.reader.read()
            if sent is None:
                return k > 0
            if k == 0:
                fill = self.reader.fill()
                self._crowded = fill > _CROWDED or (self._crowded and fill > _EASY)
            if self._crowded and sent.ros_type == RAW:
                self.left_out += 1
            else:
                self.files.write(sent)
        return True

    def _hear(self) -> None:
        for line in self._channel.lines():
            if line.get("do") == "stop":
                self.stop()
        if self._channel.closed:
            self.stop()

    def _say(self, state: str) -> None:
        self._channel.say({"state": state, **self.status()})


def main(arguments: list[str]) -> int:
    """``recorder.py RING SOCKET TASK``: file descriptors of the ring and the socket, and the task as JSON."""
    # The service stops it in its own time; a Ctrl-C in the terminal goes to all processes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    ring, sock, task = int(arguments[0]), int(arguments[1]), arguments[2]
    channel = LineChannel(socket.socket(fileno=sock))
    recorder = Recorder(msgspec.json.decode(task, type=RecorderTask), MessageRing(ring), channel)
    recorder.run()
    return 1 if recorder.files.full else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
