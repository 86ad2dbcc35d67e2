"""Echoes: what a receiver makes of the light that a beam's spot sends back.

The lanes of a spot, sorted by distance, are one echo while they lie on one plane or within the pulse's range
resolution of each other: their ranges mix, weighted by the light that arrives, and a point appears where
nothing is. Further apart they are echoes of their own. An echo is seen when its light, expressed as the
reflectivity of a wall that fills the spot squarely, suffices at its range; a sensor reports its strongest
echoes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import njit
from artemis_drivers.virtual.footprint import Spots
from artemis_drivers.virtual.mesh_builder import F32, F64, I32, U8
from artemis_drivers.virtual.scene import Scene, Surface
from artemis_drivers.virtual.shading import sample
from artemis_drivers.virtual.textures import TextureArrays

#: A material of at least this reflectivity is a retro-reflecting film (road signs, licence plates).
RETRO = 0.8
#: Light of such a film, and of a pane that is hit squarely, against a white wall's (assumption; films return
#: hundreds of times as much, receivers saturate).
RETRO_GAIN = 30.0
MOST_RETURNS = 3
_TEXTURE_LOD = 3.0  # eight texels: about what a spot covers at ten metres
_DARKEST = 0.01


class Receiver(NamedTuple):
    """What decides whether an echo is seen, see lidar.LidarSpec for the units and sources."""

    detect_m: float
    exponent: float
    max_range_m: float
    min_range_m: float
    resolution_m: float
    merge_m: float
    returns: int


class Echoes(NamedTuple):
    """Echoes of n beams, at most MOST_RETURNS each, in order of range.

    ``found`` int32 (n,); per echo (n, MOST_RETURNS): ``range_m`` float64 mean of its lanes, ``spread_m``
    float64 standard deviation of their ranges, ``light`` float64 reflectivity of a square wall that returns
    as much, ``lane`` int32 that stands for it, ``number`` uint8 in the order of arrival, from 1, ``mixed``
    bool where its lanes met several planes.
    """

    found: I32
    range_m: F64
    spread_m: F64
    light: F64
    lane: I32
    number: U8
    mixed: NDArray[np.bool_]


def echoes(scene: Scene, spots: Spots, receiver: Receiver, fading: F64) -> Echoes:
    """Echoes of a scan's spots; ``fading`` float64 (n,) scales the range at which each beam still sees."""
    light = returned_light(scene, spots)
    out = empty_echoes(len(light))
    receive(spots.distance, spots.triangle, light, scene.surface.key, receiver, fading, out)
    return out


def returned_light(scene: Scene, spots: Spots) -> F32:
    """Light (n, lanes) that each lane returns against that of a white wall; 0 where it met nothing."""
    light = np.zeros(spots.distance.shape, np.float32)
    _light(spots.triangle, spots.cosine, spots.texture, scene.surface, scene.atlas.arrays, light)
    return light


def empty_echoes(beams: int) -> Echoes:
    """Room for the echoes of so many beams, none found yet."""
    shape = (beams, MOST_RETURNS)
    return Echoes(
        np.zeros(beams, np.int32),
        np.zeros(shape),
        np.zeros(shape),
        np.zeros(shape),
        np.zeros(shape, np.int32),
        np.zeros(shape, np.uint8),
        np.zeros(shape, np.bool_),
    )


@njit
def _light(
    triangle: I32, cosine: F32, texture: F32, surface: Surface, textures: TextureArrays, light: F32
) -> None:
    """Light that each lane returns: reflectivity, varied by the picture, times the cosine of incidence."""
    for i in range(len(triangle)):
        last, rho = -1, 0.0
        for k in range(triangle.shape[1]):
            t = triangle[i, k]
            if t < 0:
                continue
            m = surface.look[t, 3]
            if textures.glass[m]:  # only squarely hit panes are in the list
                light[i, k] = RETRO_GAIN
                continue
            if t != last:  # lanes on one triangle share its picture: the spot is smaller than its detail
                last = t
                rgb = sample(
                    textures.texels, textures.start, m, texture[i, k, 0], texture[i, k, 1], _TEXTURE_LOD
                )
                bright = 0.5 + 0.5 * (rgb[0] + rgb[1] + rgb[2]) / (3.0 * max(textures.mean_luma[m], 1.0))
                rho = min(max(textures.reflectivity[m] * bright, _DARKEST), 1.0)
            light[i, k] = RETRO_GAIN if textures.reflectivity[m] >= RETRO else rho * cosine[i, k]


@njit
def seen_m(light: float, detect_m: float, exponent: float) -> float:
    """Range at which an echo is just seen: ``detect_m`` at 10 %, see LidarSpec.exponent."""
    power = exponent if light > 0.1 else 0.5
    return float(detect_m * (light / 0.1) ** power)


@njit
def _sort_lanes(distance: F32, order: I32) -> int:
    """Lanes that met something, nearest first; returns their number."""
    count = 0
    for k in range(len(distance)):
        if not np.isfinite(distance[k]):
            continue
        at = count
        while at > 0 and distance[order[at - 1]] > distance[k]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = k
        count += 1
    return count


@njit
def _mix(distance: F32, light: F32, order: I32, start: int, stop: int) -> tuple[float, float, float, int]:
    """Mean range, spread, light (of the whole spot) and representative lane of sorted lanes start..stop."""
    total, weight, mean = 0.0, 0.0, 0.0
    for j in range(start, stop):
        k = order[j]
        received = light[k] / distance[k] ** 2
        total += light[k]
        weight += received
        mean += received * distance[k]
    mean /= max(weight, 1e-30)
    spread, best, nearest = 0.0, order[start], np.inf
    middle = 0.5 * (len(distance) - 1)
    for j in range(start, stop):
        k = order[j]
        spread += light[k] / distance[k] ** 2 * (distance[k] - mean) ** 2
        # the lane nearest to the beam's axis on the surface that the mixed range is nearest to
        off = abs(distance[k] - mean) + 1e-4 * abs(k - middle)
        if off < nearest:
            best, nearest = k, off
    return mean, np.sqrt(spread / max(weight, 1e-30)), total / len(distance), best


@njit
def receive(
    distance: F32, triangle: I32, light: F32, key: NDArray[np.uint32], r: Receiver, fading: F64, out: Echoes
) -> None:
    """Echoes of spots given by their lanes (n, lanes); ``key`` is equal for triangles of one plane."""
    order = np.empty(distance.shape[1], np.int32)
    for i in range(len(distance)):
        count = _sort_lanes(distance[i], order)
        start, number = 0, 0
        while start < count:
            stop, mixed = start + 1, False
            while stop < count:
                gap = distance[i, order[stop]] - distance[i, order[stop - 1]]
                same = key[triangle[i, order[stop]]] == key[triangle[i, order[stop - 1]]]
                if gap > r.resolution_m and not same:
                    break
                mixed = mixed or not same
                stop += 1
            mean, spread, power, lane = _mix(distance[i], light[i], order, start, stop)
            start = stop
            farthest = min(seen_m(power, r.detect_m, r.exponent) * fading[i], r.max_range_m)
            if r.min_range_m <= mean <= farthest:
                # an echo as near as the sensor's own reflection is not told from it
                number += 1 if mean >= r.merge_m else 0
                _keep(out, i, r.returns, (mean, spread, power, lane, number, mixed))


@njit
def _keep(out: Echoes, i: int, returns: int, echo: tuple[float, float, float, int, int, bool]) -> None:
    """Append an echo; when there are too many, the weakest received goes (light over range squared)."""
    at = out.found[i]
    if at == returns:
        weakest, least = -1, echo[2] / echo[0] ** 2
        for k in range(returns):
            strength = out.light[i, k] / out.range_m[i, k] ** 2
            if strength < least:
                weakest, least = k, strength
        if weakest < 0:
            return
        for k in range(weakest, returns - 1):
            next_one = (
                out.range_m[i, k + 1],
                out.spread_m[i, k + 1],
                out.light[i, k + 1],
                out.lane[i, k + 1],
                out.number[i, k + 1],
                out.mixed[i, k + 1],
            )
            _store(out, i, k, next_one)
        at = returns - 1
    _store(out, i, at, echo)
    out.found[i] = at + 1


@njit
def _store(out: Echoes, i: int, k: int, echo: tuple[float, float, float, int, int, bool]) -> None:
    out.range_m[i, k], out.spread_m[i, k], out.light[i, k] = echo[0], echo[1], echo[2]
    out.lane[i, k], out.number[i, k], out.mixed[i, k] = echo[3], echo[4], echo[5]
