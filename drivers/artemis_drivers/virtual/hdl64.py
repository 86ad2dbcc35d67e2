"""Scan pattern of a spinning Velodyne HDL-64E S2 at 10 turns a second: a fan of 64 beams that goes around.

From public simulators that quote the data sheet: BlenSor (velodyne module): 0.1728 degrees of azimuth between
volleys at 10 Hz, range noise 2 cm, 50 m at 10 % and 120 m at 80 % reflectivity, pulse of 5 ns; HELIOS++
(data/scanners_tls.xml): 64 elevations evenly from -24.8 to 2 degrees, divergence 0.7 mrad. Assumptions: the
lasers of a volley fire evenly one after the other, from the top; clockwise seen from above, beginning
backwards (so that a frame is cut where KITTI's are); nothing nearer than 0.9 m; direction noise of 0.02
degrees.
"""

from __future__ import annotations

import numpy as np

from artemis_drivers.virtual.lidar import Beams, LidarSpec, Sensor
from artemis_drivers.virtual.mesh_builder import F64

LINES = 64
FRAME_S = 0.1
_DEG = np.pi / 180
_VOLLEY_S = 0.1728 / 360 * FRAME_S
_SHOT_S = _VOLLEY_S / LINES
POINTS_PER_SECOND = round(1 / _SHOT_S)
ELEVATION = np.linspace(2.0, -24.8, LINES) * _DEG


def beams(frame: int, density: float = 1.0) -> Beams:
    """Beams of a turn. ``density`` 0..1 is the share of volleys that are kept; lasers fire on over the cut
    between frames, which therefore differ by one shot in number.
    """
    # a little slack: no shot is lost or doubled by rounding
    first = int(np.ceil(frame * FRAME_S / _SHOT_S - 1e-6))
    last = int(np.ceil((frame + 1) * FRAME_S / _SHOT_S - 1e-6))
    number = np.arange(first, last)
    volley = number // LINES
    number = number[np.floor((volley + 1) * density) > np.floor(volley * density)]
    time, line = number * _SHOT_S, number % LINES
    inside = np.maximum(time - frame * FRAME_S, 0.0)
    return Beams(inside, direction(time, line), line.astype(np.uint8))


def direction(time_s: F64, line: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> F64:
    """Unit directions (n, 3) in the LiDAR's frame, x forward, y left, z up, of laser ``line`` at a time."""
    azimuth = np.pi - 2 * np.pi * time_s / FRAME_S
    flat, up = np.cos(ELEVATION)[line], np.sin(ELEVATION)[line]
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up])


SPEC = LidarSpec(
    angular_noise=0.02 * _DEG,
    divergence_vertical=0.0007,
    divergence_horizontal=0.0007,
    detect_m=50.0,
    exponent=float(np.log(120 / 50) / np.log(8)),
    max_range_m=120.0,
    min_range_m=0.9,
    merge_m=0.9,
    resolution_m=0.75,
)
SENSOR = Sensor("Velodyne HDL-64E S2", beams, SPEC, POINTS_PER_SECOND, LINES)
