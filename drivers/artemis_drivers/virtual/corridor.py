"""Worlds that starve a registration: a long bare corridor, and a flat facade at two metres."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from artemis_drivers.virtual.building import fitted_panel
from artemis_drivers.virtual.interior import wall_paint
from artemis_drivers.virtual.mesh_builder import F64, Colour, MeshBuilder, Shape, WorldMesh
from artemis_drivers.virtual.shapes import box, panel, pose, solid
from artemis_drivers.virtual.textures import HOUSES, INDOORS, PRINTS, ROADS, TextureAtlas, build_atlas
from artemis_drivers.virtual.world import World, random_sun

EYE_M = 1.45
_THINGS = (
    "wood",
    "door",
    "metal",
    "cloth",
    "bark",
    "car_paint",
    "stripes",
    "check",
    "cardboard",
)  # not drawn here
BLOCK_M = 40.0
FACADE_M = 2.0  # distance of the facade from the walker's line
_MARGIN_M = 6.0  # the path keeps this far from the ends
_INSTANCES_PER_BLOCK = 256
_FIELD_M = 2.0  # size of what is painted on the facade
_WALL_M = 0.3
_SHEET_Y = 60.0  # how far the ground before the facade reaches


def _straight(length_m: float) -> F64:
    x = np.arange(_MARGIN_M, length_m - _MARGIN_M + 1e-9, 0.25)
    return np.column_stack([x, np.zeros_like(x), np.full_like(x, EYE_M)])


def _long_world(
    name: str,
    seed: int,
    length: float,
    sun: F64,
    atlas: TextureAtlas,
    build_block: Callable[[int, int], WorldMesh],
) -> World:
    """World of as many blocks as the path needs; ``build_block(number, blocks in all)``."""
    blocks = max(int(np.ceil((length + 2 * _MARGIN_M) / BLOCK_M)), 2)
    return World(
        name=name,
        seed=seed,
        block_edges=np.arange(blocks + 1, dtype=np.float64) * BLOCK_M,
        build_block=lambda k: build_block(k, blocks),
        path=_straight(blocks * BLOCK_M),
        sun=sun,
        atlas=atlas,
    )


def build_corridor(seed: int, length: float = 100.0, atlas: TextureAtlas | None = None) -> World:
    """A straight corridor without any door, window or step: nothing tells where along it one is but its ends."""
    rng = np.random.default_rng([seed, 1])
    wide, high = float(rng.uniform(1.9, 2.6)), float(rng.uniform(2.4, 2.9))
    floor, sides, top = wall_paint(rng), wall_paint(rng), wall_paint(rng)
    floor_of = str(rng.choice(["lino", "terrazzo"]))
    atlas = build_atlas(seed, (*ROADS, *HOUSES, *_THINGS)) if atlas is None else atlas

    def block(k: int, blocks: int) -> WorldMesh:
        builder = MeshBuilder(atlas.index, k * _INSTANCES_PER_BLOCK)
        a, b = k * BLOCK_M, (k + 1) * BLOCK_M
        builder.begin("ground")
        builder.add(box((a, -wide / 2, -0.2), (b, wide / 2, 0.0)), floor_of, floor)
        builder.begin("building")
        for side in (-1.0, 1.0):
            y = sorted((side * wide / 2, side * (wide / 2 + 0.2)))
            builder.add(box((a, y[0], -0.2), (b, y[1], high + 0.2)), "bare", sides)
        builder.add(box((a, -wide / 2, high), (b, wide / 2, high + 0.2)), "bare", top)
        for x in [-0.2] * (k == 0) + [b] * (k == blocks - 1):
            builder.add(box((x, -wide / 2, 0), (x + 0.2, wide / 2, high)), "bare", sides)
        return builder.build()

    return _long_world("corridor", seed, length, random_sun(rng), atlas, block)


def build_facade(seed: int, length: float = 100.0, atlas: TextureAtlas | None = None) -> World:
    """A flat wall two metres beside the path, painted all over; windows and posters are painted on, too."""
    rng = np.random.default_rng([seed, 1])
    high = float(rng.uniform(8, 12))
    material, ground = (
        str(rng.choice(["brick_a", "plaster_a", "stone"])),
        str(rng.choice(["paving", "asphalt"])),
    )
    wall_tint, ground_tint = wall_paint(rng), wall_paint(rng)
    # the sun stands before the wall, not along it
    azimuth, elevation = rng.uniform(-2.3, -0.8), np.radians(rng.uniform(25, 50))
    across = np.cos(elevation)
    sun = np.array([np.cos(azimuth) * across, np.sin(azimuth) * across, np.sin(elevation)])
    atlas = build_atlas(seed, (*INDOORS, *HOUSES, *_THINGS)) if atlas is None else atlas

    def block(k: int, blocks: int) -> WorldMesh:
        del blocks
        builder = MeshBuilder(atlas.index, k * _INSTANCES_PER_BLOCK)
        a, b = k * BLOCK_M, (k + 1) * BLOCK_M
        builder.begin("ground")
        corners = np.array(
            [[a, -_SHEET_Y, 0], [b, -_SHEET_Y, 0], [b, FACADE_M + 0.1, 0], [a, FACADE_M + 0.1, 0]]
        )
        builder.add(solid(corners, np.array([(0, 1, 2), (0, 2, 3)], np.int32)), ground, ground_tint)
        _add_painted_wall(builder, np.random.default_rng([seed, 2, k]), (a, b), high, material, wall_tint)
        return builder.build()

    return _long_world("facade", seed, length, sun, atlas, block)


def _add_painted_wall(
    builder: MeshBuilder,
    rng: np.random.Generator,
    x: tuple[float, float],
    high: float,
    material: str,
    tint: Colour,
) -> None:
    """Wall in fields side by side, some of which show a poster: one plane, front at y = FACADE_M."""
    builder.begin("building")
    fields = np.arange(x[0], x[1] - 1e-9, _FIELD_M)
    painted = rng.random(len(fields)) < 0.4
    for low, top in ((0.0, 0.8), (0.8 + _FIELD_M, high)):
        builder.add(_strip(x[0], x[1] - x[0], low, top), material, tint)
    for left, is_painted in zip(fields, painted, strict=True):
        if is_painted:
            picture = fitted_panel(_FIELD_M, _FIELD_M, _WALL_M)
            of = f"poster_{rng.integers(PRINTS)}"
            builder.add(picture, (of, material), (1, 1, 1), pose(left, FACADE_M, 0.8))
        else:
            builder.add(_strip(float(left), _FIELD_M, 0.8, 0.8 + _FIELD_M), material, tint)


def _strip(left: float, wide: float, low: float, top: float) -> Shape:
    """Part of the facade whose texture goes on across its rims."""
    board = panel(wide, top - low, _WALL_M).moved(pose(left, FACADE_M, low))
    return Shape(board.vertices, board.triangles, board.uv + np.array([left, low]), board.part)
