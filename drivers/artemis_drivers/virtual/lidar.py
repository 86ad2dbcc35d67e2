"""A scanning LiDAR in a scene: beams from the true pose at their own times, spots, echoes, noise and loss.

What a sensor scans is a :data:`Pattern` (``avia.py``, ``mid360.py``, ``hdl64.py``); the physics here is common
to all: ``footprint.py`` casts each beam's spot, ``echo.py`` turns it into echoes, and this module adds noise.
The sources of a sensor's figures are named where its :class:`LidarSpec` is made.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import njit
from artemis_drivers.virtual.echo import MOST_RETURNS, RETRO_GAIN, Echoes, Receiver, echoes
from artemis_drivers.virtual.footprint import Spots, fan_out, lane_offsets
from artemis_drivers.virtual.mesh_builder import F32, F64, I32, U8
from artemis_drivers.virtual.motion import Motion
from artemis_drivers.virtual.scene import Scene

_DEG = np.pi / 180
_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))  # full width at half maximum of a Gaussian, in sigmas
_KNOT_S = 0.0005  # poses are interpolated between knots: 10 m/s2 err 0.3 um, 10 rad/s2 0.3 urad


@dataclass(frozen=True, slots=True)
class LidarSpec:
    """Physics of a time-of-flight LiDAR; metres, radians. The defaults are the Livox Avia's.

    From its specification page (livoxtech.com/avia/specs, as quoted by public projects; the page itself could
    not be opened): range precision 2 cm (1 sigma, 20 m); angular precision below 0.05 deg (1 sigma), taken as
    0.05; beam divergence 0.28 deg vertical x 0.03 deg horizontal, taken as full widths at half maximum; at 100
    klx 190 m at 10 % reflectivity, 230 m at 20 %, 320 m at 80 %, which ``exponent`` 0.25 fits within 2 %; 450
    m at most; nearer than 1 m is not measured. ``returns`` 1 is "strongest", 2 "dual" (Livox SDK).

    From the manual of the Mid-70 (p. 16): echoes nearer than 1.5 m may merge with the sensor's own and then
    bear the return number 0. From HELIOS++ (data/scanners_tls.xml, Mid-70): pulse of 4 ns, hence
    ``resolution_m`` c / 2 * 4 ns.

    Assumptions: the noise's variance doubles at ``noise_growth_m``; a fifth of the spread of ranges inside a
    spot shows as noise (``stretch_share``); below 10 % of light the range falls with the square root of it;
    the range at which an echo is lost scatters by ``fading``; an echo's range is the mean of its light.
    """

    range_noise_m: float = 0.02
    noise_growth_m: float = 100.0
    stretch_share: float = 0.2
    angular_noise: float = 0.05 * _DEG
    divergence_vertical: float = 0.28 * _DEG
    divergence_horizontal: float = 0.03 * _DEG
    detect_m: float = 190.0
    exponent: float = 0.25
    max_range_m: float = 450.0
    min_range_m: float = 1.0
    merge_m: float = 1.5
    resolution_m: float = 0.6
    fading: float = 0.05
    returns: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.returns <= MOST_RETURNS:
            raise ValueError(f"a LiDAR reports 1 to {MOST_RETURNS} returns a beam, not {self.returns}")


@dataclass(frozen=True, slots=True)
class Beams:
    """``time_s`` float64 (n,) from the frame's start, ``direction`` float64 (n, 3) unit in the sensor's
    frame, ``line`` uint8 (n,) laser.
    """

    time_s: F64
    direction: F64
    line: U8


#: (index of the frame, share of the points) -> its beams.
Pattern = Callable[[int, float], Beams]


@dataclass(frozen=True, slots=True)
class Sensor:
    """A model of LiDAR: its pattern, its physics and what its data sheet promises."""

    name: str
    beams: Pattern
    spec: LidarSpec
    points_per_second: int
    lines: int
    frame_s: float = 0.1


@dataclass(frozen=True, slots=True)
class Frame:
    """What the sensor reports, and the truth behind it, for ``n`` echoes in the order of their beams.

    ``points`` float32 (n, 3) in the sensor's frame at each point's own time; ``offset_ns`` uint32;
    ``intensity`` float32 0..1 as Livox' reflectivity byte / 255 (a Lambertian wall of 100 % gives 150, retro
    reflectors more); ``line`` uint8; ``tag`` uint8 as Livox': return number in bits 4-5; ``emitted`` number
    of beams. Truth: ``beam`` int32 row of the pattern; ``triangle`` int32 of the scene, ``origin`` and
    ``hit`` float64 (n, 3) in world, without noise, of the lane that stands for the echo; ``mixed`` bool where
    its lanes met more than one plane.
    """

    points: F32
    offset_ns: NDArray[np.uint32]
    intensity: F32
    line: U8
    tag: U8
    emitted: int
    beam: I32
    triangle: I32
    origin: F64
    hit: F64
    mixed: NDArray[np.bool_]


def scan(
    scene: Scene,
    motion: Motion,
    T_body_lidar: F64,
    beams: Beams,
    start_s: float,
    spec: LidarSpec,
    rng: np.random.Generator,
) -> Frame:
    """One frame that starts at ``start_s``: every beam leaves from the true pose at its own time."""
    origin, R = poses_at(motion, T_body_lidar, start_s, beams.time_s)
    offsets = lane_offsets(spec.divergence_vertical / _FWHM, spec.divergence_horizontal / _FWHM)
    fan = np.empty((len(origin), 3, len(offsets)), np.float32)
    fan_out(beams.direction, R, offsets, fan)
    spots = Spots(scene, origin, fan, start_s + beams.time_s, spec.max_range_m)
    # drawn for every beam, so that one beam's noise does not depend on what the others met
    fading = np.maximum(1 + spec.fading * rng.standard_normal(len(origin)), 0.0)
    noise = rng.standard_normal((len(origin), 2 + MOST_RETURNS))
    return _report(scene, beams, spots, echoes(scene, spots, _receiver(spec), fading), spec, noise)


def _receiver(spec: LidarSpec) -> Receiver:
    return Receiver(
        spec.detect_m,
        spec.exponent,
        spec.max_range_m,
        spec.min_range_m,
        spec.resolution_m,
        spec.merge_m,
        spec.returns,
    )


def _report(scene: Scene, beams: Beams, spots: Spots, found: Echoes, spec: LidarSpec, noise: F64) -> Frame:
    """The echoes as points, with noise."""
    beam, number = np.nonzero(np.arange(MOST_RETURNS) < found.found[:, None])
    distance, lane = found.range_m[beam, number], found.lane[beam, number]
    sigma = range_sigma(spec, distance, found.spread_m[beam, number])
    # all echoes of a beam share the error of its direction
    direction = _jittered(beams.direction[beam], noise[beam, :2] * spec.angular_noise)
    points = (distance + noise[beam, 2 + number] * sigma)[:, None] * direction
    triangle = spots.triangle[beam, lane]
    hit = spots.origin[beam] + spots.distance[beam, lane, None].astype(np.float64) * spots.fan[beam, :, lane]
    return Frame(
        points=points.astype(np.float32),
        offset_ns=np.rint(beams.time_s[beam] * 1e9).astype(np.uint32),
        intensity=_reflectivity(found.light[beam, number]),
        line=beams.line[beam],
        tag=found.number[beam, number] << np.uint8(4),
        emitted=len(beams.time_s),
        beam=beam.astype(np.int32),
        triangle=triangle,
        origin=spots.origin[beam],
        hit=hit,
        mixed=found.mixed[beam, number],
    )


def _reflectivity(light: F64) -> F32:
    """Livox' scale / 255: 0..150 for 0..100 % of a white wall, the rest for what outshines it."""
    diffuse = np.minimum(light, 1.0) * 150.0
    beyond = np.clip((light - 1.0) / (RETRO_GAIN - 1.0), 0.0, 1.0) * 105.0
    return ((diffuse + beyond) / 255.0).astype(np.float32)


def range_sigma(spec: LidarSpec, distance: F64, spread: F64) -> F64:
    """Standard deviation of the range, metres: grows with distance and with the spread inside the spot."""
    if spec.range_noise_m == 0:
        return np.zeros_like(distance)
    base = spec.range_noise_m**2 * (1 + (distance / spec.noise_growth_m) ** 2)
    return np.asarray(np.sqrt(base + (spec.stretch_share * spread) ** 2))


def poses_at(motion: Motion, T_body_lidar: F64, start_s: float, time_s: F64) -> tuple[F64, F64]:
    """Positions (n, 3) and rotations (n, 3, 3) of the LiDAR in world, linear between knots of 0.5 ms."""
    finite = time_s[np.isfinite(time_s)]
    longest = float(finite.max()) if len(finite) else 0.0
    knots = np.arange(int(longest / _KNOT_S) + 2) * _KNOT_S
    T = motion.pose(start_s + knots) @ T_body_lidar
    origin, R = np.empty((len(time_s), 3)), np.empty((len(time_s), 3, 3))
    _between(T, time_s, _KNOT_S, origin, R)
    return origin, R


@njit
def _between(T: F64, time: F64, step: float, origin: F64, R: F64) -> None:
    """Matrices (knots, 4, 4) interpolated entry by entry; NaN where the time is not finite."""
    for i in range(len(time)):
        at = time[i] / step
        if not 0.0 <= at <= len(T) - 1:
            origin[i] = np.nan
            R[i] = np.nan
            continue
        k = min(int(at), len(T) - 2)
        share = at - k
        for a in range(3):
            origin[i, a] = T[k, a, 3] + share * (T[k + 1, a, 3] - T[k, a, 3])
            for b in range(3):
                R[i, a, b] = T[k, a, b] + share * (T[k + 1, a, b] - T[k, a, b])


def _jittered(direction: F64, angle: F64) -> F64:
    """Unit directions turned by small angles (n, 2) across them, horizontally and vertically."""
    out = np.empty(direction.shape)
    _turn(direction, angle, out)
    return out


@njit
def _turn(direction: F64, angle: F64, out: F64) -> None:
    for i in range(len(direction)):
        x, y, z = direction[i, 0], direction[i, 1], direction[i, 2]
        flat = np.sqrt(x * x + y * y)
        hx, hy = (-y / flat, x / flat) if flat > 1e-9 else (0.0, 1.0)
        side, up = angle[i, 0], angle[i, 1]
        tx, ty, tz = x + side * hx - up * z * hy, y + side * hy + up * z * hx, z + up * (x * hy - y * hx)
        scale = 1.0 / np.sqrt(tx * tx + ty * ty + tz * tz)
        out[i, 0], out[i, 1], out[i, 2] = tx * scale, ty * scale, tz * scale
