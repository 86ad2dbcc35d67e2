"""Several inputs in one call of ``artemis-edge reprocess``: one after the other, side by side, or on a cluster."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from artemis_edge import health
from artemis_edge.batch_child import Child, Done, Task
from artemis_edge.errors import RunError, UserError
from artemis_edge.progress import progress, say
from artemis_edge.runtime import Request, reprocess
from artemis_edge.session.results import prepare

_LOOK_S = 0.1


@dataclass(frozen=True, slots=True)
class Mapped:
    """A finished input: its folder and the content of report.json."""

    out: Path
    report: dict[str, Any]


def places(inputs: Sequence[Path], out: Path) -> list[tuple[Path, Path]]:
    """Each input with its output folder: ``out`` itself for one, ``out/<name>`` for each of several."""
    if len(inputs) == 1:
        return [(inputs[0], out)]
    prepare(out)
    taken: dict[str, int] = {}
    found = []
    for path in inputs:
        name = path.resolve().stem if path.is_file() else path.resolve().name
        taken[name] = taken.get(name, 0) + 1
        found.append((path, out / (name if taken[name] == 1 else f"{name}_{taken[name]}")))
    return found


def run_all(
    requests: Sequence[Request], plain: bool, jobs: int | None = None, cluster: str = ""
) -> list[Mapped]:
    """Map all inputs; warnings go to stderr.

    ``jobs`` processes work at a time (None: as many as cores and memory allow), or those of the Dask ``cluster`` at an
    address. A single input's error is raised as it is. Of several, the others still run, and RunError says how many
    failed.
    """
    if cluster:
        from artemis_edge.cluster import on_cluster

        return collect(requests, on_cluster(cluster, requests, plain))
    most = jobs or fitting(requests)
    if len(requests) == 1:
        return [_here(requests[0], plain)]
    if most > 1:
        return collect(requests, _side_by_side(requests, plain, min(most, len(requests))))
    return collect(requests, [_tried(request, plain) for request in requests])


def fitting(requests: Sequence[Request]) -> int:
    """How many can be mapped at a time: a core for each, and its memory budget."""
    budget = max(request.config.voxel_map.memory_budget_mb for request in requests)
    by_memory = int(health.available_memory_mb() / budget)
    return max(1, min(len(requests), health.processors(), by_memory))


def collect(requests: Sequence[Request], done: Sequence[Done]) -> list[Mapped]:
    """Those that succeeded; what is wrong with the others is said, and raised in the end."""
    mapped: list[Mapped] = []
    for request, result in zip(requests, done, strict=True):
        fault = result.fault()
        if fault is not None and len(requests) == 1:
            raise fault
        if fault is not None:
            say(f"artemis-edge: {request.input}: {fault}")
            continue
        for warning in result.warnings:
            say(f"note: {warning}" if len(requests) == 1 else f"note: {request.input.name}: {warning}")
        mapped.append(Mapped(request.out, result.report))
    failed = len(requests) - len(mapped)
    if failed:
        raise RunError(f"{failed} of {len(requests)} inputs failed; what is wrong with each is said above")
    return mapped


def overall(shares: Sequence[float]) -> tuple[int, int, str]:
    """Progress of all: percent done, percent in all, and how many are done."""
    done = sum(share >= 1.0 for share in shares)
    return round(100 * sum(shares)), 100 * len(shares), f"{done} of {len(shares)} done"


def _here(request: Request, plain: bool) -> Mapped:
    with progress(f"mapping {request.input.name or request.input}", plain) as report:
        outcome = reprocess(request, report)
    for warning in outcome.warnings:
        say(f"note: {warning}")
    return Mapped(outcome.out, outcome.report)


def _tried(request: Request, plain: bool) -> Done:
    try:
        return Done(report=_here(request, plain).report)
    except UserError as error:
        return Done(error=str(error), code=error.exit_code)


def _side_by_side(requests: Sequence[Request], plain: bool, most: int) -> list[Done]:
    """In ``most`` processes at a time. Ctrl-C reaches them all: what they have mapped is saved."""
    waiting = list(range(len(requests)))
    running: dict[int, Child] = {}
    done: dict[int, Done] = {}
    asked = 0
    with progress(f"mapping {len(requests)} recordings", plain) as report:
        while waiting or running:
            try:
                while waiting and len(running) < most and not asked:
                    running[waiting[0]] = Child(Task.of(requests[waiting[0]]))
                    waiting.pop(0)
                time.sleep(_LOOK_S)
                for k in [k for k, child in running.items() if child.result is not None]:
                    done[k] = running.pop(k).result or Done()
                shares = [_share(k, done, running) for k in range(len(requests))]
                report(*overall(shares))
            except KeyboardInterrupt:
                asked += 1
                if asked > 1:
                    for child in running.values():
                        child.kill()
                done |= {k: Done(error="interrupted before it began", code=1) for k in waiting}
                waiting.clear()
    return [done[k] for k in range(len(requests))]


def _share(k: int, done: Mapping[int, Done], running: Mapping[int, Child]) -> float:
    if k in done:
        return 1.0
    if k not in running:
        return 0.0
    frames, total, _ = running[k].progress
    return min(frames / total, 0.99) if total else 0.0


def summary(mapped: Mapped) -> str:
    """What was made, in a few lines."""
    report = mapped.report
    pace = report["realtime_factor"]
    lines = [
        f"{report['frames']} frames mapped, {report['frames_dropped']} dropped; "
        f"{report['triangles']} triangles, {report['area_m2']:.0f} m2",
        f"frame {report['frame_ms']['p50']:.1f} ms (p99 {report['frame_ms']['p99']:.1f}), "
        f"CPU {report['cpu_ms']['mean']:.1f} ms a frame with the final flush, "
        f"{report['peak_rss_mb']:.0f} MB at most" + ("" if pace is None else f", {pace:.1f} x real time"),
    ]
    if report["lost"]:
        counts = ", ".join(f"{count} {reason}" for reason, count in report["lost"].items())
        lines.append(f"not used: {counts}")
    lines += [f"mesh    {mapped.out / 'mesh.ply'}", f"report  {mapped.out / 'report.html'}"]
    return "\n".join(lines)
