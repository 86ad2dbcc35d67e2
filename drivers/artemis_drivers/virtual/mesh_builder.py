"""Collects labelled, textured triangles into one world mesh.

Solids are added closed and wound so that every normal (right-hand rule) points out of the solid: a beam can
only hit the front of a triangle, and the truth of a reconstructed mesh's orientation is well defined. Where
solids touch, one is sunk into the other, so that no hidden face lies beside a visible one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

WHITE = (1.0, 1.0, 1.0)
Colour = tuple[float, float, float]

#: Class names that all virtual worlds share; the index is the label, 0 is "nothing of the others". Indoors the
#: floor is ground, walls and ceilings are building. A loaded world may add names after these.
CLASS_NAMES = (
    "background",
    "ground",
    "building",
    "car",
    "person",
    "bench",
    "tree",
    "pole",
    "sign",
    "other",
    "bicycle",
    "backpack",
    "statue",
    "hedge",
    "steps",
    "shelf",
    "glass",
    "pillar",
    "table",
    "chair",
    "railing",
)


@dataclass(frozen=True, slots=True)
class Shape:
    """Triangles in a shape's own frame, metres.

    ``vertices`` float64 (n, 3); ``triangles`` int32 (m, 3); ``uv`` float64 (m, 3, 2) texture coordinates of
    the corners in metres on the surface; ``part`` int32 (m,) chooses among the materials given to
    :meth:`MeshBuilder.add`.
    """

    vertices: F64
    triangles: I32
    uv: F64
    part: I32

    def moved(self, T_target_shape: F64) -> Shape:
        """The shape under a rigid (or uniformly scaled) transform; texture coordinates stay."""
        vertices = self.vertices @ T_target_shape[:3, :3].T + T_target_shape[:3, 3]
        return Shape(vertices, self.triangles, self.uv, self.part)


@dataclass(frozen=True, slots=True)
class WorldMesh:
    """Triangles of a world or of a part of it.

    ``vertices`` float32 (n, 3) metres, z up; ``triangles`` int32 (m, 3); per triangle: ``uv`` float32 (m, 3,
    2) metres, ``material`` uint16, ``tint`` uint8 (m, 3) multiplies the texture, ``class_id`` uint8 index of
    CLASS_NAMES, ``instance`` int32 unique in the world.
    """

    vertices: F32
    triangles: I32
    uv: F32
    material: U16
    tint: U8
    class_id: U8
    instance: I32

    def corners(self) -> F32:
        """float32 (m, 3, 3): the corner positions of every triangle."""
        return self.vertices[self.triangles]

    def areas_and_normals(self) -> tuple[F64, F64]:
        """Area in m2 (m,) and unit normal (m, 3) of every triangle (0 where degenerate)."""
        a, b, c = np.moveaxis(self.corners().astype(np.float64), 1, 0)
        cross = np.cross(b - a, c - a)
        twice = np.linalg.norm(cross, axis=1)
        return 0.5 * twice, cross / np.maximum(twice, 1e-30)[:, None]


def joined(parts: list[WorldMesh]) -> WorldMesh:
    """One mesh of several; instance numbers are kept."""
    first_vertex = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    return WorldMesh(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.triangles + np.int32(k) for p, k in zip(parts, first_vertex, strict=True)]),
        np.concatenate([p.uv for p in parts]),
        np.concatenate([p.material for p in parts]),
        np.concatenate([p.tint for p in parts]),
        np.concatenate([p.class_id for p in parts]),
        np.concatenate([p.instance for p in parts]),
    )


class MeshBuilder:
    """Adds shapes to the object begun last; ``instance`` numbers count up from ``first_instance``."""

    def __init__(self, materials: dict[str, int], first_instance: int = 0) -> None:
        self._materials = materials
        self._instance = first_instance - 1
        self._class_id = 0
        self._vertices: list[F64] = []
        self._columns: dict[str, list[Any]] = {
            "triangles": [],
            "uv": [],
            "material": [],
            "tint": [],
            "class_id": [],
            "instance": [],
        }
        self._vertex_count = 0

    def begin(self, class_name: str) -> int:
        """Begin a new object of the class; returns its instance number."""
        self._class_id = CLASS_NAMES.index(class_name)
        self._instance += 1
        return self._instance

    def add(
        self,
        shape: Shape,
        material: str | tuple[str, ...],
        tint: Colour | tuple[Colour, ...] = WHITE,
        T_world_shape: F64 | None = None,
    ) -> None:
        """Add a shape; ``material`` and ``tint`` may be tuples indexed by the shape's parts."""
        if T_world_shape is not None:
            shape = shape.moved(T_world_shape)
        materials = (material,) if isinstance(material, str) else material
        tints = np.atleast_2d(np.array(tint, np.float64))
        count = len(shape.triangles)
        ids = np.array([self._materials[m] for m in materials], np.uint16)
        self._vertices.append(shape.vertices)
        self._columns["triangles"].append(shape.triangles + np.int32(self._vertex_count))
        self._columns["uv"].append(shape.uv.astype(np.float32))
        self._columns["material"].append(ids[np.minimum(shape.part, len(ids) - 1)])
        rounded = np.rint(np.clip(tints, 0, 1) * 255).astype(np.uint8)
        self._columns["tint"].append(rounded[np.minimum(shape.part, len(tints) - 1)])
        self._columns["class_id"].append(np.full(count, self._class_id, np.uint8))
        self._columns["instance"].append(np.full(count, self._instance, np.int32))
        self._vertex_count += len(shape.vertices)

    def build(self) -> WorldMesh:
        """The mesh of everything added so far."""
        if not self._vertices:
            return _empty()
        columns = {name: np.concatenate(parts) for name, parts in self._columns.items()}
        return WorldMesh(np.concatenate(self._vertices).astype(np.float32), **columns)


def _empty() -> WorldMesh:
    return WorldMesh(
        np.empty((0, 3), np.float32),
        np.empty((0, 3), np.int32),
        np.empty((0, 3, 2), np.float32),
        np.empty(0, np.uint16),
        np.empty((0, 3), np.uint8),
        np.empty(0, np.uint8),
        np.empty(0, np.int32),
    )
