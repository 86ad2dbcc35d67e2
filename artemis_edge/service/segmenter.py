"""The segmentation process of a live run: the newest photograph wins; what was asked late is looked for in old ones.

It reads photographs from the ring, and its masks go back to the service, which sends and records them like a device's
messages (session/late_masks.py): the mapping never waits for it, and a crash of it costs masks, nothing else. While
it is there, it also looks at the growing mesh, like any viewer, and says what it answers to the questions (answers.py).
"""

from __future__ import annotations

import base64
import os
import signal
import socket
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import msgspec

from artemis_edge.datasets.bag_index import IMAGES
from artemis_edge.datasets.cameras import encoded_image
from artemis_edge.errors import UserError
from artemis_edge.segmentation.backend import Backend, Prompt
from artemis_edge.segmentation.engine import Job, run_job
from artemis_edge.segmentation.registry import open_by_name
from artemis_edge.segmentation.yolo_seg import Thresholds
from artemis_edge.service.answers import MapAnswers
from artemis_edge.service.map_feed import MapReader
from artemis_edge.service.segmenter_task import SegmenterTask, slower
from artemis_edge.session.asked import Asked
from artemis_edge.session.cdr import CdrError
from artemis_edge.session.late_masks import pack
from artemis_edge.session.line_channel import LineChannel
from artemis_edge.session.message_ring import MessageRing, RingReader, Sent

_POLL_S = 0.02
_SAY_S = 0.5
_KEYFRAME_NS = 1_000_000_000
_MOST_KEYFRAMES = 256  # of a camera, some 30 MB; beyond it every second one goes
_BACK_S = 0.1  # between two old photographs: the mapping fuses a few masks a frame
_ANSWER_S = 1.0
_REST = 3.0  # answers are looked for again after so many times what the last ones took
_NS = 1e9


@dataclass(frozen=True, slots=True)
class Photo:
    """A photograph, still encoded."""

    camera: str
    stamp_ns: int
    encoded: bytes


@dataclass(slots=True)
class Album:
    """Photographs of the ring: the newest of each camera that is to be segmented, and one a second to look back at."""

    newest: dict[str, Photo] = field(default_factory=dict)
    kept: dict[str, list[Photo]] = field(default_factory=dict)

    def add(self, photo: Photo) -> None:
        """A photograph; it takes the place of its camera's one that waits."""
        self.newest[photo.camera] = photo
        kept = self.kept.setdefault(photo.camera, [])
        if not kept or photo.stamp_ns - kept[-1].stamp_ns >= _KEYFRAME_NS:
            kept.append(photo)
        if len(kept) > _MOST_KEYFRAMES:
            del kept[1::2]

    def take(self, last: dict[str, int], most_hz: float) -> Photo | None:
        """One whose turn it is, of the camera that waits longest; ``last`` stamps segmented, by camera."""
        least_ns = 0.0 if most_hz <= 0.0 else _NS / most_hz
        due = [p for p in self.newest.values() if p.stamp_ns - last.get(p.camera, -(1 << 62)) >= least_ns]
        if not due:
            return None
        photo = min(due, key=lambda p: last.get(p.camera, 0))
        del self.newest[photo.camera]
        return photo

    def all_kept(self) -> list[Photo]:
        """To look back at, the newest first."""
        found = [photo for kept in self.kept.values() for photo in kept]
        return sorted(found, key=lambda photo: -photo.stamp_ns)


@dataclass(slots=True)
class LookBack:
    """New questions, and the photographs in which they are looked for still."""

    prompts: tuple[Prompt, ...]
    photos: list[Photo]
    total: int
    done: int = 0


class LiveSegmenter:
    """The loop."""

    def __init__(
        self, task: SegmenterTask, ring: MessageRing, channel: LineChannel, backend: Backend
    ) -> None:
        self.task, self.channel, self.backend = task, channel, backend
        self.asked = task.asked
        self.most_hz = task.most_hz
        self.album = Album()
        self.looking_back: list[LookBack] = []
        self.segmented = self.faulty = 0
        self.first_fault = ""
        self._reader = RingReader(ring, ring.published)
        self._last: dict[str, int] = {}
        self._times: list[tuple[float, float]] = []  # of the latest masks: when, CPU ms
        self._turn_back = False
        self._said = self._answered = self._back_s = 0.0
        self._rest_s = _ANSWER_S
        self._told: list[dict[str, Any]] = []
        self._stopped = False
        self._answers = MapAnswers(MapReader(Path(task.viewers))) if task.viewers else None

    def run(self) -> None:
        """Until it is told to stop or the service is gone."""
        while not self._stopped:
            if not self.turn():
                time.sleep(_POLL_S)

    def turn(self) -> bool:
        """One photograph at most; whether there was one."""
        self._hear()
        while (sent := self._reader.read()) is not None:
            if sent.topic in self.task.cameras:
                self._photograph(sent)
        # live and looking back take turns, so that neither waits for the end of the other
        self._turn_back = not self._turn_back
        busy = (self._back() or self._live()) if self._turn_back else (self._live() or self._back())
        self._answer()
        self._say()
        return busy

    def _hear(self) -> None:
        for line in self.channel.lines():
            what = line.get("do")
            if what == "asked":
                self.ask(msgspec.convert(line["asked"], Asked, strict=False))
            elif what == "rate":
                self.most_hz = slower(self.task.most_hz, float(line["hz"]))
            elif what == "stop":
                self._stopped = True
        self._stopped |= self.channel.closed

    def ask(self, asked: Asked) -> None:
        """What is asked from now on: classes that are new are looked for in old photographs, too."""
        new = tuple(prompt for prompt in asked.prompts if not self.asked.is_current(prompt))
        self.asked = asked
        for back in self.looking_back:
            back.prompts = tuple(prompt for prompt in back.prompts if asked.is_current(prompt))
        self.looking_back = [back for back in self.looking_back if back.prompts]
        photos = self.album.all_kept()
        if new and photos:
            self.looking_back.append(LookBack(new, photos, len(photos)))
        self._answered = 0.0

    def _photograph(self, sent: Sent) -> None:
        try:
            message = IMAGES[sent.ros_type].decode(sent.data)
            photo = Photo(message.header.frame_id, message.header.stamp_ns, encoded_image(message))
        except (CdrError, KeyError):
            return  # the mapping counts it
        self.album.add(photo)

    def _live(self) -> bool:
        if not self.asked.slots:
            self.album.newest.clear()
            return False
        photo = self.album.take(self._last, self.most_hz)
        if photo is None:
            return False
        self._last[photo.camera] = photo.stamp_ns
        self._segment(photo, self.asked.prompts)
        return True

    def _back(self) -> bool:
        """One old photograph."""
        now = time.monotonic()
        if not self.looking_back or now - self._back_s < _BACK_S:
            return False
        self._back_s = now
        back = self.looking_back[0]
        self._segment(back.photos.pop(0), back.prompts)
        back.done += 1
        if not back.photos:
            self.looking_back.pop(0)
        return True

    def _segment(self, photo: Photo, prompts: Sequence[Prompt]) -> None:
        result = run_job(self.backend, Job(photo.encoded, tuple(prompts)))
        if result.segmentation is None:
            self.faulty += 1
            self.first_fault = self.first_fault or result.fault
            return
        self.segmented += 1
        self._times = [*self._times[-19:], (time.monotonic(), result.cpu_ms)]
        message = pack(photo.camera, photo.stamp_ns, prompts, result.segmentation.dense)
        self.channel.say({"mask": base64.b64encode(message.encode()).decode()})

    def _answer(self) -> None:
        """What the map says to the questions so far."""
        start = time.monotonic()
        if self._answers is None or start - self._answered < self._rest_s:
            return
        self._told = self._answers.told(self.asked)
        self._answered = time.monotonic()
        self._rest_s = max(_ANSWER_S, _REST * (self._answered - start))

    def _say(self) -> None:
        now = time.monotonic()
        if now - self._said >= _SAY_S:
            self._said = now
            self.channel.say({"state": "segmenting", **self.status()})

    def status(self) -> dict[str, Any]:
        """How it does."""
        recent = [when for when, _ in self._times if time.monotonic() - when < 5.0]
        span = time.monotonic() - recent[0] if len(recent) > 1 else 0.0
        return {
            "pid": os.getpid(),
            "hz": round((len(recent) - 1) / span, 2) if span > 0.0 else 0.0,
            "cpu_ms": round(sum(ms for _, ms in self._times) / max(len(self._times), 1), 1),
            "segmented": self.segmented,
            "faulty": self.faulty,
            "first_fault": self.first_fault,
            "looking_back": [sum(b.done for b in self.looking_back), sum(b.total for b in self.looking_back)],
            "answers": self._told,
            "cpu_s": round(time.process_time(), 2),
        }


def main(arguments: list[str]) -> int:
    """``segmenter.py RING SOCKET TASK``: file descriptors of the ring and the socket, and the task as JSON."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    cv2.setNumThreads(1)
    ring, sock, text = int(arguments[0]), int(arguments[1]), arguments[2]
    task, channel = msgspec.json.decode(text, type=SegmenterTask), LineChannel(socket.socket(fileno=sock))
    try:
        backend = open_by_name(task.asked.model.name, Thresholds(task.least_score, task.overlap))
    except UserError as error:
        channel.say({"state": "failed", "fault": str(error)})
        return 1
    LiveSegmenter(task, MessageRing(ring), channel, backend).run()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
