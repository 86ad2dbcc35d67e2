"""A virtual world: what every street, yard or hall offers to the virtual sensors.

A world is cut into blocks along its walkable path. A block is built from the seed and its number alone, so
that a walk of twenty minutes through ever new places needs only the blocks around the sensor in memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from artemis_drivers.virtual.mesh_builder import CLASS_NAMES, F64, WorldMesh, joined
from artemis_drivers.virtual.motion import Motion
from artemis_drivers.virtual.textures import TextureAtlas


@dataclass(frozen=True, slots=True)
class Mover:
    """Something that moves through the world as one rigid body.

    ``mesh`` in the body's own frame, metres (x ahead, z up, on the ground at z = 0); ``motion`` gives
    T_world_mover over time. Times beyond the motion's ends stand for its ends.
    """

    mesh: WorldMesh
    motion: Motion


@dataclass(frozen=True, slots=True)
class World:
    """A seeded world.

    ``block_edges`` float64 (blocks + 1,): block k covers x in ``block_edges[k]..block_edges[k + 1]`` metres;
    ``build_block(k)`` makes its triangles; ``sun`` unit vector towards the sun; ``movers`` are in no block.

    ``path`` float64 (n, 3), metres, is the line a walker's eyes follow: points at most 0.5 m apart, nothing
    but movers within 0.3 m of it. It may climb stairs (z changes). ``looks_at`` float64 (m, 3) are places
    worth a look; there may be none. ``notes`` are sentences that the user should read: what of a loaded file
    could not be taken as it is.
    """

    name: str
    seed: int
    block_edges: F64
    build_block: Callable[[int], WorldMesh]
    path: F64
    sun: F64
    atlas: TextureAtlas
    class_names: tuple[str, ...] = CLASS_NAMES
    movers: tuple[Mover, ...] = ()
    notes: tuple[str, ...] = ()
    looks_at: F64 = field(default_factory=lambda: np.empty((0, 3)))

    @property
    def block_count(self) -> int:
        """Number of blocks."""
        return len(self.block_edges) - 1

    def blocks_near(self, x: float, reach_m: float) -> range:
        """Numbers of the blocks that have a part within ``reach_m`` of ``x``."""
        first = min(int(np.searchsorted(self.block_edges[1:], x - reach_m)), self.block_count - 1)
        last = int(np.searchsorted(self.block_edges[:-1], x + reach_m, side="left"))
        return range(first, max(last, first + 1))

    def mesh(self, blocks: range | None = None) -> WorldMesh:
        """Triangles of the given blocks (all without)."""
        return joined([self.build_block(k) for k in (range(self.block_count) if blocks is None else blocks)])


def random_sun(rng: np.random.Generator) -> F64:
    """Unit vector towards a sun 30 to 65 degrees high."""
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(30, 65))
    across = np.cos(elevation)
    return np.array([np.cos(azimuth) * across, np.sin(azimuth) * across, np.sin(elevation)])
