"""Geometry where classes meet: precision, recall and F1 of a mesh near the borders of a labelled reference.

The border is made of the reference points within ``band_m`` of a point of another class. Precision is the share of
the mesh samples whose nearest reference point belongs to it that lie within tau, recall the share of its points
within tau of the mesh. Sampling and thinning are those of ``mesh.py``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial import cKDTree

from artemis_edge.errors import InputError
from artemis_edge.evaluate.by_class import Score
from artemis_edge.evaluate.sampling import samples, thin
from artemis_edge.evaluate.semantics import PARTS, near_boundary
from artemis_edge.export.mesh import Mesh, PointCloud, finite_rows
from artemis_edge.frames import U8

BAND_M = 0.3
_SAMPLES_PER_TAU2 = 10.0
_WORKERS = 2


def score_boundaries(
    mesh: Mesh, reference: PointCloud, taus: Sequence[float] = (0.05, 0.1), band_m: float = BAND_M
) -> dict[float, Score]:
    """Scores by tau [m]; InputError when the reference has no labels or no two classes meet in it."""
    if reference.labels is None:
        raise InputError("the reference cloud has no labels; give a cloud with a uchar property 'label'")
    good = finite_rows(reference.points)
    points, labels = reference.points[good], reference.labels[good]
    border = near_boundary(points, labels, band_m)
    if not border.any():
        raise InputError("no two classes meet in the reference; give one with several classes")
    found = {}
    for tau in taus:
        cloud, is_border = _thinned(points, border, tau / 2)
        on_mesh = thin(samples(mesh.vertices, mesh.faces, _SAMPLES_PER_TAU2 / tau**2), tau / 2)
        distance, nearest = _tree(cloud).query(on_mesh, workers=_WORKERS, distance_upper_bound=band_m)
        near = np.isfinite(distance)
        near[near] = is_border[nearest[near]]
        met = _tree(on_mesh).query(cloud[is_border], workers=_WORKERS)[0] <= tau
        close = distance[near] <= tau
        found[tau] = Score(_mean(close), _mean(met), len(close), len(met))
    return found


def merged_labels(reference: PointCloud, names: Mapping[int, str]) -> U8:
    """Labels of the reference as the map was asked for: 0 for what it names neither itself nor the whole of."""
    mine = {name: label for label, name in names.items()}
    table = np.zeros(256, np.uint8)
    for label, name in reference.label_names.items():
        table[label] = mine.get(name, mine.get(PARTS.get(name, ""), 0))
    assert reference.labels is not None
    return table[reference.labels]


def _thinned(points: np.ndarray, border: np.ndarray, voxel_m: float) -> tuple[np.ndarray, np.ndarray]:
    parts = [thin(iter([points[border == side]]), voxel_m) for side in (False, True)]
    return np.concatenate(parts), np.repeat([False, True], [len(part) for part in parts])


def _tree(points: np.ndarray) -> cKDTree:
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def _mean(condition: np.ndarray) -> float:
    return float(np.mean(condition)) if len(condition) else float("nan")
