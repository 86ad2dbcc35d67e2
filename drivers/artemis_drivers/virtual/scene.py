"""The part of a world around the sensors, prepared for ray casting and for shading.

All triangles of a scene have one numbering: those that stand still first, then those of each mover. A surface
is described in the local frame of the part it belongs to: axes of the world and ``Scene.origin`` for what stands
still, the mover's own frame (``MovingPart.pose``) for what moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_drivers.virtual.mesh_builder import F32, F64, I32, U8, WorldMesh, joined
from artemis_drivers.virtual.moving import MovingPart, cast_mover, into_mover, prepare_movers, renumbered
from artemis_drivers.virtual.raycast import Bvh, Hits, build_bvh, cast
from artemis_drivers.virtual.textures import MACRO_M, SIZE, TextureAtlas
from artemis_drivers.virtual.world import Mover, World


class Surface(NamedTuple):
    """What shading needs of each triangle, packed into few cache lines, in the local frame of its part.

    ``rows`` float32 (m, 16): 0-3 unit normal n and n.p of its points; 4-7 and 8-11 texture u and v in metres
    as affine functions of p; 12 texels per metre of the picture on this triangle; 13-14 metres added to the
    coordinates of the slow macro picture. ``look`` uint8 (m, 4): tint and material. ``key`` uint32 (m,):
    equal for triangles of one plane that continue each other's texture.
    """

    rows: F32
    look: U8
    key: NDArray[np.uint32]


@dataclass(frozen=True, slots=True)
class Scene:
    """Triangles around the sensors; ``origin`` float64 (3,) of the float32 coordinates in ``surface``.

    ``mesh``, ``bvh``, ``object_of``, ``object_centre`` and ``object_radius`` are of what stands still;
    ``surface``, ``class_id`` uint8 and ``instance`` int32 have a row for every triangle, those of ``movers``
    behind. ``object_of`` int32 (m,) numbers the objects 0..k - 1 of the triangles; ``object_centre`` float64
    (k, 3), local, and ``object_radius`` (k,) enclose them. ``panes`` marks the triangles that let a LiDAR's
    beam pass, one array for what stands still and one for each mover, in the order of their ``bvh``.
    """

    mesh: WorldMesh
    bvh: Bvh
    surface: Surface
    atlas: TextureAtlas
    object_of: I32
    object_centre: F64
    object_radius: F64
    movers: tuple[MovingPart, ...]
    class_id: U8
    instance: I32
    panes: tuple[NDArray[np.bool_], ...]

    @property
    def origin(self) -> F64:
        """World coordinates of the local origin."""
        return self.bvh.origin


def prepare(mesh: WorldMesh, atlas: TextureAtlas, movers: tuple[Mover, ...] = ()) -> Scene:
    """Scene of a mesh and of what moves through it."""
    return _assemble(mesh, atlas, prepare_movers(movers, len(mesh.triangles)))


def _assemble(mesh: WorldMesh, atlas: TextureAtlas, movers: tuple[MovingPart, ...]) -> Scene:
    bvh = build_bvh(mesh.corners())
    parts = [(mesh, bvh.origin), *((m.mesh, m.bvh.origin) for m in movers)]
    surfaces = [_surface(part, atlas, origin) for part, origin in parts]
    return Scene(
        mesh,
        bvh,
        Surface(*(np.concatenate(columns) for columns in zip(*surfaces, strict=True))),
        atlas,
        *_objects(mesh, bvh.origin),
        movers,
        np.concatenate([part.class_id for part, _ in parts]),
        np.concatenate([part.instance for part, _ in parts]),
        tuple(
            atlas.arrays.glass[part.material[tree.order]]
            for part, tree in [(mesh, bvh), *((m.mesh, m.bvh) for m in movers)]
        ),
    )


def cast_at(
    scene: Scene, origin: F64, direction: F64, time_s: F64 | float, max_range_m: F64 | float = np.inf
) -> Hits:
    """Nearest hit of each ray with the scene as it is at the ray's time.

    ``origin``, unit ``direction`` float64 (n, 3) in world; ``time_s`` and ``max_range_m`` float64 (n,) or one
    for all. ``Hits.triangle`` is of the scene's numbering. :func:`local_rays` carries what was met into the
    frame in which ``Scene.surface`` describes it.
    """
    hits = cast(scene.bvh, origin, direction, max_range_m)
    if not scene.movers:
        return hits
    time = np.ascontiguousarray(np.broadcast_to(np.asarray(time_s, np.float64), (len(origin),)))
    limit = np.minimum(hits.distance_m, max_range_m)
    for mover in scene.movers:
        rows, met = cast_mover(mover, origin, direction, time, limit)
        nearer = met.triangle >= 0
        rows = rows[nearer]
        limit[rows] = met.distance_m[nearer]
        hits.distance_m[rows] = met.distance_m[nearer]
        hits.triangle[rows] = met.triangle[nearer] + np.int32(mover.first)
        hits.u[rows], hits.v[rows] = met.u[nearer], met.v[nearer]
    return hits


def local_rays(
    scene: Scene, triangle: I32, point: F64, direction: F64, time_s: F64 | float
) -> tuple[F64, F64]:
    """Points and directions (n, 3) of the world in the local frame of the triangle's part at its time."""
    local, turned = point - scene.origin, direction.copy()
    if len(triangle) == 0 or int(triangle.max()) < len(scene.mesh.triangles):
        return local, turned
    time = np.broadcast_to(np.asarray(time_s, np.float64), (len(point),))
    for mover in scene.movers:
        rows = np.flatnonzero(
            (triangle >= mover.first) & (triangle < mover.first + len(mover.mesh.triangles))
        )
        local[rows], turned[rows] = into_mover(mover, point[rows], direction[rows], time[rows])
    return local, turned


def _objects(mesh: WorldMesh, origin: F64) -> tuple[I32, F64, F64]:
    """Number of each triangle's object, and a sphere around each object."""
    _, number = np.unique(mesh.instance, return_inverse=True)
    count = int(number.max()) + 1 if len(number) else 0
    corners = mesh.corners().astype(np.float64) - origin
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, number, corners.min(axis=1))
    np.maximum.at(high, number, corners.max(axis=1))
    return number.astype(np.int32), (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2


def _surface(mesh: WorldMesh, atlas: TextureAtlas, origin: F64) -> Surface:
    corners = mesh.corners().astype(np.float64) - origin
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e1, e2)
    squared = np.maximum((normal**2).sum(axis=1), 1e-30)[:, None]
    # dual basis of the edges within the plane: e1 . d1 = 1, e2 . d1 = 0 and so on
    d1, d2 = np.cross(e2, normal) / squared, np.cross(normal, e1) / squared
    texture = mesh.uv.astype(np.float64)
    du, dv = texture[:, 1] - texture[:, 0], texture[:, 2] - texture[:, 0]
    unit = normal / np.sqrt(squared)
    rows = np.zeros((len(corners), 16), np.float32)
    rows[:, :3], rows[:, 3] = unit, (unit * a).sum(axis=1)
    metres = atlas.arrays.metres[mesh.material].astype(np.float64)
    for k in range(2):
        gradient = (du[:, k, None] * d1 + dv[:, k, None] * d2) / metres[:, None]
        rows[:, 4 + 4 * k : 7 + 4 * k] = gradient
        rows[:, 7 + 4 * k] = texture[:, 0, k] / metres - (gradient * a).sum(axis=1)
    stretch = np.sqrt(np.abs(du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]) / np.sqrt(squared[:, 0]))
    rows[:, 12] = np.log2(np.maximum(stretch * SIZE / metres, 1e-6))
    rows[:, 13:15] = (mesh.instance[:, None].astype(np.int64) * [7919, 104729]) % 1009 / 1009.0
    rows[:, 15] = metres / MACRO_M
    look = np.column_stack([mesh.tint, mesh.material.astype(np.uint8)])
    return Surface(rows, look, _continuation_key(rows, look, mesh.instance))


def _continuation_key(rows: F32, look: U8, instance: NDArray[np.int32]) -> NDArray[np.uint32]:
    """Hash of plane, texture mapping, look and object, rounded to a millimetre."""
    key = instance.astype(np.uint32)
    for column in np.rint(rows[:, :12].T * 1000).astype(np.int64).astype(np.uint32):
        key = key * np.uint32(0x01000193) ^ column
    for column in look.T:
        key = key * np.uint32(0x01000193) ^ column
    return np.asarray(key, np.uint32)


class Window:
    """The scene within ``reach_m`` along x of wherever the sensors are; rebuilt as they walk on."""

    def __init__(self, world: World, reach_m: float) -> None:
        self.world = world
        self.reach_m = reach_m
        self._blocks: dict[int, WorldMesh] = {}
        self._shown = range(0)
        self._scene: Scene | None = None
        self._movers = prepare_movers(world.movers, 0)

    def at(self, x: float) -> Scene:
        """Scene around ``x``; the same object as long as the same blocks are in reach."""
        wanted = self.world.blocks_near(x, self.reach_m)
        if self._scene is None or wanted != self._shown:
            self._blocks = {
                k: self._blocks[k] if k in self._blocks else self.world.build_block(k) for k in wanted
            }
            mesh = joined([self._blocks[k] for k in wanted])
            self._scene = _assemble(mesh, self.world.atlas, renumbered(self._movers, len(mesh.triangles)))
            self._shown = wanted
        return self._scene
