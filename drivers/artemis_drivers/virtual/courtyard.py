"""A courtyard between four houses: lawn with hedges and statues, benches with people, a terrace with steps.

x and y run along the walls from the corner (0, 0), the ground is z = 0. The walk goes round and round on the
paved ring between lawn and walls.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from artemis_drivers.virtual import furniture
from artemis_drivers.virtual.building import add_house
from artemis_drivers.virtual.cyclist import add_bicycle
from artemis_drivers.virtual.interior import (
    RISER_M,
    TREAD_M,
    add_chair,
    add_poster,
    add_railing,
    add_steps,
    add_table,
    any_colour,
    wall_paint,
)
from artemis_drivers.virtual.mesh_builder import F64, MeshBuilder, WorldMesh
from artemis_drivers.virtual.movers import add_walker
from artemis_drivers.virtual.person import add_backpack, add_person, add_sitting_person, add_statue
from artemis_drivers.virtual.route import laps, rounded_loop
from artemis_drivers.virtual.shapes import box, pose, solid
from artemis_drivers.virtual.textures import INDOORS, ROADS, TextureAtlas, build_atlas
from artemis_drivers.virtual.tree import add_hedge, add_tree
from artemis_drivers.virtual.world import Mover, World, random_sun

Rng = np.random.Generator
_NOT_HERE = (*INDOORS, *ROADS)  # materials that are not drawn
EYE_M = 1.45
_RING = (3.0, 6.6)  # metres from the walls that the paved ring covers
_WALK, _OTHERS = 5.3, 3.9  # where the walker goes, and where the others go
_TERRACE = 3.6  # depth of the terrace in front of the wall x = 0
_STEPS = 3
_MOVERS_AT = 1_000_000  # first instance number of what moves
_OTHERS_SPEED = 0.7  # m/s: for how long the others must keep walking


@dataclass(frozen=True, slots=True)
class _Yard:
    """Sizes, metres."""

    long: float
    wide: float

    @property
    def west(self) -> float:
        """Where the terrace's steps end."""
        return _TERRACE + _STEPS * TREAD_M

    def ring(self, inset: float, radius: float) -> F64:
        """Closed line at a distance from the walls (and from the steps)."""
        x0, x1, y0, y1 = self.west + inset - 2.0, self.long - inset, inset, self.wide - inset
        corners = np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]], np.float64)
        middle = np.array([[(x0 + x1) / 2, y0, 0]])
        return rounded_loop(np.concatenate([middle, corners[1:], corners[:1]]), radius)


def build(seed: int, length: float = 100.0, atlas: TextureAtlas | None = None) -> World:
    """A courtyard whose path is at least ``length`` metres long (whole laps)."""
    rng = np.random.default_rng([seed, 1])
    yard = _Yard(float(rng.uniform(31, 38)), float(rng.uniform(23, 28)))
    sun = random_sun(rng)
    atlas = build_atlas(seed, _NOT_HERE) if atlas is None else atlas
    loop = yard.ring(_WALK, 2.5)
    if rng.random() < 0.5:
        loop = loop[::-1]
    return World(
        name="courtyard",
        seed=seed,
        block_edges=np.array([0.0, yard.long]),
        build_block=lambda _: _build(yard, atlas, seed),
        path=laps(loop, length) + np.array([0.0, 0.0, EYE_M]),
        sun=sun,
        atlas=atlas,
        movers=_movers(yard, atlas, seed, length),
        looks_at=_sights(yard),
    )


def _sights(yard: _Yard) -> F64:
    """The statue in the middle, the terrace, and the fronts."""
    middle = ((yard.west + yard.long) / 2, yard.wide / 2, 1.5)
    rim = [(x, y, 1.0) for x in (yard.long * 0.4, yard.long * 0.75) for y in (1.5, yard.wide - 1.5)]
    fronts = [(yard.long, yard.wide / 2, 5.0), (0.0, yard.wide / 2, 5.0)]
    return np.array([middle, (1.9, yard.wide / 2, 1.2), *rim, *fronts])


def _build(yard: _Yard, atlas: TextureAtlas, seed: int) -> WorldMesh:
    rng = np.random.default_rng([seed, 2])
    builder = MeshBuilder(atlas.index)
    _add_ground(builder, yard, rng)
    _add_houses(builder, yard, rng)
    _add_terrace(builder, yard, rng)
    _add_lawn(builder, yard, rng)
    _add_rim(builder, yard, rng)
    return builder.build()


def _sheet(x: tuple[float, float], y: tuple[float, float], z: float = 0.0) -> F64:
    return np.array([[x[0], y[0], z], [x[1], y[0], z], [x[1], y[1], z], [x[0], y[1], z]])


def _add_ground(builder: MeshBuilder, yard: _Yard, rng: Rng) -> None:
    """Frames of different paving around the lawn; each is an upper side only."""
    outer, inner = _RING
    lines_x = [
        -0.5,
        yard.west + outer - 2.0,
        yard.west + inner - 2.0,
        yard.long - inner,
        yard.long - outer,
        yard.long + 0.5,
    ]
    lines_y = [-0.5, outer, inner, yard.wide - inner, yard.wide - outer, yard.wide + 0.5]
    materials = rng.permutation(["cobbles", "paving", "gravel"])
    tints = [wall_paint(rng) for _ in range(3)]
    ways = (str(materials[0]), str(materials[1]), str(rng.choice(["grass", "grass", "gravel"])))
    builder.begin("ground")
    for i in range(5):
        for k in range(5):
            depth = min(i, k, 4 - i, 4 - k)
            cell = _sheet((lines_x[i], lines_x[i + 1]), (lines_y[k], lines_y[k + 1]))
            shape = solid(cell, np.array([(0, 1, 2), (0, 2, 3)], np.int32))
            builder.add(shape, ways[depth], tints[depth])


def _add_houses(builder: MeshBuilder, yard: _Yard, rng: Rng) -> None:
    """Fronts on all four sides; local -y of a house looks into the yard."""
    for side, long in ((0, yard.long), (1, yard.wide), (2, yard.long), (3, yard.wide)):
        shares = rng.uniform(0.7, 1.3, int(rng.integers(2, 4)))
        at = np.concatenate([[0.0], np.cumsum(shares) / shares.sum() * long])
        for a, b in itertools.pairwise(at):
            T = (
                pose(b, 0, 0, np.pi),
                pose(yard.long, b, 0, -np.pi / 2),
                pose(a, yard.wide, 0),
                pose(0, a, 0, np.pi / 2),
            )[side]
            add_house(builder, rng, T @ pose(z=0.02), float(b - a), 8.0)


def _add_terrace(builder: MeshBuilder, yard: _Yard, rng: Rng) -> None:
    """Raised floor along the wall x = 0 with steps, railing, statues and a café."""
    high = _STEPS * RISER_M
    builder.begin("ground")
    top = box((-0.3, 1.2, -0.3), (_TERRACE, yard.wide - 1.2, high))
    builder.add(top, str(rng.choice(["paving", "terrazzo"])), wall_paint(rng))
    wide = yard.wide * rng.uniform(0.25, 0.4)
    y0 = rng.uniform(2.5, yard.wide - 2.5 - wide)
    stair = pose(yard.west, y0 + wide, 0, np.pi)
    add_steps(builder, rng, stair, _STEPS, wide, str(rng.choice(["stone", "concrete", "marble"])))
    paint = any_colour(rng, 0.15, 0.8)
    for a, b in ((1.3, y0), (y0 + wide, yard.wide - 1.3)):
        foot = np.array([[_TERRACE - 0.08, a, high], [_TERRACE - 0.08, b, high]])
        add_railing(builder, paint, foot)
    for y in np.linspace(2.6, yard.wide - 2.6, 4) + rng.uniform(-0.4, 0.4, 4):
        if rng.random() < 0.3:
            add_statue(builder, rng, pose(1.9, y, high, rng.normal(0, 0.4)))
        else:
            _add_cafe(builder, rng, pose(1.9, y, high))


def _add_cafe(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    add_table(builder, rng, T)
    for angle in rng.uniform(0, 2 * np.pi) + np.arange(3) * 2.1:
        # chairs look at the table
        T_chair = T @ pose(0.72 * np.cos(angle), 0.72 * np.sin(angle), 0, angle + np.pi)
        add_chair(builder, rng, T_chair)
        if rng.random() < 0.3:
            add_sitting_person(builder, rng, T_chair @ pose(-0.02), 0.46)


def _add_lawn(builder: MeshBuilder, yard: _Yard, rng: Rng) -> None:
    """Hedges with gaps around the lawn, a statue in its middle, trees and persons."""
    inset = _RING[1] + 0.45
    x0, x1, y0, y1 = yard.west + inset - 2.0, yard.long - inset, inset, yard.wide - inset
    tint = any_colour(rng, 0.5, 1.0)
    for y in (y0, y1):
        for a, b in ((x0, (x0 + x1) / 2 - 1.2), ((x0 + x1) / 2 + 1.2, x1)):
            add_hedge(builder, rng, pose(a, y), b - a, tint)
    for x in (x0, x1):
        add_hedge(builder, rng, pose(x, y0 + 0.5, yaw=np.pi / 2), (y1 - y0) / 2 - 1.5, tint)
        add_hedge(builder, rng, pose(x, (y0 + y1) / 2 + 1.0, yaw=np.pi / 2), (y1 - y0) / 2 - 1.5, tint)
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    add_statue(builder, rng, pose(middle[0], middle[1], yaw=rng.uniform(0, 2 * np.pi)))
    places = [(x, y) for x in np.linspace(x0 + 1.6, x1 - 1.6, 4) for y in (y0 + 1.6, y1 - 1.6)]
    kinds = rng.permutation(["tree", "tree", "tree", "tree", "statue", "person", "bin", "none"])
    for (x, y), kind in zip(places, kinds, strict=True):
        T = pose(x + rng.uniform(-0.5, 0.5), y + rng.uniform(-0.4, 0.4), 0, rng.uniform(0, 2 * np.pi))
        if kind == "tree":
            add_tree(builder, rng, T)
        elif kind == "statue":
            add_statue(builder, rng, T)
        elif kind == "person":
            add_person(builder, rng, T)
        elif kind == "bin":
            furniture.add_bin(builder, rng, T)


def _add_rim(builder: MeshBuilder, yard: _Yard, rng: Rng) -> None:
    """Things along the three walls without terrace; local -y looks into the yard."""
    first = yard.west + 1.6
    spots = [pose(x, 1.5, 0, np.pi) for x in np.arange(first, yard.long - 3.0, 2.7)]
    spots += [pose(x, yard.wide - 1.5) for x in np.arange(first, yard.long - 3.0, 2.7)]
    spots += [pose(yard.long - 1.5, y, 0, -np.pi / 2) for y in np.arange(3.6, yard.wide - 3.0, 2.7)]
    order = rng.permutation(len(spots))
    # the bench on which a person sits with a backpack beside is in every yard
    kinds = ["seat", "seat", "bench", "bicycles", "planter", "lamp", "person", "boxes", "bin", "cafe"]
    kinds += ["bicycles", "hedge", "statue", "poster", "cabinet", "person", "planter", "tree"]
    chosen = [*kinds[:10], *rng.choice(kinds, max(len(spots) - 10, 0))]
    for k, kind in zip(order, chosen, strict=False):
        T = spots[k] @ pose(rng.uniform(-0.3, 0.3), rng.uniform(-0.1, 0.3))
        _add_thing(builder, rng, str(kind), T)


def _add_thing(builder: MeshBuilder, rng: Rng, kind: str, T: F64) -> None:
    turned = T @ pose(yaw=rng.uniform(0, 2 * np.pi))
    if kind in ("seat", "bench"):
        add_seat(builder, rng, T, taken=kind == "seat")
    elif kind == "bicycles":
        for x in (-0.9, -0.3, 0.35):
            lean = pose(x, 0, 0, np.pi / 2 + rng.normal(0, 0.1)) @ pose(roll=rng.normal(0, 0.06))
            add_bicycle(builder, rng, T @ lean)
    elif kind == "planter":
        furniture.add_planter(builder, rng, T)
    elif kind == "lamp":
        furniture.add_lamp(builder, rng, T @ pose(yaw=-np.pi / 2))
    elif kind == "person":
        add_person(builder, rng, turned)
    elif kind == "boxes":
        furniture.add_boxes(builder, rng, T @ pose(-0.6, 0.5))
    elif kind == "bin":
        furniture.add_bin(builder, rng, turned)
    elif kind == "cafe":
        _add_cafe(builder, rng, T @ pose(y=0.1))
    elif kind == "hedge":
        add_hedge(builder, rng, T @ pose(-1.0, 0.2), 2.0)
    elif kind == "statue":
        add_statue(builder, rng, T @ pose(yaw=-np.pi / 2))
    elif kind == "poster":
        # a board on two legs, so that it does not hang before a window
        builder.begin("pole")
        for x in (0.1, 0.5):
            builder.add(box((x, 0.0, -0.3), (x + 0.05, 0.04, 0.9)), "wood", (0.6, 0.5, 0.4), T)
        add_poster(builder, rng, T @ pose(z=0.7))
    elif kind == "tree":
        add_tree(builder, rng, turned)
    else:
        furniture.add_cabinet(builder, rng, T @ pose(y=0.5))


def add_seat(builder: MeshBuilder, rng: Rng, T: F64, taken: bool) -> None:
    """Bench along x facing -y; ``taken``: a person sits on it with a backpack that touches both."""
    furniture.add_bench(builder, rng, T)
    if not taken:
        return
    facing, side = -np.pi / 2, float(rng.choice([-1.0, 1.0]))
    add_sitting_person(builder, rng, T @ pose(-0.2 * side, 0.02, yaw=facing), furniture.SEAT_M)
    # 0.33 m away: half the trunk, an elbow and half the backpack
    add_backpack(builder, rng, T @ pose(0.16 * side, 0.0, furniture.SEAT_M, yaw=facing + rng.normal(0, 0.1)))
    if rng.random() < 0.5:
        add_backpack(builder, rng, T @ pose(0.75 * side, -0.33, 0.0, yaw=facing))


def _movers(yard: _Yard, atlas: TextureAtlas, seed: int, length: float) -> tuple[Mover, ...]:
    """Two people who walk round in opposite directions."""
    rng = np.random.default_rng([seed, 3])
    duration = length / _OTHERS_SPEED + 60.0
    loop = yard.ring(_OTHERS, 2.0)
    movers: list[Mover] = []
    for k, line in enumerate((loop, loop[::-1])):
        movers += add_walker(atlas, rng, _MOVERS_AT + k, line, duration, rng.uniform(0, 60))
    return tuple(movers)
