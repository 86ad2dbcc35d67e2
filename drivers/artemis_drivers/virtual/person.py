"""Persons: one jointed figure that stands, walks, sits or rides; as flesh and cloth, or as a statue."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from artemis_drivers.virtual.mesh_builder import F64, Colour, MeshBuilder, Shape
from artemis_drivers.virtual.shapes import box, cylinder, ellipsoid, limb, loft, pose

Rng = np.random.Generator
HIP_M, SHOULDER_M = 0.90, 1.42  # heights on a standing figure of 1.75 m
_TALL_M = 1.75
_SIDES = 7
_SKINS: tuple[Colour, ...] = ((1.0, 1.0, 1.0), (0.86, 0.78, 0.72), (0.62, 0.52, 0.45), (0.42, 0.34, 0.3))
_CLOTHS = ("cloth", "stripes", "check", "denim")


@dataclass(frozen=True, slots=True)
class Outfit:
    """Materials and tints of a figure's parts: (material, tint)."""

    shirt: tuple[str, Colour]
    trousers: tuple[str, Colour]
    shoes: tuple[str, Colour]
    skin: tuple[str, Colour]
    hair: tuple[str, Colour]
    hat: bool = False
    skirt: bool = False


@dataclass(frozen=True, slots=True)
class Stance:
    """Joints in the figure's frame, metres: x ahead, y left, z up, feet near z = 0.

    Of each pair the first is the right one. ``lean`` radians: the trunk's tilt forwards about the hips.
    """

    hip: tuple[float, float]  # x, z
    knees: tuple[tuple[float, float], tuple[float, float]]  # x, z
    ankles: tuple[tuple[float, float], tuple[float, float]]
    elbows: tuple[tuple[float, float, float], tuple[float, float, float]]
    hands: tuple[tuple[float, float, float], tuple[float, float, float]]
    lean: float = 0.0


def random_outfit(rng: Rng) -> Outfit:
    """Clothes in any colours."""

    def cloth(low: float, high: float) -> tuple[str, Colour]:
        grey = rng.uniform(low, high)
        tint = np.clip(grey + rng.uniform(-0.35, 0.35, 3) * rng.choice([0.15, 1.0]), 0.06, 1.0)
        return str(rng.choice(_CLOTHS)), (float(tint[0]), float(tint[1]), float(tint[2]))

    hair = rng.uniform(0.1, 0.9) * np.array([1.0, rng.uniform(0.7, 1.0), rng.uniform(0.4, 1.0)])
    return Outfit(
        shirt=cloth(0.15, 1.0),
        trousers=cloth(0.1, 0.8),
        shoes=("plastic", cloth(0.1, 0.9)[1]),
        skin=("skin", _SKINS[rng.integers(len(_SKINS))]),
        hair=("cloth", (float(hair[0]), float(hair[1]), float(hair[2]))),
        hat=bool(rng.random() < 0.3),
        skirt=bool(rng.random() < 0.25),
    )


def stone_outfit(material: str, tint: Colour) -> Outfit:
    """All of one material: a statue."""
    part = (material, tint)
    return Outfit(part, part, part, part, part)


def standing(rng: Rng) -> Stance:
    """On both feet, one a little forward, arms at rest or bent."""
    step, bend = rng.uniform(0.03, 0.14), rng.uniform(0.0, 0.4)
    return Stance(
        hip=(0.0, HIP_M),
        knees=((step * 0.5, 0.48), (-step * 0.5, 0.48)),
        ankles=((step, 0.08), (-step, 0.08)),
        elbows=((-0.02, -0.27, 1.14), (0.0, 0.27, 1.14)),
        hands=((0.06, -0.25, 0.88), (0.06 + 0.55 * bend, 0.24 - 0.2 * bend, 0.88 + 0.8 * bend)),
    )


def striding() -> Stance:
    """In mid-step; walking movers bring their own legs (:func:`leg_of`)."""
    return Stance(
        hip=(0.0, HIP_M - 0.02),
        knees=((0.17, 0.50), (-0.05, 0.46)),
        ankles=((0.27, 0.09), (-0.36, 0.15)),
        elbows=((-0.14, -0.25, 1.15), (0.1, 0.25, 1.14)),
        hands=((-0.12, -0.25, 0.89), (0.3, 0.21, 0.98)),
        lean=0.05,
    )


def sitting(rng: Rng, seat_m: float) -> Stance:
    """On a seat of height ``seat_m`` whose middle is at x = 0, feet on the ground in front."""
    hip = seat_m + 0.10
    ahead = rng.uniform(0.34, 0.46)
    return Stance(
        hip=(-0.06, hip),
        knees=((0.40, hip + 0.02), (0.40, hip + 0.02)),
        ankles=((ahead, 0.08), (ahead + 0.06, 0.08)),
        elbows=((0.02, -0.27, hip + 0.27), (0.02, 0.27, hip + 0.27)),
        hands=((0.28, -0.12, hip + 0.13), (0.30, 0.10, hip + 0.13)),
        lean=-0.08,
    )


def riding(saddle: tuple[float, float], pedals: F64, grips: F64) -> Stance:
    """On a bicycle: saddle (x, z), pedals (2, 2) x, z, grips (2, 3); right first."""
    hip = (saddle[0], saddle[1] + 0.07)
    knees = [((hip[0] + p[0]) / 2 + 0.24, (hip[1] + p[1]) / 2 + 0.12) for p in pedals]
    middle = [(g[0] - 0.22, g[1] * 1.15, g[2] + 0.12) for g in grips]
    return Stance(
        hip=hip,
        knees=(knees[0], knees[1]),
        ankles=((pedals[0, 0] - 0.06, pedals[0, 1] + 0.09), (pedals[1, 0] - 0.06, pedals[1, 1] + 0.09)),
        elbows=(middle[0], middle[1]),
        hands=(tuple(grips[0].tolist()), tuple(grips[1].tolist())),
        lean=0.55,
    )


def add_figure(builder: MeshBuilder, outfit: Outfit, stance: Stance, T: F64, legs: bool = True) -> None:
    """Add the figure to the object begun last."""
    for side, knee, ankle in zip((-0.095, 0.095), stance.knees, stance.ankles, strict=True):
        if legs:
            joints = ((stance.hip[0], side * 0.9, stance.hip[1]), (knee[0], side, knee[1]))
            _add_leg(builder, outfit, *joints, (ankle[0], side, ankle[1]), T)
    T_trunk = T @ pose(stance.hip[0], 0, stance.hip[1], pitch=stance.lean)
    builder.add(_trunk(outfit.skirt and legs), *outfit.shirt, T_trunk)
    shoulder_x = stance.hip[0] + (SHOULDER_M - HIP_M) * np.sin(stance.lean)
    shoulder_z = stance.hip[1] + (SHOULDER_M - HIP_M) * np.cos(stance.lean)
    for sign, elbow, hand in zip((-1.0, 1.0), stance.elbows, stance.hands, strict=True):
        shoulder = (shoulder_x, sign * 0.185, shoulder_z - 0.02)
        builder.add(limb(shoulder, elbow, 0.062, 0.05, _SIDES), *outfit.shirt, T)
        builder.add(limb(elbow, hand, 0.046, 0.036, _SIDES), *outfit.skin, T)
        builder.add(ellipsoid((0.06, 0.035, 0.06), _SIDES, 5), *outfit.skin, T @ pose(*hand))
    _add_head(builder, outfit, T_trunk @ pose(z=SHOULDER_M - HIP_M))


def _add_leg(
    builder: MeshBuilder,
    outfit: Outfit,
    hip: tuple[float, float, float],
    knee: tuple[float, float, float],
    ankle: tuple[float, float, float],
    T: F64,
) -> None:
    builder.add(limb(hip, knee, 0.095, 0.068, _SIDES), *outfit.trousers, T)
    builder.add(limb(knee, ankle, 0.067, 0.05, _SIDES), *outfit.trousers, T)
    shoe = T @ pose(ankle[0] + 0.055, ankle[1], ankle[2] - 0.03)
    builder.add(ellipsoid((0.14, 0.05, 0.055), _SIDES, 5), *outfit.shoes, shoe)


def leg_of(builder: MeshBuilder, outfit: Outfit, T_leg: F64) -> None:
    """One leg of a walking figure, hanging from the origin, knee a little bent."""
    _add_leg(builder, outfit, (0, 0, 0), (0.045, 0, 0.48 - HIP_M), (0.0, 0, 0.09 - HIP_M), T_leg)


def _trunk(skirt: bool) -> Shape:
    """From the hips (z = 0) to the neck; with a skirt down to the knees."""
    sections = [
        (-0.10, 0.10, 0.14),
        (0.0, 0.125, 0.175),
        (0.15, 0.11, 0.155),
        (0.35, 0.12, 0.18),
        (0.50, 0.10, 0.19),
        (0.57, 0.06, 0.10),
    ]
    if skirt:
        sections[0] = (-0.42, 0.22, 0.24)
    angle = 2 * np.pi * np.arange(12) / 12
    rings = [np.column_stack([a * np.cos(angle), b * np.sin(angle), np.full(12, z)]) for z, a, b in sections]
    return loft(np.array(rings))


def _add_head(builder: MeshBuilder, outfit: Outfit, T_shoulders: F64) -> None:
    builder.add(limb((0, 0, 0.02), (0.01, 0, 0.13), 0.055, 0.05, _SIDES), *outfit.skin, T_shoulders)
    builder.add(ellipsoid((0.095, 0.08, 0.12), 12, 8), *outfit.skin, T_shoulders @ pose(0.015, 0, 0.21))
    nose = T_shoulders @ pose(0.11, 0, 0.20)
    builder.add(ellipsoid((0.025, 0.016, 0.03), 6, 4), *outfit.skin, nose)
    if outfit.hat:
        builder.add(cylinder(0.105, 0.25, 0.36, 12, 0.085), *outfit.hair, T_shoulders)
        builder.add(cylinder(0.16, 0.245, 0.262, 12), *outfit.hair, T_shoulders)
    else:
        builder.add(ellipsoid((0.10, 0.09, 0.10), 12, 7), *outfit.hair, T_shoulders @ pose(-0.014, 0, 0.245))


def sized(rng: Rng, T: F64) -> F64:
    """``T`` scaled so that the figure is 1.5 to 1.95 m tall."""
    tall = rng.uniform(1.5, 1.95) / _TALL_M
    return np.asarray(T @ np.diag([tall, tall, tall, 1.0]))


def add_person(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Standing person, facing +x; some carry a bag."""
    builder.begin("person")
    T = sized(rng, T)
    stance = standing(rng)
    add_figure(builder, random_outfit(rng), stance, T)
    if rng.random() < 0.3:
        x, y, z = stance.hands[0]
        tint = rng.uniform(0.1, 0.9, 3)
        bag = box((x - 0.16, y - 0.07, z - 0.36), (x + 0.16, y + 0.03, z - 0.02))
        builder.add(bag, "cloth", (float(tint[0]), float(tint[1]), float(tint[2])), T)


def add_sitting_person(builder: MeshBuilder, rng: Rng, T: F64, seat_m: float) -> None:
    """Person on a seat of height ``seat_m`` with its middle above the origin, facing +x."""
    builder.begin("person")
    add_figure(builder, random_outfit(rng), sitting(rng, seat_m), T)


def add_backpack(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Backpack of 0.45 m standing on the origin, its back towards -x."""
    builder.begin("backpack")
    tint = rng.uniform(0.1, 1.0, 3)
    colour: Colour = (float(tint[0]), float(tint[1]), float(tint[2]))
    dark: Colour = (0.15, 0.15, 0.17)
    material = str(rng.choice(_CLOTHS))
    sections = [
        (-0.01, 0.09, 0.14),
        (0.06, 0.115, 0.165),
        (0.30, 0.11, 0.16),
        (0.41, 0.08, 0.13),
        (0.45, 0.03, 0.07),
    ]
    angle = 2 * np.pi * np.arange(16) / 16

    def rounded(half: float, wave: F64) -> F64:
        return np.asarray(half * np.sign(wave) * np.abs(wave) ** 0.5)

    rings = [
        np.column_stack([rounded(a, np.cos(angle)), rounded(b, np.sin(angle)), np.full(16, z)])
        for z, a, b in sections
    ]
    builder.add(loft(np.array(rings)), material, colour, T)
    builder.add(box((0.08, -0.11, 0.04), (0.16, 0.11, 0.22)), material, dark, T)
    for y in (-0.08, 0.08):
        strap = np.array([[-0.09, y, 0.05], [-0.15, y, 0.2], [-0.13, y, 0.36], [-0.06, y, 0.41]])
        for a, b in itertools.pairwise(strap):
            builder.add(limb(a, b, 0.018, 0.018, 6), "cloth", dark, T)
    builder.add(limb((-0.02, -0.04, 0.47), (-0.02, 0.04, 0.47), 0.013, 0.013, 6), "cloth", dark, T)


def add_statue(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """Figure of stone or bronze on a plinth, facing +x."""
    builder.begin("statue")
    bronze = rng.random() < 0.5
    shade = rng.uniform(0.75, 1.0)
    tint: Colour = (0.42 * shade, 0.52 * shade, 0.42 * shade) if bronze else (shade, shade, 0.95 * shade)
    high, half = rng.uniform(0.7, 1.2), rng.uniform(0.34, 0.45)
    stone: Colour = (shade, 0.97 * shade, 0.92 * shade)
    builder.add(box((-half - 0.12, -half - 0.12, -0.3), (half + 0.12, half + 0.12, 0.16)), "stone", stone, T)
    builder.add(box((-half, -half, 0.1), (half, half, high - 0.06)), "marble", stone, T)
    builder.add(
        box((-half - 0.06, -half - 0.06, high - 0.08), (half + 0.06, half + 0.06, high)), "stone", stone, T
    )
    raised = rng.uniform(0.0, 0.6)
    stance = standing(rng)
    hands = (stance.hands[0], (0.3, 0.32, 1.25 + raised))
    elbows = (stance.elbows[0], (0.1, 0.36, 1.2 + 0.4 * raised))
    stance = Stance(stance.hip, stance.knees, stance.ankles, elbows, hands)
    big = rng.uniform(1.0, 1.25)
    T_figure = T @ pose(z=high - 0.01) @ np.diag([big, big, big, 1.0])
    add_figure(builder, stone_outfit("metal" if bronze else "marble", tint), stance, T_figure)
