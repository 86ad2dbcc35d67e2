"""Several inputs in one call of ``artemis-edge reprocess``, and what is said of each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from artemis_edge.errors import RunError, UserError
from artemis_edge.progress import progress, say
from artemis_edge.runtime import Outcome, Request, reprocess
from artemis_edge.session.results import prepare


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


def run_all(requests: Sequence[Request], plain: bool) -> list[Outcome]:
    """Map one input after the other; warnings go to stderr.

    A single input's error is raised as it is. Of several, the others still run, and RunError says how many
    failed.
    """
    outcomes: list[Outcome] = []
    for request in requests:
        try:
            outcomes.append(_run(request, plain))
        except UserError as error:
            if len(requests) == 1:
                raise
            say(f"artemis-edge: {request.input}: {error}")
    failed = len(requests) - len(outcomes)
    if failed:
        raise RunError(f"{failed} of {len(requests)} inputs failed; what is wrong with each is said above")
    return outcomes


def _run(request: Request, plain: bool) -> Outcome:
    with progress(f"mapping {request.input.name or request.input}", plain) as report:
        outcome = reprocess(request, report)
    for warning in outcome.warnings:
        say(f"note: {warning}")
    return outcome


def summary(outcome: Outcome) -> str:
    """What was made, in a few lines."""
    report = outcome.report
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
    lines += [f"mesh    {outcome.out / 'mesh.ply'}", f"report  {outcome.out / 'report.html'}"]
    return "\n".join(lines)
