"""A mesh against a reference cloud: precision, recall and F1 within tau, distances, topology.

    python -m artemis_edge.evaluate.mesh MESH --reference CLOUD.ply --threshold 0.1 --crop --json

For each tau the mesh is sampled by area (at least 10 samples per square of edge tau), samples and reference
are thinned to the mean point per voxel of tau/2 (grid anchored at the origin), and each looks for its nearest
neighbour in the other. Accuracy is the mean distance from mesh to reference, completeness that from reference
to mesh, Chamfer the mean of the two, all at the smallest tau. Nothing is aligned.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from artemis_edge.errors import InputError, UserError
from artemis_edge.evaluate.sampling import samples, thin, triangle_areas
from artemis_edge.evaluate.topology import Topology, topology
from artemis_edge.export.mesh import finite_rows
from artemis_edge.export.ply import Mesh, read_mesh, read_points
from artemis_edge.frames import F32, F64, I32

DEFAULT_THRESHOLDS = (0.1,)
# Thresholds [m]: below a LiDAR's ranging noise and beyond a scene they measure nothing.
_FINEST_TAU_M, _COARSEST_TAU_M = 0.001, 100.0
_SAMPLES_PER_TAU2 = 10.0
_WORKERS = 2
_CM = 100.0


@dataclass(frozen=True, slots=True)
class Comparison:
    """One threshold ``tau_m``: both thinned clouds float64 (n, 3), each point's distance to the other (m)."""

    tau_m: float
    mesh_points: F64
    mesh_distance: F64
    reference_points: F64
    reference_distance: F64

    @property
    def precision(self) -> float:
        """Share of mesh samples within tau of the reference."""
        return float(np.mean(self.mesh_distance <= self.tau_m))

    @property
    def recall(self) -> float:
        """Share of the reference within tau of the mesh."""
        return float(np.mean(self.reference_distance <= self.tau_m))

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        both = self.precision + self.recall
        return 2.0 * self.precision * self.recall / both if both else 0.0

    @property
    def accuracy_m(self) -> float:
        """Mean distance from the mesh to the reference."""
        return float(np.mean(self.mesh_distance))

    @property
    def completeness_m(self) -> float:
        """Mean distance from the reference to the mesh."""
        return float(np.mean(self.reference_distance))


@dataclass(frozen=True, slots=True)
class MeshEvaluation:
    """All that is measured of one mesh; ``skipped`` counts what had no finite coordinates."""

    comparisons: tuple[Comparison, ...]
    topology: Topology
    vertices: int
    triangles: int
    area_m2: float
    skipped: dict[str, int]

    def to_json(self) -> dict[str, Any]:
        """The JSON object of ``evaluate mesh``."""
        finest = min(self.comparisons, key=lambda c: c.tau_m)
        return {
            "thresholds": {
                f"{c.tau_m:g}": {"precision": c.precision, "recall": c.recall, "f1": c.f1}
                for c in self.comparisons
            },
            "chamfer_cm": 0.5 * (finest.accuracy_m + finest.completeness_m) * _CM,
            "accuracy_cm": finest.accuracy_m * _CM,
            "completeness_cm": finest.completeness_m * _CM,
            "vertices": self.vertices,
            "triangles": self.triangles,
            "area_m2": self.area_m2,
            "edges": {
                "non_manifold_share": self.topology.non_manifold_share,
                "boundary_share": self.topology.boundary_share,
                "orientation_share": self.topology.orientation_share,
                "count": self.topology.edges,
            },
            "degenerate_triangles": self.topology.degenerate_triangles,
            "skipped": self.skipped,
        }


def evaluate_mesh(
    mesh: Mesh, reference: F32, thresholds: Sequence[float] = DEFAULT_THRESHOLDS, crop: bool = False
) -> MeshEvaluation:
    """Compare ``mesh`` with ``reference`` points float32 (n, 3) in the same frame at each threshold (m).

    ``crop`` leaves out samples outside the reference's bounding box + tau. Raises InputError when the
    reference or the (cropped) mesh is empty, a threshold is not within 1 mm and 100 m, or the mesh is so large
    for it that sampling would take hours.
    """
    good_point = finite_rows(reference)
    good_face = finite_rows(mesh.vertices)[mesh.faces].all(axis=1)
    reference, faces = reference[good_point], mesh.faces[good_face]
    if len(reference) == 0:
        raise InputError("the reference cloud has no points; give a cloud of the same scene")
    if len(faces) == 0:
        raise InputError("the mesh has no triangle with finite coordinates; export or map it again")
    if not thresholds or any(not _FINEST_TAU_M <= tau <= _COARSEST_TAU_M for tau in thresholds):
        raise InputError(
            f"a threshold must be a length from {_FINEST_TAU_M:g} to {_COARSEST_TAU_M:g} metres, "
            "for example --threshold 0.1"
        )
    return MeshEvaluation(
        comparisons=tuple(_compare(mesh.vertices, faces, reference, tau, crop) for tau in thresholds),
        topology=topology(mesh.vertices, faces),
        vertices=len(mesh.vertices),
        triangles=len(mesh.faces),
        area_m2=float(triangle_areas(mesh.vertices, faces).sum()),
        skipped={
            "reference_points": int(np.count_nonzero(~good_point)),
            "triangles": int(np.count_nonzero(~good_face)),
        },
    )


def _compare(vertices: F32, faces: I32, reference: F32, tau: float, crop: bool) -> Comparison:
    low, high = reference.min(axis=0) - tau, reference.max(axis=0) + tau
    if crop:
        faces = _touching(vertices, faces, low, high)
    chunks = samples(vertices, faces, _SAMPLES_PER_TAU2 / tau**2)
    if crop:
        chunks = (c[((c >= low) & (c <= high)).all(axis=1)] for c in chunks)
    on_mesh = thin(chunks, tau / 2)
    if len(on_mesh) == 0:
        raise InputError("the mesh has no surface where the reference is; are both in the same frame?")
    in_cloud = thin(iter([reference]), tau / 2)
    return Comparison(tau, on_mesh, _nearest(on_mesh, in_cloud), in_cloud, _nearest(in_cloud, on_mesh))


def _touching(vertices: F32, faces: I32, low: F32, high: F32) -> I32:
    """Triangles whose own box meets the box: the rest need not be sampled to be cut away."""
    corner = vertices[faces]
    kept: I32 = faces[((corner.max(axis=1) >= low) & (corner.min(axis=1) <= high)).all(axis=1)]
    return kept


def _nearest(points: F64, others: F64) -> F64:
    """Distance (m) of each point to the nearest of the others."""
    tree = cKDTree(others, balanced_tree=False, compact_nodes=False)
    distance: F64 = tree.query(points, workers=_WORKERS)[0]
    return distance


def run(mesh: Path, reference: Path, thresholds: Sequence[float], crop: bool) -> MeshEvaluation:
    """Read both files and compare; raises InputError for files that are not what they should be."""
    return evaluate_mesh(read_mesh(mesh), read_points(reference).points, thresholds, crop)


def to_text(evaluation: MeshEvaluation) -> str:
    """The figures for people."""
    lines = [
        f"within {c.tau_m:g} m: precision {c.precision:.4f}  recall {c.recall:.4f}  F1 {c.f1:.4f}"
        for c in evaluation.comparisons
    ]
    shown = evaluation.to_json()
    edges = shown["edges"]
    lines += [
        f"Chamfer {shown['chamfer_cm']:.2f} cm (accuracy {shown['accuracy_cm']:.2f}, "
        f"completeness {shown['completeness_cm']:.2f})",
        f"{evaluation.vertices} vertices, {evaluation.triangles} triangles, {evaluation.area_m2:.1f} m2",
        f"edges: {edges['non_manifold_share']:.3%} non-manifold, {edges['boundary_share']:.3%} boundary, "
        f"{edges['orientation_share']:.3%} consistently oriented",
    ]
    lines += [
        f"left out: {n} {what} without finite coordinates" for what, n in evaluation.skipped.items() if n
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """The module as a command of its own."""
    parser = argparse.ArgumentParser(prog="python -m artemis_edge.evaluate.mesh")
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--reference", type=Path, required=True)
    parser.add_argument("--threshold", type=float, action="append", metavar="METRES")
    parser.add_argument("--crop", action="store_true")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    try:
        result = run(given.mesh, given.reference, given.threshold or DEFAULT_THRESHOLDS, given.crop)
    except UserError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    print(json.dumps(result.to_json()) if given.json else to_text(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
