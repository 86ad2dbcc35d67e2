"""What stands in a street or a yard: benches, lamps, road signs, bins, boxes, bollards, cabinets, planters."""

from __future__ import annotations

import numpy as np

from artemis_drivers.virtual.building import fitted_panel
from artemis_drivers.virtual.mesh_builder import F64, Colour, MeshBuilder, Shape
from artemis_drivers.virtual.shapes import (
    box,
    cylinder,
    disc_panel,
    ellipsoid,
    loft,
    merged,
    pose,
    tube,
)
from artemis_drivers.virtual.textures import ROAD_SIGNS

Rng = np.random.Generator
SEAT_M = 0.455
SUNK = 0.3  # metres that things reach below the ground they stand on


def _colour(rng: Rng, low: float, high: float) -> Colour:
    r, g, b = rng.uniform(low, high, 3)
    return (float(r), float(g), float(b))


def _paint(rng: Rng) -> Colour:
    """Paint of iron things: mostly dull, at times bright."""
    return _colour(rng, 0.2, 0.75) if rng.random() < 0.4 else (rng.uniform(0.2, 0.7),) * 3


def add_bench(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Bench of slats on two legs, along x, to be sat on facing -y; the seat is SEAT_M high."""
    builder.begin("bench")
    long = rng.uniform(1.6, 2.1)
    slats = [box((-long / 2, y, 0.42), (long / 2, y + 0.095, 0.455)) for y in (-0.24, -0.125, -0.01, 0.105)]
    back = [box((-long / 2, 0, z), (long / 2, 0.03, z + 0.10)) for z in (0.14, 0.28)]
    wood: Colour = (0.9, 0.72, 0.5) if rng.random() < 0.4 else _colour(rng, 0.2, 1.0)
    builder.add(merged(slats), "wood", wood, T)
    builder.add(merged(back), "wood", wood, T @ pose(0, 0.21, 0.42, roll=-0.2))
    for x in (-long / 2 + 0.18, long / 2 - 0.22):
        frame = [
            box((x, -0.22, -SUNK), (x + 0.05, -0.16, 0.425)),
            box((x, 0.14, -SUNK), (x + 0.05, 0.20, 0.425)),
            box((x, -0.22, 0.36), (x + 0.05, 0.20, 0.424)),
        ]
        builder.add(merged(frame), "metal", (0.2, 0.2, 0.22), T)
        rest = box((x, 0.03, -0.06), (x + 0.05, 0.065, 0.40))
        builder.add(rest, "metal", (0.2, 0.2, 0.22), T @ pose(0, 0.21, 0.42, roll=-0.2))


def add_lamp(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Street lamp of 5.5 to 7 m with an arm towards +x."""
    builder.begin("pole")
    high = rng.uniform(5.5, 7.0)
    grey = _paint(rng)
    path = np.array(
        [[0, 0, -SUNK], [0, 0, high - 0.5], [0.12, 0, high - 0.12], [0.5, 0, high], [1.3, 0, high + 0.05]]
    )
    builder.add(tube(path, (0.085, 0.06, 0.05, 0.045, 0.04), 12), "metal", grey, T)
    builder.add(cylinder(0.12, -SUNK, 0.55, 12, 0.10), "metal", grey, T)
    builder.add(box((1.15, -0.12, high - 0.02), (1.85, 0.12, high + 0.1)), "metal", grey, T)
    builder.add(box((1.2, -0.1, high - 0.05), (1.8, 0.1, high - 0.015)), "lamp", (1, 1, 1), T)


def add_road_sign(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Road sign on a post, front towards -x."""
    high = rng.uniform(2.1, 2.5)
    builder.begin("pole")
    builder.add(cylinder(0.03, -SUNK, high + 0.65, 8), "metal", (0.7, 0.7, 0.72), T)
    builder.begin("sign")
    kind = int(rng.integers(ROAD_SIGNS))
    T_face = T @ pose(-0.05, 0, high + 0.3, yaw=-np.pi / 2)
    if kind < 2:
        radius = 0.3
        disc = disc_panel(radius, 0.025)
        scale = np.where((disc.part == 0)[:, None, None], 1 / (2 * radius), 1.0)
        shape = Shape(disc.vertices, disc.triangles, disc.uv * scale, disc.part)
        builder.add(shape, (f"road_sign_{kind}", "metal"), (1, 1, 1), T_face)
    else:
        builder.add(
            fitted_panel(0.6, 0.6, 0.025),
            (f"road_sign_{kind}", "metal"),
            (1, 1, 1),
            T_face @ pose(-0.3, -0.0125, -0.3),
        )


def add_bin(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Litter bin or a wheeled household bin."""
    builder.begin("other")
    tint = _colour(rng, 0.15, 0.6)
    if rng.random() < 0.5:
        builder.add(cylinder(0.21, -SUNK, 0.82, 16, 0.25), "plastic", tint, T)
        builder.add(cylinder(0.27, 0.80, 0.88, 16, 0.22), "plastic", (0.15, 0.15, 0.15), T)
        return
    rings = []
    for z, half in ((-0.05, 0.23), (0.95, 0.29)):
        rings.append([(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)])
    builder.add(loft(np.array(rings, np.float64)), "plastic", tint, T)
    lid = box((-0.31, -0.31, 0), (0.33, 0.31, 0.06))
    builder.add(lid, "plastic", tint, T @ pose(0, 0, 0.95, pitch=0.1))
    for y in (-0.25, 0.25):
        builder.add(
            cylinder(0.1, -0.03, 0.03, 12),
            "rubber",
            (0.15, 0.15, 0.15),
            T @ pose(-0.24, y, 0.1, roll=np.pi / 2),
        )


def add_boxes(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """A few cardboard boxes, some on top of others."""
    builder.begin("other")
    x = 0.0
    for _ in range(int(rng.integers(2, 4))):
        w, d, h = rng.uniform(0.3, 0.6, 3)
        T_low = T @ pose(x, rng.uniform(-0.1, 0.1), 0, yaw=rng.uniform(-0.3, 0.3))
        builder.add(box((-w / 2, -d / 2, -0.1), (w / 2, d / 2, h)), "cardboard", (1, 1, 1), T_low)
        if rng.random() < 0.5:
            top = rng.uniform(0.2, 0.3)
            T_top = T_low @ pose(0, 0, h, yaw=rng.uniform(-0.6, 0.6))
            builder.add(
                box((-top / 2, -top / 2, -0.01), (top / 2, top / 2, top)), "cardboard", (0.9, 0.95, 1), T_top
            )
        x += w / 2 + 0.4


def add_bollard(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Iron bollard with a knob."""
    builder.begin("pole")
    dark = _paint(rng)
    builder.add(cylinder(0.07, -SUNK, 0.82, 12, 0.055), "metal", dark, T)
    builder.add(cylinder(0.085, 0.68, 0.73, 12), "metal", dark, T)
    builder.add(ellipsoid((0.075, 0.075, 0.07), 12, 8), "metal", dark, T @ pose(0, 0, 0.87))


def add_cabinet(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Utility cabinet."""
    builder.begin("other")
    w, d, h = rng.uniform(0.7, 1.2), rng.uniform(0.32, 0.45), rng.uniform(0.95, 1.3)
    grey = _paint(rng)
    builder.add(box((-w / 2, -d / 2, -SUNK), (w / 2, d / 2, h)), "metal", grey, T)
    builder.add(
        box((-w / 2 - 0.03, -d / 2 - 0.03, h), (w / 2 + 0.03, d / 2 + 0.03, h + 0.05)), "metal", grey, T
    )
    builder.add(
        box((-0.01, -d / 2 - 0.012, 0.1), (0.01, -d / 2 + 0.05, h - 0.05)), "metal", (0.3, 0.3, 0.3), T
    )


def add_planter(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Tub of concrete or wood with a small bush."""
    builder.begin("other")
    half, high = rng.uniform(0.25, 0.45), rng.uniform(0.4, 0.6)
    material = str(rng.choice(["concrete", "wood", "brick_a"]))
    builder.add(box((-half, -half, -SUNK), (half, half, high)), material, _colour(rng, 0.5, 1.0), T)
    builder.begin("hedge")
    bush = 0.9 * half
    builder.add(ellipsoid((bush, bush, 0.8 * bush), 14, 9), "hedge", _colour(rng, 0.6, 1.0), T @ pose(z=high))
