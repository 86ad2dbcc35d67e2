"""The LiDAR update of the filter: points against the voxel planes of the map, as normal equations of the state.

Residuals and their variances are those of registration.py; how much they tell together is said by observed.py.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from artemis_edge.frames import F32, F64
from artemis_edge.odometry import se3
from artemis_edge.odometry.observed import Expected, observed_part
from artemis_edge.odometry.path import Path
from artemis_edge.odometry.plane_map import PlaneMap
from artemis_edge.odometry.registration import MATCH_COLUMNS, PLANE, arm_m, linearise, match
from artemis_edge.odometry.state import NormalEquations, State

_REMATCH = 0.05  # displacement, as a share of the voxel in use, after which planes are looked up again


class Explained(NamedTuple):
    """How a scan fits the map: ``N`` (3, 3) mean of n n' in the lidar frame, matches, share explained 0..1."""

    N: F64
    matches: int
    score: float


class PlaneMeasurement:
    """Points float32 (n, 3) in the lidar frame at the state's stamp, linearised at one state after the other.

    ``tau_m`` is the misalignment to expect at the first state; it shrinks with the steps from state to state, and
    with it the voxels and the reach of the robust kernel. ``prior`` is the state whose covariance is expected.
    """

    def __init__(
        self, plane_map: PlaneMap, points: F32, path: Path, sigma_m: float, tau_m: float, prior: State
    ) -> None:
        self._map, self._points, self._path = plane_map, points, path
        self._sigma2, self._tau_m = sigma_m**2, tau_m
        self._arm_m = arm_m(points)
        self._matched = np.empty((0, MATCH_COLUMNS))
        self._level, self._moved = -1, np.inf
        self._T: F64 | None = None
        J = path.at(prior, 0.0).J
        self._expected = Expected(J @ prior.P @ J.T, tau_m, self._arm_m)

    def __call__(self, state: State) -> NormalEquations:
        """Normal equations of the error of a state."""
        pose = self._path.at(state, 0.0)
        self._follow(pose.T_world_lidar)
        noise2 = self._sigma2 + self._tau_m**2
        finest = self._map.level_of(2.0 * self._tau_m)
        if finest != self._level or self._moved > _REMATCH * self._map.voxel_m * 2**finest:
            self._level, self._moved = finest, 0.0
            found = match(self._map, self._points, pose.T_world_lidar, finest, noise2)
            self._matched = found[np.argsort(found[:, PLANE], kind="stable")]
        said = observed_part(self._matched, pose.T_world_lidar, noise2, self._expected)
        return NormalEquations(pose.J.T @ said.H @ pose.J, pose.J.T @ said.g)

    def explained(self, state: State) -> Explained:
        """How well the points fit at a state."""
        T = self._path.at(state, 0.0).T_world_lidar
        lin = linearise(match(self._map, self._points, T, 0, self._sigma2), T, self._sigma2)
        return Explained(lin.observed(), lin.matches, lin.score / max(len(self._points), 1))

    def score(self, state: State) -> float:
        """How many points fit at a state that is wrong by what is expected, each counted by how well."""
        T = self._path.at(state, 0.0).T_world_lidar
        noise2, level = self._sigma2 + self._tau_m**2, self._map.level_of(2.0 * self._tau_m)
        return float(linearise(match(self._map, self._points, T, level, noise2), T, noise2).score)

    def _follow(self, T: F64) -> None:
        """Take note of how far the points moved since the last state."""
        if self._T is not None:
            x = se3.log(se3.inverse(self._T) @ T)
            step = float(np.linalg.norm(x[:3]) + self._arm_m * np.linalg.norm(x[3:]))
            self._moved += step
            self._tau_m = min(0.5 * self._tau_m, step)
        self._T = T


def expected_miss_m(state: State, path: Path, arm: float) -> float:
    """One deviation (m) of where a point at the distance ``arm`` is, by the state's covariance."""
    J = path.at(state, 0.0).J
    variance = np.diag(J @ state.P @ J.T)
    return float(np.sqrt((variance[:3].sum() + arm**2 * variance[3:].sum()) / 3.0))
