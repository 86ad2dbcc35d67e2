"""Scan pattern of the Livox Mid-360: four lasers thrown all around by a fast mirror, nodding slowly.

Published (livoxtech.com/mid-360/specs as quoted by public projects): 360 degrees by -7..52 degrees, 200 000
points/s, typically 10 Hz, 40 m at 10 % reflectivity and 70 m at 80 % (100 klx), blind below 0.1 m, range
precision 2 cm (10 m), angular precision below 0.15 degrees (1 sigma). Four lines: Livox SDK 2.

The pattern is a fit to stretches of 3 ms at 0, 33 and 200 ms of the table that Livox publishes for simulators
(livox_laser_simulation, scan_mode/mid360.csv; times from its copy in carla_0.9.15_livoxLidar): a shot every 5
us, lasers in turn; azimuth falls by 36.497 turns, unevenly, while the mean zenith nods twice in 200.09 ms; the
lasers stand in a row that turns with the mirror, 4.15 degrees either way at the top of the field and less
below, and 2.65 degrees in azimuth. The fit follows those stretches within 1 degree of elevation and 4 of
azimuth; in between it is a guess. The beam's shape and pulse are not published: assumed to be the Avia's.
"""

from __future__ import annotations

import numpy as np

from artemis_drivers.virtual.lidar import Beams, LidarSpec, Sensor
from artemis_drivers.virtual.mesh_builder import F64

POINTS_PER_SECOND = 200_000
FRAME_S = 0.1
LINES = 4
_DEG = np.pi / 180
_TURN_HZ = -36.497 / 0.20009
_NOD_HZ = 2 / 0.20009
_START = 269.0 * _DEG
# zenith of the row's middle: 68.6 - 26.5 cos + 2 (cos 2x - 1), degrees
_ZENITH, _NOD, _SECOND = 68.6 * _DEG, 26.5 * _DEG, 2.0 * _DEG
_UNEVEN = (34.6 * _DEG, 5.7 * _DEG, 1.3 * _DEG)  # of the azimuth, with one to three times the nod's phase
_ROW_ZENITH, _ROW_AZIMUTH = 4.15 * _DEG, 2.65 * _DEG  # half the row's length where the zenith is 42 degrees
_ROW_SHRINKS = 0.045  # of its length in zenith per zenith
_TOP = 42.0 * _DEG
_PLACE = np.array([-1.0, -1 / 3, 1 / 3, 1.0])  # of the lasers along their row


def beams(frame: int, density: float = 1.0) -> Beams:
    """Beams of a 100 ms frame. ``density`` 0..1 is the share of shots of all four lasers that are kept."""
    number = np.arange(round(POINTS_PER_SECOND * FRAME_S))
    volley = number // LINES
    number = number[np.floor((volley + 1) * density) > np.floor(volley * density)]
    time, line = number / POINTS_PER_SECOND, number % LINES
    return Beams(time, direction(frame * FRAME_S + time, line), line.astype(np.uint8))


def direction(time_s: F64, line: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> F64:
    """Unit directions (n, 3) in the LiDAR's frame, x forward, y left, z up, of laser ``line`` at a time."""
    nod, turn = 2 * np.pi * _NOD_HZ * time_s, 2 * np.pi * _TURN_HZ * time_s
    middle = _ZENITH - _NOD * np.cos(nod) + _SECOND * (np.cos(2 * nod) - 1)
    place = _PLACE[line]
    zenith = middle + place * (_ROW_ZENITH - _ROW_SHRINKS * (middle - _TOP)) * np.cos(turn)
    azimuth = _START + turn + place * _ROW_AZIMUTH * np.sin(turn)
    for k, share in enumerate(_UNEVEN):
        azimuth += share * np.sin((k + 1) * nod)
    return np.column_stack(
        [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)]
    )


SPEC = LidarSpec(
    angular_noise=0.15 * _DEG,
    detect_m=40.0,
    exponent=float(np.log(70 / 40) / np.log(8)),
    max_range_m=70.0,
    min_range_m=0.1,
    merge_m=0.1,
)
SENSOR = Sensor("Livox Mid-360", beams, SPEC, POINTS_PER_SECOND, LINES)
