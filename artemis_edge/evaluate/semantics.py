"""Labels of a map against a labelled cloud: intersection over union of each class.

Each reference point takes the label of the nearest mesh point. A point of a triangle has the label of the corner
it belongs to by its largest barycentric coordinate; the mesh is sampled so densely that the nearest sample is the
nearest point to within half of ``_SPACING_M``. A reference point with no mesh within ``REACH_M`` counts as wrong.
Classes are matched by name; label 255 of the reference and classes that the map was not asked for are ignored.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from artemis_edge.errors import InputError
from artemis_edge.evaluate.sampling import triangle_areas
from artemis_edge.export.mesh import Mesh, PointCloud, finite_rows
from artemis_edge.export.ply import find_mesh, read_mesh, read_points
from artemis_edge.frames import F32, I32, I64, U8, Bool

REACH_M = 0.2
IGNORED = 255
#: What a person would call the first is, in a labelled cloud, a class of its own: panes are parts of what they are set
#: in, and a beam or a photograph shows what is behind them as often as the pane.
PARTS = {"glass": "building"}
BACKGROUND = 0
_SPACING_M = 0.03
_WORKERS = 2
_GOLDEN = 0.6180339887498949
_PLASTIC = 1.32471795724474602596


@dataclass(frozen=True, slots=True)
class ClassScore:
    """``iou`` 0..1 and how many reference ``points`` carry the class."""

    iou: float
    points: int


@dataclass(frozen=True, slots=True)
class SemanticEvaluation:
    """``miou`` is the mean over the classes that the reference has; ``unmatched_share`` of its points had no mesh.

    ``boundary_share``: of the points within ``boundary_m`` of another class those that are labelled right; None
    where there are none.
    """

    miou: float
    classes: dict[str, ClassScore]
    points: int
    unmatched_share: float
    boundary_share: float | None
    boundary_m: float

    def to_json(self) -> dict[str, Any]:
        """The JSON object of ``evaluate semantics``."""
        return {
            "miou": self.miou,
            "classes": {name: {"iou": s.iou, "points": s.points} for name, s in self.classes.items()},
            "points": self.points,
            "unmatched_share": self.unmatched_share,
            "boundary_share": self.boundary_share,
            "boundary_m": self.boundary_m,
        }


def labelled_samples(mesh: Mesh, spacing_m: float = _SPACING_M) -> tuple[F32, U8]:
    """Points (n, 3) about ``spacing_m`` apart on the mesh and their labels (n,); every vertex in use is one."""
    faces = mesh.faces[finite_rows(mesh.vertices)[mesh.faces].all(axis=1)]
    used = np.unique(faces)
    count = np.ceil(triangle_areas(mesh.vertices, faces) / spacing_m**2).astype(np.int64)
    triangle = np.repeat(np.arange(len(faces)), count)
    k = np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count)
    weight = _barycentric(k)
    corner = faces[triangle]
    points = np.zeros((len(triangle), 3), np.float32)
    for c in range(3):
        points += weight[:, c, None] * mesh.vertices[corner[:, c]]
    nearest = corner[np.arange(len(corner)), weight.argmax(axis=1)]
    return (
        np.concatenate((mesh.vertices[used], points)),
        np.concatenate((mesh.labels[used], mesh.labels[nearest])),
    )


def _barycentric(k: I64) -> F32:
    """Weights (n, 3) of the k-th sample of a triangle: a sequence that fills it evenly (Roberts 2018)."""
    u, v = np.modf(0.5 + k / _PLASTIC)[0], np.modf(0.5 + k / _PLASTIC**2)[0]
    folded = u + v > 1.0
    u, v = np.where(folded, 1.0 - u, u), np.where(folded, 1.0 - v, v)
    return np.stack((1.0 - u - v, u, v), axis=1).astype(np.float32)


def predicted_labels(mesh: Mesh, points: F32, reach_m: float = REACH_M) -> I32:
    """Label of the mesh at each of ``points`` (n, 3), int32 (n,); -1 where no mesh is within ``reach_m``."""
    on_mesh, labels = labelled_samples(mesh)
    if len(on_mesh) == 0:
        return np.full(len(points), -1, np.int32)
    tree = cKDTree(on_mesh, balanced_tree=False, compact_nodes=False)
    distance, nearest = tree.query(points, workers=_WORKERS, distance_upper_bound=reach_m)
    found = np.isfinite(distance)
    return np.where(found, labels[np.where(found, nearest, 0)].astype(np.int32), np.int32(-1))


def near_boundary(points: F32, labels: U8, distance_m: float) -> Bool:
    """Which points (n, 3) lie within ``distance_m`` of a point of another class, bool (n,)."""
    near = np.zeros(len(points), bool)
    for label in np.unique(labels):
        mine = labels == label
        if mine.all():
            continue
        others = cKDTree(points[~mine], balanced_tree=False, compact_nodes=False)
        found = others.query(points[mine], distance_upper_bound=distance_m, workers=_WORKERS)[0]
        near[mine] = np.isfinite(found)
    return near


def evaluate_semantics(mesh: Mesh, reference: PointCloud, boundary_m: float = 0.1) -> SemanticEvaluation:
    """Compare the labels of ``mesh`` with those of ``reference``, by name of the class.

    A class of the reference that the mesh does not name counts as what it is a part of (a pane of glass as
    building), else as background of the mesh. Raises InputError when
    the reference has no labels or the two have no class in common.
    """
    if reference.labels is None:
        raise InputError("the reference cloud has no labels; give a cloud with a uchar property 'label'")
    wanted = _by_name(reference, mesh)
    kept = finite_rows(reference.points) & (reference.labels != IGNORED)
    points, truth = reference.points[kept], wanted[reference.labels[kept]]
    found = predicted_labels(mesh, points)
    names = {label: name for label, name in mesh.label_names.items() if label != BACKGROUND}
    classes = {
        name: _score(truth == label, found == label)
        for label, name in names.items()
        if (truth == label).any()
    }
    if not classes:
        raise InputError(
            "map and reference have no class in common; ask the map for classes that the reference names: "
            + ", ".join(sorted(reference.label_names.values()))
        )
    border = near_boundary(points, truth.astype(np.uint8), boundary_m)
    return SemanticEvaluation(
        miou=float(np.mean([score.iou for score in classes.values()])),
        classes=classes,
        points=len(points),
        unmatched_share=float(np.mean(found < 0)),
        boundary_share=float(np.mean(found[border] == truth[border])) if border.any() else None,
        boundary_m=boundary_m,
    )


def _by_name(reference: PointCloud, mesh: Mesh) -> I64:
    """The mesh's label for each label of the reference (256,), by name; else background."""
    mine = {_plain(name): label for label, name in mesh.label_names.items()}
    table = np.full(256, BACKGROUND, np.int64)
    for label, name in reference.label_names.items():
        part = PARTS.get(_plain(name), "")
        table[label] = mine.get(_plain(name), mine.get(part, BACKGROUND))
    return table


def _plain(name: str) -> str:
    return " ".join(name.lower().split())


def _score(truth: Bool, found: Bool) -> ClassScore:
    union = np.count_nonzero(truth | found)
    return ClassScore(np.count_nonzero(truth & found) / union if union else 0.0, int(np.count_nonzero(truth)))


def run(map_path: Path, labels: Path) -> SemanticEvaluation:
    """Read both files and compare; raises InputError for files that are not what they should be."""
    return evaluate_semantics(read_mesh(find_mesh(map_path)), read_points(labels))


def to_text(evaluation: SemanticEvaluation) -> str:
    """The figures for people."""
    rows: Mapping[str, ClassScore] = evaluation.classes
    width = max(len(name) for name in rows)
    lines = [f"{name:<{width}}  IoU {s.iou:.3f}  {s.points} points" for name, s in rows.items()]
    lines.append(
        f"mean IoU {evaluation.miou:.3f}; no mesh within {REACH_M:g} m: {evaluation.unmatched_share:.2%}"
    )
    if evaluation.boundary_share is not None:
        lines.append(
            f"within {evaluation.boundary_m:g} m of another class: {evaluation.boundary_share:.2%} labelled right"
        )
    return "\n".join(lines)
