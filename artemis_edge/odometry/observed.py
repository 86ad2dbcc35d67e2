"""What points matched with planes tell of the pose, errors that they share counted as shared.

Three things would make a blank wall tell more than it does. Points of one plane share the error of its place and
tilts, which is an unknown of every plane and eliminated. A motion that the mean of n n' hardly sees is taken out of the
planes that do not face it: else the noise of their normals would say that the rig stands. And which way a wall as a
whole faces is known to a degree, so that of what may have been moved along it a little is seen across.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.frames import F64, Bool
from artemis_edge.odometry.registration import (
    DEGENERATE,
    GATE2,
    PLACE,
    PLANE,
    THICK,
    TILT,
    VARIANCE,
    accumulate,
    geman_mcclure,
    mirror,
    residual,
)
from artemis_edge.odometry.state import NormalEquations

_FACING2 = 0.5  # squared cosine: within 45 degrees; planes of few far scan lines are tilted by up to 30
_OPEN_M = 0.1  # deviation of the prior beyond which the plane that faces may be the wrong one
_LEAK_RAD = 0.02  # how well a wall as a whole is known to face its direction
_MIXED = 10.0  # a tenth of the points in a corner's voxel are of its smaller side
_LEAST_ARM_M = 1e-3


class Expected(NamedTuple):
    """What is known beforehand: covariance ``C`` (6, 6) of the pose (a right perturbation), what it means at the points
    (``miss_m``, one deviation), which a turn by a radian moves by ``arm_m``.
    """

    C: F64
    miss_m: float
    arm_m: float


class ByPlane(NamedTuple):
    """Normal equations ``H`` (6, 6), ``g`` (6,) of the pose, and the ``weight`` (1/m2) of the planes in them."""

    H: F64
    g: F64
    weight: float


def observed_part(matched: F64, T_world_lidar: F64, noise2: float, expected: Expected) -> NormalEquations:
    """Normal equations (6, 6) of the pose by matched planes (m, 12), those of a plane in a row, of what they observe.

    Motions are judged by what they move the points. Along one that the planes hardly observe only those that clearly
    face it are heard, a corridor's end; and not even they where the prior leaves open which plane a point belongs to.
    """
    if len(matched) == 0:
        return NormalEquations.none(6)
    scale = np.ones(6)  # motions in metres at the points are the perturbation divided by it
    scale[3:] = 1.0 / max(expected.arm_m, _LEAST_ARM_M)
    outer = np.outer(scale, scale)
    middle = len(matched) // 2
    usual2 = float(np.partition(matched[:, THICK], middle)[middle])
    whole = _by_plane(matched, T_world_lidar, noise2, usual2, expected)
    values, vectors = np.linalg.eigh(whole.H * outer / max(whole.weight, 1e-12))
    weak = vectors[:, values < DEGENERATE]
    if weak.shape[1] == 0:
        return NormalEquations(whole.H, whole.g)
    faces = _facing(matched, T_world_lidar, scale, weak)
    along = _by_plane(matched[faces], T_world_lidar, noise2, usual2, expected)
    across = _by_plane(matched[~faces], T_world_lidar, noise2, usual2, expected)
    C = weak.T @ (expected.C / outer) @ weak
    variances, axes = np.linalg.eigh(C)
    wide = weak @ axes[:, variances > _OPEN_M**2]
    hear, keep = _without(wide, scale), _without(weak, scale)
    H = hear @ along.H @ hear.T + keep @ across.H @ keep.T
    left = np.linalg.inv(np.eye(6) + _LEAK_RAD**2 * np.trace(C) * H * scale**2)
    return NormalEquations(left @ H, left @ (hear @ along.g + keep @ across.g))


def _facing(matched: F64, T_world_lidar: F64, scale: F64, directions: F64) -> Bool:
    """Which planes face a space of motions, an orthonormal basis (6, k) in metres at the points."""
    normals = matched[:, 3:6] @ T_world_lidar[:3, :3]
    seen = np.hstack([normals, np.cross(matched[:, :3], normals)]) * scale
    return np.asarray(np.square(seen @ directions).sum(axis=1) > _FACING2)


def _without(directions: F64, scale: F64) -> F64:
    """The projection K (6, 6), H -> K H K' and g -> K g, that takes motions out of normal equations."""
    K: F64 = (np.eye(6) - directions @ directions.T) * np.outer(1.0 / scale, scale)
    return K


def _by_plane(matched: F64, T_world_lidar: F64, noise2: float, usual2: float, expected: Expected) -> ByPlane:
    sums: ByPlane = by_plane(matched, T_world_lidar, noise2, usual2, expected.miss_m**2)
    return sums


@njit
def by_plane(matched: F64, T_world_lidar: F64, noise2: float, usual2: float, miss2: float) -> ByPlane:
    """``registration.linearise`` of matched planes (m, 12), those of a plane in a row, whose points err together.

    A plane's place errs as the mean of the points that made it. If they are thicker than usual (``usual2``, m2) the
    voxel holds a corner, and points of the smaller side lie as far from the plane as that side does. Its tilts err
    likewise, which moves its place by the motion still expected (``miss2``, m2). This error of variance s is
    eliminated: H = sum A - b b' / (c + 1 / s).
    """
    H, g, J = np.zeros((6, 6)), np.zeros(6), np.empty(6)
    b, br, c, total = np.zeros(6), 0.0, 0.0, 0.0
    for i in range(len(matched)):
        r = residual(matched[i], T_world_lidar, J)
        s2 = noise2 + matched[i, VARIANCE]
        if r * r <= GATE2 * s2:
            weight = geman_mcclure(r * r / s2) / s2
            c += weight
            br += weight * r
            for j in range(6):
                b[j] += weight * J[j]
            accumulate(H, g, J, r, weight)
        if i + 1 == len(matched) or matched[i + 1, PLANE] != matched[i, PLANE]:
            mixed = _MIXED * max(matched[i, THICK] - usual2, 0.0)
            shared = (matched[i, PLACE] + mixed) * (1.0 + matched[i, TILT] * miss2)
            f = shared / (1.0 + c * shared)
            total += c - f * c * c
            accumulate(H, g, b, br, -f)
            b[:], br, c = 0.0, 0.0, 0.0
    mirror(H)
    return ByPlane(H, g, total)
