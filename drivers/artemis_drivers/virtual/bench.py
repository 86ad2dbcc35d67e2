"""A small square for things that touch: a person sits on a bench, a backpack leans between person and armrest.

The bench stands at (0, 0) along x and is sat on facing -y; the ground is z = 0. The walk comes towards it from
the front, goes round it at two to three metres and back. Fronts of houses on two sides, trees and hedges on the
others; a second bench, a standing person and a bin, so that the classes are not to be told by their number.
"""

from __future__ import annotations

import numpy as np

from artemis_drivers.virtual import furniture
from artemis_drivers.virtual.building import add_house
from artemis_drivers.virtual.courtyard import add_seat
from artemis_drivers.virtual.interior import any_colour, wall_paint
from artemis_drivers.virtual.mesh_builder import F64, MeshBuilder, WorldMesh
from artemis_drivers.virtual.person import add_backpack, add_person
from artemis_drivers.virtual.route import laps, rounded_loop
from artemis_drivers.virtual.shapes import pose, solid
from artemis_drivers.virtual.textures import INDOORS, ROADS, TextureAtlas, build_atlas
from artemis_drivers.virtual.tree import add_hedge, add_tree
from artemis_drivers.virtual.world import World, random_sun

Rng = np.random.Generator
EYE_M = 1.45
_NOT_HERE = (*INDOORS, *ROADS)  # materials that are not drawn
_LOW, _HIGH = np.array([-12.0, -9.0]), np.array([8.0, 6.0])  # corners of the square, metres
_PLAZA = np.array([-8.0, -5.5]), np.array([4.5, 4.0])  # of its middle, paved otherwise
_RADIUS_M = 1.3  # of the corners of the walk
#: The walk: begins far in front of the bench, to its left, and is not nearer than 1.8 m to it.
_CORNERS = np.array(
    [
        [-6.6, -2.6, 0],
        [-3.2, -2.9, 0],
        [0.6, -2.6, 0],
        [3.2, -1.6, 0],
        [2.9, 2.1, 0],
        [-2.6, 2.4, 0],
        [-6.2, 0.4, 0],
    ]
)


def build(seed: int, length: float = 100.0, atlas: TextureAtlas | None = None) -> World:
    """A square whose path is at least ``length`` metres long (whole laps)."""
    rng = np.random.default_rng([seed, 1])
    sun = random_sun(rng)
    atlas = build_atlas(seed, _NOT_HERE) if atlas is None else atlas
    return World(
        name="bench",
        seed=seed,
        block_edges=np.array([_LOW[0], _HIGH[0]]),
        build_block=lambda _: _build(atlas, seed),
        path=laps(rounded_loop(_CORNERS, _RADIUS_M), length) + np.array([0.0, 0.0, EYE_M]),
        sun=sun,
        atlas=atlas,
        looks_at=np.array([[-0.2, 0.0, 0.8], [0.2, 0.0, 0.6]]),
    )


def _build(atlas: TextureAtlas, seed: int) -> WorldMesh:
    rng = np.random.default_rng([seed, 2])
    builder = MeshBuilder(atlas.index)
    _add_ground(builder, rng)
    _add_houses(builder, rng)
    add_seat(builder, rng, pose(), taken=True)
    _add_surroundings(builder, rng)
    return builder.build()


def _add_ground(builder: MeshBuilder, rng: Rng) -> None:
    """A paved middle within a frame; an upper side only."""
    inner, outer = (str(m) for m in rng.choice(["cobbles", "paving", "gravel", "grass"], 2, replace=False))
    tints = wall_paint(rng), wall_paint(rng)
    xs, ys = ([_LOW[a] - 0.5, _PLAZA[0][a], _PLAZA[1][a], _HIGH[a] + 0.5] for a in (0, 1))
    builder.begin("ground")
    for i in range(3):
        for k in range(3):
            corners = [
                [xs[i], ys[k], 0],
                [xs[i + 1], ys[k], 0],
                [xs[i + 1], ys[k + 1], 0],
                [xs[i], ys[k + 1], 0],
            ]
            cell = solid(np.array(corners), np.array([(0, 1, 2), (0, 2, 3)], np.int32))
            middle = i == 1 and k == 1
            builder.add(cell, inner if middle else outer, tints[0] if middle else tints[1])


def _add_houses(builder: MeshBuilder, rng: Rng) -> None:
    """Fronts behind the bench and to its right; local -y of a house looks into the square."""
    split = rng.uniform(0.35, 0.65) * (_HIGH[0] - _LOW[0]) + _LOW[0]
    add_house(builder, rng, pose(_LOW[0], _HIGH[1], 0.02), float(split - _LOW[0]), 8.0)
    add_house(builder, rng, pose(split, _HIGH[1], 0.02), float(_HIGH[0] - split), 8.0)
    add_house(builder, rng, pose(_HIGH[0], _HIGH[1], 0.02, -np.pi / 2), float(_HIGH[1] - _LOW[1]), 8.0)


def _add_surroundings(builder: MeshBuilder, rng: Rng) -> None:
    """Along the rims of the square, out of the walk's way."""
    tint = any_colour(rng, 0.5, 1.0)
    add_hedge(builder, rng, pose(_LOW[0] + 0.6, _LOW[1] + 1.0, yaw=np.pi / 2), 9.0, tint)
    add_hedge(builder, rng, pose(_LOW[0] + 2.5, _LOW[1] + 0.7), 12.0, tint)
    spots = [pose(x, 4.6) for x in (-8.5, -5.5, -2.5, 1.0, 4.0)]
    spots += [pose(6.4, y, yaw=-np.pi / 2) for y in (-6.0, -3.0, 0.5)]
    spots += [pose(x, -6.6, yaw=np.pi) for x in (-8.0, -4.5, -1.0, 2.5)]
    kinds = [
        "seat",
        "bench",
        "person",
        "person",
        "tree",
        "tree",
        "tree",
        "bin",
        "planter",
        "lamp",
        "backpack",
        "none",
    ]
    for T, kind in zip(spots, rng.permutation(kinds), strict=True):
        _add_thing(builder, rng, str(kind), T @ pose(rng.uniform(-0.4, 0.4), rng.uniform(-0.3, 0.3)))


def _add_thing(builder: MeshBuilder, rng: Rng, kind: str, T: F64) -> None:
    turned = T @ pose(yaw=rng.uniform(0, 2 * np.pi))
    if kind in ("seat", "bench"):
        add_seat(builder, rng, T, taken=kind == "seat")
    elif kind == "person":
        add_person(builder, rng, turned)
    elif kind == "tree":
        add_tree(builder, rng, turned)
    elif kind == "bin":
        furniture.add_bin(builder, rng, turned)
    elif kind == "planter":
        furniture.add_planter(builder, rng, T)
    elif kind == "lamp":
        furniture.add_lamp(builder, rng, T @ pose(yaw=-np.pi / 2))
    elif kind == "backpack":
        add_backpack(builder, rng, turned)
