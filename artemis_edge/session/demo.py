"""``artemis-edge demo``: a walk through a virtual world, mapped by odometry, measured by the truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from artemis_edge.evaluate.mesh import Comparison, evaluate_mesh
from artemis_edge.evaluate.trajectory import evaluate_trajectory
from artemis_edge.export.ply import Mesh, read_mesh
from artemis_edge.frames import F32, F64, Trajectory
from artemis_edge.progress import Report, progress, say
from artemis_edge.runtime import MakeMapper, Outcome, Request, pipeline, reprocess
from artemis_edge.session.compile_demo import compiling
from artemis_edge.session.report import Evaluation
from artemis_edge.session.results import preparing
from artemis_edge.session.simulate import simulate
from artemis_edge.session.truth import evaluate_against_world, read_moving, read_reference
from artemis_edge.trajectory import inverse, read_tum

SESSION = "session"
# What the demo asks for by itself: classes that the shipped network knows
QUERIES = ("car", "person", "bench", "tree")
# Measuring within 10 cm thins the reference to 5 cm anyway.
_SETTINGS = {"reference_spacing_m": "0.04", "image_width": "640"}
# How far an Avia's points lie close enough together to carry a mesh at the default spacing.
NEAR_M = 30.0


#: Gives a Report for a piece of work that has a name.
Reporter = Callable[[str], AbstractContextManager[Report]]


def demo(
    world: str,
    seconds: float,
    seed: int,
    out: Path,
    make: MakeMapper = pipeline,
    reporter: Reporter = progress,
    queries: Sequence[str] = QUERIES,
) -> str:
    """Write session and results to ``out``; returns what to print. Raises UserError as its parts do."""
    session = out / SESSION
    request = Request(session, out, own_odometry=True, queries=tuple(queries))
    say(f"recording a walk of {seconds:g} s through the virtual world '{world}'")
    with preparing(out), preparing(session), compiling(request), reporter("recording") as report:
        made = simulate(world, seed, seconds, "avia", session, _SETTINGS, report)
    for note in made.notes:
        say(f"note: {note}")
    say("mapping it by its own odometry (the truth is only for measuring)")
    with reporter("mapping") as report:
        outcome = reprocess(request, report, lambda mesh, path: measure(mesh, path, made.truth), make)
    return _closing(outcome, made.length_m)


def measure(mesh: Mesh, trajectory: Trajectory, truth: Path) -> Evaluation:
    """Map and trajectory against the truth that ``simulate`` wrote, in the frame of the first pose.

    The levelling error of the first pose is measured apart, because it would tilt the whole map.
    """
    true_path = read_tum(truth / "trajectory.tum")
    reference = read_reference(truth / "reference.ply")
    T_truth_world = true_path.T_world_lidar[0] @ inverse(trajectory.T_world_lidar[0])
    moved = replace(mesh, vertices=_moved(mesh.vertices, T_truth_world))
    world = evaluate_against_world(moved, read_mesh(truth / "mesh.ply"), reference, read_moving(truth))
    scores = evaluate_mesh(moved, reference.points, crop=True)
    near = near_path(scores.comparisons[0], true_path.T_world_lidar[:, :3, 3], NEAR_M)
    return Evaluation(
        mesh=scores,
        trajectory=evaluate_trajectory(trajectory, true_path),
        world={
            **world.to_json(),
            "levelling_error_deg": _angle_deg(T_truth_world),
            "near_m": NEAR_M,
            "near_precision": near.precision,
            "near_recall": near.recall,
            "near_f1": near.f1,
        },
    )


def near_path(whole: Comparison, path: F64, reach_m: float) -> Comparison:
    """The part of a comparison within ``reach_m`` of the positions ``path`` (n, 3)."""
    tree = cKDTree(path)
    on_mesh = tree.query(whole.mesh_points)[0] <= reach_m
    in_cloud = tree.query(whole.reference_points)[0] <= reach_m
    return replace(
        whole,
        mesh_points=whole.mesh_points[on_mesh],
        mesh_distance=whole.mesh_distance[on_mesh],
        reference_points=whole.reference_points[in_cloud],
        reference_distance=whole.reference_distance[in_cloud],
    )


def _moved(vertices: F32, T: F64) -> F32:
    return np.asarray(vertices @ T[:3, :3].T + T[:3, 3], np.float32)


def _angle_deg(T: F64) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))))


def _closing(outcome: Outcome, length_m: float) -> str:
    report = outcome.report
    rows = [*_measured(report["evaluation"], length_m), *_cost(report)]
    rows += [
        ("asked for", _answers(report)),
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
    near = f"precision {world['near_precision']:.3f}, recall {world['near_recall']:.3f}"
    return [
        (
            "mesh within 10 cm",
            f"F1 {world['near_f1']:.3f} up to {NEAR_M:g} m from the path ({near}); {scores['f1']:.3f} of all",
        ),
        (
            "wound as the world",
            f"{_percent(world['mean_wound_share'])} of the triangles by the mean normal around them, "
            f"{_percent(world['facing_wound_share'])} by where they were seen from, "
            f"{_percent(world['wound_share'])} by the nearest normal",
        ),
        (
            "bridging a gap",
            f"{_percent(world['bridging_area_share'])} of the area; "
            f"{_percent(world['ghost_area_share'])} are ghosts of what moved",
        ),
        ("edges", f"{edges['non_manifold_share']:.2%} non-manifold, {edges['boundary_share']:.2%} boundary"),
        (
            "path",
            f"{path['ate_rmse_m'] * 100:.1f} cm rms off over {length_m:.1f} m, "
            f"levelled to {world['levelling_error_deg']:.2f} degrees",
        ),
    ]


def _answers(report: dict[str, Any]) -> str:
    """How many were found of each question."""
    told = [f"{q['text']} {len(q['objects']) or q['status']}" for q in report.get("queries", [])]
    return ", ".join(told) or "nothing"


def _percent(share: float | None) -> str:
    """``None`` where nothing could be judged."""
    return "none judged" if share is None else f"{share:.2%}"


def _cost(report: dict[str, Any]) -> list[tuple[str, str]]:
    frame, pace, cpu = report["frame_ms"], report["realtime_factor"], report["cpu_ms"]["mean"]
    return [
        ("map", f"{report['triangles']:,} triangles, {report['area_m2']:,.0f} m2, {report['frames']} frames"),
        ("time a frame", f"{frame['p50']:.1f} ms, p99 {frame['p99']:.1f} ms, CPU {cpu:.1f} ms"),
        ("pace", f"{pace:.1f} times real time, {report['peak_rss_mb']:.0f} MB at most"),
    ]
