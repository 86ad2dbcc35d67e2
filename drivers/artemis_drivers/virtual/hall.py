"""A hall with pillars, shelves and a gallery between two stairs, and a corridor behind its bare wall.

x runs along the hall, y across it from the corridor's wall (y = 0) to the gallery, z up from the hall's
floor. The walk: along the hall, up one stair, over the gallery, down the other, through a door into the
corridor, back through the other door, and again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from artemis_drivers.virtual import furniture
from artemis_drivers.virtual.building import fitted_panel
from artemis_drivers.virtual.interior import (
    RISER_M,
    SHELF_DEEP_M,
    TREAD_M,
    Opening,
    add_chair,
    add_pillar,
    add_poster,
    add_railing,
    add_shelf,
    add_steps,
    add_table,
    any_colour,
    wall,
    wall_paint,
)
from artemis_drivers.virtual.mesh_builder import F64, Colour, MeshBuilder, WorldMesh
from artemis_drivers.virtual.movers import add_walker
from artemis_drivers.virtual.person import add_backpack, add_person, add_sitting_person, add_statue
from artemis_drivers.virtual.route import laps, rounded_loop
from artemis_drivers.virtual.shapes import box, pose
from artemis_drivers.virtual.textures import HOUSES, ROADS, TextureAtlas, build_atlas
from artemis_drivers.virtual.world import Mover, World, random_sun

Rng = np.random.Generator
_NOT_HERE = (*ROADS, *HOUSES)  # materials that are not drawn
EYE_M = 1.45
_WALL_M = 0.2  # thickness of walls
_STAIR_WIDE = 2.4
_GALLERY_DEEP = 3.0
_SLAB_M = 0.25  # thickness of the gallery's floor
_DOOR: tuple[float, float] = (1.5, 2.25)  # width and height
_DOOR_X = 2.0  # of the middle of the doors, from either end of the hall
_AISLES = (3.0, 6.4)  # y of the two aisles that are walked
_OUTSIDE_M = 7.0  # width of the strip outside the corridor's windows
_MOVERS_AT = 1_000_000  # first instance number of what moves
_OTHERS_SPEED = 0.7  # m/s: for how long the others must keep walking


@dataclass(frozen=True, slots=True)
class _Plan:
    """Sizes, metres, and what walls and floors are made of."""

    long: float
    wide: float
    high: float
    corridor: float  # width of the corridor
    risers: int
    walls: tuple[str, Colour]
    floors: tuple[str, Colour]

    @property
    def gallery_m(self) -> float:
        """Height of the gallery's floor."""
        return self.risers * RISER_M

    @property
    def stair_m(self) -> float:
        """Length of a stair on the ground."""
        return self.risers * TREAD_M

    @property
    def gallery_x(self) -> tuple[float, float]:
        """Where the gallery begins and ends, which is where the stairs end."""
        first = 3.6 + self.stair_m
        return first, self.long - first

    @property
    def doors(self) -> tuple[float, float]:
        """x of the middles of the doors."""
        return _DOOR_X, self.long - _DOOR_X


def build(seed: int, length: float = 100.0, atlas: TextureAtlas | None = None) -> World:
    """A hall whose path is at least ``length`` metres long (whole laps)."""
    rng = np.random.default_rng([seed, 1])
    plan = _Plan(
        long=float(rng.uniform(27, 33)),
        wide=float(rng.uniform(14, 16)),
        high=float(rng.uniform(5.4, 6.4)),
        corridor=float(rng.uniform(2.2, 3.0)),
        risers=int(rng.integers(13, 16)),
        walls=(str(rng.choice(["bare", "plaster_b", "bare"])), wall_paint(rng)),
        floors=(str(rng.choice(["terrazzo", "lino", "wood", "paving"])), wall_paint(rng)),
    )
    sun = random_sun(rng)
    loop = _loop(plan)
    if rng.random() < 0.5:
        loop = loop[::-1]
    atlas = build_atlas(seed, _NOT_HERE) if atlas is None else atlas
    return World(
        name="hall",
        seed=seed,
        block_edges=np.array([0.0, plan.long]),
        build_block=lambda _: _build(plan, atlas, seed),
        path=laps(loop, length) + np.array([0.0, 0.0, EYE_M]),
        sun=sun,
        atlas=atlas,
        movers=_movers(plan, atlas, seed, length),
    )


def _loop(plan: _Plan) -> F64:
    """Line of the feet; level where no stair is."""
    near, far = _AISLES
    y_up, y_down, z = plan.wide - _STAIR_WIDE / 2, -_WALL_M - plan.corridor / 2, plan.gallery_m
    (x0, x1), (d0, d1) = plan.gallery_x, plan.doors
    corners = [
        (plan.long / 2, near, 0),
        (plan.long - 5.0, near, 0),
        (plan.long - 2.2, (near + y_up) / 2, 0),
        (plan.long - 2.4, y_up, 0),
        (plan.long - 3.5, y_up, 0),
        (x1, y_up, z),
        (x0, y_up, z),
        (3.5, y_up, 0),
        (2.4, y_up, 0),
        (d0, y_up - 1.0, 0),
        (d0, y_down, 0),
        (d1, y_down, 0),
        (d1, far - 1.0, 0),
        (d1 - 1.0, far, 0),
        (5.0, far, 0),
        (4.2, (near + far) / 2, 0),
        (5.0, near, 0),
    ]
    return rounded_loop(np.array(corners, np.float64), 1.2)


def _build(plan: _Plan, atlas: TextureAtlas, seed: int) -> WorldMesh:
    rng = np.random.default_rng([seed, 2])
    builder = MeshBuilder(atlas.index)
    _add_floors(builder, plan, rng)
    _add_walls(builder, plan, rng)
    _add_ceiling(builder, plan, rng)
    _add_gallery(builder, plan, rng)
    _add_pillars(builder, plan, rng)
    _add_shelves(builder, plan, rng)
    _add_clutter(builder, plan, rng)
    _add_corridor_things(builder, plan, rng)
    return builder.build()


def _add_floors(builder: MeshBuilder, plan: _Plan, rng: Rng) -> None:
    """Floors of hall and corridor; outside, a strip of grass before a wall that windows look on."""
    out = -_WALL_M - plan.corridor
    builder.begin("ground")
    builder.add(box((0, -_WALL_M / 2, -0.3), (plan.long, plan.wide, 0)), *plan.floors)
    builder.begin("ground")
    strip = box((0, out, -0.3), (plan.long, -_WALL_M / 2, 0.0))
    builder.add(strip, str(rng.choice(["lino", "terrazzo"])), wall_paint(rng))
    builder.begin("ground")
    y1 = out - _WALL_M
    builder.add(
        box((-5, y1 - _OUTSIDE_M, -0.4), (plan.long + 5, y1, -0.1)), "grass", any_colour(rng, 0.7, 1.0)
    )
    builder.begin("building")
    T = pose(plan.long + 5, y1 - _OUTSIDE_M + 0.1, 0, np.pi)
    builder.add(wall(plan.long + 10, -0.4, 3.5, 0.3), "brick_b", any_colour(rng, 0.5, 1.0), T)


def _windows(plan: _Plan, first: float, z: tuple[float, float], pitch: float, share: float) -> list[Opening]:
    """Equal openings along a wall of the hall's length."""
    count = int((plan.long - 2 * first) / pitch)
    x0 = (plan.long - count * pitch) / 2 + pitch * (1 - share) / 2
    return [(x0 + k * pitch, x0 + k * pitch + share * pitch, *z) for k in range(count)]


def _add_walls(builder: MeshBuilder, plan: _Plan, rng: Rng) -> None:
    t, high, out = _WALL_M, plan.high, -_WALL_M - plan.corridor
    (d0, d1), (door, tall) = plan.doors, _DOOR
    doors = [(d - door / 2, d + door / 2, 0.0, tall) for d in (d0, d1)]
    builder.begin("building")
    middle = wall(plan.long, 0.0, high, t, doors)
    builder.add(middle, *plan.walls, pose(0, -t, 0))
    for x, yaw in ((0.0, np.pi / 2), (plan.long, -np.pi / 2)):
        # front towards the hall
        T = pose(x, -t - 0.01, 0, yaw) if yaw > 0 else pose(x, plan.wide + t, 0, yaw)
        builder.add(wall(plan.wide + 2 * t, 0.0, high, t), *plan.walls, T)
    builder.begin("building")
    upper = _windows(plan, 1.5, (plan.gallery_m + 0.9, high - 0.5), 2.6, 0.6)
    builder.add(wall(plan.long, 0.0, high, t, upper), *plan.walls, pose(0, plan.wide, 0))
    _add_panes(builder, upper, pose(0, plan.wide + 0.08, 0))
    builder.begin("building")
    material = (str(rng.choice(["bare", "plaster_a"])), wall_paint(rng))
    lower = _windows(plan, 3.0, (0.9, 2.1), 3.4, 0.5)
    builder.add(wall(plan.long, 0.0, 2.7, t, lower), *material, pose(plan.long, out, 0, np.pi))
    for x, yaw in ((0.0, np.pi / 2), (plan.long, -np.pi / 2)):
        T = pose(x, out - t, 0, yaw) if yaw > 0 else pose(x, -t + 0.01, 0, yaw)
        builder.add(wall(plan.corridor + t, 0.0, 2.7, t), *material, T)
    _add_panes(builder, lower, pose(plan.long, out - 0.08, 0, np.pi))
    _add_frames(builder, doors, rng)


def _add_panes(builder: MeshBuilder, openings: list[Opening], T: F64) -> None:
    """Panes with frames in the openings of a wall."""
    frame = 0.05
    for a, b, c, d in openings:
        builder.begin("building")
        for bar in (
            box((a, -0.02, c), (a + frame, 0.03, d)),
            box((b - frame, -0.02, c), (b, 0.03, d)),
            box((a + frame, -0.02, c), (b - frame, 0.03, c + frame)),
            box((a + frame, -0.02, d - frame), (b - frame, 0.03, d)),
        ):
            builder.add(bar, "wood", (0.75, 0.75, 0.75), T)
    builder.begin("glass")
    for a, b, c, d in openings:
        builder.add(box((a, 0, c), (b, 0.012, d)), "pane", (1, 1, 1), T)


def _add_frames(builder: MeshBuilder, doors: list[Opening], rng: Rng) -> None:
    """Door frames around the openings, and the doors, open against the wall."""
    colour = any_colour(rng, 0.3, 1.0)
    for a, b, _, d in doors:
        builder.begin("building")
        for bar in (
            box((a - 0.08, -_WALL_M - 0.02, 0), (a, 0.02, d + 0.08)),
            box((b, -_WALL_M - 0.02, 0), (b + 0.08, 0.02, d + 0.08)),
            box((a, -_WALL_M - 0.02, d), (b, 0.02, d + 0.08)),
        ):
            builder.add(bar, "wood", colour)
        leaf = fitted_panel(b - a, d, 0.04)
        # opened by a little less than half a turn, into the hall
        hinge = pose(a - 0.02, 0.05, 0, np.pi - 0.15) if a > 5 else pose(b + 0.02, 0.05, 0, 0.15)
        builder.add(leaf, ("door", "wood"), colour, hinge)


def _add_ceiling(builder: MeshBuilder, plan: _Plan, rng: Rng) -> None:
    """Ceilings; that of the hall has open skylights, through which the sun falls."""
    builder.begin("building")
    lights = [
        (x, x + 1.6, y, y + 2.0)
        for x in np.arange(3.0, plan.long - 3.5, 4.2)
        for y in (plan.wide * 0.35, plan.wide * 0.62)
    ]
    # a wall that lies on its back: its front (-y) looks up, its z runs along the hall's y
    slab = wall(plan.long, -_WALL_M, plan.wide + _WALL_M, 0.25, lights)
    builder.add(slab, "ceiling", wall_paint(rng), pose(0, 0, plan.high + 0.25, roll=-np.pi / 2))
    builder.begin("building")
    low = box((0, -2 * _WALL_M - plan.corridor, 2.7), (plan.long, -_WALL_M + 0.02, 2.9))
    builder.add(low, "ceiling", wall_paint(rng))
    for x in np.arange(2.5, plan.long - 2.0, 4.0):
        y = -_WALL_M - plan.corridor / 2
        builder.begin("other")
        builder.add(box((x, y - 0.12, 2.64), (x + 1.2, y + 0.12, 2.72)), "lamp", (1, 1, 1))


def _add_gallery(builder: MeshBuilder, plan: _Plan, rng: Rng) -> None:
    (x0, x1), z, y0 = plan.gallery_x, plan.gallery_m, plan.wide - _GALLERY_DEEP
    builder.begin("ground")
    builder.add(box((x0, y0, z - _SLAB_M), (x1, plan.wide + 0.02, z)), *plan.floors)
    material = str(rng.choice(["concrete", "marble", "wood", "stone"]))
    inner = plan.wide - _STAIR_WIDE
    add_steps(builder, rng, pose(x0 - plan.stair_m, inner, 0), plan.risers, _STAIR_WIDE, material)
    add_steps(builder, rng, pose(x1 + plan.stair_m, plan.wide, 0, np.pi), plan.risers, _STAIR_WIDE, material)
    colour = any_colour(rng, 0.15, 0.9)
    add_railing(builder, colour, np.array([[x0, y0 + 0.06, z], [x1, y0 + 0.06, z]]))
    for top, foot in ((x0, x0 - plan.stair_m), (x1, x1 + plan.stair_m)):
        line = np.array([[top, inner + 0.06, z], [foot, inner + 0.06, RISER_M]])
        add_railing(builder, colour, line)
        add_railing(builder, colour, np.array([[top, y0 + 0.06, z], [top, inner + 0.06, z]]))
    for x in np.linspace(x0 + 0.4, x1 - 0.4, max(int((x1 - x0) / 4), 2)):
        add_pillar(builder, rng, pose(x, y0 + 0.3, 0), z - _SLAB_M, "concrete", any_colour(rng, 0.5, 1.0))


def _add_pillars(builder: MeshBuilder, plan: _Plan, rng: Rng) -> None:
    material = str(rng.choice(["marble", "concrete", "brick_a", "plaster_b"]))
    colour = any_colour(rng, 0.5, 1.0)
    for x in np.arange(6.5, plan.long - 5.0, 4.2):
        add_pillar(builder, rng, pose(x, _AISLES[1] + 1.3, 0), plan.high, material, colour)


def _add_shelves(builder: MeshBuilder, plan: _Plan, rng: Rng) -> None:
    """A double row between the aisles, single ones at the bare wall and under the gallery."""
    kind = str(rng.choice(["books", "goods"]))
    middle = sum(_AISLES) / 2
    x = 7.0
    while x < plan.long - 9.0:
        bays = int(rng.integers(2, 4))
        add_shelf(builder, rng, pose(x, middle - SHELF_DEEP_M), bays, kind)  # back to back
        add_shelf(builder, rng, pose(x + bays, middle + SHELF_DEEP_M + 0.002, 0, np.pi), bays, kind)
        x += bays + rng.uniform(0.8, 1.6)
    for x in (rng.uniform(5.0, 8.0), rng.uniform(14.0, 17.0)):
        add_shelf(builder, rng, pose(x + 3, SHELF_DEEP_M + 0.01, 0, np.pi), 3, kind)
    x0, x1 = plan.gallery_x
    for x in np.arange(x0 + 0.5, x1 - 3.2, 4.0):
        if rng.random() < 0.7:
            add_shelf(builder, rng, pose(x, plan.wide - SHELF_DEEP_M - 0.01), 3, kind)


def _add_clutter(builder: MeshBuilder, plan: _Plan, rng: Rng) -> None:
    """Tables, seats, persons, statues and boxes between the far aisle and the gallery."""
    y = _AISLES[1] + 1.3
    kinds = ["table", "bench", "statue", "boxes", "table", "bench", "planter", "table"]
    for x, kind in zip(np.arange(8.6, plan.long - 5.0, 2.1), rng.permutation(kinds), strict=False):
        T = pose(x, y + rng.uniform(0.1, 0.7), 0, rng.uniform(-0.2, 0.2))
        if kind == "table":
            _add_group(builder, rng, T)
        elif kind == "bench":
            furniture.add_bench(builder, rng, T)
            add_sitting_person(builder, rng, T @ pose(-0.2, 0.02, yaw=-np.pi / 2), furniture.SEAT_M)
            add_backpack(builder, rng, T @ pose(0.16, 0, furniture.SEAT_M, yaw=-np.pi / 2))
        elif kind == "statue":
            add_statue(builder, rng, T @ pose(yaw=-np.pi / 2))
        elif kind == "boxes":
            furniture.add_boxes(builder, rng, T)
        else:
            furniture.add_planter(builder, rng, T)
    for _ in range(3):
        x = rng.uniform(*plan.gallery_x)
        add_person(builder, rng, pose(x, plan.wide - _GALLERY_DEEP - 0.8, 0, rng.uniform(0, 2 * np.pi)))
    for x in (rng.uniform(10.0, 12.5), rng.uniform(18.5, plan.long - 6.0)):
        add_poster(builder, rng, pose(x + 1.2, 0, 1.0, np.pi))
    for y in np.arange(1.5, plan.wide - 5.0, 1.9) + rng.uniform(0, 0.5):
        # posters on both end walls, above what stands there
        if rng.random() < 0.6:
            add_poster(builder, rng, pose(0, y, 1.1, np.pi / 2))
        if rng.random() < 0.6:
            add_poster(builder, rng, pose(plan.long, y + 1.2, 1.1, -np.pi / 2))


def _add_group(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Table with chairs, some taken, a backpack on the floor against one."""
    add_table(builder, rng, T)
    for k, angle in enumerate((0.0, np.pi)):
        T_chair = T @ pose(0.68 * np.cos(angle), 0.68 * np.sin(angle), 0, angle + np.pi)
        add_chair(builder, rng, T_chair)
        if rng.random() < 0.4:
            add_sitting_person(builder, rng, T_chair @ pose(-0.02), 0.46)
        elif k == 0:
            add_backpack(builder, rng, T_chair @ pose(0.02, 0, 0.46))


def _add_corridor_things(builder: MeshBuilder, plan: _Plan, rng: Rng) -> None:
    """A few things at the corridor's outer wall; most of it is bare."""
    y = -_WALL_M - plan.corridor
    for x in rng.uniform(5.0, plan.long - 5.0, 2):
        add_poster(builder, rng, pose(x, -_WALL_M, 1.0))
    x = rng.uniform(6.0, plan.long - 6.0)
    furniture.add_planter(builder, rng, pose(x, y + 0.5, 0))
    add_chair(builder, rng, pose(x + 1.6, y + 0.35, 0, np.pi / 2))
    if rng.random() < 0.5:
        add_sitting_person(builder, rng, pose(x + 1.6, y + 0.37, 0, np.pi / 2), 0.46)


def _movers(plan: _Plan, atlas: TextureAtlas, seed: int, length: float) -> tuple[Mover, ...]:
    """Two people who walk up and down: in an aisle and before the gallery."""
    rng = np.random.default_rng([seed, 3])
    duration = length / _OTHERS_SPEED + 60.0
    movers: list[Mover] = []
    for k, y in enumerate((_AISLES[1] - 0.75, plan.wide - _GALLERY_DEEP - 1.7)):
        line = np.array([[7.0, y, 0.0], [plan.long - 5.5, y, 0.0]])
        movers += add_walker(atlas, rng, _MOVERS_AT + k, line, duration, rng.uniform(0, 20))
    return tuple(movers)
