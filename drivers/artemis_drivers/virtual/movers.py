"""What moves through the worlds: walkers with swinging legs, riders, cars."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from artemis_drivers.virtual.cyclist import add_bicycle
from artemis_drivers.virtual.mesh_builder import F64, MeshBuilder, WorldMesh
from artemis_drivers.virtual.motion import Motion
from artemis_drivers.virtual.person import HIP_M, add_figure, leg_of, random_outfit, striding
from artemis_drivers.virtual.route import motion_along, motion_once
from artemis_drivers.virtual.textures import TextureAtlas
from artemis_drivers.virtual.world import Mover

Rng = np.random.Generator
_STEP_S = 0.1  # spacing of a walking leg's samples: a tenth of a stride
_SWING = 0.42  # radians that a leg swings to either side


def vehicle(
    atlas: TextureAtlas,
    rng: Rng,
    instance: int,
    line: F64,
    duration_s: float,
    leave_s: float,
    add: Callable[[MeshBuilder, Rng, F64], None],
) -> Mover:
    """What ``add`` builds (its instances count from ``instance``), driving along ``line`` once."""
    builder = MeshBuilder(atlas.index, instance)
    add(builder, rng, np.eye(4))
    slow = add is add_rider
    speed = rng.uniform(3.0, 4.5) if slow else rng.uniform(4.5, 8.0)
    return Mover(builder.build(), motion_once(line, speed, duration_s, leave_s))


def add_rider(builder: MeshBuilder, rng: Rng, T: F64) -> None:
    """A bicycle and its rider."""
    add_bicycle(builder, rng, T, ridden=True)


def add_walker(
    atlas: TextureAtlas, rng: Rng, instance: int, line: F64, duration_s: float, start_m: float
) -> list[Mover]:
    """A walking person in three bodies of one instance: trunk with arms, right leg, left leg."""
    tall = rng.uniform(0.88, 1.1)
    outfit = random_outfit(rng)
    speed = rng.uniform(0.9, 1.5)
    motion = motion_along(line, speed, duration_s, start_m, _STEP_S)
    scale = np.diag([tall, tall, tall, 1.0])
    trunk = _built(atlas, instance, lambda b: add_figure(b, outfit, striding(), scale, legs=False))
    leg = _built(atlas, instance, lambda b: leg_of(b, outfit, scale))
    strides = 0.75 / tall * speed / 1.2  # Hz
    phase = rng.uniform(0, 2 * np.pi)
    movers = [Mover(trunk, motion)]
    for side, half in ((-0.086, 0.0), (0.086, np.pi)):
        movers.append(Mover(leg, _swinging(motion, side * tall, HIP_M * tall, strides, phase + half)))
    return movers


def _built(atlas: TextureAtlas, instance: int, add: Callable[[MeshBuilder], None]) -> WorldMesh:
    builder = MeshBuilder(atlas.index, instance)
    builder.begin("person")
    add(builder)
    return builder.build()


def _swinging(body: Motion, left_m: float, hip_m: float, stride_hz: float, phase: float) -> Motion:
    """Motion of a leg's hip, pitching to and fro as it goes."""
    t = np.arange(0.0, body.duration_s, _STEP_S)
    angles, position = body.angles(t), body.position(t)
    yaw = angles[:, 0]
    position[:, 0] -= left_m * np.sin(yaw)
    position[:, 1] += left_m * np.cos(yaw)
    position[:, 2] += hip_m
    angles[:, 1] = _SWING * np.sin(2 * np.pi * stride_hz * t + phase)
    return Motion.through(t, position, angles)
