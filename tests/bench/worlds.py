"""The mapping with true poses on every virtual world: how near to what could be observed, class by class.

    .venv/bin/python tests/bench/worlds.py [--worlds street hall] [--seed 1] [--seconds 20] [--json FILE]

Each world is simulated and mapped (``reprocess --poses truth/trajectory_400hz.tum``) into a temporary folder, or into
``--out``. F1 at 5 and 10 cm against the observed surface; classes with fewer than LEAST_POINTS points of it are left
out of the table, not of the JSON. Mesh on things that moved is left out of the
precision of ``all`` and of the classes, and counted beside.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from artemis_drivers.virtual.catalogue import worlds

from artemis_edge.config import load
from artemis_edge.evaluate.by_class import Score, score_classes
from artemis_edge.export.ply import read_mesh
from artemis_edge.progress import progress, say
from artemis_edge.runtime import Request, reprocess
from artemis_edge.session.simulate import simulate
from artemis_edge.session.truth import (
    TruthReport,
    Winding,
    evaluate_against_world,
    read_moving,
    read_reference,
)

TAUS_M = (0.05, 0.1)
LEAST_POINTS = 1000
JUDGES = ("nearest", "mean", "facing")


def make(world: str, seed: int, seconds: float, lidar: str, out: Path, sets: list[str]) -> None:
    """Simulate and map one world."""
    session = out / "session"
    with progress(f"recording {world}") as report:
        made = simulate(world, seed, seconds, lidar, session, {"camera": "off"}, report)
    request = Request(session, out, load(sets=sets), poses=made.truth / "trajectory_400hz.tum")
    with progress(f"mapping {world}") as report:
        reprocess(request, report)


def measure(out: Path) -> dict[str, Any]:
    """Judge what :func:`make` wrote."""
    where = out / "session" / "truth"
    said = json.loads((where / "world.json").read_text())
    run = json.loads((out / "report.json").read_text())
    mesh, reference, moving = (
        read_mesh(out / "mesh.ply"),
        read_reference(where / "reference.ply"),
        read_moving(where),
    )
    assert reference.labels is not None
    names = {0: "background", **reference.label_names}
    truth = evaluate_against_world(mesh, read_mesh(where / "mesh.ply"), reference, moving)
    scores = {
        f"{tau:g}": score_classes(mesh, reference.points, reference.labels, names, tau, moving)
        for tau in TAUS_M
    }
    classes = {name: {j: _winding(w) for j, w in found.items()} for name, found in truth.classes.items()}
    return {
        **{key: said[key] for key in ("world", "seed", "seconds", "lidar")},
        "reference_points": len(reference.points),
        "moving_points": 0 if moving is None else len(moving),
        "triangles": truth.triangles,
        "area_m2": truth.area_m2,
        "frame_ms": run["frame_ms"],
        "f1": {tau: {name: s.to_json() for name, s in found.items()} for tau, found in scores.items()},
        "winding": {judge: _winding(w) for judge, w in truth.winding.items()},
        "winding_by_class": classes,
        "bridging_area_share": truth.bridging_area_share,
        "ghost_area_share": truth.ghost_area_share,
        "table": table(said["world"], scores, truth),
    }


def _winding(found: Winding) -> dict[str, float | int | None]:
    shares = {"share": found.share, "area_share": found.area_share}
    plain: dict[str, float | int | None] = {k: v if v == v else None for k, v in shares.items()}
    return plain | {"judged": found.judged}


def table(world: str, scores: dict[str, dict[str, Score]], truth: TruthReport) -> str:
    """Rows of a Markdown table: the world, then its classes, those with the most points first."""
    fine, coarse = (scores[f"{tau:g}"] for tau in TAUS_M)
    shown = sorted(fine, key=lambda name: -fine[name].points)
    hanging = f"{_percent(truth.bridging_area_share)}, {_percent(truth.ghost_area_share)}"
    rows = []
    for name in shown:
        if fine[name].points < LEAST_POINTS:
            continue
        judged = truth.winding if name == "all" else truth.classes.get(name, {})
        wound = " | ".join(_percent(judged[j].share) if j in judged else "-" for j in JUDGES)
        rows.append(
            f"| {world} | {name} | {_score(fine[name])} | {_score(coarse[name])} | {wound} | "
            f"{hanging if name == 'all' else ''} | {fine[name].points} |"
        )
    return "\n".join(rows)


HEADER = (
    "| world | class | F1 5 cm (P, R) | F1 10 cm (P, R) | wound, nearest | wound, mean | facing | bridging, ghosts | "
    "points |\n|---|---|---|---|---|---|---|---|---|"
)


def _score(score: Score) -> str:
    return f"**{score.f1:.3f}** ({score.precision:.3f}, {score.recall:.3f})"


def _percent(share: float) -> str:
    return f"{100 * share:.2f} %" if share == share else "-"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--worlds", nargs="+", default=list(worlds()), metavar="WORLD")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--lidar", default="avia")
    parser.add_argument("--set", action="append", default=[], dest="sets", help="setting of the mapping")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="keep sessions and meshes here")
    parser.add_argument("--again", action="store_true", help="only measure again what is in --out")
    parser.add_argument("--json", type=Path, metavar="FILE")
    given = parser.parse_args()
    found = []
    with tempfile.TemporaryDirectory(prefix="artemis-worlds-") as scratch:
        for world in given.worlds:
            out = (given.out or Path(scratch)) / Path(world).stem
            out.mkdir(parents=True, exist_ok=True)
            if not given.again:
                make(world, given.seed, given.seconds, given.lidar, out, given.sets)
            found.append(measure(out))
            say(found[-1]["table"])
    print(HEADER)
    for row in found:
        print(row.pop("table"))
    if given.json is not None:
        given.json.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
