"""``reprocess``: from an input to the output directory of the contract."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import msgspec
import numpy as np

from artemis_edge import health
from artemis_edge.compile_ahead import compile_ahead
from artemis_edge.config import Config, OdometryConfig, to_toml
from artemis_edge.continuing import EarlierMap, find_start, open_earlier
from artemis_edge.datasets import lidar_poses, open_input
from artemis_edge.errors import InputError, RunError
from artemis_edge.export.atlas import read_atlas
from artemis_edge.export.glb import write_glb
from artemis_edge.export.objects import objects_json, queries_json
from artemis_edge.export.ply import Mesh
from artemis_edge.frames import FrameSource, Odometry, SyncedFrame, Trajectory
from artemis_edge.highlight import Reply
from artemis_edge.keeper import Keeper
from artemis_edge.loop.corrected import CorrectedOdometry
from artemis_edge.mapping_run import Interrupt, Mapper, MappingRun, readable, warm_up
from artemis_edge.odometry.choice import OwnOdometry, odometry_for
from artemis_edge.odometry.given_poses import GivenPoses
from artemis_edge.odometry.inertial_odometry import InertialOdometry
from artemis_edge.odometry.known_map import Start
from artemis_edge.odometry.visual import VisualUpdate
from artemis_edge.progress import Report, silent
from artemis_edge.questions import BlankMasks, Questions, ScheduledMasks, every_image, unanswered
from artemis_edge.segmentation.yolo_seg import Thresholds
from artemis_edge.semantic_map import Segmenter
from artemis_edge.session.photos import INDEX, HeldOut
from artemis_edge.session.report import Evaluation, RunStatistics, write_report
from artemis_edge.session.results import Results, preparing, refuse_foreign, scratch
from artemis_edge.telling import telling
from artemis_edge.trajectory import hole_sentence, pose_per_frame, read_tum, write_tum

_WARM_UP_FRAMES = 3
_WARM_UP_MB = 600

#: Called with configuration, odometry, folder for pages and, where questions need a network, what asks it.
MakeMapper = Callable[..., Mapper]
#: What is measured of a finished map, for the report; None where there is no truth.
Evaluate = Callable[[Mesh, Trajectory], Evaluation]


@dataclass(frozen=True, slots=True)
class Request:
    """What to map and how. ``poses`` a TUM file, ``own_odometry`` ignores poses of the input (--no-poses).

    ``start`` and ``stop`` bound the frames (None: the end); ``holdout`` keeps every N-th photograph of each
    camera out of the map (0: none). ``queries`` are questions that the map is to answer, with the ``model`` of the
    registry (empty: that of the configuration). ``go_on`` is a map to be continued.
    """

    input: Path
    out: Path
    config: Config = field(default_factory=Config)
    poses: Path | None = None
    own_odometry: bool = False
    start: int = 0
    stop: int | None = None
    holdout: int = 0
    queries: tuple[str, ...] = ()
    model: str = ""
    go_on: Path | None = None

    def estimates(self, source: FrameSource) -> bool:
        """Whether the poses are those of our own odometry: none are given with it or by the input."""
        return self.poses is None and (self.own_odometry or source.poses is None or not len(source.poses))


@dataclass(frozen=True, slots=True)
class Outcome:
    """``report`` is the content of report.json; ``warnings`` are sentences for the user."""

    out: Path
    report: dict[str, Any]
    statistics: RunStatistics
    trajectory: Trajectory
    warnings: list[str]


def pipeline(
    config: Config, odometry: Odometry, page_folder: Path, segmenter: Segmenter | None = None
) -> Mapper:
    """The pipeline of the paper."""
    from artemis_edge.pipeline import Pipeline

    return Pipeline(config, odometry, page_folder, segmenter)


def warm_pipeline(request: Request) -> MakeMapper:
    """The pipeline with masks without content where the request has questions: to compile and load its kernels."""
    if not request.queries:
        return pipeline
    return lambda config, odometry, folder: pipeline(config, odometry, folder, BlankMasks(("anything",)))


def reprocess(
    request: Request,
    report: Report = silent,
    evaluate: Evaluate | None = None,
    make: MakeMapper = pipeline,
) -> Outcome:
    """Map an input into ``request.out``.

    Raises InputError when nothing can be done, RunError when the run ended early, a result could not be written
    or the mesh has no triangle; its sentence says what was kept.
    """
    health.restart_peak()
    source = open_input(request.input, request.config.input, request.config.exclusion)
    span = frame_span(source, request)
    odometry = choose_odometry(source, request, span)
    earlier = None if request.go_on is None else open_earlier(request.go_on, request.config)
    statistics = RunStatistics(source.name, source.input_hz, config_toml=to_toml(request.config))
    refuse_foreign(request.out)
    with preparing(request.out), scratch(request.out) as pages, Answering(request) as answering:
        with Interrupt() as interrupt, telling(request.config.view) as live:
            warm_up_run(request, odometry, pages, source, span, statistics, make)
            if earlier is not None:
                odometry = placed(earlier, odometry, source, request, span, statistics)
            tracker = odometry()
            if request.config.odometry.close_loops and isinstance(tracker, OwnOdometry):
                tracker = corrected(tracker, odometry, source, span)
            photos = HeldOut(request.out, request.holdout)
            mapper = answering.mapper(make, photos.watching(tracker), pages)
            run = MappingRun(mapper, source, span, statistics, live.watching(mapper))
            keeper = Keeper(pages, request.config.keep, request.config.segmentation)
            if earlier is not None:
                earlier.into(mapper, keeper)
            run.frames(report, interrupt, answering.between(keeper.between(photos.take, mapper)))
            if not statistics.frame_ms:
                raise _nothing_mapped(run, source, span)
            stage = partial(report, len(span), len(span))
            stage("settling what was put off")
            run.flush(report, interrupt)
        count_losses(statistics, source, tracker, mapper)
        results = Results(request.out)
        outcome = write_results(
            results, run.trajectory(), mapper, keeper, photos, statistics, evaluate, answering, stage
        )
    _complain(run, results, request.out)
    if outcome is not None and not outcome["triangles"]:
        raise _nothing_meshed(outcome, request, results)
    told = [*source.warnings, *statistics.notes, *_skipped(run, statistics)]
    warnings = [*told, *mapper.warnings, *answering.warnings]
    return Outcome(request.out, outcome or {}, statistics, run.trajectory(), warnings)


class Answers(Protocol):
    """What knows the questions that a finished map is to answer."""

    def replies(self, mesh: Mesh, mapper: Mapper) -> list[Reply]:
        """One for each question."""
        ...


class Answering:
    """The questions of a request, while its run lasts: what asks the network, and what the map answers."""

    def __init__(self, request: Request) -> None:
        self.warnings: list[str] = []
        self._request = request
        model = request.model or request.config.segmentation.model
        thresholds = Thresholds.by(request.config.segmentation)
        self.questions = Questions.of(request.queries, model, thresholds) if request.queries else None
        self._masks: ScheduledMasks | None = None

    def __enter__(self) -> Answering:
        return self

    def __exit__(self, *_: object) -> None:
        if self._masks is not None:
            self._masks.close()

    def mapper(self, make: MakeMapper, odometry: Odometry, pages: Path) -> Mapper:
        """The mapper of the run, with the network at work where a question needs it."""
        config = self._request.config
        if self.questions is None or not self.questions.names:
            return make(config, odometry, pages)
        rule = config.segmentation
        self._masks = self.questions.segmenter(every_image(rule.every, rule.delay_frames))
        return make(config, odometry, pages, self._masks)

    def between(self, prepare: Callable[[SyncedFrame], SyncedFrame]) -> Callable[[SyncedFrame], SyncedFrame]:
        """``prepare``, which is called before every frame, after the masks that the frame will need are there."""
        masks = self._masks
        if masks is None:
            return prepare

        def both(frame: SyncedFrame) -> SyncedFrame:
            masks.settle()
            return prepare(frame)

        return both

    def replies(self, mesh: Mesh, mapper: Mapper) -> list[Reply]:
        """What the map answers to each question."""
        if self.questions is None:
            return []
        if self._masks is None:
            return unanswered(self.questions, "nothing in it can be looked for")
        tally = self._masks.work.tally
        if tally.first_fault:
            self.warnings.append(
                f"{tally.faulty} photographs could not be segmented; the first: {tally.first_fault}"
            )
        if tally.segmented == 0:
            self.warnings.append("no photograph was segmented: the input has none that the frames could use")
            return unanswered(self.questions, "the recording has no photographs to look at")
        return self.questions.replies(mesh, mapper.probability)


def frame_span(source: FrameSource, request: Request) -> range:
    """The frames asked for; InputError if the input has none of them."""
    count = len(source)
    stop = count if request.stop is None else min(request.stop, count)
    if not 0 <= request.start < stop:
        asked = f"{request.start}:{'' if request.stop is None else request.stop}"
        raise InputError(f"{source.name} has {count} frames, none of them in --frames {asked}")
    return range(request.start, stop)


def placed(
    earlier: EarlierMap,
    odometry: Callable[[], Odometry],
    source: FrameSource,
    request: Request,
    span: range,
    statistics: RunStatistics,
) -> Callable[[], Odometry]:
    """The odometry in the frame of a map made before, in which the recording must be recognised.

    An odometry of ours then also registers to that map; given poses are only moved there.
    """
    found = find_start(earlier, odometry, _frames(source, span), source.name)
    statistics.continued = earlier.account(found, int(source.stamp_ns[span.start]))
    start = earlier.start(found)
    if request.estimates(source):
        return lambda: own_odometry(request.config.odometry, lambda: _frames(source, span), start)
    fixed = Trajectory(np.zeros(1, np.int64), found.T_map_world[None])
    return lambda: CorrectedOdometry(odometry(), fixed)


def choose_odometry(source: FrameSource, request: Request, span: range) -> Callable[[], Odometry]:
    """Given poses, else those of the input, else the odometry; called once for every run over the frames."""
    if request.poses is not None:
        given = lidar_poses(source, read_tum(request.poses))
        poses = pose_per_frame(given, source.stamp_ns, span.start, span.stop, str(request.poses))
        # more poses than frames also tell how the sensor moved within a scan
        chosen = GivenPoses(given if len(given) > len(source.stamp_ns) else poses)
        hole = None if len(given) == len(source.stamp_ns) else hole_sentence(given, poses.stamp_ns)
        source.warnings.extend([] if hole is None else [f"{request.poses}: {hole}"])
        return lambda: chosen
    if request.estimates(source) or source.poses is None:
        return lambda: own_odometry(request.config.odometry, lambda: _frames(source, span))
    own = GivenPoses(source.poses)
    return lambda: own


def own_odometry(
    config: OdometryConfig, frames: Callable[[], Iterator[SyncedFrame]], start: Start | None = None
) -> OwnOdometry:
    """The odometry of a recording, with its images unless the configuration says no; from a ``start`` in a map."""
    return odometry_for(config, frames, VisualUpdate() if config.visual else None, start)


def corrected(
    tracker: Odometry, odometry: Callable[[], Odometry], source: FrameSource, span: range
) -> Odometry:
    """The odometry with the loops of the recording closed, for which it runs once beforehand."""
    from artemis_edge.loop.corrected import close_loops

    closed = close_loops(odometry, _frames(source, span))
    source.warnings.append(closed.sentence())
    return CorrectedOdometry(tracker, closed.correction) if closed.loops else tracker


def _frames(source: FrameSource, span: range) -> Iterator[SyncedFrame]:
    return (frame for frame, _ in readable(source, span) if frame is not None)


def warm_up_run(
    request: Request,
    odometry: Callable[[], Odometry],
    pages: Path,
    source: FrameSource,
    span: range,
    statistics: RunStatistics,
    make: MakeMapper,
) -> None:
    """Kernels ready before the first frame."""
    start = time.perf_counter()
    if make is pipeline:
        compile_ahead(request, source, span)
        make = warm_pipeline(request)
    warm_up_here(request.config, odometry, pages, source, span, make)
    statistics.warmup_s = time.perf_counter() - start
    gc.collect()
    health.give_back_memory()


def with_tiny_map(config: Config) -> Config:
    """The configuration with the smallest map there can be, for a warm-up."""
    small = msgspec.structs.replace(config.voxel_map, memory_budget_mb=_WARM_UP_MB)
    return msgspec.structs.replace(config, voxel_map=small)


def warm_up_here(
    config: Config,
    odometry: Callable[[], Odometry],
    pages: Path,
    source: FrameSource,
    span: range,
    make: MakeMapper,
) -> None:
    """Load every kernel into this process, compiled or not; the map of the warm-up is as small as can be."""
    tiny = with_tiny_map(config)
    folder = pages / "warm-up"
    folder.mkdir()
    warm_up(lambda: make(tiny, odometry(), folder), source, span, _WARM_UP_FRAMES)


def count_losses(statistics: RunStatistics, source: FrameSource, odometry: Odometry, mapper: Mapper) -> None:
    """What the input could not give and what the stages could not use."""
    statistics.add_lost(source.lost)
    statistics.add_lost(mapper.lost)
    odometry = getattr(odometry, "inner", odometry)
    if isinstance(odometry, OwnOdometry):
        losses = odometry.losses if isinstance(odometry, InertialOdometry) else odometry.lost
        statistics.notes += [odometry.instruction] if odometry.instruction is not None else []
        statistics.add_lost({f"odometry_{reason.replace(' ', '_')}": n for reason, n in losses.items()})
    statistics.frames_dropped += source.lost.get("empty_file", 0)


def unheard(_: str) -> None:
    """Tell nobody."""


def write_results(
    results: Results,
    trajectory: Trajectory,
    mapper: Mapper,
    keeper: Keeper,
    photos: HeldOut,
    statistics: RunStatistics,
    evaluate: Evaluate | None,
    answering: Answers | None = None,
    stage: Callable[[str], None] = unheard,
) -> dict[str, Any] | None:
    """All results, small ones first; returns the report. ``stage`` is told what comes next."""
    results.text("config.toml", statistics.config_toml)
    results.attempt("trajectory.tum", lambda path: write_tum(path, trajectory))
    results.json("objects.json", {"objects": []})
    photos.remove_earlier()
    if photos.every:
        lost = results.attempt(INDEX, lambda path: photos.write_index(path, trajectory, mapper.falloff))
        statistics.add_lost({"photos_without_pose": lost} if lost else {})
    stage("finishing the mesh")
    mesh = results.attempt("mesh.ply", mapper.write_mesh)
    stage("saving the map")
    saved = results.directory("map", lambda folder: (mapper.save(folder), keeper.save(folder, trajectory)))
    statistics.map_bytes, statistics.kept_bytes = saved or (0, 0)
    if mesh is None:
        return None
    whole = mesh
    stage("writing mesh.glb and objects.json")
    replies = answering.replies(whole, mapper) if answering is not None else []
    if replies:
        results.json("objects.json", objects_json(replies))
    atlas = read_atlas(results.folder / "map") if saved else None
    results.attempt("mesh.glb", lambda path: write_glb(path, whole, atlas))
    statistics.peak_rss_mb = health.peak_resident_mb() or None
    if evaluate is not None:
        stage("measuring against the truth")
    evaluation = evaluate(whole, trajectory) if evaluate is not None and len(whole.faces) else None
    stage("drawing the report")
    return results.attempt(
        "report.html",
        lambda path: write_report(
            path.parent, whole, trajectory, statistics, queries_json(replies), evaluation
        ),
    )


def _nothing_mapped(run: MappingRun, source: FrameSource, span: range) -> InputError | RunError:
    if run.stopped is not None:
        return RunError(f"{run.stopped}; nothing was mapped")
    why = f": {run.fault}" if run.fault is not None else ""
    return InputError(f"none of the {len(span)} frames of {source.name} could be mapped{why}")


def _nothing_meshed(report: Mapping[str, Any], request: Request, results: Results) -> RunError:
    lost = ", ".join(f"{count} {reason}" for reason, count in report["lost"].items()) or "nothing"
    rules = request.config.voxel_map
    return RunError(
        f"the mesh of {report['frames']} frames has no triangles (counted as not used: {lost}); see whether the "
        f"scans hold points between voxel_map.min_range_m = {rules.min_range_m:g} and "
        f"voxel_map.max_range_m = {rules.max_range_m:g}, whether their poses are right and whether more than a few "
        f"frames were asked for; kept in {request.out}: {', '.join(results.kept)}"
    )


def _complain(run: MappingRun, results: Results, out: Path) -> None:
    """RunError if the run ended early or a result is missing."""
    why = run.stopped or results.fault
    if why is not None:
        kept = ", ".join(results.kept)
        raise RunError(f"{why}; " + (f"kept in {out}: {kept}" if kept else f"nothing could be kept in {out}"))


def _skipped(run: MappingRun, statistics: RunStatistics) -> list[str]:
    count = statistics.lost.get("frames_skipped", 0)
    return [f"{count} frames were skipped; the first: {run.fault}"] if count else []
