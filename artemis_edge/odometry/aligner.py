"""Which guesses are registered, and whether the outcome is believed.

Most frames lie where constant velocity says, to a few centimetres. When such a registration explains less
of the scan than usual, the reach is widened to what the carrier's accelerations allow, then guesses all
over that reach are compared. Hence one configuration serves a car at 10 Hz and a hand at 2 Hz.
"""

from __future__ import annotations

import numpy as np

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import F64
from artemis_edge.odometry.motion import Prediction
from artemis_edge.odometry.plane_map import PlaneMap
from artemis_edge.odometry.registration import Registration, arm_m, judge, register
from artemis_edge.odometry.search import RINGS, all_round, guesses
from artemis_edge.odometry.thin import TimedPoints

_MIN_MATCHES = 50  # fewer planes do not fix six numbers against outliers
_GOOD = 0.85  # share of the usual score below which a better guess is sought
_LOST = 0.4  # share of the usual score below which the pose is not believed
_DOUBTFUL = (
    0.6  # share below which it is believed only near the prediction: new places look new, wrong ones too
)
_MEMORY = 0.1  # weight of a new frame in the usual score and the usual miss
_BASIN = 2.0  # displacement that registration mends by itself, in finest voxels
_JUDGED = 500  # points that judge a guess
_REFINED = 4  # best guesses that are registered


class Aligner:
    """Registers scans to a plane map and remembers how well that usually goes."""

    def __init__(self, config: OdometryConfig, plane_map: PlaneMap) -> None:
        self._config = config
        self._map = plane_map
        self._usual_score = 0.0
        self._usual_miss2 = 0.0

    def align(self, scan: TimedPoints, prediction: Prediction) -> Registration | None:
        """Pose of a scan, or None if it does not fit the map anywhere near the prediction."""
        if len(scan.points) < _MIN_MATCHES:
            return None
        best = self._best(scan, prediction)
        miss = prediction.missed_by_m(best.T_world_lidar, arm_m(scan.points))
        near = miss < _BASIN * self._config.voxel_m
        least = _LOST if near else _DOUBTFUL
        if best.matches < _MIN_MATCHES or best.score < least * self._usual_score:
            return None
        first = self._usual_score == 0.0
        self._usual_score += (1.0 if first else _MEMORY) * (best.score - self._usual_score)
        self._usual_miss2 += _MEMORY * (miss**2 - self._usual_miss2)
        return best

    def refine(self, scan: TimedPoints, prediction: Prediction, T: F64) -> Registration | None:
        """Register from a guess T_world_lidar known to be close."""
        found = self._register(scan, prediction, T, self._config.sigma_m)
        return found if found.matches >= _MIN_MATCHES else None

    def _best(self, scan: TimedPoints, prediction: Prediction) -> Registration:
        bound = prediction.reach_m(arm_m(scan.points))
        best = Registration(prediction.T_world_lidar, np.zeros((3, 3)), 0, 0.0)
        for tau in (min(self._usual_miss2**0.5, bound), bound):
            found = self._register(scan, prediction, prediction.T_world_lidar, tau)
            best = max(best, found, key=_score)
            if best.score >= _GOOD * self._usual_score > 0.0:
                return best
        basin = max(_BASIN * self._config.voxel_m, bound / RINGS)
        tried = guesses(
            prediction.T_world_lidar, prediction.sigma_m, prediction.sigma_rad, arm_m(scan.points), basin
        )
        best = self._best_of(scan, prediction, [prediction.T_world_start, *tried], basin, best)
        if best.score >= _GOOD * self._usual_score > 0.0:
            return best
        tried = all_round(prediction.T_world_start, prediction.T_world_lidar, prediction.sigma_rad)
        return self._best_of(scan, prediction, tried, _BASIN * self._config.voxel_m, best)

    def _best_of(
        self, scan: TimedPoints, prediction: Prediction, tried: list[F64], basin_m: float, best: Registration
    ) -> Registration:
        """The best registration from the few best of many guesses, or the one already known."""
        few = TimedPoints(*(a[:: max(len(scan.points) // _JUDGED, 1)] for a in scan))
        level, sigma = self._map.level_of(basin_m), 0.5 * basin_m
        scores = []
        for T in tried:
            points = few.at_one_time(prediction.twist(T))
            scores.append(judge(self._map, points, T, sigma, level).score)
        for k in np.argsort(scores, kind="stable")[::-1][:_REFINED]:
            best = max(best, self._register(scan, prediction, tried[k], basin_m), key=_score)
        return best

    def _register(self, scan: TimedPoints, prediction: Prediction, guess: F64, tau_m: float) -> Registration:
        return register(self._map, scan, prediction, guess, tau_m, self._config.sigma_m)


def _score(found: Registration) -> float:
    return found.score
