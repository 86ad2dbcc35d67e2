"""Guesses around a prediction, for when the prediction may lie outside the reach of Gauss-Newton.

A carried sensor at 2 Hz turns 40 deg between two scans; a car's first two scans lie a metre apart with
nothing known of its speed. The score of a few hundred points on the coarse planes tells good guesses from
bad ones (in the manner of Olson's correlative scan matching, ICRA 2009).
"""

from __future__ import annotations

import numpy as np

from artemis_edge.frames import F64
from artemis_edge.odometry import se3

RINGS = 5  # guesses at fifths of the reach
_TURN = np.pi / 18  # spacing of guesses about the upright axis
_ON_THE_WAY = (0.0, 0.5, 1.0)


def ball(radius: float, spacing: float) -> F64:
    """Lattice points (n, 3) within a radius, the origin first, at most ``2 * RINGS + 1`` along an axis."""
    steps = min(int(np.ceil(radius / spacing)), RINGS) if radius > 0 else 0
    axis = np.arange(-steps, steps + 1) * (radius / max(steps, 1))
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    length = np.linalg.norm(grid, axis=1)
    order = np.argsort(length, kind="stable")
    inside: F64 = grid[order][length[order] <= radius * (1 + 1e-9)]
    return inside


def all_round(T_world_start: F64, T_world_lidar: F64, reach_rad: float) -> list[F64]:
    """Poses on the way to a guess, turned about the sensor's upright axis by up to ``reach_rad`` or all round.

    Carriers turn about the vertical more than anything else.
    """
    steps = min(int(np.ceil(reach_rad / _TURN)), int(np.pi / _TURN))
    way = se3.log(se3.inverse(T_world_start) @ T_world_lidar)
    twists = np.zeros((2 * steps + 1, 6))
    twists[:, 5] = np.arange(-steps, steps + 1) * _TURN
    out = []
    for share in _ON_THE_WAY:
        place = (T_world_start @ se3.exp(share * way))[:3, 3]
        for twist in twists:
            T = T_world_start @ se3.exp(twist)
            T[:3, 3] = place
            out.append(T)
    return out


def guesses(T_world_lidar: F64, reach_m: float, reach_rad: float, arm_m: float, basin_m: float) -> list[F64]:
    """Poses around a guess, itself first: shifted up to ``reach_m``, then turned up to ``reach_rad``.

    ``arm_m`` is the distance at which a turn displaces points, ``basin_m`` the displacement that registration
    mends by itself, hence the spacing.
    """
    shifts = ball(reach_m, basin_m)
    turns = ball(reach_rad, basin_m / arm_m)[1:]
    twists = np.zeros((len(shifts) + len(turns), 6))
    twists[: len(shifts), :3] = shifts
    twists[len(shifts) :, 3:] = turns
    return [T_world_lidar @ se3.exp(twist) for twist in twists]
