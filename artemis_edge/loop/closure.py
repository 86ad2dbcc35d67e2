"""Places seen again: candidates by nearness, each proved by registration of what was seen there."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from artemis_edge.errors import InputError
from artemis_edge.frames import F64
from artemis_edge.loop.keyframes import Keyframe, submap
from artemis_edge.odometry import se3
from artemis_edge.trajectory import inverse

_LEAST_WAY_M = 15.0  # walked in between: less is no loop but the odometry's own neighbourhood
_REACH_M, _DRIFT = (
    3.0,
    0.03,
)  # how near in the odometry's poses: walking beside it, and drift as a share of the way
_FARTHEST_M = 15.0
_HEADING = 0.5  # cosine of the angle between views that can overlap: 60 deg
_FITS_M = 0.3  # a point this near to one of the other submap is explained
_LEAST_OVERLAP = 0.7  # share of the points, of those that the other submap surrounds
_LEAST_POINTS = 300
_SIGMA_M = 0.03  # of a registration in the direction that it knows best
_LEAST_OBSERVED = 0.02  # smallest to largest eigenvalue of the information on the place


class Loop(NamedTuple):
    """Keyframes ``a`` and ``b``, T_a_b (4, 4) and its information (6, 6), rotation first, right perturbation."""

    a: int
    b: int
    T_a_b: F64
    information: F64


def require_extra() -> Any:
    """``small_gicp``; InputError where the extra is missing."""
    try:
        import gtsam  # noqa: F401  (needed later: better to know now)
        import small_gicp
    except ImportError:
        raise InputError(
            "odometry.close_loops needs the extra 'loop'; install it with: pip install 'artemis-edge[loop]'"
        ) from None
    return small_gicp


def find_loops(keyframes: list[Keyframe]) -> list[Loop]:
    """All loops that registration proves, in order."""
    registration = require_extra()
    found = []
    for a, b in candidates(keyframes):
        loop = _prove(registration, keyframes, a, b)
        if loop is not None:
            found.append(loop)
    return found


def candidates(keyframes: list[Keyframe]) -> list[tuple[int, int]]:
    """For every keyframe b the nearest earlier a that saw the same way, a long way before."""
    if len(keyframes) < 2:
        return []
    place = np.array([k.T_world_lidar[:3, 3] for k in keyframes])
    heading = np.array([k.T_world_lidar[:3, 0] for k in keyframes])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    pairs = []
    for b in range(len(keyframes)):
        apart = np.linalg.norm(place[:b] - place[b], axis=1)
        between = way[b] - way[:b]
        reach = np.minimum(_REACH_M + _DRIFT * between, _FARTHEST_M)
        good = (between > _LEAST_WAY_M) & (apart < reach) & (heading[:b] @ heading[b] > _HEADING)
        if good.any():
            pairs.append((int(np.argmin(np.where(good, apart, np.inf))), b))
    return pairs


def _prove(registration: Any, keyframes: list[Keyframe], a: int, b: int) -> Loop | None:
    """Register coarse, then fine; None where the submaps do not explain one another."""
    target, source = submap(keyframes, a), submap(keyframes, b)
    if min(len(target), len(source)) < _LEAST_POINTS:
        return None
    T = guess = inverse(keyframes[a].T_world_lidar) @ keyframes[b].T_world_lidar
    result = None
    for reach_m in (2.0, 0.7):
        result = registration.align(
            target, source, T, "GICP", downsampling_resolution=0.25, max_correspondence_distance=reach_m,
            num_threads=1, max_iterations=40,
        )  # fmt: skip
        T = np.array(result.T_target_source, np.float64)
    moved = se3.log(inverse(guess) @ se3.orthonormal(T))
    if result is None or not result.converged or np.linalg.norm(moved[:3]) > _FARTHEST_M:
        return None
    H = np.array(result.H, np.float64)
    seen = np.linalg.eigvalsh(H[3:, 3:])
    if overlap(target, source, T) < _LEAST_OVERLAP or seen[0] < _LEAST_OBSERVED * seen[-1]:
        return None
    return Loop(a, b, se3.orthonormal(T), H / (seen[-1] * _SIGMA_M**2))


def overlap(target: F64, source: F64, T_target_source: F64) -> float:
    """Share of the source's points, of those inside the target's box, that lie near one of the target's."""
    moved = source @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    inside = ((moved > target.min(axis=0)) & (moved < target.max(axis=0))).all(axis=1)
    if inside.sum() < _LEAST_POINTS:
        return 0.0
    distance, _ = KDTree(target).query(moved[inside], distance_upper_bound=_FITS_M)
    return float(np.isfinite(distance).mean())
