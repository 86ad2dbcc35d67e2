"""The paper's ablations on virtual worlds: Table III (semantic constraint) and Table IV (semantic refinement).

    python -m artemis_edge.session.ablation --out FOLDER [--world courtyard] [--seed 4] [--seconds 12] [--model NAME]

A walk is recorded with its truth and mapped with the true poses, several times, all else equal. Without ``--model``
the masks are the true ones, spoilt: in each image 30 % of the objects get a random other class, and all masks are
dilated by 10 pixels of 1280. Table III: precision, recall and F1 where classes meet, with and without the constraint
(lambda_sem = 0, sim = 1). Table IV: IoU by class, with the refinement and by voxel fusion alone; and of what the
photographs show, because what only the LiDAR saw no image can tell.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge.config import load
from artemis_edge.datasets import open_input
from artemis_edge.errors import UserError
from artemis_edge.evaluate.boundaries import merged_labels, score_boundaries
from artemis_edge.evaluate.semantics import IGNORED, evaluate_semantics
from artemis_edge.export.atomic import write_bytes
from artemis_edge.export.mesh import Mesh, PointCloud
from artemis_edge.export.ply import read_points
from artemis_edge.frames import I32, Bool, CameraImage
from artemis_edge.odometry.given_poses import GivenPoses
from artemis_edge.progress import progress, say
from artemis_edge.segmentation.backend import DenseScores
from artemis_edge.segmentation.worker import every
from artemis_edge.semantic_map import LateMask, Segmenter
from artemis_edge.session.results import prepare
from artemis_edge.session.shown import views_of
from artemis_edge.session.simulate import simulate
from artemis_edge.session.true_masks import Spoilt, TrueMasks
from artemis_edge.session.true_views import reopen
from artemis_edge.sight import Sight
from artemis_edge.trajectory import read_tum

CLASSES = ("car", "person", "bench", "tree", "building", "ground")
TAUS_M = (0.05, 0.1)
NO_TEXTURE = ("refinement.enabled=false",)
#: Settings of the variants beside the default.
VARIANTS = {
    "ARTEMIS": (),
    "w/o Sem. Constraint": ("semantics.lambda_sem=0", "semantics.sim_semantic=false"),
    "w/o Sem. Refinement": ("semantics.refinement=false",),
}


@dataclass(slots=True)
class StoredMasks:
    """Masks of a session by stamp, made once and used for every variant, fused ``delay`` calls late."""

    names: Sequence[str]
    source: TrueMasks
    known: dict[int, DenseScores] = field(default_factory=dict)
    _queue: list[tuple[Sight, int]] = field(default_factory=list)

    def offer(self, image: CameraImage, look: Callable[[], Sight]) -> None:
        """Take the view of an image."""
        self._queue.append((look(), image.stamp_ns))

    def ready(self) -> list[LateMask]:
        """The masks of the images offered since."""
        queue, self._queue = self._queue, []
        return [LateMask(sight, self._of(stamp)) for sight, stamp in queue]

    def drain(self) -> list[LateMask]:
        """What is left."""
        return self.ready()

    def _of(self, stamp_ns: int) -> DenseScores:
        if stamp_ns not in self.known:
            self.known[stamp_ns] = self.source.at(stamp_ns)
        return self.known[stamp_ns]


def map_session(session: Path, segmenter: Segmenter, sets: Sequence[str]) -> Mesh:
    """The finished mesh of a virtual session with its true poses."""
    from artemis_edge.pipeline import Pipeline

    config = load(sets=sets)
    source = open_input(session, config.input)
    poses = GivenPoses(read_tum(session / "truth" / "trajectory_400hz.tum"))
    with tempfile.TemporaryDirectory(prefix="artemis-ablation-") as folder:
        pipeline = Pipeline(config, poses, Path(folder), segmenter)
        with progress(f"mapping {' '.join(sets)}") as report:
            for done, frame in enumerate(source.frames(), start=1):
                pipeline.process(frame)
                report(done, len(source), "")
        pipeline.finish()
        mesh = pipeline.write_mesh(Path(folder) / "mesh.ply")
        pipeline.pager.file.close()
    return mesh


def measure(mesh: Mesh, reference: PointCloud, views: I32) -> dict[str, Any]:
    """Figures of both tables for one mesh; ``views`` int32 (n,) photographs show each point of the reference."""
    merged = replace(reference, labels=merged_labels(reference, mesh.label_names))
    borders = score_boundaries(mesh, merged, TAUS_M)
    return {
        "boundaries": {f"{tau:g}": score.to_json() for tau, score in borders.items()},
        "semantics": evaluate_semantics(mesh, reference).to_json(),
        "shown": evaluate_semantics(mesh, only(reference, views > 0)).to_json(),
    }


def only(reference: PointCloud, chosen: Bool) -> PointCloud:
    """The reference with the label that is ignored where it is not ``chosen`` bool (n,)."""
    assert reference.labels is not None
    return replace(reference, labels=np.where(chosen, reference.labels, np.uint8(IGNORED)))


def ablate(session: Path, spoilt: Spoilt | None, model: str = "") -> dict[str, dict[str, Any]]:
    """All variants of one session, by name; ``spoilt`` masks, or those of a registered ``model``."""
    reference = read_points(session / "truth" / "reference.ply")
    rig = reopen(session / "truth")
    stored = StoredMasks(CLASSES, TrueMasks(rig, CLASSES, spoilt))
    views = views_of(rig, reference.points, photographs(session), load().semantics.reach_m)
    out = {}
    for name, sets in VARIANTS.items():
        say(f"{name}: {' '.join(sets) or 'as configured'}")
        out[name] = measure(
            map_session(session, _masks(stored, model), (*NO_TEXTURE, *sets)), reference, views
        )
    return out


def photographs(session: Path) -> list[int]:
    """Stamps of a session's photographs."""
    source = open_input(session, load().input)
    return [image.stamp_ns for frame in source.frames() for image in frame.images]


def _masks(stored: StoredMasks, model: str) -> Segmenter:
    if not model:
        return stored
    from artemis_edge.questions import Questions

    return Questions.of(CLASSES, model).segmenter(every(1, 3), beside=False)


def to_text(found: dict[str, dict[str, Any]]) -> str:
    """Both tables."""
    lines = [f"Table III, where classes meet        {'precision':>10}{'recall':>10}{'F1':>10}"]
    for name in ("w/o Sem. Constraint", "ARTEMIS"):
        for tau, score in found[name]["boundaries"].items():
            figures = "".join(f"{score[key]:>10.4f}" for key in ("precision", "recall", "f1"))
            lines.append(f"  {name:<22} at {float(tau) * 100:>4.0f} cm   {figures}")
    classes = list(found["ARTEMIS"]["semantics"]["classes"])
    lines.append("Table IV, IoU in %           " + "".join(f"{name:>10}" for name in ("mean", *classes)))
    for part, where in (("semantics", ""), ("shown", ", shown")):
        for name in ("w/o Sem. Refinement", "ARTEMIS"):
            scores = found[name][part]
            row = [
                scores["miou"],
                *(scores["classes"].get(key, {"iou": float("nan")})["iou"] for key in classes),
            ]
            lines.append(f"  {name + where:<27}" + "".join(f"{100 * value:>10.1f}" for value in row))
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """The module as a command of its own."""
    parser = argparse.ArgumentParser(prog="python -m artemis_edge.session.ablation")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--world", default="courtyard", metavar="NAME")
    parser.add_argument("--seed", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument(
        "--model", default="", metavar="NAME", help="a registered network instead of true masks"
    )
    parser.add_argument("--clean", action="store_true", help="true masks as they are, not spoilt")
    given = parser.parse_args(arguments)
    try:
        prepare(given.out)
        session = given.out / "session"
        prepare(session)
        wanted = {"reference_spacing_m": "0.04", "camera_every": "2", "point_truth": "off", "mesh": "off"}
        with progress("recording") as report:
            simulate(given.world, given.seed, given.seconds, "avia", session, wanted, report)
        found = ablate(session, None if given.clean else Spoilt(seed=given.seed), given.model)
        write_bytes(given.out / "ablation.json", (json.dumps(found, indent=1) + "\n").encode())
    except UserError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    print(to_text(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
