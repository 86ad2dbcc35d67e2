"""A town street, metre-true and seeded: road, kerbs, pavements, houses, parked cars and what stands around.

x runs along the street, y = 0 is the middle of the road, z up. The street is made of blocks of BLOCK_M metres
that follow from (seed, number), so that it can be as long as a walk needs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from artemis_drivers.virtual import furniture
from artemis_drivers.virtual.building import add_gate_wall, add_house
from artemis_drivers.virtual.car import add_car
from artemis_drivers.virtual.cyclist import add_bicycle
from artemis_drivers.virtual.mesh_builder import F64, MeshBuilder, Shape, WorldMesh
from artemis_drivers.virtual.movers import add_rider, add_walker, vehicle
from artemis_drivers.virtual.person import add_backpack, add_person, add_sitting_person
from artemis_drivers.virtual.shapes import pose, solid
from artemis_drivers.virtual.textures import INDOORS, TextureAtlas, build_atlas
from artemis_drivers.virtual.tree import add_hedge, add_tree
from artemis_drivers.virtual.world import Mover, World, random_sun

Rng = np.random.Generator
_NOT_HERE = (*INDOORS, "poster_", "terrazzo", "grass", "gravel", "marble")  # materials that are not drawn
BLOCK_M = 40.0
STATION_M = 1.0  # spacing of the ground's cross sections
KERB_M = 0.12  # height of the kerb
_PARKING_M = 2.1
EYE_M = 1.45  # height at which the rig is held
INSTANCES_PER_BLOCK = 4096
HOUSE_DEPTH_M = 9.0
SLOW_WALK, _USUAL_WALK = 0.8, 1.1  # m/s: for how long the world must keep moving, and when cars come by
_MOST_VEHICLES, _MOST_WALKERS = 6, 6
_QUEUE_M = 7.0  # from car to car where they wait
END_MARGIN_M = 8.0  # the path keeps this far from the ends of the street


@dataclass(frozen=True, slots=True)
class _Layout:
    """What all blocks of a street share."""

    seed: int
    length: float
    road: float  # half width of the road
    pavement: float
    wave: tuple[float, float, float]  # long waves of the ground: amplitude, length, phase
    tints: tuple[tuple[float, float, float], ...]  # road, pavement, kerb, gutter

    @property
    def front(self) -> float:
        """Distance of the house fronts from the middle."""
        return self.road + 0.15 + self.pavement

    def level(self, x: float | F64) -> F64:
        """Height of the middle of the road at ``x``."""
        amplitude, wavelength, phase = self.wave
        x = np.asarray(x, np.float64)
        slow = np.sin(2 * np.pi * x / wavelength + phase)
        return amplitude * (slow + 0.3 * np.sin(2 * np.pi * x / 17.3 + 2 * phase))

    def ground(self, x: float, y: float) -> float:
        """Height of the ground, kerb included."""
        side, height = self.section()
        return float(self.level(x) + np.interp(abs(y), side, height))

    def section(self) -> tuple[F64, F64]:
        """Half cross section: distances from the middle and heights above the middle of the road."""
        crown = 0.02 * self.road  # 2 % fall towards the gutter
        kerb = self.road + 0.15
        y = [
            0.0,
            0.06,
            self.road - 2.1,
            self.road - 0.25,
            self.road,
            self.road + 0.012,
            kerb,
            self.front,
            self.front + 12,
        ]
        gutter = -crown
        top = gutter + KERB_M
        fall = 0.015 * self.pavement
        z = [
            0.0,
            -0.001,
            -crown * 0.5,
            gutter + 0.01,
            gutter,
            top,
            top + 0.003,
            top + fall,
            top + fall + 0.02,
        ]
        return np.array(y), np.array(z)


def build(seed: int, length: float = 100.0, atlas: TextureAtlas | None = None) -> World:
    """A street of at least ``length`` metres (whole blocks); the seed decides layout, sizes and colours."""
    blocks = max(int(np.ceil(length / BLOCK_M)), 2)
    rng = np.random.default_rng([seed, 1])
    layout = _Layout(
        seed=seed,
        length=blocks * BLOCK_M,
        road=float(rng.uniform(5.0, 5.8)),
        pavement=float(rng.uniform(2.4, 3.4)),
        wave=(float(rng.uniform(0.05, 0.25)), float(rng.uniform(45, 80)), float(rng.uniform(0, 2 * np.pi))),
        tints=tuple(
            tuple((rng.uniform(0.85, 1.1) * np.array(c)).tolist())
            for c in ((1, 1, 1), (0.85, 0.82, 0.78), (0.95, 0.95, 0.93), (0.55, 0.54, 0.53))
        ),
    )
    atlas = build_atlas(seed, _NOT_HERE) if atlas is None else atlas
    return World(
        name="street",
        seed=seed,
        block_edges=np.arange(blocks + 1, dtype=np.float64) * BLOCK_M,
        build_block=lambda k: _block(layout, atlas, k, blocks),
        path=_path(layout, rng),
        sun=random_sun(rng),
        atlas=atlas,
        movers=_movers(layout, atlas, blocks),
    )


def _path(layout: _Layout, rng: Rng) -> F64:
    """The walker keeps to the right half of the road, in part of which cars drive, and drifts from side to side."""
    x = np.arange(END_MARGIN_M, layout.length - END_MARGIN_M, 0.4)
    phase = rng.uniform(0, 2 * np.pi, 2)
    drift = 0.6 * np.sin(2 * np.pi * x / 31.0 + phase[0]) + 0.3 * np.sin(2 * np.pi * x / 13.7 + phase[1])
    # from beside the parked cars, which take 2.1 m, to beside the driving ones
    outer, inner = layout.road - _PARKING_M - 0.6, 0.3
    y = -(outer + inner) / 2 + (outer - inner) / 2 * drift
    return np.column_stack([x, y, layout.level(x) + EYE_M])


def _block(layout: _Layout, atlas: TextureAtlas, number: int, blocks: int) -> WorldMesh:
    rng = np.random.default_rng([layout.seed, 2, number])
    builder = MeshBuilder(atlas.index, number * INSTANCES_PER_BLOCK)
    x0 = number * BLOCK_M
    _add_ground(builder, layout, x0)
    for side in (1.0, -1.0):
        _add_houses(builder, layout, rng, x0, side)
        _add_parked_cars(builder, layout, rng, x0, side)
        _add_furniture(builder, layout, rng, x0, side)
    if number == 0:
        _add_end(builder, layout, rng, 0.0, np.pi / 2)
    if number == blocks - 1:
        _add_end(builder, layout, rng, layout.length, -np.pi / 2)
    return builder.build()


def _strip(xs: F64, y: tuple[float, float], z: tuple[F64, F64], rows: NDArray[np.bool_]) -> Shape:
    """Sheet between two lines along the street, facing up (y ascending), only the chosen rows."""
    a = np.column_stack([xs, np.full(len(xs), y[0]), z[0]])
    b = np.column_stack([xs, np.full(len(xs), y[1]), z[1]])
    k = np.flatnonzero(rows)
    n = len(xs)
    quads = [np.stack([k, k + 1, k + 1 + n], -1), np.stack([k, k + 1 + n, k + n], -1)]
    return solid(np.concatenate([a, b]), np.stack(quads, axis=1).reshape(-1, 3).astype(np.int32))


def _add_ground(builder: MeshBuilder, layout: _Layout, x0: float) -> None:
    """The ground is a sheet over an endless solid: it has an upper side only."""
    xs = x0 + np.arange(0, BLOCK_M + STATION_M / 2, STATION_M)
    level = layout.level(xs)
    side, height = layout.section()
    materials = ["lane_paint", "asphalt", "asphalt", "cobbles", "kerbstone", "kerbstone", "paving", "paving"]
    tints = [0, 0, 0, 3, 2, 2, 1, 1]
    every = np.ones(len(xs) - 1, bool)
    dash = (np.floor((xs[:-1] + 0.5) / 3.0) % 2) == 0
    builder.begin("ground")
    for k, material in enumerate(materials):
        for sign in (1.0, -1.0):
            a, b = (k, k + 1) if sign > 0 else (k + 1, k)
            y = (sign * side[a], sign * side[b])
            z = (level + height[a], level + height[b])
            if material == "lane_paint":
                builder.add(_strip(xs, y, z, ~dash), "asphalt", layout.tints[0])
            rows = dash if material == "lane_paint" else every
            builder.add(_strip(xs, y, z, rows), material, layout.tints[tints[k]])


def _side_pose(layout: _Layout, x: float, y: float, side: float, yaw: float = 0.0) -> F64:
    """Pose on the ground at distance ``y`` from the middle; local -y looks to the road, whatever the side."""
    return pose(x, side * y, layout.ground(x, y), yaw + (0.0 if side > 0 else np.pi))


def _add_houses(builder: MeshBuilder, layout: _Layout, rng: Rng, x0: float, side: float) -> None:
    gap = rng.uniform(2.2, 3.2) if rng.random() < 0.6 else 0.0
    count = int(rng.integers(3, 5))
    shares = rng.uniform(0.8, 1.25, count)
    widths = shares / shares.sum() * (BLOCK_M - gap)
    gap_after = int(rng.integers(0, count))
    x = x0
    for k, width in enumerate(widths):
        setback = rng.uniform(0.0, 0.35)
        _place_front(builder, layout, rng, x, width, setback, side, add_house)
        x += width
        if k == gap_after and gap > 0:
            _place_front(builder, layout, rng, x, gap, 1.2, side, add_gate_wall)
            x += gap


def _place_front(
    builder: MeshBuilder,
    layout: _Layout,
    rng: Rng,
    x: float,
    width: float,
    setback: float,
    side: float,
    add: Callable[..., None],
) -> None:
    left = x if side > 0 else x + width
    y = layout.front + setback
    T = _side_pose(layout, left, y, side)
    T[2, 3] = min(layout.ground(x, y), layout.ground(x + width, y)) + 0.02
    if add is add_house:
        add_house(builder, rng, T, width, HOUSE_DEPTH_M)
    else:
        add(builder, rng, T, width)


def _add_end(builder: MeshBuilder, layout: _Layout, rng: Rng, x: float, yaw: float) -> None:
    """Houses across the end of the street; local -y must look back along it."""
    wide = 2 * layout.front / 2 + 3.0
    direction = 1.0 if yaw > 0 else -1.0
    for k in (-1.0, 0.0):
        T = pose(x - direction * 0.05, direction * k * wide, float(layout.level(x)), yaw)
        add_house(builder, rng, T, wide, HOUSE_DEPTH_M)


def _add_parked_cars(builder: MeshBuilder, layout: _Layout, rng: Rng, x0: float, side: float) -> None:
    x = x0 + rng.uniform(2.5, 5.0)
    while x < x0 + BLOCK_M - 2.6:
        if rng.random() < 0.62:
            y = layout.road - 1.05 - rng.uniform(0.0, 0.1)
            slope = float(layout.level(x + 1.3) - layout.level(x - 1.3)) / 2.6
            T = pose(x, side * y, layout.ground(x, y), rng.normal(0, 0.015), -np.arctan(slope))
            # right-hand traffic: cars on the +y side come towards us
            add_car(builder, rng, T @ pose(yaw=np.pi if side > 0 else 0.0))
        x += rng.uniform(5.6, 7.5)


_KINDS = (
    *("tree",) * 3,
    *("person",) * 2,
    *("bench",) * 2,
    *("bollard",) * 2,
    "lamp",
    "sign",
    "bin",
    "boxes",
    "cabinet",
    "bicycle",
    "planter",
    "hedge",
)


def _add_furniture(builder: MeshBuilder, layout: _Layout, rng: Rng, x0: float, side: float) -> None:
    """Things at the kerb and at the houses; a lane of 0.8 m between them is left to walkers."""
    count = len(_KINDS)
    slots = x0 + 1.4 + np.arange(count) * (BLOCK_M - 2.8) / (count - 1) + rng.uniform(-0.25, 0.25, count)
    for x, kind in zip(slots, rng.permutation(_KINDS), strict=True):
        _add_thing(builder, layout, rng, str(kind), float(x), side)


def _add_thing(builder: MeshBuilder, layout: _Layout, rng: Rng, kind: str, x: float, side: float) -> None:
    kerb, house = layout.road + 0.55, layout.front - 0.5
    yaw = rng.uniform(0, 2 * np.pi)

    def at(y: float, yaw: float = 0.0) -> F64:
        return _side_pose(layout, x, y, side, yaw)

    if kind == "tree":
        add_tree(builder, rng, at(kerb + 0.1, yaw))
    elif kind == "lamp":
        furniture.add_lamp(builder, rng, at(kerb - 0.15, -np.pi / 2))
    elif kind == "sign":
        # the front looks along the street, either way
        furniture.add_road_sign(builder, rng, at(kerb, 0.0 if rng.random() < 0.5 else np.pi))
    elif kind == "person":
        add_person(builder, rng, at(house + 0.1 if rng.random() < 0.5 else kerb, yaw))
    elif kind == "bench":
        _add_bench(builder, rng, at(house + 0.1))
    elif kind == "bin":
        furniture.add_bin(builder, rng, at(kerb + 0.05, yaw))
    elif kind == "boxes":
        furniture.add_boxes(builder, rng, at(house + 0.1))
    elif kind == "bollard":
        furniture.add_bollard(builder, rng, at(kerb - 0.2))
    elif kind == "bicycle":
        add_bicycle(builder, rng, at(house + 0.25, rng.normal(0, 0.06)) @ pose(roll=rng.normal(0, 0.05)))
    elif kind == "planter":
        furniture.add_planter(builder, rng, at(house))
    elif kind == "hedge":
        add_hedge(builder, rng, at(house + 0.2) @ pose(-1.1), 2.2)
    else:
        furniture.add_cabinet(builder, rng, at(house + 0.2))


def _add_bench(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Bench, often with a person, at times with a backpack that touches both."""
    furniture.add_bench(builder, rng, T)
    if rng.random() < 0.5:
        return
    facing = -np.pi / 2
    add_sitting_person(builder, rng, T @ pose(-0.25, 0.02, yaw=facing), furniture.SEAT_M)
    if rng.random() < 0.5:
        add_backpack(builder, rng, T @ pose(0.1, -0.02, furniture.SEAT_M, yaw=facing))


def _movers(layout: _Layout, atlas: TextureAtlas, blocks: int) -> tuple[Mover, ...]:
    """Cars and a cyclist in the left lane, walkers on both pavements."""
    rng = np.random.default_rng([layout.seed, 3])
    instance = blocks * INSTANCES_PER_BLOCK
    duration = layout.length / SLOW_WALK + 60.0
    movers: list[Mover] = []

    def line(y: float, first: float, last: float) -> F64:
        x = np.linspace(first, last, int(abs(last - first) / 0.5) + 1)
        return np.column_stack([x, np.full_like(x, y), [layout.ground(a, y) for a in x]])

    middle = layout.road - _PARKING_M - 1.25  # of the lane of those who come towards the walker
    count = int(np.clip(layout.length / 60.0, 3, _MOST_VEHICLES))
    for k in range(count):
        # they wait in a queue at the far end and drive one after another through the whole street
        way = line(middle, layout.length - 5.0 - _QUEUE_M * k, 5.0 + _QUEUE_M * (count - 1 - k))
        leave = (count - 1 - k + rng.uniform(0.05, 0.6)) / count * layout.length / _USUAL_WALK
        add = add_rider if k == count - 2 else add_car
        movers.append(vehicle(atlas, rng, instance + 2 * k, way, duration, leave, add))
    instance += 2 * count
    for k in range(min(blocks + 1, _MOST_WALKERS)):
        side = 1.0 if k % 2 else -1.0
        y = side * (layout.road + rng.uniform(1.3, layout.pavement - 0.55))
        start = rng.uniform(0, min(layout.length, 160.0))
        way = line(y, 4.0, layout.length - 4.0)
        if k % 4 > 1:
            way, start = way[::-1], layout.length - start
        movers += add_walker(atlas, rng, instance + k, way, duration, start)
    return tuple(movers)
