"""What stands in halls and yards: tables, chairs, shelves, stairs, railings, pillars, walls with openings."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from artemis_drivers.virtual.building import fitted_panel
from artemis_drivers.virtual.mesh_builder import F64, Colour, MeshBuilder, Shape
from artemis_drivers.virtual.shapes import bar, box, cylinder, limb, merged, pose, solid
from artemis_drivers.virtual.textures import PRINTS

Rng = np.random.Generator
SHELF_DEEP_M = 0.34
RISER_M, TREAD_M = 0.17, 0.30  # of a stair
_RAIL_M = 1.0  # height of railings
_BAY_M = 1.0  # width of a shelf's bay

#: An opening of a wall: x0, x1, z0, z1 in metres.
Opening = tuple[float, float, float, float]


def any_colour(rng: Rng, low: float, high: float) -> Colour:
    """Three values drawn between ``low`` and ``high``."""
    r, g, b = rng.uniform(low, high, 3)
    return (float(r), float(g), float(b))


def wall_paint(rng: Rng) -> Colour:
    """What walls and floors are painted with: light, and of any hue, but pale."""
    r, g, b = np.clip(rng.uniform(0.65, 1.0) * rng.uniform(0.82, 1.1, 3), 0, 1)
    return (float(r), float(g), float(b))


def wall(width: float, z0: float, z1: float, thickness: float, openings: Sequence[Opening] = ()) -> Shape:
    """Closed wall, front in the x-z plane facing -y, 0..width, with openings right through it."""
    xs = np.unique([0.0, width, *(x for o in openings for x in o[:2])])
    zs = np.unique([z0, z1, *(z for o in openings for z in o[2:])])
    is_open = np.array(
        [
            [any(o[0] < x < o[1] and o[2] < z < o[3] for o in openings) for z in (zs[:-1] + zs[1:]) / 2]
            for x in (xs[:-1] + xs[1:]) / 2
        ]
    )
    # no wall around the grid: what lies beside a wall's cell and is open gets a face
    full = np.pad(~is_open, 1, constant_values=False)
    quads: list[list[tuple[float, float, float]]] = []
    for i, (a, b) in enumerate(itertools.pairwise(xs)):
        for k, (c, d) in enumerate(itertools.pairwise(zs)):
            if is_open[i, k]:
                continue
            t = thickness
            quads.append([(a, 0, c), (b, 0, c), (b, 0, d), (a, 0, d)])
            quads.append([(b, t, c), (a, t, c), (a, t, d), (b, t, d)])
            if not full[i, k + 1]:
                quads.append([(a, t, c), (a, 0, c), (a, 0, d), (a, t, d)])
            if not full[i + 2, k + 1]:
                quads.append([(b, 0, c), (b, t, c), (b, t, d), (b, 0, d)])
            if not full[i + 1, k]:
                quads.append([(a, t, c), (b, t, c), (b, 0, c), (a, 0, c)])
            if not full[i + 1, k + 2]:
                quads.append([(a, 0, d), (b, 0, d), (b, t, d), (a, t, d)])
    corners = np.array(quads, np.float64)
    first = np.arange(len(corners), dtype=np.int32)[:, None, None] * 4
    triangles = (first + np.array([(0, 1, 2), (0, 2, 3)], np.int32)).reshape(-1, 3)
    return solid(corners.reshape(-1, 3), triangles)


def add_table(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Round or square table."""
    builder.begin("table")
    high, half = rng.uniform(0.70, 0.76), rng.uniform(0.35, 0.45)
    colour, metal = any_colour(rng, 0.3, 1.0), any_colour(rng, 0.2, 0.6)
    if rng.random() < 0.5:
        builder.add(cylinder(half, high - 0.03, high, 24), "wood", colour, T)
        builder.add(cylinder(0.035, 0.0, high - 0.02, 10), "metal", metal, T)
        builder.add(cylinder(0.24, -0.02, 0.03, 16, 0.2), "metal", metal, T)
        return
    builder.add(box((-half, -half, high - 0.03), (half, half, high)), "wood", colour, T)
    legs = [
        box((x - 0.025, y - 0.025, -0.02), (x + 0.025, y + 0.025, high - 0.02))
        for x in (-half + 0.05, half - 0.05)
        for y in (-half + 0.05, half - 0.05)
    ]
    builder.add(merged(legs), "metal", metal, T)


def add_chair(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Chair to be sat on facing +x."""
    builder.begin("chair")
    colour, material = any_colour(rng, 0.2, 1.0), str(rng.choice(["wood", "plastic", "cloth"]))
    builder.add(box((-0.2, -0.2, 0.43), (0.2, 0.2, 0.46)), material, colour, T)
    builder.add(box((-0.2, -0.19, 0.62), (-0.17, 0.19, 0.86)), material, colour, T @ pose(pitch=-0.08))
    legs = [
        limb((x, y, 0.0), (0.9 * x, 0.9 * y, 0.44), 0.014, 0.014, 6)
        for x in (-0.2, 0.2)
        for y in (-0.19, 0.19)
    ]
    legs += [limb((-0.18, y, 0.44), (-0.215, y, 0.86), 0.013, 0.013, 6) for y in (-0.17, 0.17)]
    builder.add(merged(legs), "metal", any_colour(rng, 0.2, 0.7), T)


def add_shelf(builder: MeshBuilder, rng: Rng, T: F64, bays: int, kind: str = "books") -> None:
    """Open shelf along x with its front towards -y: ``bays`` of 1 m, full of ``kind`` (books or goods)."""
    builder.begin("shelf")
    deep, high, boards = SHELF_DEEP_M, rng.uniform(1.7, 2.3), int(rng.integers(4, 6))
    colour = any_colour(rng, 0.25, 1.0)
    material = str(rng.choice(["wood", "bare"]))
    frame = [box((k * _BAY_M - 0.015, 0, -0.02), (k * _BAY_M + 0.015, deep, high)) for k in range(bays + 1)]
    zs = np.linspace(0.08, high - 0.02, boards)
    frame += [box((0, 0.005, z - 0.012), (bays * _BAY_M, deep - 0.005, z + 0.012)) for z in zs]
    frame.append(box((0, deep - 0.012, 0.0), (bays * _BAY_M, deep - 0.002, high - 0.01)))
    builder.add(merged(frame), material, colour, T)
    for k in range(bays):
        for low, top in itertools.pairwise(zs):
            if rng.random() < 0.12:
                continue
            wide, tall = rng.uniform(0.5, 0.96) * _BAY_M, rng.uniform(0.65, 0.92) * (top - low)
            x = k * _BAY_M + 0.018 + rng.uniform(0, _BAY_M - 0.036 - wide)
            row = fitted_panel(wide, tall, rng.uniform(0.14, 0.26))
            tint = any_colour(rng, 0.7, 1.0)
            material = f"{kind}_{rng.integers(PRINTS)}"
            builder.add(row, (material, "cardboard"), tint, T @ pose(x, rng.uniform(0.01, 0.06), low + 0.011))


def add_steps(builder: MeshBuilder, rng: Rng, T: F64, count: int, width: float, material: str) -> float:
    """Solid stair that climbs along +x from the origin, ``width`` to the left; returns its height.

    The last tread is the floor that it leads to.
    """
    builder.begin("steps")
    builder.add(_stair(count, width), material, any_colour(rng, 0.6, 1.0), T)
    return count * RISER_M


def _stair(count: int, width: float) -> Shape:
    """Stepped solid without inner faces: profile in x-z, extruded along y."""
    k = np.arange(count)
    a, z = k * TREAD_M, (k + 1) * RISER_M
    below = -0.1
    end = count * TREAD_M
    quads: list[list[tuple[float, float, float]]] = []
    for x, top in zip(a, z, strict=True):
        low = top - RISER_M if x > 0 else below
        quads.append([(x, width, low), (x, 0, low), (x, 0, top), (x, width, top)])
        quads.append([(x, 0, top), (x + TREAD_M, 0, top), (x + TREAD_M, width, top), (x, width, top)])
        quads.append([(x, 0, below), (x + TREAD_M, 0, below), (x + TREAD_M, 0, top), (x, 0, top)])
        quads.append(
            [(x + TREAD_M, width, below), (x, width, below), (x, width, top), (x + TREAD_M, width, top)]
        )
    quads.append([(end, 0, below), (end, width, below), (end, width, z[-1]), (end, 0, z[-1])])
    corners = np.array(quads, np.float64)
    first = np.arange(len(corners), dtype=np.int32)[:, None, None] * 4
    triangles = (first + np.array([(0, 1, 2), (0, 2, 3)], np.int32)).reshape(-1, 3)
    return solid(corners.reshape(-1, 3), triangles)


def add_railing(builder: MeshBuilder, colour: Colour, foot: F64) -> None:
    """Railing with balusters above the line ``foot`` (n, 3)."""
    builder.begin("railing")
    up = np.array([0.0, 0.0, _RAIL_M])
    bars = []
    for a, b in itertools.pairwise(foot):
        bars.append(limb(a + up, b + up, 0.022, 0.022, 8))
        bars.append(limb(a + 0.12 * up, b + 0.12 * up, 0.012, 0.012, 6))
        count = max(int(np.linalg.norm((b - a)[:2]) / 0.16), 1)
        bars += [
            bar(p + 0.1 * up, p + 0.99 * up, 0.016)
            for p in a + (b - a) * ((np.arange(count) + 0.5) / count)[:, None]
        ]
    bars += [limb(p - 0.02 * up, p + 0.99 * up, 0.02, 0.02, 8) for p in foot]
    builder.add(merged(bars), "metal", colour, np.eye(4))


def add_pillar(builder: MeshBuilder, rng: Rng, T: F64, high: float, material: str, colour: Colour) -> None:
    """Round or square pillar with base and capital."""
    builder.begin("pillar")
    half = rng.uniform(0.2, 0.28)
    if rng.random() < 0.5:
        builder.add(cylinder(half, -0.1, high + 0.05, 20), material, colour, T)
    else:
        builder.add(box((-half, -half, -0.1), (half, half, high + 0.05)), material, colour, T)
    for z0, z1 in ((-0.1, 0.25), (high - 0.2, high + 0.05)):
        wide = half + 0.07
        builder.add(box((-wide, -wide, z0), (wide, wide, z1)), "concrete", colour, T)


def add_poster(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Printed board on a wall whose face is the x-z plane, facing -y, lower left at the origin."""
    builder.begin("sign")
    wide = rng.uniform(0.6, 1.2)
    board = fitted_panel(wide, wide * rng.uniform(1.0, 1.4), 0.04)
    builder.add(
        board, (f"poster_{rng.integers(PRINTS)}", "wood"), any_colour(rng, 0.8, 1.0), T @ pose(y=-0.025)
    )
