"""A demo behind the terminal: recording and mapping run in a process of their own, at the pace of the walk."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from artemis_edge import health
from artemis_edge.config import Config
from artemis_edge.frames import MeshDelta, Odometry, SyncedFrame
from artemis_edge.map_size import MapSize
from artemis_edge.newest import Newest
from artemis_edge.pipeline import Pipeline
from artemis_edge.progress import Report
from artemis_edge.questions import BlankMasks
from artemis_edge.refinement.stage import GoOn, always
from artemis_edge.semantic_map import Segmenter
from artemis_edge.status import MapStatus, Status, Stream
from artemis_edge.tui.live_questions import EVERY_CLASS, LiveQuestions
from artemis_edge.tui.remote import RemoteError

_SEND_EVERY_S = 0.2
_MOST_BLOCKS = 400  # in one message: some megabytes
_RECENT = 300
_FRAME_S = 0.1
_STOP_S = 5.0


class DemoRemote:
    """Starts ``session.demo`` in a child and relays what it tells."""

    def __init__(self, world: str, seconds: float, seed: int, out: Path, queries: list[str]) -> None:
        self.name = f"demo: {world}"
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._child = context.Process(
            target=_child, args=(theirs, world, seconds, seed, out, queries), daemon=False
        )
        self._child.start()
        theirs.close()
        self._status = Status(state="checking", message="starting")
        self._news: list[MeshDelta] = []
        self._lock = threading.Lock()
        self._gone = ""
        threading.Thread(target=self._listen, daemon=True).start()

    def status(self) -> Status:
        """What the child told last."""
        if self._gone and self._status.state != "done":
            raise RemoteError(self._gone)
        return self._status

    def deltas(self) -> list[MeshDelta]:
        """News of the map."""
        with self._lock:
            news, self._news = self._news, []
        return news

    def ask(self, text: str) -> str:
        """A live question."""
        return self._send("ask", text, f"looking for '{text}'")

    def forget(self, text: str) -> str:
        """No longer."""
        return self._send("forget", text, f"'{text}' is no longer looked for")

    def command(self, name: str) -> str:
        """The demo walks by itself: it can be stopped and its moments marked."""
        if name == "start":
            return "the demo walks by itself; stop it with s"
        if name == "mark":
            return self._send("mark", "", "marked")
        return self._send("stop", "", "stopping: the map is being saved")

    def close(self) -> None:
        """End the child; what it saved stays."""
        with contextlib.suppress(OSError):
            self._pipe.send(("quit", ""))
        self._child.join(_STOP_S)
        if self._child.is_alive():
            self._child.terminate()
            self._child.join(_STOP_S)

    def _send(self, what: str, text: str, answer: str) -> str:
        try:
            self._pipe.send((what, text))
        except OSError:
            raise RemoteError("the demo has ended") from None
        return answer

    def _listen(self) -> None:
        while True:
            try:
                status, delta = self._pipe.recv()
            except (EOFError, OSError):
                self._gone = self._status.message or "the demo ended early; run it without --tui to see why"
                return
            with self._lock:
                self._status = status
                if delta is not None:
                    self._news.append(delta)


class Teller:
    """In the child: keeps the newest state and sends it from a thread, so that the pipeline never waits."""

    def __init__(self, pipe: Connection, leave: Callable[[], None] = lambda: _signal(signal.SIGTERM)) -> None:
        """``leave`` is called when the terminal has gone."""
        self._pipe, self._leave = pipe, leave
        self._newest = Newest()
        self._status = Status(state="checking", message="starting")
        self._times: deque[float] = deque(maxlen=_RECENT)
        self.orders: deque[tuple[str, str]] = deque()
        self.live: LiveQuestions | None = None
        self.stop = threading.Event()
        self._closing = threading.Event()
        self._start = time.monotonic()
        self._threads = [threading.Thread(target=t, daemon=True) for t in (self._send, self._hear)]
        for thread in self._threads:
            thread.start()

    def say(self, **fields: Any) -> None:
        """Change fields of the status."""
        self._status = replace(self._status, **fields)

    def frame(self, delta: MeshDelta, ms: float) -> None:
        """A frame was mapped."""
        self._newest.add(delta)
        self._times.append(ms)

    def news(self, delta: MeshDelta) -> None:
        """What changed outside a frame."""
        self._newest.add(delta)

    def close(self) -> None:
        """Send what is left."""
        self._closing.set()
        self._threads[0].join(_STOP_S)

    def _send(self) -> None:
        while True:
            last = self._closing.wait(_SEND_EVERY_S)
            delta = self._newest.take(_MOST_BLOCKS)
            while self.live is not None and self.orders:  # also when the walk is over
                self.live.order(*self.orders.popleft())
            queries = [] if self.live is None else self.live.told()
            status = replace(
                self._status,
                frame_ms=list(self._times),
                queries=queries,
                seconds=time.monotonic() - self._start,
            )
            try:
                self._pipe.send((status, delta))
            except OSError:
                return
            if last and len(self._newest) == 0:
                return

    def _hear(self) -> None:
        while True:
            try:
                what, text = self._pipe.recv()
            except (EOFError, OSError):
                what, text = "quit", ""
            if what == "quit":
                self._leave()
                return
            if what == "stop":
                self.stop.set()
                _signal(signal.SIGINT)  # the run ends after this frame and keeps what it has
            else:
                self.orders.append((what, text))


def _signal(number: int) -> None:
    os.kill(os.getpid(), number)


class WatchedPipeline(Pipeline):
    """The pipeline at the pace of the recording, telling what it does."""

    def __init__(
        self,
        config: Config,
        odometry: Odometry,
        folder: Path,
        teller: Teller,
        segmenter: Segmenter | None,
    ) -> None:
        super().__init__(config, odometry, folder, segmenter)
        teller.live = LiveQuestions([] if segmenter is None else list(segmenter.names))
        self._teller = teller
        self._due = 0.0
        self._frames = 0
        self._size = MapSize()

    def process(self, frame: SyncedFrame) -> MeshDelta:
        """One frame, not before its time."""
        now = time.monotonic()
        if self._frames:
            time.sleep(max(self._due - now, 0.0))
        self._due = max(self._due, now - _FRAME_S) + _FRAME_S
        start = time.perf_counter()
        delta = super().process(frame)
        self._frames += 1
        self._size.add(delta)
        self._teller.frame(delta, (time.perf_counter() - start) * 1e3)
        self._tell(frame)
        return delta

    def finish(self, go_on: GoOn = always) -> MeshDelta:
        """The walk is over: what was postponed is done, and everything is saved."""
        self._teller.say(state="saving", message="the walk is over; the map is being saved and measured")

        def told(done: int, total: int) -> bool:
            self._teller.say(message=f"the walk is over; photographs asked again: {done} of {total}")
            return go_on(done, total)

        delta = super().finish(told)
        self._teller.news(delta)
        return delta

    def _tell(self, frame: SyncedFrame) -> None:
        T = self.trajectory[-1][1]
        points = sum(len(scan.points) for scan in frame.scans)
        streams = [
            Stream("lidar", points / _FRAME_S, 0.0, frame.lost.get("packets", 0), state="running"),
            Stream("camera", len(frame.images) / _FRAME_S, 10.0, state="running"),
            Stream("imu", len(frame.imu.stamp_ns) / _FRAME_S, 0.0, state="running"),
        ]
        self._teller.say(
            state="replaying",
            frames=self._frames,
            streams=streams,
            position=tuple(float(v) for v in T[:3, 3]),
            yaw=float(np.arctan2(T[1, 0], T[0, 0])),
            map=MapStatus(self._size.vertices, self._size.triangles, resident_mb=health.resident_mb()),
            message="",
            degenerate=self.tracked is not None and self.tracked.degenerate,
            coaching=[said] if (said := getattr(self.odometry, "instruction", None)) is not None else [],
        )


class _Make:
    """The first pipeline warms up and is not watched, the second maps."""

    def __init__(self, teller: Teller) -> None:
        self._teller, self._made = teller, 0

    def __call__(
        self, config: Config, odometry: Odometry, folder: Path, segmenter: Segmenter | None = None
    ) -> Pipeline:
        self._made += 1
        if self._made == 1:
            self._teller.say(
                message="getting ready; the very first time takes a minute or two", frames_total=0
            )
            return Pipeline(config, odometry, folder, BlankMasks(("anything",)))
        return WatchedPipeline(config, odometry, folder, self._teller, segmenter)


def _child(pipe: Connection, world: str, seconds: float, seed: int, out: Path, queries: list[str]) -> None:
    """Record, map, tell; the terminal belongs to the parent, so nothing is printed."""
    with Path(os.devnull).open("w") as sink, redirect_stdout(sink), redirect_stderr(sink):
        _demo(Teller(pipe), world, seconds, seed, out, queries)


def _demo(teller: Teller, world: str, seconds: float, seed: int, out: Path, queries: list[str]) -> None:
    from artemis_edge.errors import UserError
    from artemis_edge.session.demo import demo

    teller.orders.extend(("ask", text) for text in queries)

    @contextlib.contextmanager
    def report(label: str) -> Iterator[Report]:
        def tell(done: int, total: int, note: str = "") -> None:
            if label != "mapping":  # of that the pipeline itself tells
                teller.say(message=f"{label}: {done} of {total}", frames_total=total)

        yield tell

    try:
        demo(
            world, seconds, seed, out,
            make=_Make(teller),
            reporter=report,
            queries=list(dict.fromkeys([*queries, *EVERY_CLASS])),
        )  # fmt: skip
    except UserError as error:
        interrupted = teller.stop.is_set() and (out / "report.html").exists()
        teller.say(state="done" if interrupted else "fault", message=str(error))
    except KeyboardInterrupt:
        teller.say(state="fault", message="stopped before there was a map")
    else:
        teller.say(state="done", message=f"done: {out / 'mesh.glb'}")
    if (out / "report.html").exists():
        teller.say(report=str(out / "report.html"))
    teller.close()
