"""Trees whose loose crowns a beam passes about half of the time, and hedges."""

from __future__ import annotations

import numpy as np

from artemis_drivers.virtual.mesh_builder import F64, Colour, MeshBuilder, Shape
from artemis_drivers.virtual.shapes import box, leaf_cards, tube

Rng = np.random.Generator
SUNK = 0.3  # metres that a trunk reaches below the ground
LEAF_LENGTH, LEAF_WIDTH = 0.26, 0.18  # a card stands for a bunch of leaves
LEAVES_PER_M2 = 64.0  # cards per square metre of a crown's outline: about half of all beams pass
_LEAF_TINTS: tuple[Colour, ...] = (
    (0.75, 0.8, 0.6),
    (0.6, 0.75, 0.5),
    (1.0, 0.72, 0.4),
    (0.85, 0.95, 0.55),
    (1.0, 0.42, 0.35),
    (0.9, 0.6, 0.9),
)


def add_tree(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Tree with a bent trunk, branches and a loose crown, foot at the origin; green, yellow, red or purple."""
    builder.begin("tree")
    fork = rng.uniform(2.3, 2.9)
    lean = rng.normal(0, 0.12, 2)
    radius = rng.uniform(0.11, 0.17)
    crown = np.array([lean[0] * 1.5, lean[1] * 1.5, fork + rng.uniform(1.2, 1.6)])
    radii = rng.uniform(1.25, 1.75) * np.array([1.0, rng.uniform(0.85, 1.15), rng.uniform(0.85, 1.1)])
    shade = rng.uniform(0.6, 1.1)
    bark: Colour = (0.75 * shade, 0.72 * shade, 0.68 * shade)
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
    tint = _LEAF_TINTS[rng.integers(len(_LEAF_TINTS))]
    builder.add(_leaves(rng, crown, radii), "leaf", tint, T)


def _leaves(rng: Rng, crown: F64, radii: F64) -> Shape:
    outline = np.pi * radii[0] * radii[2]
    count = int(LEAVES_PER_M2 * outline)
    bunches = rng.normal(0, 1, (18, 3))
    bunches *= (rng.uniform(0.35, 0.85, 18) / np.linalg.norm(bunches, axis=1))[:, None]
    offset = bunches[rng.integers(0, 18, count)] + rng.normal(0, 0.2, (count, 3))
    return leaf_cards(
        crown + offset * radii,
        _leaf_normals(rng, count, 0.8),
        rng.uniform(0, 2 * np.pi, count),
        LEAF_LENGTH,
        LEAF_WIDTH,
    )


def _leaf_normals(rng: Rng, count: int, upwards: float) -> F64:
    normals = rng.normal(0, 1, (count, 3)) + np.array([0, 0, upwards])
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def add_hedge(builder: MeshBuilder, rng: Rng, T: F64, length: float, tint: Colour | None = None) -> None:
    """Clipped hedge along x, 0.45 m deep: a dense core with leaves that stick out."""
    builder.begin("hedge")
    high, half = rng.uniform(0.55, 0.95), 0.225
    colour = _LEAF_TINTS[rng.integers(len(_LEAF_TINTS))] if tint is None else tint
    core = box((0.05, -half + 0.06, -SUNK), (length - 0.05, half - 0.06, high - 0.06))
    builder.add(core, "hedge", colour, T)
    count = int(length * (high * 2 + 0.45) * 55)
    # on the faces: both sides, the top and, in proportion to their size, the ends
    side = rng.random(count)
    x, z = rng.uniform(0, length, count), rng.uniform(0.02, high, count)
    y = rng.uniform(-half, half, count)
    top = side > 2 * high / (2 * high + 0.45)
    y = np.where(top, y, np.where(side < high / (2 * high + 0.45), -half, half))
    z = np.where(top, high - 0.03, z)
    ends = rng.random(count) < 0.45 / (length + 0.45)
    x = np.where(ends, np.where(rng.random(count) < 0.5, 0.02, length - 0.02), x)
    centres = np.column_stack([x, y * np.where(top, 1.0, 0.9), z]) + rng.normal(0, 0.015, (count, 3))
    spin = rng.uniform(0, 2 * np.pi, count)
    builder.add(leaf_cards(centres, _leaf_normals(rng, count, 0.3), spin, 0.12, 0.08), "leaf", colour, T)
