"""What stands in a street: trees, persons, benches, lamps, road signs, bins, boxes, bollards, cabinets."""

from __future__ import annotations

import numpy as np

from artemis_drivers.virtual.building import fitted_panel
from artemis_drivers.virtual.mesh_builder import F64, Colour, MeshBuilder, Shape
from artemis_drivers.virtual.shapes import (
    box,
    cylinder,
    disc_panel,
    ellipsoid,
    leaf_cards,
    limb,
    loft,
    merged,
    pose,
    tube,
)
from artemis_drivers.virtual.textures import ROAD_SIGNS

Rng = np.random.Generator
SUNK = 0.3  # metres that things reach below the ground they stand on
LEAF_LENGTH, LEAF_WIDTH = 0.26, 0.18  # a card stands for a bunch of leaves
LEAVES_PER_M2 = 64.0  # cards per square metre of a crown's outline: about half of all beams pass


def _colour(rng: Rng, low: float, high: float) -> Colour:
    r, g, b = rng.uniform(low, high, 3)
    return (float(r), float(g), float(b))


def add_tree(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Tree with a bent trunk, branches and a loose crown, foot at the origin."""
    builder.begin("tree")
    fork = rng.uniform(2.3, 2.9)
    lean = rng.normal(0, 0.12, 2)
    radius = rng.uniform(0.11, 0.17)
    crown = np.array([lean[0] * 1.5, lean[1] * 1.5, fork + rng.uniform(1.2, 1.6)])
    radii = rng.uniform(1.25, 1.75) * np.array([1.0, rng.uniform(0.85, 1.15), rng.uniform(0.85, 1.1)])
    bark: Colour = (0.75, 0.72, 0.68)
    bend = lean[0] * 0.3
    trunk = np.array([[0, 0, -SUNK], [0, 0, 0.1], [bend, lean[1] * 0.2, fork * 0.5], [*lean, fork], crown])
    builder.add(tube(trunk, np.array([1.6, 1.25, 1.0, 0.8, 0.25]) * radius, 9), "bark", bark, T)
    for angle in rng.uniform(0, 2 * np.pi) + np.arange(5) * 2 * np.pi / 5:
        tip = crown + radii * np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.1, 0.7)]) * 0.75
        start = trunk[3] - [0, 0, rng.uniform(0, 0.5)]
        middle = (start + tip) / 2 + [0, 0, 0.15]
        builder.add(
            tube(np.array([start, middle, tip]), np.array([0.4, 0.25, 0.1]) * radius, 6), "bark", bark, T
        )
    builder.add(_leaves(rng, crown, radii), "leaf", _leaf_tint(rng), T)


def _leaf_tint(rng: Rng) -> Colour:
    options = ((0.75, 0.8, 0.6), (0.6, 0.75, 0.5), (0.95, 0.75, 0.45), (0.8, 0.95, 0.55))
    return options[rng.integers(len(options))]


def _leaves(rng: Rng, crown: F64, radii: F64) -> Shape:
    outline = np.pi * radii[0] * radii[2]
    count = int(LEAVES_PER_M2 * outline)
    bunches = rng.normal(0, 1, (18, 3))
    bunches *= (rng.uniform(0.35, 0.85, 18) / np.linalg.norm(bunches, axis=1))[:, None]
    offset = bunches[rng.integers(0, 18, count)] + rng.normal(0, 0.2, (count, 3))
    normals = rng.normal(0, 1, (count, 3)) + np.array([0, 0, 0.8])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return leaf_cards(
        crown + offset * radii, normals, rng.uniform(0, 2 * np.pi, count), LEAF_LENGTH, LEAF_WIDTH
    )


def add_person(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Standing person of 1.55 to 1.9 m, one leg a little forward, facing +x."""
    builder.begin("person")
    tall = rng.uniform(1.55, 1.9) / 1.75
    T = T @ np.diag([tall, tall, tall, 1.0])
    trousers, shirt, hair = _colour(rng, 0.1, 0.5), _colour(rng, 0.2, 1.0), _colour(rng, 0.08, 0.4)
    step = rng.uniform(0.05, 0.16)
    for side, forward in ((-0.095, step), (0.095, -step)):
        builder.add(
            limb((forward, side, 0.07), (forward * 0.5, side, 0.48), 0.055, 0.07), "cloth", trousers, T
        )
        builder.add(
            limb((forward * 0.5, side, 0.48), (0, side * 0.9, 0.88), 0.07, 0.095), "cloth", trousers, T
        )
        shoe = T @ pose(forward + 0.05, side, 0.045)
        builder.add(ellipsoid((0.14, 0.05, 0.065), 10, 6), "rubber", (0.2, 0.18, 0.17), shoe)
    builder.add(_torso(), "cloth", shirt, T)
    bend = rng.uniform(-0.15, 0.35)
    for side in (-1.0, 1.0):
        elbow = (0.02, side * 0.27, 1.12)
        hand = (0.05 + max(bend * side, 0.0), side * 0.25, 0.88 + abs(bend) * 0.3)
        builder.add(limb((0, side * 0.19, 1.40), elbow, 0.06, 0.05), "cloth", shirt, T)
        builder.add(limb(elbow, hand, 0.048, 0.038), "skin", (1, 1, 1), T)
    builder.add(limb((0, 0, 1.44), (0.01, 0, 1.55), 0.055, 0.05), "skin", (1, 1, 1), T)
    builder.add(ellipsoid((0.095, 0.08, 0.12), 14, 10), "skin", (1, 1, 1), T @ pose(0.015, 0, 1.63))
    builder.add(ellipsoid((0.098, 0.088, 0.10), 14, 8), "cloth", hair, T @ pose(-0.012, 0, 1.66))


def _torso() -> Shape:
    sections = [
        (0.82, 0.10, 0.14),
        (0.90, 0.125, 0.175),
        (1.05, 0.11, 0.155),
        (1.25, 0.12, 0.18),
        (1.40, 0.10, 0.19),
        (1.47, 0.06, 0.10),
    ]
    angle = 2 * np.pi * np.arange(14) / 14
    rings = [np.column_stack([a * np.cos(angle), b * np.sin(angle), np.full(14, z)]) for z, a, b in sections]
    return loft(np.array(rings))


def add_bench(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Bench of slats on two legs, along x, to be sat on facing -y."""
    builder.begin("bench")
    long = rng.uniform(1.5, 2.0)
    slats = [box((-long / 2, y, 0.42), (long / 2, y + 0.095, 0.455)) for y in (-0.24, -0.125, -0.01, 0.105)]
    back = [box((-long / 2, 0, z), (long / 2, 0.03, z + 0.10)) for z in (0.14, 0.28)]
    wood: Colour = (0.9, 0.72, 0.5) if rng.random() < 0.5 else (0.5, 0.62, 0.45)
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
    grey = _colour(rng, 0.28, 0.4)
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
    dark: Colour = (0.22, 0.22, 0.24)
    builder.add(cylinder(0.07, -SUNK, 0.82, 12, 0.055), "metal", dark, T)
    builder.add(cylinder(0.085, 0.68, 0.73, 12), "metal", dark, T)
    builder.add(ellipsoid((0.075, 0.075, 0.07), 12, 8), "metal", dark, T @ pose(0, 0, 0.87))


def add_cabinet(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Utility cabinet."""
    builder.begin("other")
    w, d, h = rng.uniform(0.7, 1.2), rng.uniform(0.32, 0.45), rng.uniform(0.95, 1.3)
    grey = _colour(rng, 0.55, 0.7)
    builder.add(box((-w / 2, -d / 2, -SUNK), (w / 2, d / 2, h)), "metal", grey, T)
    builder.add(
        box((-w / 2 - 0.03, -d / 2 - 0.03, h), (w / 2 + 0.03, d / 2 + 0.03, h + 0.05)), "metal", grey, T
    )
    builder.add(
        box((-0.01, -d / 2 - 0.012, 0.1), (0.01, -d / 2 + 0.05, h - 0.05)), "metal", (0.3, 0.3, 0.3), T
    )
