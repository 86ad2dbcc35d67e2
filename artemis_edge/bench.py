"""``artemis-edge bench``: what a frame costs on this machine, stage by stage. Nothing is kept."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge import health
from artemis_edge.config import Config
from artemis_edge.datasets import open_input
from artemis_edge.errors import RunError
from artemis_edge.mapping_run import Interrupt, MappingRun
from artemis_edge.progress import progress
from artemis_edge.runtime import (
    MakeMapper,
    Request,
    choose_odometry,
    count_losses,
    frame_span,
    pipeline,
    warm_up_run,
)
from artemis_edge.session.statistics import RunStatistics

_FRAMES_PER_S = 10
_SEED = 1


def bench(
    path: Path | None, frames: int, config: Config, plain: bool = False, make: MakeMapper = pipeline
) -> dict[str, Any]:
    """Map at most ``frames`` frames of an input, or of a virtual Avia walk, and say what they cost.

    Raises InputError for bad input, RunError when no frame could be mapped.
    """
    with tempfile.TemporaryDirectory(prefix="artemis-bench-") as name:
        folder = Path(name)
        if path is None:
            path = _virtual_walk(folder, frames, plain)
        return _measure(Request(path, folder, config, stop=frames), plain, make)


def _virtual_walk(folder: Path, frames: int, plain: bool) -> Path:
    from artemis_edge.session.simulate import simulate

    settings = {"camera": "false", "reference": "false", "mesh": "false"}
    with progress("simulating a walk", plain) as report:
        made = simulate("street", _SEED, frames / _FRAMES_PER_S, "avia", folder / "walk", settings, report)
    return made.session


def _measure(request: Request, plain: bool, make: MakeMapper) -> dict[str, Any]:
    health.restart_peak()
    source = open_input(request.input, request.config.input, request.config.exclusion)
    span = frame_span(source, request)
    odometry = choose_odometry(source, request, span)
    statistics = RunStatistics(source.name, source.input_hz)
    with Interrupt() as interrupt, progress("measuring", plain) as report:
        warm_up_run(request, odometry, request.out, source, span, statistics, make)
        tracker = odometry()
        mapper = make(request.config, tracker, request.out)
        run = MappingRun(mapper, source, span, statistics)
        run.frames(report, interrupt, lambda frame: frame)
        run.flush(report, interrupt)
    if run.stopped is not None or not statistics.frame_ms:
        raise RunError(f"{run.stopped or run.fault or 'no frame was mapped'}; nothing was measured")
    statistics.peak_rss_mb = health.peak_resident_mb() or None
    count_losses(statistics, source, tracker, mapper)
    summary = statistics.summary()
    wanted = {
        "stages": statistics.stage_ms,
        "frame_ms": {"": statistics.frame_ms},
        "cpu_ms": {"": statistics.cpu_ms},
    }
    figures = {name: {key: _figures(times) for key, times in group.items()} for name, group in wanted.items()}
    mean = {"mean_with_flush": summary["cpu_ms"]["mean"]}
    return summary | {
        "stages": figures["stages"],
        "frame_ms": figures["frame_ms"][""],
        "cpu_ms": figures["cpu_ms"][""] | mean,
    }


def _figures(times: Sequence[float]) -> dict[str, float]:
    values = np.asarray(times)
    figures = {f"p{p}": float(np.percentile(values, p)) for p in (50, 95, 99)}
    return {name: round(value, 3) for name, value in {**figures, "mean": float(values.mean())}.items()}


def to_text(result: dict[str, Any]) -> str:
    """The table for people."""
    rows = [*result["stages"].items(), ("frame, wall", result["frame_ms"]), ("frame, CPU", result["cpu_ms"])]
    columns = ("p50", "p95", "p99", "mean")
    lines = [
        f"{result['input']}: {result['frames']} frames, {result['frames_dropped']} dropped, times in ms",
        f"{'':<24}" + "".join(f"{column:>9}" for column in columns),
    ]
    lines += [f"{name:<24}" + "".join(f"{figures[c]:>9.2f}" for c in columns) for name, figures in rows]
    lines += [
        f"CPU a frame with the final flush ({result['flush_ms']:.0f} ms): "
        f"{result['cpu_ms']['mean_with_flush']:.2f} ms",
        f"{result['warmup_s']:.1f} s warm-up, {result['peak_rss_mb']:.0f} MB resident at most",
    ]
    return "\n".join(lines)
