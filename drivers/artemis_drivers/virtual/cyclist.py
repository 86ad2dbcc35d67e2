"""Bicycles, alone or ridden."""

from __future__ import annotations

import numpy as np

from artemis_drivers.virtual.mesh_builder import F64, Colour, MeshBuilder, Shape
from artemis_drivers.virtual.person import add_figure, random_outfit, riding
from artemis_drivers.virtual.shapes import bar, box, cylinder, limb, loft, merged, pose

Rng = np.random.Generator
_WHEEL_M = 0.33  # radius
_BASE_M = 1.04  # distance of the axles


def _beside(point: F64, y: float, z: float = 0.0) -> F64:
    return np.asarray(point + np.array([0.0, y, z]))


def _ring(radius: float, thick: float, around: int = 24, sides: int = 5) -> Shape:
    """Torus about the y axis."""
    phi = 2 * np.pi * np.arange(around + 1) / around
    theta = 2 * np.pi * np.arange(sides) / sides
    r = radius + thick * np.cos(theta)
    x, z = np.cos(phi)[:, None] * r, np.sin(phi)[:, None] * r
    y = np.tile(thick * np.sin(theta), (around + 1, 1))
    return loft(np.stack([x, y, z], axis=-1), closed_ends=False)


def _wheel() -> Shape:
    spokes = [
        bar((0, 0, 0), (0.31 * np.cos(a), 0, 0.31 * np.sin(a)), 0.007) for a in np.arange(10) * 2 * np.pi / 10
    ]
    hub = cylinder(0.03, -0.045, 0.045, 8).moved(pose(roll=np.pi / 2))
    return merged([hub, *spokes])


def add_bicycle(builder: MeshBuilder, rng: Rng, T: F64, ridden: bool = False) -> None:
    """Bicycle on the ground, front towards +x, origin between the wheels; with its rider if ``ridden``."""
    builder.begin("bicycle")
    r, g, b = rng.uniform(0.1, 1.0, 3)
    paint: Colour = (float(r), float(g), float(b))
    rear, front = np.array([-_BASE_M / 2, 0, _WHEEL_M]), np.array([_BASE_M / 2, 0, _WHEEL_M])
    for axle in (rear, front):
        builder.add(_ring(_WHEEL_M - 0.02, 0.02), "plastic", (0.12, 0.12, 0.12), T @ pose(*axle))
        builder.add(_wheel(), "metal", (0.75, 0.75, 0.78), T @ pose(*axle))
    crank, saddle = np.array([-0.08, 0, 0.28]), np.array([-0.25, 0, 0.93])
    head, bar = np.array([0.36, 0, 0.82]), np.array([0.33, 0, 1.02])
    tubes = [
        (crank, saddle),
        (crank, _beside(head, 0, -0.08)),
        (saddle + np.array([0.03, 0, -0.12]), head),
        (head, bar),
    ]
    tubes += [(_beside(head, 0, -0.08), _beside(front, side)) for side in (-0.05, 0.05)]
    for side in (-0.05, 0.05):
        tubes += [(_beside(rear, side), crank), (_beside(rear, side), saddle + np.array([0.03, 0, -0.14]))]
    builder.add(merged([limb(p, q, 0.017, 0.017, 6) for p, q in tubes]), "car_paint", paint, T)
    builder.add(limb(_beside(bar, -0.29), _beside(bar, 0.29), 0.014, 0.014, 6), "metal", (0.4, 0.4, 0.4), T)
    builder.add(box((-0.37, -0.07, 0.92), (-0.12, 0.07, 0.97)), "plastic", (0.2, 0.15, 0.12), T)
    builder.add(
        cylinder(0.09, -0.06, -0.05, 14).moved(pose(crank[0], 0, crank[2], roll=np.pi / 2)),
        "metal",
        (0.5, 0.5, 0.5),
        T,
    )
    pedals = np.array([[0.06, 0.17], [-0.22, 0.39]])
    for side, pedal in zip((-0.12, 0.12), pedals, strict=True):
        arm = limb(_beside(crank, side * 0.6), (pedal[0], side * 0.6, pedal[1]), 0.012, 0.012, 6)
        builder.add(arm, "metal", (0.4, 0.4, 0.4), T)
        plate = box(
            (pedal[0] - 0.05, side - 0.05, pedal[1] - 0.012), (pedal[0] + 0.05, side + 0.05, pedal[1] + 0.012)
        )
        builder.add(plate, "plastic", (0.1, 0.1, 0.1), T)
    if rng.random() < 0.5:
        basket = box((0.36, -0.16, 0.82), (0.62, 0.16, 1.02))
        builder.add(basket, "wood", (0.8, 0.7, 0.5), T)
    if ridden:
        builder.begin("person")
        grips = np.array([[0.33, -0.26, 1.05], [0.33, 0.26, 1.05]])
        add_figure(builder, random_outfit(rng), riding((-0.25, 0.97), pedals, grips), T)
