"""A handheld walk: standing still, then walking with gait, sway, and slow looks to the sides and upwards.

Amplitudes are those of a person who carries a scanner in front of the chest; gait of about two steps a second
moves the rig up and down by 2 cm and rolls it by a degree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from artemis_drivers.virtual.mesh_builder import F64
from artemis_drivers.virtual.motion import Motion

Rng = np.random.Generator
_KNOT_S = 0.04  # spacing of the spline's samples: a twelfth of a gait period
_DEG = np.pi / 180


@dataclass(frozen=True, slots=True)
class Gait:
    """How the walker moves; metres, seconds, Hz, degrees."""

    still_s: float = 1.0
    start_s: float = 1.5  # from standing to full speed
    speed: float = 1.2
    step_hz: float = 2.0
    bob_m: float = 0.02
    sway_m: float = 0.025
    roll_deg: float = 1.0
    pitch_deg: float = 0.7
    look_deg: float = 60.0
    look_every_s: float = 6.0
    tilt_down_deg: float = 4.0


def walk(path: F64, seconds: float, seed: int, gait: Gait | None = None) -> Motion:
    """Walk along ``path`` (n, 3) for ``seconds``; the body's x axis looks ahead, z up.

    The rig starts exactly level and still for ``gait.still_s``. Raises ValueError when the path is too short.
    """
    gait = gait or Gait()
    rng = np.random.default_rng([seed, 21])
    t = np.arange(0.0, seconds + 4 * _KNOT_S, _KNOT_S)
    go = _smooth((t - gait.still_s) / gait.start_s)
    speed = gait.speed * go * (1 + 0.12 * np.sin(2 * np.pi * t / 9.7 + rng.uniform(0, 2 * np.pi)))
    travelled = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * _KNOT_S)])
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    if travelled[-1] > arc[-1]:
        raise ValueError(f"the path of {arc[-1]:.1f} m is too short for a walk of {travelled[-1]:.1f} m")
    along = Motion.through(arc, path, np.zeros_like(path)).position
    step = 2 * np.pi * gait.step_hz * (t - gait.still_s)
    ahead = along(travelled, 1)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    position = along(travelled)
    position[:, 2] += go * gait.bob_m * np.cos(step)
    sway = go * gait.sway_m * np.sin(step / 2)
    position[:, 0] -= sway * np.sin(heading)
    position[:, 1] += sway * np.cos(heading)
    angles = np.column_stack([heading, np.zeros_like(t), np.zeros_like(t)])
    angles += go[:, None] * _head(t, step, gait, rng) * _DEG
    return Motion.through(t, position, angles)


def path_needed_m(seconds: float, gait: Gait | None = None) -> float:
    """Length of path that a walk of ``seconds`` uses at most, metres."""
    gait = gait or Gait()
    return 1.13 * gait.speed * max(seconds - gait.still_s, 0.0) + 2.0


def _smooth(x: F64) -> F64:
    """From 0 to 1 over 0..1 with four continuous derivatives."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**5 * (126 - 420 * x + 540 * x**2 - 315 * x**3 + 70 * x**4))


def _head(t: F64, step: F64, gait: Gait, rng: Rng) -> F64:
    """Yaw, pitch, roll about the heading, degrees (n, 3): gait, slow drift, looks around."""
    phase = rng.uniform(0, 2 * np.pi, 6)
    yaw = 1.5 * np.sin(step / 2 + phase[0]) + 3.0 * np.sin(2 * np.pi * t / 5.3 + phase[1])
    pitch = (
        gait.tilt_down_deg
        + gait.pitch_deg * np.sin(step + phase[2])
        + 1.5 * np.sin(2 * np.pi * t / 4.1 + phase[3])
    )
    roll = gait.roll_deg * np.sin(step / 2 + phase[4]) + 1.0 * np.sin(2 * np.pi * t / 6.7 + phase[5])
    side = rng.choice([-1.0, 1.0])
    begin = gait.still_s + 1.5
    while begin < t[-1]:
        turn, hold = rng.uniform(1.2, 1.8), rng.uniform(0.5, 1.2)
        look = _smooth((t - begin) / turn) * (1 - _smooth((t - begin - turn - hold) / turn))
        yaw += side * gait.look_deg * rng.uniform(0.6, 1.1) * look
        pitch -= rng.uniform(0.0, 14.0) * look  # looks to the sides go up the fronts of the houses
        side = -side
        begin += gait.look_every_s * rng.uniform(0.8, 1.25)
    return np.column_stack([yaw, pitch, roll])
