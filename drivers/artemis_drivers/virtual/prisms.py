"""Rotating prisms in front of a laser: the optics of Livox' rosettes, by Snell's law.

Every wedge has its slanted face towards the laser and its flat face, square to the axis, away from it. With the
wedges and rates that are published this gives the published fields of view, which no other arrangement of the
faces does: 38.3 degrees for the Mid-40 (its sheet: 38.4) and 70.4 for one laser of the Avia.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import njit
from artemis_drivers.virtual.mesh_builder import F64


@njit
def deflect(
    wedge: F64, rate: F64, index: float, laser: F64, which: NDArray[np.int64], time: F64, out: F64
) -> None:
    """Unit directions (n, 3), x along the axis, y left, z up, of shots through rotating wedges.

    ``wedge`` radians and ``rate`` turns per second of each prism in the order that light passes them; ``laser``
    (lasers, 3) unit directions before the prisms and ``which`` (n,) the one that fired at ``time`` (n,) s.
    """
    tilt, straight = np.sin(wedge), np.cos(wedge)
    for i in range(len(time)):
        d = (laser[which[i], 0], laser[which[i], 1], laser[which[i], 2])
        for p in range(len(wedge)):
            angle = 2 * np.pi * rate[p] * time[i]
            face = (-straight[p], -tilt[p] * np.cos(angle), -tilt[p] * np.sin(angle))
            d = refract(d, face, 1.0 / index)
            d = refract(d, (-1.0, 0.0, 0.0), index)
        out[i, 0], out[i, 1], out[i, 2] = d


@njit
def refract(
    d: tuple[float, float, float], n: tuple[float, float, float], ratio: float
) -> tuple[float, float, float]:
    """Snell's law: unit ray ``d`` through a face of normal ``n`` (against the ray), indices in/out ``ratio``."""
    c = -(d[0] * n[0] + d[1] * n[1] + d[2] * n[2])
    e = ratio * c - np.sqrt(1.0 - ratio * ratio * (1.0 - c * c))
    return ratio * d[0] + e * n[0], ratio * d[1] + e * n[1], ratio * d[2] + e * n[2]
