"""The mapping process: maps what is recorded, from the ring and where that has moved on from the files.

It says a few times a second how it does, and hears when to stop: after the last message until then it saves the map.
When it dies, its last checkpoint goes on (checkpoint.py), and maps again what came since, from the recording.
"""

from __future__ import annotations

import gc
import os
import signal
import socket
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from artemis_edge import health
from artemis_edge.config import Config, from_toml
from artemis_edge.continuing import find_earlier
from artemis_edge.errors import UserError
from artemis_edge.export.atomic import disk_sentence
from artemis_edge.loop.relocate import Found
from artemis_edge.orphans import end_with_the_parent
from artemis_edge.service.checkpoint import Checkpoints
from artemis_edge.service.map_feed import MapFeed
from artemis_edge.service.mapper_task import MapperTask
from artemis_edge.session.feed import LiveFeed
from artemis_edge.session.late_masks import LateMasks
from artemis_edge.session.line_channel import LineChannel
from artemis_edge.session.message_ring import MessageRing, Sent
from artemis_edge.session.results import prepare, scratch
from artemis_edge.session.stream_mapping import StreamMapping, warm_up
from artemis_edge.session.stream_search import StreamSearch

_POLL_S = 0.005
_SAY_S = 0.25
_COLLECT_EVERY = 100  # frames
_LATEST = 50  # frames that times are told of
_EARLY = 300  # frames after which it is too late to hold still at the start


class LiveMapper:
    """The loop. ``save`` at the end unless the service has gone."""

    def __init__(self, task: MapperTask, ring: MessageRing, channel: LineChannel, pages: Path) -> None:
        self.task, self.channel = task, channel
        self.feed = LiveFeed(ring, Path(task.folder), task.first)
        config = from_toml(task.config) if task.config else Config()
        self.mapping = StreamMapping(config, pages, questions=task.questions)
        self.checkpoints = Checkpoints(self._reopen)
        self.mapping.before = self.checkpoints.working_on
        self._config, self._pages = config, pages
        self.viewers = MapFeed(Path(task.viewers), task.viewers_mode) if task.viewers else None
        self._ring = ring
        self._search = self._searching(config)
        self._stop_at: int | None = None
        self._checked = time.monotonic()
        self._said = 0.0
        self._photographs_left = 0

    def run(self) -> None:
        """Until it is told to stop and has mapped everything until then."""
        try:
            self._guard(self.checkpoints.take())
            self._say("mapping", force=True)
            self._loop()
        except (UserError, ServiceGoneError):  # an orderly end, not to be tried again by the copy
            self.checkpoints.close()
            raise
        self.checkpoints.close()
        if self.viewers is not None:
            self.viewers.close()

    def _loop(self) -> None:
        while self._stop_at is None or self.feed.next < self._stop_at:
            sent = self.feed.take()
            if sent is None:
                time.sleep(_POLL_S)
                self._tend()
            elif self._search is not None:
                self._look(self._search, sent)
            elif self.mapping.take(sent):
                self.checkpoints.working_on(-1)
                self._after_frame()
            if self._search is not None and self._stop_at is not None and self.feed.next >= self._stop_at:
                self._begin(self._search, self._search.last_look())

    def _searching(self, config: Config) -> StreamSearch | None:
        earlier = find_earlier(Path(self.task.earlier), config) if self.task.earlier else None
        return None if earlier is None else StreamSearch(config, earlier)

    def _look(self, search: StreamSearch, sent: Sent) -> None:
        """Look for the place in the map that is continued; then map from the first message on."""
        found = search.take(sent)
        if found is not None or search.given_up:
            self._begin(search, found)
        self._tend()

    def _begin(self, search: StreamSearch, found: Found | None) -> None:
        """Map from the first message on: in the map that is continued, or on its own."""
        if found is None:
            search.given_up = True
            self.mapping.statistics.notes.append(search.sentence())
        else:
            self.mapping.go_on_in(search.earlier, found, search.first_ns or 0)
        self._search = None
        self.feed = LiveFeed(self._ring, Path(self.task.folder), self.task.first)

    def save(self) -> dict[str, Any]:
        """The map and all results."""
        self._say("saving", force=True)
        return self.mapping.save(Path(self.task.out), self._saving)

    def _saving(self, done: int, total: int) -> bool:
        self._photographs_left = total - done
        self._say("saving")
        return True

    def _after_frame(self) -> None:
        if self.mapping.assembler.next_index % _COLLECT_EVERY == 0:
            gc.collect()
        if self.viewers is not None and self.mapping.delta is not None:
            self.viewers.most_hz = self.mapping.load.preview_hz
            self.viewers.add(self.mapping.delta)
        if time.monotonic() - self._checked > self.task.checkpoint_s:
            _call(self.mapping.mapper, "before_copy")
            self._guard(self.checkpoints.take())
        self._tend()

    def _guard(self, resumed: bool) -> None:
        """A copy that takes over tells it, and leaves a copy of its own at once."""
        while resumed:
            self.mapping.skip |= self.checkpoints.fatal
            resumed = self.checkpoints.guard_again()
            if not resumed:
                self._say("mapping", force=True, resumed=True)
        self._checked = time.monotonic()

    def _tend(self) -> None:
        for line in self.channel.lines():
            if line.get("do") == "stop":
                self._stop_at = int(line.get("at", 0))
        if self.channel.closed:
            raise ServiceGoneError
        if self.viewers is not None and self.viewers.turn():
            self.mapping.mapper.tell_everything()
        self._say("mapping")

    def _reopen(self) -> None:
        _call(self.mapping.mapper, "after_copy")
        self.mapping.keeper.after_copy()
        if self.viewers is not None:
            self.viewers.forget_viewers()
        self.channel.forget()

    def _say(self, state: str, *, force: bool = False, resumed: bool = False) -> None:
        now = time.monotonic()
        if not force and now - self._said < _SAY_S:
            return
        self._said = now
        self.channel.say({"state": state, "pid": os.getpid(), "resumed": resumed, **self.status()})

    def status(self) -> dict[str, Any]:
        """How it does."""
        statistics, feed = self.mapping.statistics, self.feed
        tracked = self.mapping.mapper.tracked
        times = statistics.frame_ms[-_LATEST:]
        masks = self.mapping.masks or LateMasks()
        pose = self.mapping.mapper.trajectory[-1][1] if self.mapping.mapper.trajectory else np.eye(4)
        return {
            "frames": self.mapping.assembler.next_index,
            "mapped": len(statistics.frame_ms),
            "dropped": statistics.frames_dropped,
            "latest_ns": self.mapping.latest_ns,
            "frame_ms": round(float(np.median(times)), 1) if times else 0.0,
            "frame_ms_list": [round(t, 1) for t in times],
            "cpu_ms_list": [round(t, 1) for t in statistics.cpu_ms[-_LATEST:]],
            "stages_ms": {name: round(ms, 1) for name, ms in self.mapping.mapper.stage_ms.items()},
            "waiting": feed.ring.published - feed.next,
            "from_files": feed.from_files,
            "missed": feed.missed,
            "pose": [round(float(v), 4) for v in pose[:3].ravel()],
            "lost": {**statistics.lost, **self.mapping.assembler.lost, **masks.lost},
            "vertices": self.mapping.size.vertices,
            "triangles": self.mapping.size.triangles,
            "masks": masks.fused,
            "behind_s": round(feed.behind_s(), 2),
            "load": self.mapping.load.level,
            "fault": self.mapping.fault,
            "photographs_left": self._photographs_left,
            "degenerate": bool(tracked is not None and tracked.degenerate),
            "coaching": self._coaching(),
            "deaths": self.checkpoints.deaths,
            "checkpoint_s": round(time.monotonic() - self._checked, 1),
            "fork_ms": round(self.checkpoints.fork_ms, 1),
            "rss_mb": round(health.resident_mb(), 1),
            "cpu_s": round(time.process_time(), 2),
        }

    def _coaching(self) -> list[str]:
        """What the operator should do now."""
        search = [] if self._search is None else [self._search.sentence()]
        early = len(self.mapping.statistics.frame_ms) < _EARLY
        said = self.mapping.odometry.instruction
        return [*search, *self.mapping.statistics.notes, *([said] if said is not None and early else [])]


class ServiceGoneError(Exception):
    """Nobody is there to map for; the recording is on the disk and can be mapped again."""


def _call(mapper: object, name: str) -> None:
    """A method that the mapper may have."""
    method = getattr(mapper, name, None)
    if method is not None:
        method()


def _work(task: MapperTask, ring: MessageRing, channel: LineChannel) -> None:
    out = Path(task.out)
    prepare(out)
    with scratch(out) as pages:
        channel.say({"state": "warming up", "pid": os.getpid()})
        config = from_toml(task.config) if task.config else Config()
        warm_up(config, pages / "warm-up", questions=task.questions)
        gc.collect()
        gc.freeze()
        gc.disable()
        mapper = LiveMapper(task, ring, channel, pages)
        _run(mapper)
        channel.say({"state": "saved", "pid": os.getpid(), **mapper.status(), **_told(mapper.save())})


def _run(mapper: LiveMapper) -> None:
    """All frames. A defect ends this process as a signal would: what its checkpoints go on from stays on the disk."""
    try:
        mapper.run()
    except (UserError, ServiceGoneError, OSError):
        raise
    except Exception:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)


def _told(saved: dict[str, Any]) -> dict[str, Any]:
    report = saved["report"]
    known = ("frames", "triangles", "area_m2", "peak_rss_mb", "realtime_factor")
    return {
        "kept": saved["kept"],
        "fault": saved["fault"],
        "report": {k: report[k] for k in known if k in report},
    }


def main(arguments: list[str]) -> int:
    """``mapper.py RING SOCKET TASK``: file descriptors of the ring and the socket, and the task as JSON."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_the_parent(signal.SIGTERM)
    cv2.setNumThreads(1)  # a pool of threads would not survive a fork
    ring, sock, text = int(arguments[0]), int(arguments[1]), arguments[2]
    task, channel = msgspec.json.decode(text, type=MapperTask), LineChannel(socket.socket(fileno=sock))
    try:
        _work(task, MessageRing(ring), channel)
    except ServiceGoneError:
        return 1
    except UserError as error:
        channel.say({"state": "failed", "fault": str(error)})
        return 1
    except OSError as error:
        where = Path(str(error.filename or task.out))
        channel.say({"state": "failed", "fault": disk_sentence(where, error)})
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
