"""Scan pattern of the Livox Avia: a rosette of two counter-rotating prisms, six lasers, never repeating.

Known of the Avia: field of view 70.4 x 77.2 degrees in non-repetitive mode, 240 000 points/s, six lasers
fired in turn, frames of 100 ms (user manual; Livox SDK 1: line = point number modulo 6). Two equal prisms
deflect a beam within a circle; we take its diameter as 70.4 degrees and spread the six lasers vertically over
the missing 6.8 degrees. The prisms' rates are those published for the Mid-40 of the same maker, 7294 and
-4664 rpm (Brazeal, Wilkinson & Hochmair, "A Rigorous Observation Model for the Risley Prism-Based Livox
Mid-40 Lidar Sensor", Sensors 21(14), 2021); the Avia's own are not published.
"""

from __future__ import annotations

import numpy as np

from artemis_drivers.virtual.lidar import Beams
from artemis_drivers.virtual.mesh_builder import F64

POINTS_PER_SECOND = 240_000
FRAME_S = 0.1
LINES = 6
FOV_HORIZONTAL = 70.4 * np.pi / 180
FOV_VERTICAL = 77.2 * np.pi / 180
_RATE_1_HZ = 7294.0 / 60.0
_RATE_2_HZ = -4664.0 / 60.0


def beams(frame: int, density: float = 1.0) -> Beams:
    """Beams of a 100 ms frame. ``density`` 0..1 is the share of shots of all six lasers that are kept."""
    per_frame = round(POINTS_PER_SECOND * FRAME_S)
    number = np.arange(per_frame)
    volley = number // LINES
    kept = np.floor((volley + 1) * density) > np.floor(volley * density)
    number = number[kept]
    time = number / POINTS_PER_SECOND
    line = number % LINES
    return Beams(time, direction(frame * FRAME_S + time, line), line.astype(np.uint8))


def direction(time_s: F64, line: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> F64:
    """Unit directions (n, 3) in the LiDAR's frame, x forward, y left, z up, of laser ``line`` at a time."""
    prism = FOV_HORIZONTAL / 4  # deflection of one prism
    a, b = 2 * np.pi * _RATE_1_HZ * time_s, 2 * np.pi * _RATE_2_HZ * time_s
    left = prism * (np.cos(a) + np.cos(b))
    up = prism * (np.sin(a) + np.sin(b))
    angle = np.hypot(left, up)
    sine = np.sinc(angle / np.pi)  # sin(angle) / angle
    x, y, z = np.cos(angle), left * sine, up * sine
    # each laser's own elevation, added after the prisms
    tilt = (FOV_VERTICAL - FOV_HORIZONTAL) * (line / (LINES - 1) - 0.5)
    c, s = np.cos(tilt), np.sin(tilt)
    return np.column_stack([c * x - s * z, y, s * x + c * z])
