"""The mapping of a stream of messages: the same for what is recorded just now and for what is replayed."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge import health, topics
from artemis_edge.config import Config, to_toml
from artemis_edge.continuing import EarlierMap
from artemis_edge.errors import InputError, RunError
from artemis_edge.exclusion import Zones
from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import MeshDelta, SyncedFrame, Trajectory
from artemis_edge.highlight import Reply, answer, objects_of
from artemis_edge.keeper import Keeper
from artemis_edge.load import Load
from artemis_edge.loop.relocate import Found
from artemis_edge.map_size import MapSize
from artemis_edge.mapping_run import Mapper
from artemis_edge.refinement.stage import GoOn, always
from artemis_edge.runtime import MakeMapper, pipeline, with_tiny_map, write_results
from artemis_edge.session import made_up_room
from artemis_edge.session.asked import Asked
from artemis_edge.session.assembly import FrameAssembler
from artemis_edge.session.late_masks import LateMasks
from artemis_edge.session.late_odometry import LateOdometry
from artemis_edge.session.message_ring import Sent
from artemis_edge.session.messages import Mask, Text
from artemis_edge.session.photos import HeldOut
from artemis_edge.session.results import Results, prepare
from artemis_edge.session.statistics import RunStatistics

_NS_PER_MS = 1e6
_INPUT_HZ = 10.0
_ABOUT_QUESTIONS = frozenset({topics.QUESTIONS.name, topics.MASKS.name})


class StreamMapping:
    """Takes messages in their order; every frame that one completes is mapped.

    ``skip`` are indices of frames that are not mapped, because mapping them ended the process. With ``questions`` the
    map has classes, asked for and seen by messages of the stream.
    """

    def __init__(
        self,
        config: Config,
        pages: Path,
        make: MakeMapper = pipeline,
        name: str = "live",
        questions: bool = False,
    ) -> None:
        self.config = config
        self.assembler = FrameAssembler()
        self._zones = Zones.of(config.exclusion)
        self.odometry = LateOdometry(config.odometry)
        self.masks = LateMasks() if questions else None
        segmenter = () if self.masks is None else (self.masks,)
        self.mapper: Mapper = make(config, self.odometry, pages, *segmenter)
        self.keeper = Keeper(pages, config.keep, config.segmentation)
        self._prepare = self.keeper.between(lambda frame: frame, self.mapper)
        self.statistics = RunStatistics(name, _INPUT_HZ, config_toml=to_toml(config))
        self.load = Load()
        self.skip: set[int] = set()
        self.latest_ns = 0
        self.fault = ""
        self.delta: MeshDelta | None = None  # of the latest frame
        self.size = MapSize()
        self.before: Callable[[int], None] = lambda index: None

    def go_on_in(self, earlier: EarlierMap, found: Found, first_ns: int) -> None:
        """Before the first message: begin with a map made before, in which the stream was recognised."""
        self.odometry.start = earlier.start(found)
        self.statistics.continued = earlier.account(found, first_ns)
        earlier.into(self.mapper, self.keeper)

    def take(self, sent: Sent) -> bool:
        """Whether the message completed a frame. A frame that cannot be mapped is counted and skipped."""
        if self.masks is not None and sent.topic in _ABOUT_QUESTIONS:
            self._take_question(self.masks, sent)
            return False
        if sent.topic == topics.OVERLOAD.name:
            self._take_load(sent)
            return False
        frame = self.assembler.take(sent)
        if frame is None:
            return False
        self.latest_ns = frame.stamp_ns
        for ready in self.odometry.ready(self._zones.applied(frame)):
            self._one(ready)
        return True

    def _take_question(self, masks: LateMasks, sent: Sent) -> None:
        """What is asked from now on, or a mask. One that is damaged is counted."""
        try:
            if sent.topic == topics.MASKS.name:
                masks.take(Mask.decode(sent.data))
                return
            masks.asked = Asked.decode(Text.decode(sent.data).text)
            self.mapper.ask(masks.asked.slots)
        except ValueError:
            masks.lost["questions_undecodable"] += 1

    def _take_load(self, sent: Sent) -> None:
        """How much may be done from the next frame on."""
        try:
            self.load = Load.decode(Text.decode(sent.data).text)
        except ValueError:
            self.statistics.add_lost({"loads_undecodable": 1})
            return
        self.mapper.reduce(self.load)

    def save(self, out: Path, go_on: GoOn = always) -> dict[str, Any]:
        """Finish the map and write all results to ``out``; returns what report.json holds. Raises RunError.

        ``go_on`` is told of photographs that are asked again, of how many.
        """
        prepare(out)
        for frame in self.odometry.release():
            self._one(frame)
        if not self.mapper.trajectory:
            raise RunError("no frame of a LiDAR could be mapped; what was recorded is kept")
        wall, cpu = time.perf_counter_ns(), time.process_time_ns()
        self.mapper.finish(go_on)
        self.statistics.flush_ms = (time.perf_counter_ns() - wall) / _NS_PER_MS
        self.statistics.flush_cpu_ms = (time.process_time_ns() - cpu) / _NS_PER_MS
        self.statistics.add_lost(self.assembler.lost)
        self.statistics.add_lost(self.mapper.lost)
        self.statistics.notes += [self.odometry.instruction] if self.odometry.instruction else []
        found = self.odometry.lost.items()
        self.statistics.add_lost({f"odometry_{reason.replace(' ', '_')}": n for reason, n in found})
        results = Results(out)
        photos = HeldOut(out, 0)
        answering = None
        if self.masks is not None:
            self.statistics.add_lost(self.masks.lost)
            answering = None if self.masks.asked is None else StreamAnswers(self.masks.asked)
        report = write_results(
            results, self.trajectory(), self.mapper, self.keeper, photos, self.statistics, None, answering
        )
        return {"report": report or {}, "kept": results.kept, "fault": results.fault or ""}

    def trajectory(self) -> Trajectory:
        """The pose of every frame that was mapped."""
        poses = self.mapper.trajectory
        stamps = np.array([stamp for stamp, _ in poses], np.int64)
        return Trajectory(stamps, np.array([T for _, T in poses], np.float64).reshape(-1, 4, 4))

    def _one(self, frame: SyncedFrame) -> None:
        self.before(frame.index)
        if frame.index in self.skip:
            self._drop("frames_that_end_the_process")
            return
        try:
            self._map(frame)
        except InputError as error:
            self.fault = self.fault or str(error)
            self._drop("frames_skipped")

    def _map(self, frame: SyncedFrame) -> None:
        frame = self._prepare(thinned(frame, self.load.every_point))
        wall, cpu = time.perf_counter_ns(), time.process_time_ns()
        self.delta = self.mapper.process(frame)
        wall, cpu = time.perf_counter_ns() - wall, time.process_time_ns() - cpu
        self.size.add(self.delta)
        self.statistics.add_frame(
            wall / _NS_PER_MS, cpu / _NS_PER_MS, self.mapper.stage_ms, self.mapper.tracked
        )
        self.statistics.add_lost(frame.lost)

    def _drop(self, reason: str) -> None:
        self.statistics.frames_dropped += 1
        self.statistics.add_lost({reason: 1})


def thinned(frame: SyncedFrame, every: int) -> SyncedFrame:
    """The frame with every so-manyth point of its scans."""
    if every == 1:
        return frame
    scans = tuple(
        replace(
            scan,
            points=np.ascontiguousarray(scan.points[::every]),
            offset_s=None if scan.offset_s is None else np.ascontiguousarray(scan.offset_s[::every]),
            intensity=None if scan.intensity is None else np.ascontiguousarray(scan.intensity[::every]),
        )
        for scan in frame.scans
    )
    return replace(frame, scans=scans)


@dataclass(frozen=True, slots=True)
class StreamAnswers:
    """What the finished map answers to the questions that were asked last."""

    asked: Asked

    def replies(self, mesh: Mesh, mapper: Mapper) -> list[Reply]:
        """One for each question."""
        return answer(self.asked.understood(), objects_of(mesh, mapper.probability))


def has_questions(stream: Iterator[Sent]) -> tuple[bool, Iterator[Sent]]:
    """Whether a stream tells of questions before its first cloud, as all of a run with questions do; and the stream."""
    first: list[Sent] = []
    found = False
    for sent in stream:
        first.append(sent)
        found = found or sent.topic == topics.QUESTIONS.name
        if found or sent.topic == topics.LIDAR_POINTS.name:
            break
    return found, chain(first, stream)


def warm_up(config: Config, folder: Path, make: MakeMapper = pipeline, questions: bool = False) -> float:
    """Have every kernel compiled or loaded before the first frame, on a small made-up room; returns the seconds."""
    start = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    mapping = StreamMapping(with_tiny_map(config), folder, make, questions=questions)
    for sent in made_up_room.messages(questions):
        mapping.take(sent)
    mapping.mapper.finish()
    del mapping
    gc.collect()
    health.give_back_memory()
    return time.perf_counter() - start
