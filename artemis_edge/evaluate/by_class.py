"""A mesh against a labelled reference, class by class.

Each mesh sample belongs to the class of its nearest reference point. Precision of a class is the share of its
samples within tau of any reference point, recall the share of its reference points within tau of the mesh, F1
harmonic. Sampling and thinning are those of ``mesh.py``, the reference thinned class by class.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from artemis_edge.errors import InputError
from artemis_edge.evaluate.sampling import samples, thin
from artemis_edge.export.mesh import Mesh, finite_rows
from artemis_edge.frames import F32, F64, U8, Bool

_SAMPLES_PER_TAU2 = 10.0
_WORKERS = 2


@dataclass(frozen=True, slots=True)
class Score:
    """Shares 0..1, NaN without ``samples`` of the mesh or ``points`` of the reference to take them of."""

    precision: float
    recall: float
    samples: int
    points: int

    @property
    def f1(self) -> float:
        """Harmonic mean; NaN where precision or recall is."""
        both = self.precision + self.recall
        return 2.0 * self.precision * self.recall / both if both != 0 else 0.0

    def to_json(self) -> dict[str, float | int | None]:
        """Plain values, None for what cannot be judged."""
        shares = {"precision": self.precision, "recall": self.recall, "f1": self.f1}
        plain: dict[str, float | int | None] = {k: v if v == v else None for k, v in shares.items()}
        return plain | {"samples": self.samples, "points": self.points}


def score_classes(
    mesh: Mesh, points: F32, labels: U8, names: Mapping[int, str], tau_m: float, ignored: F32 | None = None
) -> dict[str, Score]:
    """Scores by class, and of ``"all"`` classes; ``points`` float32 (n, 3) with ``labels`` uint8 (n,).

    Mesh samples within tau of ``ignored`` points (what moved) but not of the reference are left out. Raises
    InputError when there is nothing to compare.
    """
    good = finite_rows(points)
    cloud, label = _thinned(points[good], labels[good], tau_m / 2)
    faces = mesh.faces[finite_rows(mesh.vertices)[mesh.faces].all(axis=1)]
    on_mesh = thin(samples(mesh.vertices, faces, _SAMPLES_PER_TAU2 / tau_m**2), tau_m / 2)
    if len(cloud) == 0 or len(on_mesh) == 0:
        raise InputError("there is no reference or no mesh to compare; give a mesh with faces and a cloud")
    distance, nearest = _tree(cloud).query(on_mesh, workers=_WORKERS)
    kept = _kept(on_mesh, distance <= tau_m, tau_m, ignored)
    found = distance[kept] <= tau_m
    met = _tree(on_mesh).query(cloud, workers=_WORKERS)[0] <= tau_m
    belongs = label[nearest[kept]]
    out = {"all": _score(found, met)}
    for number in np.unique(label):
        name = names.get(int(number), "background")
        out[name] = _score(found[belongs == number], met[label == number])
    return out


def _kept(on_mesh: F64, near: Bool, tau_m: float, ignored: F32 | None) -> Bool:
    if ignored is None or len(ignored) == 0:
        return np.ones(len(on_mesh), bool)
    away = np.isinf(_tree(ignored).query(on_mesh, distance_upper_bound=tau_m, workers=_WORKERS)[0])
    kept: Bool = near | away
    return kept


def _thinned(points: F32, labels: U8, voxel_m: float) -> tuple[F64, U8]:
    """Thinned class by class, so that a voxel on a border keeps both."""
    numbers = np.unique(labels)
    parts = [thin(iter([points[labels == number]]), voxel_m) for number in numbers]
    if not parts:
        return np.empty((0, 3)), np.empty(0, np.uint8)
    return np.concatenate(parts), np.repeat(numbers, [len(part) for part in parts])


def _tree(points: F64 | F32) -> cKDTree:
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def _score(found: Bool, met: Bool) -> Score:
    return Score(_mean(found), _mean(met), len(found), len(met))


def _mean(condition: Bool) -> float:
    return float(np.mean(condition)) if len(condition) else float("nan")
