"""A scanning LiDAR in a scene: beams from the true pose at their own times, range noise, reflectivity, loss.

What a sensor scans is a :class:`Pattern` (see ``avia.py``); the physics here is common to all.

Sources. Range noise: Livox states a distance random error (1 sigma) below 2 cm at 20 m on 80 % reflectivity
(HAP user manual, table 1.2.1, which also gives the 0.28 x 0.03 degree beam of that family); we take 2 cm at
all ranges up to there. Angular noise: below 0.1 degree there; 0.05 degree for the Avia (its specification).
Detection: 190 m at 10 % reflectivity (Avia specification, 100 klx), scaled by the link budget P ~ rho cos /
r2. Growth of the noise with range and with the stretch of the pulse on slanted surfaces is our assumption.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import njit
from artemis_drivers.virtual.mesh_builder import F32, F64, I32, U8
from artemis_drivers.virtual.motion import Motion
from artemis_drivers.virtual.raycast import Hits, cast
from artemis_drivers.virtual.scene import Scene, Surface
from artemis_drivers.virtual.shading import sample
from artemis_drivers.virtual.textures import TextureArrays


@dataclass(frozen=True, slots=True)
class LidarSpec:
    """Physics of a time-of-flight LiDAR; metres, radians."""

    range_noise_m: float = 0.02
    noise_growth_m: float = 100.0  # range at which the noise variance has doubled
    beam_sigma: float = 0.28 * np.pi / 180 / 2.355  # of the beam's wide axis (full width at half maximum)
    stretch_share: float = 0.2  # share of a slanted footprint's depth that shows as range noise
    angular_noise: float = 0.05 * np.pi / 180
    detect_m: float = 190.0  # range at which 10 % reflectivity is just seen
    max_range_m: float = 450.0
    min_range_m: float = 0.5


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
class Frame:
    """What the sensor reports, and the truth behind it, for the ``n`` beams that returned.

    ``points`` float32 (n, 3) in the sensor's frame at each point's own time; ``offset_ns`` uint32;
    ``intensity`` float32 0..1; ``line`` uint8; ``emitted`` number of beams. Truth: ``triangle`` int32 of the
    scene's mesh, ``origin`` and ``hit`` float64 (n, 3) in world, without noise.
    """

    points: F32
    offset_ns: NDArray[np.uint32]
    intensity: F32
    line: U8
    emitted: int
    triangle: I32
    origin: F64
    hit: F64


@njit
def _reflectivity(triangle: I32, hit: F64, surface: Surface, textures: TextureArrays, out: F64) -> None:
    """Material's reflectivity, varied by the picture at the point (hits relative to the scene's origin)."""
    for i in range(len(triangle)):
        row, m = surface.rows[triangle[i]], surface.look[triangle[i], 3]
        u = row[4] * hit[i, 0] + row[5] * hit[i, 1] + row[6] * hit[i, 2] + row[7]
        v = row[8] * hit[i, 0] + row[9] * hit[i, 1] + row[10] * hit[i, 2] + row[11]
        r, g, b = sample(textures.texels, textures.start, m, u, v, 3.0)
        bright = 0.5 + 0.5 * (r + g + b) / (3.0 * max(textures.mean_luma[m], 1.0))
        out[i] = min(max(textures.reflectivity[m] * bright, 0.01), 1.0)


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
    T = motion.pose(start_s + beams.time_s) @ T_body_lidar
    origin = T[:, :3, 3]
    direction = np.einsum("nij,nj->ni", T[:, :3, :3], beams.direction)
    hits = cast(scene.bvh, origin, direction, spec.max_range_m)
    # drawn for every beam, so that one beam's noise does not depend on what the others met
    noise = rng.standard_normal((len(direction), 3))
    seen = np.flatnonzero(hits.triangle >= 0)
    hit = origin[seen] + hits.distance_m[seen, None] * direction[seen]
    rho, cosine = _surface_at(scene, hits, seen, hit, direction)
    distance = hits.distance_m[seen]
    limit = spec.detect_m * np.sqrt(rho * cosine / 0.1)
    kept = (distance >= spec.min_range_m) & (distance <= np.minimum(limit, spec.max_range_m))
    seen, hit, rho, cosine, distance = seen[kept], hit[kept], rho[kept], cosine[kept], distance[kept]
    measured = distance + noise[seen, 0] * range_sigma(spec, distance, cosine)
    reported = _jittered(beams.direction[seen], noise[seen, 1:] * spec.angular_noise)
    return Frame(
        points=(measured[:, None] * reported).astype(np.float32),
        offset_ns=np.rint(beams.time_s[seen] * 1e9).astype(np.uint32),
        intensity=rho.astype(np.float32),
        line=beams.line[seen],
        emitted=len(direction),
        triangle=hits.triangle[seen],
        origin=origin[seen],
        hit=hit,
    )


def range_sigma(spec: LidarSpec, distance: F64, cosine: F64) -> F64:
    """Standard deviation of the range, metres: grows with distance and with the slant of the surface."""
    slant = np.minimum(np.sqrt(1 - np.minimum(cosine, 1) ** 2) / np.maximum(cosine, 0.02), 20.0)
    stretch = spec.stretch_share * distance * spec.beam_sigma * slant
    base = spec.range_noise_m
    if base == 0:
        return np.zeros_like(distance)
    return np.asarray(np.sqrt(base**2 * (1 + (distance / spec.noise_growth_m) ** 2) + stretch**2))


def _surface_at(
    scene: Scene, hits: Hits, seen: NDArray[np.intp], hit: F64, direction: F64
) -> tuple[F64, F64]:
    triangle, surface = hits.triangle[seen], scene.surface
    rho = np.empty(len(seen))
    _reflectivity(triangle, hit - scene.origin, surface, scene.atlas.arrays, rho)
    cosine = np.abs((surface.rows[triangle, :3] * direction[seen]).sum(axis=1))
    return rho, cosine


def _jittered(direction: F64, angle: F64) -> F64:
    """Unit directions turned by small angles (n, 2) about two axes across them."""
    across = np.column_stack([-direction[:, 1], direction[:, 0], np.zeros(len(direction))])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    up = np.cross(direction, across)
    turned = direction + angle[:, :1] * across + angle[:, 1:] * up
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))
