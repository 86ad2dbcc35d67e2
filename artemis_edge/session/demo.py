"""``artemis-edge demo``: a walk through a virtual world, mapped by odometry, measured by the truth."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from artemis_edge.evaluate.mesh import evaluate_mesh
from artemis_edge.evaluate.trajectory import evaluate_trajectory
from artemis_edge.export.ply import Mesh, read_mesh, read_points
from artemis_edge.frames import Trajectory
from artemis_edge.progress import progress, say
from artemis_edge.runtime import Outcome, Request, reprocess
from artemis_edge.session.report import Evaluation
from artemis_edge.session.results import prepare
from artemis_edge.session.simulate import simulate
from artemis_edge.session.truth import evaluate_against_world, read_reference
from artemis_edge.trajectory import read_tum

SESSION = "session"


def demo(world: str, seconds: float, seed: int, out: Path) -> str:
    """Write session and results to ``out``; returns what to print. Raises UserError as its parts do."""
    prepare(out)
    session = out / SESSION
    prepare(session)
    say(f"a walk of {seconds:g} s through the virtual world '{world}', recorded to {session}")
    with progress("recording") as report:
        made = simulate(world, seed, seconds, "avia", session, progress=report)
    say("mapping the recording with the odometry alone: the truth is kept for the measuring")
    with progress("mapping") as report:
        outcome = reprocess(
            Request(session, out, own_odometry=True),
            report,
            lambda mesh, path: _measure(mesh, path, made.truth),
        )
    return _closing(outcome, made.length_m)


def _measure(mesh: Mesh, trajectory: Trajectory, truth: Path) -> Evaluation:
    reference = read_points(truth / "reference.ply").points
    world = evaluate_against_world(
        mesh, read_mesh(truth / "mesh.ply"), read_reference(truth / "reference.ply")
    )
    return Evaluation(
        mesh=evaluate_mesh(mesh, reference, crop=True),
        trajectory=evaluate_trajectory(trajectory, read_tum(truth / "trajectory.tum")),
        world=asdict(world),
    )


def _closing(outcome: Outcome, length_m: float) -> str:
    report = outcome.report
    rows = [*_measured(report["evaluation"], length_m), *_cost(report)]
    rows += [
        ("mesh", str(outcome.out / "mesh.ply")),
        ("mesh for viewers", str(outcome.out / "mesh.glb")),
        ("report", str(outcome.out / "report.html")),
        ("recording, truth", str(outcome.out / SESSION)),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)


def _measured(found: dict[str, Any], length_m: float) -> list[tuple[str, str]]:
    scores, path, world = found["mesh"]["thresholds"]["0.1"], found["trajectory"], found["world"]
    edges = found["mesh"]["edges"]
    return [
        (
            "mesh within 10 cm",
            f"F1 {scores['f1']:.3f} (precision {scores['precision']:.3f}, recall {scores['recall']:.3f})",
        ),
        ("wound as the world", f"{_percent(world['wound_share'])} of the triangles"),
        ("bridging a gap", f"{_percent(world['bridging_area_share'])} of the area"),
        ("edges", f"{edges['non_manifold_share']:.2%} non-manifold, {edges['boundary_share']:.2%} boundary"),
        ("path", f"{path['ate_rmse_m'] * 100:.1f} cm rms off over {length_m:.1f} m"),
    ]


def _percent(share: float | None) -> str:
    """``None`` where nothing could be judged."""
    return "none judged" if share is None else f"{share:.2%}"


def _cost(report: dict[str, Any]) -> list[tuple[str, str]]:
    frame, pace = report["frame_ms"], report["realtime_factor"]
    return [
        ("map", f"{report['triangles']:,} triangles, {report['area_m2']:,.0f} m2, {report['frames']} frames"),
        (
            "time a frame",
            f"{frame['p50']:.1f} ms, p99 {frame['p99']:.1f} ms, CPU {report['cpu_ms']['mean']:.1f} ms",
        ),
        ("pace", f"{pace} times real time, {report['peak_rss_mb']:.0f} MB at most"),
    ]
