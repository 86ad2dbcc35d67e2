"""The loop over the frames of one input: timing, faults, interruption. It knows nothing of files."""

from __future__ import annotations

import gc
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import numpy as np

from artemis_edge import health
from artemis_edge.errors import InputError, RunError, UserError
from artemis_edge.export.atomic import disk_sentence
from artemis_edge.export.ply import Mesh
from artemis_edge.frames import (
    F32,
    F64,
    CameraModel,
    FrameSource,
    MeshDelta,
    SyncedFrame,
    TrackedFrame,
    Trajectory,
)
from artemis_edge.load import Load
from artemis_edge.paging import Page
from artemis_edge.progress import Report, now_and_then, say
from artemis_edge.refinement.photographs import Waiting
from artemis_edge.session.statistics import RunStatistics
from artemis_edge.sight import Sight
from artemis_edge.trajectory import inverse

Publish = Callable[[MeshDelta], None]

_NS_PER_MS = 1e6
# Cycles are collected between frames, not inside one; what the warm-up left is frozen and costs nothing.
_COLLECT_EVERY = 100
_TELL_EVERY_S = 5.0


class Mapper(Protocol):
    """What the loop needs of ``pipeline.Pipeline``."""

    stage_ms: dict[str, float]
    trajectory: list[tuple[int, F64]]
    tracked: TrackedFrame | None

    @property
    def lost(self) -> Mapping[str, int]:
        """What the stages could not use, by reason."""
        ...

    def take_over(self, pages: Iterable[Page], photographs: Iterable[Waiting]) -> None:
        """Begin with the blocks of a map made before and the photographs that colour it."""
        ...

    def process(self, frame: SyncedFrame) -> MeshDelta:
        """All stages for one frame."""
        ...

    @property
    def warnings(self) -> Sequence[str]:
        """Sentences for the user about what the stages could not use."""
        ...

    @property
    def falloff(self) -> Mapping[str, F64]:
        """Of each camera whose lens's fall-off was found, its coefficients."""
        ...

    @property
    def probability(self) -> F32:
        """Of each vertex of the written mesh, that of its class; empty without classes."""
        ...

    def finish(self, go_on: Callable[[int, int], bool] = ...) -> MeshDelta | None:
        """Work that was postponed; ``go_on`` is told of photographs asked again, of how many, and may end that."""
        ...

    def ask(self, slots: Mapping[int, str]) -> None:
        """Which class each slot of the map holds from the next frame on; of a mapper with a segmenter only."""
        ...

    def reduce(self, load: Load) -> None:
        """How much may be done from the next frame on."""
        ...

    def sight(self, camera: CameraModel, T_world_cam: F64) -> Sight:
        """The view of a camera with the reference depth that the map has now."""
        ...

    def tell_everything(self) -> None:
        """The deltas to come hold the whole map once more."""
        ...

    def write_mesh(self, path: Path) -> Mesh:
        """Write the whole mesh."""
        ...

    def save(self, folder: Path) -> int:
        """Write what reopens the map; returns bytes."""
        ...


class Interrupt:
    """While entered, the first SIGINT or SIGTERM asks for an end after this frame, the next ends at once."""

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        say("stopping after this frame; what is mapped is kept (once more to stop at once)")


class MappingRun:
    """Feeds the frames ``span`` of a source to a mapper and keeps the account in ``statistics``.

    ``stopped`` says why the run ended early (None: it did not), ``fault`` is the first sentence about a frame
    that was skipped. ``publish`` is offered every delta, outside the time of the frame.
    """

    def __init__(
        self,
        mapper: Mapper,
        source: FrameSource,
        span: range,
        statistics: RunStatistics,
        publish: Publish = lambda delta: None,
    ) -> None:
        self.stopped: str | None = None
        self.fault: InputError | None = None
        self._mapper, self._source, self._span, self._statistics = mapper, source, span, statistics
        self._publish = publish

    def frames(
        self, report: Report, interrupt: Interrupt, prepare: Callable[[SyncedFrame], SyncedFrame]
    ) -> None:
        """All frames. One that cannot be read or mapped is counted and skipped; a full disk ends the run."""
        with _quiet_collector():
            for done, (frame, fault) in enumerate(readable(self._source, self._span)):
                if interrupt.asked:
                    total = len(self._span)
                    self._stop(f"interrupted after {done} of {total} frames", total - done)
                    return
                if frame is not None:
                    fault = self._one(frame, prepare)
                if self.stopped is not None:
                    return
                if fault is not None:
                    self._skip(fault)
                report(done + 1, len(self._span), self._note())
                if done % _COLLECT_EVERY == _COLLECT_EVERY - 1:
                    gc.collect()

    def flush(self, report: Report, interrupt: Interrupt) -> None:
        """The work that was postponed, counted apart; less of it for a user who wants an end."""

        def told(done: int, total: int, note: str = "") -> None:
            report(len(self._span), len(self._span), f"photographs asked again: {done} of {total}")

        seldom = now_and_then(told, _TELL_EVERY_S)

        def go_on(done: int, total: int) -> bool:
            seldom(done, total)
            return not interrupt.asked

        wall, cpu = time.perf_counter_ns(), time.process_time_ns()
        delta = None
        try:
            delta = self._mapper.finish(go_on)
        except (RunError, OSError) as error:
            self._stop(_sentence(error))
        self._statistics.flush_ms = (time.perf_counter_ns() - wall) / _NS_PER_MS
        self._statistics.flush_cpu_ms = (time.process_time_ns() - cpu) / _NS_PER_MS
        if delta is not None:
            self._publish(delta)

    def trajectory(self) -> Trajectory:
        """The pose of every frame that was mapped."""
        poses = self._mapper.trajectory
        stamps = np.array([stamp for stamp, _ in poses], np.int64)
        return Trajectory(stamps, np.array([T for _, T in poses], np.float64).reshape(-1, 4, 4))

    def _one(self, frame: SyncedFrame, prepare: Callable[[SyncedFrame], SyncedFrame]) -> InputError | None:
        try:
            frame = prepare(frame)
            wall, cpu = time.perf_counter_ns(), time.process_time_ns()
            delta = self._mapper.process(frame)
            wall, cpu = time.perf_counter_ns() - wall, time.process_time_ns() - cpu
        except InputError as error:
            return error
        except (RunError, OSError) as error:
            self._stop(_sentence(error), self._span.stop - frame.index)
            return None
        self._statistics.add_frame(
            wall / _NS_PER_MS, cpu / _NS_PER_MS, self._mapper.stage_ms, self._mapper.tracked
        )
        self._statistics.add_lost(frame.lost)
        self._publish(delta)
        return None

    def _skip(self, fault: InputError) -> None:
        self.fault = self.fault or fault
        self._statistics.frames_dropped += 1
        self._statistics.add_lost({"frames_skipped": 1})

    def _stop(self, why: str, left: int = 0) -> None:
        self.stopped = self.stopped or why
        if left:
            self._statistics.add_lost({"frames_not_reached": left})

    def _note(self) -> str:
        times = self._statistics.frame_ms
        pace = f"{np.median(times[-20:]):.0f} ms a frame, " if times else ""
        return f"{pace}{health.resident_mb():.0f} MB"


def readable(source: FrameSource, span: range) -> Iterator[tuple[SyncedFrame | None, InputError | None]]:
    """Every frame of ``span``, or why it cannot be read."""
    index = span.start
    while index < span.stop:
        try:
            for frame in source.frames(index, span.stop):
                index += 1
                yield frame, None
            return
        except InputError as error:
            index += 1
            yield None, error


def warm_up(make: Callable[[], Mapper], source: FrameSource, span: range, frames: int) -> None:
    """Compile or load every kernel on a throw-away map of the first frames.

    The input's own frames, because kernels are compiled for the very types that they meet.
    """
    try:
        mapper = make()
        for frame in source.frames(span.start, min(span.start + frames, span.stop)):
            mapper.process(frame)
            for image in frame.images[:1]:
                mapper.sight(image.model, inverse(image.T_cam_lidar))
        mapper.finish()
    except (UserError, OSError):
        pass  # the run itself will meet the same fault and count it


def _sentence(error: RunError | OSError) -> str:
    if isinstance(error, OSError):
        return disk_sentence(Path(str(error.filename or "the map")), error)
    return str(error)


@contextmanager
def _quiet_collector() -> Iterator[None]:
    """No garbage collection inside frames (1 million objects: 187 ms, docs/tuning.md)."""
    was_on = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.unfreeze()
        if was_on:
            gc.enable()
