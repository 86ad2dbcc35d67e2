"""Semantic rendering's other half: which objects the labelled mesh holds, and which of them a question means.

An object is the triangles of one class that hang together: joined by edges, or apart by less than a gap that the
sensor leaves in one thing. Because the map's classes are fused from all views, so are its objects. There is no
hysteresis: what is highlighted follows from the probabilities as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from artemis_edge.evaluate.sampling import triangle_areas
from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import F32, F64, I32, I64, Bool
from artemis_edge.highlighted import face_labels
from artemis_edge.segmentation.attribute import usual_sizes
from artemis_edge.segmentation.backend import Status
from artemis_edge.segmentation.layout import Box
from artemis_edge.segmentation.resolve import Understanding
from artemis_edge.segmentation.select import Selection, select

GAP_M = 0.3  # parts of one class nearer than this are one object: a bench's slats, a person behind a pole
LEAST_AREA_M2 = 0.05  # smaller pieces are stray labels: a mask's edge on what lies behind
# Nor is a piece claimed to be a thing of which it shows less than this share of the smallest one's side (sizes.toml)
LEAST_SHARE = 0.1
LEAST_SCORE = 0.5  # below it the map does not say that the object is there
_ENOUGH_SEEN = (
    0.5  # share of an object that images need to have seen: nobody photographs things from all sides
)
_NOT_SEEN = 180  # grey of vertices that no camera has coloured


@dataclass(frozen=True, slots=True)
class MapObject:
    """An object of the map. ``triangles`` int64 (k,) are rows of the mesh's faces."""

    id: int
    classes: dict[str, float]
    colour: F64 | None
    box: Box
    centroid: F64
    triangles: I64
    area_m2: float

    @property
    def name(self) -> str:
        """Its class."""
        return next(iter(self.classes))


@dataclass(frozen=True, slots=True)
class FoundObject:
    """An object as the answer to a question."""

    text: str
    status: Status
    score: float
    item: MapObject


@dataclass(frozen=True, slots=True)
class Reply:
    """What became of one question: its objects, best first, or why there are none."""

    text: str
    status: Status
    reason: str
    found: tuple[FoundObject, ...]


def objects_of(mesh: Mesh, probability: F32, skip: Sequence[str] = ()) -> list[MapObject]:
    """All objects of a labelled mesh, those of a class from the largest on, ids from 1.

    ``probability`` float32 (n,) is that of each vertex' label times the confidence in it. Classes in ``skip`` are
    left out, background is.
    """
    labels = face_labels(mesh)
    area = triangle_areas(mesh.vertices, mesh.faces)
    out: list[MapObject] = []
    for label, name in sorted(mesh.label_names.items()):
        rows = np.flatnonzero(labels == label)
        if label == 0 or name in skip or len(rows) == 0:
            continue
        piece = pieces(mesh.vertices, mesh.faces[rows])
        size = np.bincount(piece, area[rows])
        for k in np.argsort(-size, kind="stable"):
            if size[k] >= least_area_m2(name):
                out.append(_object(mesh, probability, name, rows[piece == k], area, len(out) + 1))
    return out


def least_area_m2(name: str) -> float:
    """Surface below which a piece of a class is a stray label [m2]."""
    usual = usual_sizes().get(name)
    if usual is None:
        return LEAST_AREA_M2
    return max(LEAST_AREA_M2, LEAST_SHARE * usual["height"][0] * usual["length"][0])


def pieces(vertices: F32, faces: I32, gap_m: float = GAP_M) -> I32:
    """Number of the object each triangle belongs to, int32 (m,): joined by a corner or nearer than ``gap_m``."""
    used, corner = np.unique(faces, return_inverse=True)
    corner = corner.reshape(faces.shape)
    near = cKDTree(vertices[used]).query_pairs(gap_m, output_type="ndarray")
    pairs = np.concatenate((corner[:, :2], corner[:, 1:], near))
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(used), len(used)))
    return np.asarray(connected_components(graph, directed=False)[1][corner[:, 0]], np.int32)


def _object(mesh: Mesh, probability: F32, name: str, rows: I64, area: F64, number: int) -> MapObject:
    faces, weight = mesh.faces[rows], area[rows] / area[rows].sum()
    middle = mesh.vertices[faces].mean(axis=1).astype(np.float64)
    return MapObject(
        id=number,
        classes={name: _score(probability[faces], weight)},
        colour=_colour(mesh, faces, weight),
        box=upright_box(mesh.vertices[np.unique(faces)]),
        centroid=weight @ middle,
        triangles=rows,
        area_m2=float(area[rows].sum()),
    )


def _score(probability: F32, weight: F64) -> float:
    """Mean probability of the corners (k, 3) that images have seen, by area; less where they are less than enough."""
    share = (probability > 0.0) * weight[:, None] / 3.0
    seen = float(share.sum())
    if seen == 0.0:
        return 0.0
    mean = float((probability * share).sum()) / seen
    return min(mean * min(seen / _ENOUGH_SEEN, 1.0), 1.0)


def _colour(mesh: Mesh, faces: I32, weight: F64) -> F64 | None:
    """Mean colour by area of the corners that a camera has coloured; None where it coloured few."""
    colour = mesh.colours[faces].astype(np.float64)
    known: Bool = (colour != _NOT_SEEN).any(axis=2)
    share = known * weight[:, None] / 3.0
    if share.sum() < 0.1:
        return None
    mean: F64 = np.einsum("ijk,ij->k", colour, share) / share.sum()
    return mean


def upright_box(points: F32) -> Box:
    """Smallest upright box around points (n, 3)."""
    (x, y), (along, across), angle = cv2.minAreaRect(np.ascontiguousarray(points[:, :2], np.float32))
    low, high = float(points[:, 2].min()), float(points[:, 2].max())
    if across > along:
        along, across, angle = across, along, angle + 90.0
    yaw = (np.radians(angle) + np.pi / 2) % np.pi - np.pi / 2
    return Box(np.array([x, y, 0.5 * (low + high)]), np.array([along, across, high - low]), float(yaw))


def answer(
    asked: Sequence[Understanding], objects: Sequence[MapObject], viewpoint: F64 | None = None
) -> list[Reply]:
    """For each question the objects of the map that it means, with their scores.

    An object below ``LEAST_SCORE`` is not claimed to be there. ``viewpoint`` (3,) is where the person who asks
    stands.
    """
    sure = [item for item in objects if max(item.classes.values()) >= LEAST_SCORE]
    by_id = {item.id: item for item in sure}
    return [_reply(question, select(question, sure, viewpoint), by_id) for question in asked]


def _reply(question: Understanding, chosen: Selection, by_id: dict[int, MapObject]) -> Reply:
    text = question.query.text
    found = tuple(FoundObject(text, hit.status, hit.score, by_id[hit.id]) for hit in chosen.hits)
    return Reply(text, chosen.status, chosen.reason, found)
