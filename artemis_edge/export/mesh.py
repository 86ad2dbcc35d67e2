"""A mesh and a point cloud as they leave the program."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import F32, F64, I32, U8, Bool

_GREY = 128


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangle mesh in world coordinates (metres), one row per vertex.

    ``vertices`` and ``normals`` float32 (n, 3), ``colours`` uint8 (n, 3) sRGB, ``labels`` uint8 (n,),
    ``confidence`` float32 (n,) 0..1, ``faces`` int32 (m, 3) counter-clockwise seen from the free side,
    ``label_names`` class names by label.
    """

    vertices: F32
    normals: F32
    colours: U8
    labels: U8
    confidence: F32
    faces: I32
    label_names: dict[int, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class PointCloud:
    """Points float32 (n, 3) in metres; ``colours`` uint8 (n, 3) and ``labels`` uint8 (n,) if known."""

    points: F32
    colours: U8 | None = None
    labels: U8 | None = None
    label_names: dict[int, str] = field(default_factory=dict)


def bare_mesh(
    vertices: F32 | F64,
    faces: I32,
    *,
    normals: F32 | None = None,
    colours: U8 | None = None,
    labels: U8 | None = None,
    confidence: F32 | None = None,
    label_names: dict[int, str] | None = None,
) -> Mesh:
    """Mesh of geometry and what else is known; else area-weighted normals, grey, label 0, confidence 1."""
    vertices = np.ascontiguousarray(vertices, np.float32).reshape(-1, 3)
    faces = np.ascontiguousarray(faces, np.int32).reshape(-1, 3)
    count = len(vertices)
    return Mesh(
        vertices=vertices,
        normals=vertex_normals(vertices, faces) if normals is None else normals,
        colours=np.full((count, 3), _GREY, np.uint8) if colours is None else colours,
        labels=np.zeros(count, np.uint8) if labels is None else labels,
        confidence=np.ones(count, np.float32) if confidence is None else confidence,
        faces=faces,
        label_names=label_names or {},
    )


def finite_rows(points: F32 | F64) -> Bool:
    """Which rows of (n, k) have only finite numbers, bool (n,)."""
    finite: Bool = np.logical_and.reduce(np.isfinite(points), axis=1)
    return finite


def require_finite(mesh: Mesh) -> None:
    """InputError for a mesh whose coordinates other programs could not open."""
    if not (np.isfinite(mesh.vertices).all() and np.isfinite(mesh.normals).all()):
        raise InputError(
            "the mesh has coordinates that are not finite; write it again with `artemis-edge reprocess`"
        )


def vertex_normals(vertices: F32, faces: I32) -> F32:
    """Unit normals float32 (n, 3): mean of the adjoining triangles by area; zero where there are none.

    Triangles with a corner that is not finite count as none.
    """
    faces = faces[finite_rows(vertices)[faces].all(axis=1)]
    corner = vertices[faces].astype(np.float64)
    doubled = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    total = np.zeros((len(vertices), 3))
    for axis in range(3):
        for k in range(3):
            total[:, axis] += np.bincount(faces[:, k], doubled[:, axis], minlength=len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    unit: F32 = np.divide(total, length, out=np.zeros_like(total), where=length > 0).astype(np.float32)
    return unit


def edges_of(faces: I32) -> I32:
    """The edges of triangles (m, 3), each once: int32 (e, 2), the lower vertex first, in order."""
    ends = np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]])).astype(np.int64)
    # one number an edge, sorted: np.unique takes forty times as long (it hashes), and longer still for pairs
    keys = np.sort(ends.min(axis=1) << 32 | ends.max(axis=1))
    keys = keys[np.concatenate(([True], keys[1:] != keys[:-1]))] if len(keys) else keys
    return np.stack((keys >> 32, keys & 0xFFFFFFFF), axis=1).astype(np.int32)
