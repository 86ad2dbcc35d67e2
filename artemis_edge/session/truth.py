"""A reconstructed mesh against the truth of a virtual world: its winding, and what of it bridges air.

*Winding*: of the triangles whose centroid lies within NEAR_M of an observed surface, the share wound as it is;
``winding.py`` defines three judges. In a virtual world normals point out of the solids, that is, towards any sensor
that can see them. *Bridging*: a point of a triangle hangs in air when it is further from every surface of the world
than BRIDGE times the local spacing, which is the median length of the edges that touch the triangle's corners (its
one-ring). A gap of width g has its middle g/2 from both rims, so BRIDGE = 1.5 finds what spans a gap wider than
three spacings. A spacing finer than SPACING_FLOOR_M counts as that, so that sensor noise does not count as a bridge.
What hangs within NEAR_M of where beams met moving things is no bridge but a ghost, and counted as that.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from artemis_drivers.virtual.proximity import anything_within
from artemis_drivers.virtual.raycast import build_bvh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from artemis_edge.errors import InputError
from artemis_edge.export.ply import Mesh, read_points
from artemis_edge.frames import F32, F64, I32, U8, Bool
from artemis_edge.session.truth_files import REFERENCE_POINT
from artemis_edge.session.winding import NEAR_M, Verdict, near, verdicts

__all__ = ["BRIDGE", "NEAR_M", "Reference", "TruthReport", "Winding", "evaluate_against_world"]

BRIDGE = 1.5
SPACING_FLOOR_M = 0.05
_SURFACE_SPACING_M = 0.04  # of the samples on the world that stand for its surfaces
_MESH_SPACING_M = 0.05  # of the samples on the reconstruction
_MARGIN_M = 1.0  # world surfaces further than this from the reconstruction are left out
_SEED = 7


@dataclass(frozen=True, slots=True)
class Reference:
    """The observed surface: ``points``, unit ``normals`` and ``views`` (towards a place from which a beam saw the
    point) float32 (n, 3), ``labels`` uint8, ``instance`` int32 (n,), and the names of the classes.

    Without ``views``, nothing is said of facing; without ``labels``, nothing of classes.
    """

    points: F32
    normals: F32
    views: F32 | None = None
    labels: U8 | None = None
    instance: I32 | None = None
    label_names: dict[int, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Winding:
    """Shares 0..1 by number and by area of the ``judged`` triangles that agree; NaN when none is judged."""

    share: float
    area_share: float
    judged: int


@dataclass(frozen=True, slots=True)
class TruthReport:
    """``winding`` by judge (nearest, mean, facing), ``classes`` the same by the class of the nearest observed
    point; ``bridging_area_share``: of the whole area ``area_m2``, what hangs in air; ``ghost_area_share``: what
    hangs where something moved.
    """

    winding: dict[str, Winding]
    classes: dict[str, dict[str, Winding]]
    bridging_area_share: float
    ghost_area_share: float
    triangles: int
    area_m2: float

    def to_json(self) -> dict[str, float]:
        """Plain values; the judge ``nearest`` is called wound, as ever."""
        out: dict[str, float] = {}
        for prefix, judge in (("", "nearest"), ("mean_", "mean"), ("facing_", "facing")):
            if judge in self.winding:
                found = self.winding[judge]
                out[f"{prefix}wound_share"] = found.share
                out[f"{prefix}wound_area_share"] = found.area_share
                out[f"{prefix}judged"] = found.judged
        return out | {
            "bridging_area_share": self.bridging_area_share,
            "ghost_area_share": self.ghost_area_share,
            "triangles": self.triangles,
            "area_m2": self.area_m2,
        }


def evaluate_against_world(
    mesh: Mesh, world: Mesh, observed: Reference | None = None, moving: F32 | None = None
) -> TruthReport:
    """Judge ``mesh`` by the world mesh, both in the same frame; ``moving`` (n, 3): where beams met what moves.

    ``observed`` (truth/reference.ply) judges the winding, because inside walls and under cars surfaces touch
    that no sensor can tell apart. Without it all of the world's surfaces do. Raises InputError when either mesh
    has no triangles.
    """
    if len(mesh.faces) == 0 or len(world.faces) == 0:
        raise InputError("a mesh without triangles cannot be compared with a world; give a mesh with faces")
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area, normal = _area_and_normal(corners)
    surface = _within(world, corners)
    judge = _world_samples(surface) if observed is None else observed
    found = near(corners.mean(axis=1), judge.points, judge.normals)
    said = verdicts(normal, found, judge.normals, judge.views)
    class_of = None if judge.labels is None else judge.labels[np.maximum(found.nearest, 0)]
    bridged, ghosts = _hanging_area(corners, area, _local_spacing(mesh), surface, moving)
    return TruthReport(
        winding={name: _winding(verdict, area) for name, verdict in said.items()},
        classes={} if class_of is None else _by_class(said, area, class_of, judge.label_names),
        bridging_area_share=_share(bridged, area.sum()),
        ghost_area_share=_share(ghosts, area.sum()),
        triangles=len(corners),
        area_m2=float(area.sum()),
    )


def read_moving(truth: Path) -> F32 | None:
    """Where beams met what moves, float32 (n, 3), if the session says; InputError if it cannot be read."""
    path = truth / "moving.ply"
    return read_points(path).points if path.exists() else None


def read_reference(path: Path) -> Reference:
    """A reference.ply that ``simulate`` wrote; InputError for any other file."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; simulate the session again") from None
    end = content.find(b"end_header\n") + len(b"end_header\n")
    header = content[:end].decode("ascii", errors="replace")
    names = [line.split()[-1] for line in header.splitlines() if line.startswith("property")]
    wanted = ["x", "y", "z", "nx", "ny", "nz", "vx", "vy", "vz", "label", "instance"]
    if names != wanted or (len(content) - end) % REFERENCE_POINT.itemsize:
        raise InputError(f"{path} is not a reference written by 'artemis-edge simulate'; simulate it again")
    rows = np.frombuffer(content, REFERENCE_POINT, offset=end)
    words = [line.split(maxsplit=3) for line in header.splitlines() if line.startswith("comment label ")]
    return Reference(
        rows["position"].copy(),
        rows["normal"].copy(),
        rows["view"].copy(),
        rows["label"].copy(),
        rows["instance"].copy(),
        {int(number): name for _, _, number, name in words},
    )


def _winding(verdict: Verdict, area: F64, chosen: Bool | None = None) -> Winding:
    judged = verdict.judged if chosen is None else verdict.judged & chosen
    agrees = verdict.agrees & judged
    return Winding(
        _share(agrees.sum(), judged.sum()),
        _share(area[agrees].sum(), area[judged].sum()),
        int(judged.sum()),
    )


def _by_class(
    said: dict[str, Verdict], area: F64, class_of: U8, names: dict[int, str]
) -> dict[str, dict[str, Winding]]:
    out = {}
    for label in np.unique(class_of[said["nearest"].judged]):
        name = names.get(int(label), "background")
        out[name] = {judge: _winding(verdict, area, class_of == label) for judge, verdict in said.items()}
    return out


def _share(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0 else float("nan")


def _area_and_normal(corners: F64) -> tuple[F64, F64]:
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(cross, axis=1)
    return twice / 2, cross / np.maximum(twice, 1e-30)[:, None]


def _local_spacing(mesh: Mesh) -> F64:
    """Per triangle the median length of all edges that touch one of its corners, floored."""
    faces = mesh.faces.astype(np.int64)
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges = np.unique(edges[:, 0] * len(mesh.vertices) + edges[:, 1])
    edges = np.stack([edges // len(mesh.vertices), edges % len(mesh.vertices)], axis=1)
    length = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1).astype(
        np.float64
    )
    per_vertex = _grouped_median(edges.reshape(-1), np.repeat(length, 2), len(mesh.vertices))
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


def _hanging_area(
    corners: F64, area: F64, spacing: F64, surface: F64, moving: F32 | None
) -> tuple[float, float]:
    """Areas (m2) that bridge and that are ghosts: of each triangle the share of its samples that does or is."""
    points, triangle = _samples(corners, area, _MESH_SPACING_M, np.random.default_rng(_SEED))
    bvh = build_bvh(surface.astype(np.float32))
    hanging = np.flatnonzero(~anything_within(bvh, points, BRIDGE * spacing[triangle]))
    taken = np.bincount(triangle, minlength=len(corners))
    each = (area / np.maximum(taken, 1))[triangle[hanging]]
    ghost = np.zeros(len(hanging), bool)
    if moving is not None and len(moving):
        ghost = np.isfinite(cKDTree(moving).query(points[hanging], distance_upper_bound=NEAR_M)[0])
    return float(each[~ghost].sum()), float(each[ghost].sum())


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


def _within(world: Mesh, corners: F64) -> F64:
    """Corners (m, 3, 3) of the world's triangles around a reconstruction."""
    low, high = corners.min(axis=(0, 1)) - _MARGIN_M, corners.max(axis=(0, 1)) + _MARGIN_M
    surface = world.vertices[world.faces].astype(np.float64)
    inside = ((surface.max(axis=1) >= low) & (surface.min(axis=1) <= high)).all(axis=1)
    kept: F64 = surface[inside]
    return kept


def _world_samples(surface: F64) -> Reference:
    """Points and normals on the world's surfaces, as if all had been observed."""
    area, normal = _area_and_normal(surface)
    points, triangle = _samples(surface, area, _SURFACE_SPACING_M, np.random.default_rng(_SEED))
    return Reference(points.astype(np.float32), normal[triangle].astype(np.float32))
