"""A reconstructed mesh against the truth of a virtual world: its winding, and what of it bridges air.

Definitions. *Winding*: among triangles whose centroid lies within NEAR_M of an observed surface, the share
whose normal (right-hand rule) agrees (dot > 0) with that surface's normal at its nearest point; in a virtual
world normals point out of the solids, that is, towards any sensor that can see them. *Bridging*: a point of
a triangle hangs in air when it is further from every surface of the world than BRIDGE times the local
spacing, which is the median length of the edges that touch the triangle's corners (its one-ring). A gap of
width g has its middle g/2 from both rims, so BRIDGE = 1.5 finds what spans a gap wider than three spacings.
A spacing finer than SPACING_FLOOR_M counts as that, so that sensor noise does not count as a bridge.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from artemis_edge.errors import InputError
from artemis_edge.export.ply import Mesh, read_mesh
from artemis_edge.frames import F32, F64

NEAR_M = 0.10
BRIDGE = 1.5
SPACING_FLOOR_M = 0.05
_SURFACE_SPACING_M = 0.04  # of the samples on the world that stand for its surfaces
_MESH_SPACING_M = 0.05  # of the samples on the reconstruction
_MARGIN_M = 1.0  # world surfaces further than this from the reconstruction are left out
_SEED = 7


@dataclass(frozen=True, slots=True)
class TruthReport:
    """Shares 0..1 (NaN when nothing can be judged); areas in m2.

    ``wound_share`` and ``wound_area_share``: of the judged triangles, by number and by area, those wound as
    the world is; ``judged`` their number, ``triangles`` all. ``bridging_area_share``: of the whole area
    ``area_m2``, what hangs in air.
    """

    wound_share: float
    wound_area_share: float
    bridging_area_share: float
    judged: int
    triangles: int
    area_m2: float


def evaluate_against_world(mesh: Mesh, world: Mesh, observed: tuple[F32, F32] | None = None) -> TruthReport:
    """Judge ``mesh`` by the world mesh, both in the same frame.

    ``observed`` are points and normals float32 (n, 3) of the observed surface (truth/reference.ply): they
    judge the winding, because inside walls and under cars surfaces touch that no sensor can tell apart.
    Without them all of the world's surfaces do. Raises InputError when either mesh has no triangles.
    """
    if len(mesh.faces) == 0 or len(world.faces) == 0:
        raise InputError("a mesh without triangles cannot be compared with a world; give a mesh with faces")
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    low, high = corners.min(axis=(0, 1)) - _MARGIN_M, corners.max(axis=(0, 1)) + _MARGIN_M
    area, normal = _area_and_normal(corners)
    surface, surface_normal = _world_samples(world, low, high)
    judge = (surface, surface_normal) if observed is None else observed
    wound, judged = _winding(corners.mean(axis=1), normal, *judge)
    bridged = _bridged_area(corners, area, _local_spacing(mesh), surface)
    agree = judged & wound
    return TruthReport(
        wound_share=_share(agree.sum(), judged.sum()),
        wound_area_share=_share(area[agree].sum(), area[judged].sum()),
        bridging_area_share=_share(bridged.sum(), area.sum()),
        judged=int(judged.sum()),
        triangles=len(corners),
        area_m2=float(area.sum()),
    )


def evaluate_files(mesh: Path, truth: Path) -> TruthReport:
    """Judge the mesh in a PLY file by a session's ``truth/`` folder; raises InputError as the readers do."""
    reference = truth / "reference.ply"
    observed = read_reference(reference) if reference.exists() else None
    return evaluate_against_world(read_mesh(mesh), read_mesh(truth / "mesh.ply"), observed)


def read_reference(path: Path) -> tuple[F32, F32]:
    """Points and normals float32 (n, 3) of a reference.ply that ``simulate`` wrote."""
    content = path.read_bytes()
    end = content.find(b"end_header\n") + len(b"end_header\n")
    header = content[:end].decode("ascii", errors="replace")
    row = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("label", "u1")])
    if "property float nz\nproperty uchar label" not in header or (len(content) - end) % row.itemsize:
        raise InputError(f"{path} is not a reference written by 'artemis-edge simulate'; simulate it again")
    rows = np.frombuffer(content, row, offset=end)
    return rows["position"].copy(), rows["normal"].copy()


def _share(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0 else float("nan")


def _area_and_normal(corners: F64) -> tuple[F64, F64]:
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(cross, axis=1)
    return twice / 2, cross / np.maximum(twice, 1e-30)[:, None]


def _winding(
    centroid: F64, normal: F64, surface: F32, surface_normal: F32
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Per triangle: wound as the nearest surface, and whether one is near enough to judge."""
    distance, nearest = cKDTree(surface).query(centroid, distance_upper_bound=NEAR_M, workers=-1)
    judged = np.isfinite(distance) & (np.abs(normal).sum(axis=1) > 0)
    agree = np.zeros(len(centroid), bool)
    agree[judged] = (normal[judged] * surface_normal[nearest[judged]]).sum(axis=1) > 0
    return agree, judged


def _local_spacing(mesh: Mesh) -> F64:
    """Per triangle the median length of all edges that touch one of its corners, floored."""
    faces = mesh.faces.astype(np.int64)
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges = np.unique(edges, axis=0)
    length = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1).astype(
        np.float64
    )
    vertex = edges.reshape(-1)
    per_vertex = _grouped_median(vertex, np.repeat(length, 2), len(mesh.vertices))
    # the median of the corners' medians: their rings share most edges with the triangle's own ring
    spacing = np.median(per_vertex[faces], axis=1)
    return np.maximum(spacing, SPACING_FLOOR_M)


def _grouped_median(group: NDArray[np.int64], value: F64, groups: int) -> F64:
    """Median of ``value`` within each group 0..groups - 1 (0 where empty)."""
    order = np.lexsort((value, group))
    value = value[order]
    count = np.bincount(group, minlength=groups)
    first = np.cumsum(count) - count
    filled = count > 0
    out = np.zeros(groups)
    lower, upper = first + (count - 1) // 2, first + count // 2
    out[filled] = (value[lower[filled]] + value[upper[filled]]) / 2
    return out


def _bridged_area(corners: F64, area: F64, spacing: F64, surface: F32) -> F64:
    """Per triangle the area that hangs in air: its area times the share of its samples that do."""
    tree = cKDTree(surface)
    points, triangle = _samples(corners, area, _MESH_SPACING_M, np.random.default_rng(_SEED))
    limit = BRIDGE * spacing[triangle]
    distance, _ = tree.query(points, distance_upper_bound=float(limit.max()) + 1e-6, workers=-1)
    # the samples of the world stand for surfaces: up to half their diagonal lies between them
    hanging = distance > np.hypot(limit, _SURFACE_SPACING_M * 0.71)
    taken = np.bincount(triangle, minlength=len(corners))
    hung = np.bincount(triangle, hanging.astype(np.float64), minlength=len(corners))
    return np.asarray(area * hung / np.maximum(taken, 1))


def _samples(
    corners: F64, area: F64, spacing_m: float, rng: np.random.Generator
) -> tuple[F64, NDArray[np.int64]]:
    """Random points, one per square of ``spacing_m`` and at least one a triangle, and their triangles."""
    count = np.maximum(np.ceil(area / spacing_m**2).astype(np.int64), 1)
    triangle = np.repeat(np.arange(len(corners)), count)
    u, v = rng.random((2, len(triangle)))
    flip = u + v > 1
    u[flip], v[flip] = 1 - u[flip], 1 - v[flip]
    a, b, c = corners[triangle, 0], corners[triangle, 1], corners[triangle, 2]
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), triangle


def _world_samples(world: Mesh, low: F64, high: F64) -> tuple[F32, F32]:
    """Points and normals on the world's surfaces within the box."""
    corners = world.vertices[world.faces].astype(np.float64)
    inside = ((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1)
    corners = corners[inside]
    area, normal = _area_and_normal(corners)
    points, triangle = _samples(corners, area, _SURFACE_SPACING_M, np.random.default_rng(_SEED))
    kept = ((points >= low) & (points <= high)).all(axis=1)
    return points[kept].astype(np.float32), normal[triangle[kept]].astype(np.float32)
