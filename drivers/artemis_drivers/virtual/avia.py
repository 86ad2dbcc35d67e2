"""Scan pattern of the Livox Avia: six lasers behind three rotating prisms, a rosette that does not repeat.

Published: field of view 70.4 x 77.2 degrees in non-repetitive mode, 240 000 points/s, frames of 100 ms
(livoxtech.com/avia/specs as quoted by public projects); six lasers fired in turn, so that the line is the
point's number modulo 6 (Livox SDK 1 and its ROS driver). Not published by Livox: the optics. Wedges, rates and
refractive index are those in the tests of PlantSimulationLab/Phytograph (backend, Livox rosette), which takes
its other scanners from HELIOS++. Two things confirm them: through them one laser fills a circle of 70.42
degrees, and real frames of a one-laser Livox with that view move over it as these prisms make a beam move and
as two prisms cannot (tests/bench/lidar_pattern.py). That the six lasers differ in elevation only, evenly and by
as much as makes the field 77.2 degrees high, is our assumption.
"""

from __future__ import annotations

import numpy as np

from artemis_drivers.virtual.lidar import Beams, LidarSpec, Sensor
from artemis_drivers.virtual.mesh_builder import F64
from artemis_drivers.virtual.prisms import deflect

POINTS_PER_SECOND = 240_000
FRAME_S = 0.1
LINES = 6
WEDGE = np.radians([30.8856, 29.7735, 3.1351])
RATE_HZ = np.array([-131.5463, 40.8032, 213.1611])
INDEX = 1.51
# elevation of the outer lasers before the prisms: with it the field is 77.2 degrees high behind them
_OUTER = 3.08 * np.pi / 180


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
    elevation = _OUTER * (2 * np.arange(LINES) / (LINES - 1) - 1)
    laser = np.column_stack([np.cos(elevation), np.zeros(LINES), np.sin(elevation)])
    out = np.empty((len(time_s), 3))
    deflect(WEDGE, RATE_HZ, INDEX, laser, line, np.asarray(time_s, np.float64), out)
    return out


SENSOR = Sensor("Livox Avia", beams, LidarSpec(), POINTS_PER_SECOND, LINES)
