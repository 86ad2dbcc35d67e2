"""The part of a world around the sensors, prepared for ray casting and for shading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from artemis_drivers.virtual.mesh_builder import F32, F64, U8, U16, WorldMesh, joined
from artemis_drivers.virtual.raycast import Bvh, build_bvh
from artemis_drivers.virtual.textures import SIZE, TextureAtlas
from artemis_drivers.virtual.world import World


@dataclass(frozen=True, slots=True)
class Surface:
    """What shading needs of each triangle, in coordinates relative to ``Scene.origin``.

    ``plane`` float32 (m, 4): unit normal n and n.p of its points; ``uv`` float32 (m, 2, 4): u = uv[0, :3].p +
    uv[0, 3] in metres, and v likewise; ``texels_per_m`` float32 of the picture on this triangle; ``shift``
    float32 (m, 2) metres added to the coordinates of the slow macro picture.
    """

    plane: F32
    uv: F32
    texels_per_m: F32
    shift: F32
    material: U16
    tint: U8


@dataclass(frozen=True, slots=True)
class Scene:
    """Triangles around the sensors; ``origin`` float64 (3,) of the float32 coordinates in ``surface``."""

    mesh: WorldMesh
    bvh: Bvh
    surface: Surface
    atlas: TextureAtlas

    @property
    def origin(self) -> F64:
        """World coordinates of the local origin."""
        return self.bvh.origin


def prepare(mesh: WorldMesh, atlas: TextureAtlas) -> Scene:
    """Scene of a mesh."""
    bvh = build_bvh(mesh.corners())
    return Scene(mesh, bvh, _surface(mesh, atlas, bvh.origin), atlas)


def _surface(mesh: WorldMesh, atlas: TextureAtlas, origin: F64) -> Surface:
    corners = mesh.corners().astype(np.float64) - origin
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e1, e2)
    squared = np.maximum((normal**2).sum(axis=1), 1e-30)[:, None]
    # dual basis of the edges within the plane: e1 . d1 = 1, e2 . d1 = 0 and so on
    d1, d2 = np.cross(e2, normal) / squared, np.cross(normal, e1) / squared
    texture = mesh.uv.astype(np.float64)
    du, dv = texture[:, 1] - texture[:, 0], texture[:, 2] - texture[:, 0]
    gradient = du[:, :, None] * d1[:, None, :] + dv[:, :, None] * d2[:, None, :]
    constant = texture[:, 0] - (gradient * a[:, None, :]).sum(axis=2)
    unit = normal / np.sqrt(squared)
    stretch = np.sqrt(np.abs(du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]) / np.sqrt(squared[:, 0]))
    shift = (mesh.instance[:, None].astype(np.int64) * [7919, 104729]) % 1009 / 1009.0 * 11.3
    return Surface(
        np.column_stack([unit, (unit * a).sum(axis=1)]).astype(np.float32),
        np.concatenate([gradient, constant[:, :, None]], axis=2).astype(np.float32),
        (stretch * SIZE / atlas.metres[mesh.material]).astype(np.float32),
        shift.astype(np.float32),
        mesh.material,
        mesh.tint,
    )


class Window:
    """The scene within ``reach_m`` along x of wherever the sensors are; rebuilt as they walk on."""

    def __init__(self, world: World, reach_m: float) -> None:
        self.world = world
        self.reach_m = reach_m
        self._blocks: dict[int, WorldMesh] = {}
        self._shown = range(0)
        self._scene: Scene | None = None

    def at(self, x: float) -> Scene:
        """Scene around ``x``; the same object as long as the same blocks are in reach."""
        wanted = self.world.blocks_near(x, self.reach_m)
        if self._scene is None or wanted != self._shown:
            self._blocks = {k: self._blocks[k] if k in self._blocks else self.world.build_block(k) for k in wanted}  # fmt: skip
            self._scene = prepare(joined([self._blocks[k] for k in wanted]), self.world.atlas)
            self._shown = wanted
        return self._scene
