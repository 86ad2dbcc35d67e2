"""What the semantic map gets right on virtual worlds, and what it gets wrong by cause.

    python tests/bench/bench_semantics.py map      [--worlds courtyard ...] [--seeds 1 2] [--model NAME] [--out FOLDER]
    python tests/bench/bench_semantics.py touching [--seeds 1 2] [--model NAME] [--out FOLDER]
    python tests/bench/bench_semantics.py absent   [--worlds street ...] [--seeds 1 2] [--model NAME] [--out FOLDER]

``map``: IoU by class of the map of a walk, over all points that the LiDAR saw and over those that photographs show,
and the wrong points by cause. ``touching``: a backpack on a bench beside a sitting person (world ``bench``); persons
and benches are asked for, and how much of the backpacks is taken for one. ``absent``: questions for what a world has
and for what it has not, put to a finished map; how many are answered with ``matched`` (``make questions``). Without
``--model`` the masks of ``map`` and ``touching`` are the true ones. Sessions in ``--out`` are used again. Poses are the
true ones.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from scipy.spatial import cKDTree

from artemis_edge.ask import ask
from artemis_edge.config import load
from artemis_edge.evaluate.semantics import evaluate_semantics, predicted_labels
from artemis_edge.export.mesh import Mesh, PointCloud
from artemis_edge.export.ply import read_points
from artemis_edge.frames import I32
from artemis_edge.progress import progress, say
from artemis_edge.questions import Questions
from artemis_edge.runtime import Request, reprocess
from artemis_edge.segmentation.backend import Status
from artemis_edge.segmentation.registry import open_by_name
from artemis_edge.segmentation.worker import every
from artemis_edge.semantic_map import Segmenter
from artemis_edge.session.ablation import CLASSES, NO_TEXTURE, StoredMasks, map_session, only, photographs
from artemis_edge.session.shown import views_of
from artemis_edge.session.simulate import simulate
from artemis_edge.session.true_masks import TrueMasks
from artemis_edge.session.true_views import reopen

SETTINGS = {"reference_spacing_m": "0.04", "camera_every": "2", "point_truth": "off", "mesh": "off"}
LEAST_POINTS = 400  # of the reference: a thing that the LiDAR hardly met is not called present
#: Things that no virtual world has, and that no network trained on them knows.
UNHEARD = ("elephant", "boat", "piano", "umbrella", "horse", "traffic light", "airplane", "sheep")
AT_ONCE = 12  # questions to a map at a time; each may need a slot


def session(world: str, seed: int, seconds: float, out: Path) -> Path:
    """The recorded walk, made where it is not there yet."""
    folder = out / f"{world}-{seed}"
    if not (folder / "truth" / "world.json").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        with progress(f"recording {world} {seed}") as report:
            simulate(world, seed, seconds, "avia", folder, SETTINGS, report)
    return folder


def segmenter(folder: Path, names: tuple[str, ...], model: str) -> Segmenter:
    """True masks, or those of a network every other photograph, three late."""
    if model:
        return Questions.of(names, model).segmenter(every(1, 3), beside=False)
    return StoredMasks(names, TrueMasks(reopen(folder / "truth"), names))


def judge(folder: Path, names: tuple[str, ...], model: str, sets: list[str]) -> dict[str, Any]:
    """A walk mapped with the masks and compared with its truth."""
    reference = read_points(folder / "truth" / "reference.ply")
    mesh = map_session(folder, segmenter(folder, names, model), (*NO_TEXTURE, *sets))
    reach_m = load(sets=sets).semantics.reach_m
    views = views_of(reopen(folder / "truth"), reference.points, photographs(folder), reach_m)
    every_point = evaluate_semantics(mesh, reference)
    shown = evaluate_semantics(mesh, only(reference, views > 0))
    return {
        "all": every_point.to_json(),
        "shown": shown.to_json(),
        "causes": causes(mesh, reference, views),
        "taken": taken(mesh, reference),
    }


def causes(mesh: Mesh, reference: PointCloud, views: I32) -> dict[str, dict[str, float]]:
    """Of each class' points the shares that are wrong, by cause.

    ``not shown`` by a photograph, ``no mesh`` near; ``place``: the vertex has the label of where it stands, the point
    another; ``label``: the vertex' own is wrong.
    """
    assert reference.labels is not None
    names = {name: label for label, name in mesh.label_names.items()}
    own = cKDTree(reference.points).query(mesh.vertices)[1]
    found = predicted_labels(mesh, reference.points)
    nearest = cKDTree(mesh.vertices).query(reference.points)[1]
    out = {}
    for label, name in reference.label_names.items():
        mine = reference.labels == label
        if name not in names or not mine.any():
            continue
        wrong = mine & (found != names[name])
        dark, bare = wrong & (views == 0), wrong & (views > 0) & (found < 0)
        rest = wrong & ~dark & ~bare
        place = rest & (reference.labels[own[nearest]] != label)
        parts = {"not shown": dark, "no mesh": bare, "place": place, "label": rest & ~place}
        out[name] = {key: float(part.sum() / mine.sum()) for key, part in parts.items()}
    return out


def taken(mesh: Mesh, reference: PointCloud) -> dict[str, float]:
    """Of each class that was not asked for the share that is highlighted as one that was."""
    assert reference.labels is not None
    found = predicted_labels(mesh, reference.points)
    asked = set(mesh.label_names.values())
    return {
        name: float((found[reference.labels == label] > 0).mean())
        for label, name in sorted(reference.label_names.items())
        if name not in asked and (reference.labels == label).any()
    }


def questions(folder: Path, model: str, scratch: Path, sets: list[str]) -> dict[str, dict[str, str]]:
    """Status of each question for what is there and what is not, put to the finished map of a walk."""
    reference = read_points(folder / "truth" / "reference.ply")
    assert reference.labels is not None
    count = {name: int((reference.labels == label).sum()) for label, name in reference.label_names.items()}
    classes = [name for name in open_by_name(model).classes if name not in ("background", "other")]
    config = load(sets=[*NO_TEXTURE, "segmentation.every=1000", *sets])
    poses = folder / "truth" / "trajectory_400hz.tum"
    with progress(f"mapping {folder.name}") as report:
        reprocess(Request(folder, scratch, config, poses=poses), report)
    present = [name for name in classes if count.get(name, 0) >= LEAST_POINTS]
    absent = [name for name in classes if count.get(name, 0) == 0]
    out: dict[str, dict[str, str]] = {"present": {}, "absent": {}}
    for kind, names in (("present", present), ("absent", [*absent, *UNHEARD])):
        for first in range(0, len(names), AT_ONCE):
            for reply in ask(scratch, names[first : first + AT_ONCE], model):
                score = max((found.score for found in reply.found), default=0.0)
                area = sum(found.item.area_m2 for found in reply.found)
                out[kind][reply.text] = f"{reply.status.value} {score:.2f} {area:.2f}"
    return out


def verdict(results: dict[str, dict[str, dict[str, str]]]) -> Iterator[str]:
    """All worlds together: how many questions for what is there, and for what is not, were answered as matched."""
    for kind in ("present", "absent"):
        status = [(name, reply.split()[0]) for said in results.values() for name, reply in said[kind].items()]
        matched = sum(found == Status.MATCHED.value for _, found in status)
        known = sum(name not in UNHEARD for name, _ in status)
        yield f"{kind}: {matched} of {len(status)} matched; {known} of them are classes that the network knows"


def table(found: dict[str, Any]) -> Iterator[str]:
    """The figures for people."""
    for part in ("all", "shown"):
        row = "".join(f"  {name} {s['iou']:.3f}" for name, s in found[part]["classes"].items())
        border = found[part]["boundary_share"]
        yield f"  {part:<6} mIoU {found[part]['miou']:.3f}  border {border or 0:.3f} {row}"
    for name, parts in found["causes"].items():
        yield f"  {name:<10}" + "".join(f"{key} {100 * share:5.1f} %   " for key, share in parts.items())
    yield "  taken for something asked: " + ", ".join(
        f"{k} {100 * v:.1f} %" for k, v in found["taken"].items()
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", choices=("map", "touching", "absent"))
    parser.add_argument("--worlds", nargs="+", default=["courtyard"], metavar="WORLD")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--model", default="")
    parser.add_argument("--set", action="append", default=[], dest="sets", help="setting of the mapping")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="keep sessions here")
    parser.add_argument("--json", type=Path, metavar="FILE")
    given = parser.parse_args()
    results = {}
    with tempfile.TemporaryDirectory(prefix="artemis-semantics-") as scratch:
        out = given.out or Path(scratch)
        for world in ["bench"] if given.what == "touching" else given.worlds:
            for seed in given.seeds:
                results[f"{world} {seed}"] = one(
                    given, session(world, seed, given.seconds, out), Path(scratch)
                )
    if given.what == "absent":
        print(*verdict(results), sep="\n")
    if given.json is not None:
        given.json.write_text(json.dumps(results, indent=1) + "\n")
    return 0


def one(given: argparse.Namespace, folder: Path, scratch: Path) -> dict[str, Any]:
    """One walk, told as it is done."""
    say(folder.name)
    if given.what == "absent":
        said = questions(folder, given.model, scratch / f"map-{folder.name}", given.sets)
        for kind, replies in said.items():
            matched = sum(reply.startswith(Status.MATCHED.value) for reply in replies.values())
            print(f"{folder.name} {kind}: {matched} of {len(replies)} matched;", replies, flush=True)
        return said
    names = ("person", "bench") if given.what == "touching" else CLASSES
    found = judge(folder, names, given.model, given.sets)
    print(folder.name, given.model or "true masks", *table(found), sep="\n", flush=True)
    return found


if __name__ == "__main__":
    sys.exit(main())
