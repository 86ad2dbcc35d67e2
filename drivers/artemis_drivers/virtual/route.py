"""Lines to walk: rounded corners, even spacing, laps; and loops for what moves by itself."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from artemis_drivers.virtual.mesh_builder import F64
from artemis_drivers.virtual.motion import Motion

SPACING_M = 0.25
_FINE_M = 0.05
_DRIVE_STEP_S, _BRAKING_S = 0.2, 1.5


def resampled(points: F64, spacing_m: float) -> F64:
    """Points along a polyline (n, 3) at even distances of about ``spacing_m``, both ends kept."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0.0, arc[-1], max(int(np.ceil(arc[-1] / spacing_m)), 1) + 1)
    return np.column_stack([np.interp(at, arc, points[:, k]) for k in range(points.shape[1])])


def rounded_loop(corners: F64, radius_m: float) -> F64:
    """Closed line through ``corners`` (n, 3) with soft corners of about ``radius_m``; first point repeated."""
    fine = resampled(np.concatenate([corners, corners[:1]]), _FINE_M)[:-1]
    soft = gaussian_filter1d(fine, 0.5 * radius_m / _FINE_M, axis=0, mode="wrap")
    return resampled(np.concatenate([soft, soft[:1]]), SPACING_M)


def laps(loop: F64, length_m: float) -> F64:
    """The closed line walked as often as ``length_m`` needs (at least once); end not on the start again."""
    once = float(np.linalg.norm(np.diff(loop, axis=0), axis=1).sum())
    count = max(int(np.ceil(length_m / once)) + 1, 2)
    return np.concatenate([np.tile(loop[:-1], (count, 1)), loop[:1]])


def motion_along(
    line: F64, speed: float, duration_s: float, start_m: float = 0.0, step_s: float = 0.2
) -> Motion:
    """Motion along an open ``line`` (n, 3), there and back, or a closed one round and round.

    Open lines are turned around smoothly at their ends; the body's x axis looks ahead, level.
    """
    closed = bool(np.allclose(line[0], line[-1]))
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    t = np.arange(0.0, max(duration_s, 2.0) + step_s, step_s)
    s = (start_m + speed * t) % (arc[-1] if closed else 2 * arc[-1])
    s = np.where(s > arc[-1], 2 * arc[-1] - s, s)
    position = np.column_stack([np.interp(s, arc, line[:, k]) for k in range(3)])
    position = gaussian_filter1d(position, 0.4 / step_s, axis=0, mode="nearest")
    ahead = np.gradient(position, axis=0)
    moving = np.linalg.norm(ahead[:, :2], axis=1) > 1e-6
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    heading = np.interp(t, t[moving], heading[moving])
    heading = gaussian_filter1d(heading, 0.5 / step_s, mode="nearest")
    angles = np.column_stack([heading, np.zeros_like(t), np.zeros_like(t)])
    return Motion.through(t, position, angles)


def motion_once(line: F64, speed: float, duration_s: float, leave_s: float) -> Motion:
    """Motion from one end of ``line`` (n, 3) to the other, standing until ``leave_s`` and at the end."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    t = np.arange(0.0, max(duration_s, 2.0) + _DRIVE_STEP_S, _DRIVE_STEP_S)
    s = np.clip(speed * (t - leave_s), 0.0, arc[-1])
    s = gaussian_filter1d(s, _BRAKING_S / _DRIVE_STEP_S, mode="nearest")
    position = np.column_stack([np.interp(s, arc, line[:, k]) for k in range(3)])
    before, after = (
        np.column_stack([np.interp(s + d, arc, line[:, k]) for k in (0, 1)]) for d in (-1.0, 1.0)
    )
    heading = np.unwrap(np.arctan2(*(after - before).T[::-1]))
    position = gaussian_filter1d(position, 2.0, axis=0, mode="nearest")
    angles = np.column_stack([heading, np.zeros_like(t), np.zeros_like(t)])
    return Motion.through(t, position, angles)
