"""Refines the mount of one camera: photometric consistency between views, and silhouettes within each.

The two complete one another: views from several places fix what turns or moves between them, silhouettes tie a
photograph to the LiDAR however the rig moved. Coarse to fine; a silhouette may look larger to the LiDAR than it is
(the spot of a beam is wide), which is estimated along.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from artemis_edge.calibrate.anchors import on_planes, select
from artemis_edge.calibrate.edges import Silhouettes, attract, silhouettes, smooth_gradients
from artemis_edge.calibrate.material import Camera, Material
from artemis_edge.calibrate.mounts import CameraMount
from artemis_edge.calibrate.photometric import PARAMETERS, View, compare
from artemis_edge.frames import F32, F64
from artemis_edge.odometry import se3

_SIZE = PARAMETERS + 2  # and how much silhouettes swell along u and v
_SIGMA_T_M, _SIGMA_R, _SIGMA_S, _SIGMA_SWELL_PX = 0.05, 0.035, 0.02, 0.3  # what is expected of a rig as built
_STATION_SIGMA_T_M = 0.002  # views from one place do not tell the place: a drawing is better
# nor do they tell the pitch but by the last digits of the lens model, where the rig only turned
_STATION_TRUST = 0.03
_ALIKE = 20.0  # neighbouring pixels and silhouettes err alike: so many count as one
_PIXELS = 25.0
_BASELINES_S = (0.4, 0.8, 1.6)  # between photographs that are compared
_MOST_ANCHORED = 60  # photographs that patches are taken from
_REACHES_PX = (4.0, 6.0, 10.0, 16.0)  # of the search for silhouettes, from the finest level on
_SMOOTH_PX = (1.0, 1.0, 1.5, 2.0)
_ITERATIONS, _FINE_ITERATIONS = 6, 25
_CONVERGED = 1e-5  # m, rad, s
_LONGER = (2.0, 4.0)  # steps tried beyond Gauss-Newton's, which is short along what the views hardly tell
_LEAST_PATCHES = 200


class Score(NamedTuple):
    """Mean robust residuals of patches (share of their contrast) and of silhouettes (pixels squared).

    ``total`` joins them as the estimate does; smaller is better.
    """

    photometric: float
    silhouettes: float
    total: float
    patches: int
    rims: int


class CameraFit(NamedTuple):
    """The refined mount; ``sigma`` (7,): m, rad, s; ``before`` and ``after`` on views that were not used."""

    mount: CameraMount
    sigma: F64
    before: Score
    after: Score


class _Said(NamedTuple):
    H: F64
    g: F64
    cost: float
    seen: int


class CameraSolver:
    """Estimates a mount on half of the views, and judges mounts on the other half."""

    def __init__(self, material: Material, camera: Camera, start: CameraMount) -> None:
        self._material, self._camera, self._start = material, camera, start
        self._time_known = material.stations
        self._trees: dict[int, tuple[F64, KDTree]] = {}

    def solve(self) -> CameraFit | None:
        """The refined mount; None if the views do not tell enough."""
        mount, swell = self._start, np.zeros(2)
        H = np.zeros((_SIZE, _SIZE))
        for level in (
            range(len(self._camera.photographs[0].levels) - 1, -1, -1) if self._camera.photographs else ()
        ):
            for _ in range(2 if level else 1):  # with patches chosen anew
                stage = _Stage(self, mount, level, 0)
                if level == 0 and stage.patches() < _LEAST_PATCHES:
                    return None
                mount, swell, H = stage.descend(mount, swell, _ITERATIONS if level else _FINE_ITERATIONS)
        if not H.any():
            return None
        sigma = np.sqrt(np.diag(np.linalg.inv(H)))[:PARAMETERS]
        before, after = self.judge(self._start, mount)
        return CameraFit(mount, sigma, before, after)

    def judge(self, present: CameraMount, found: CameraMount) -> tuple[Score, Score]:
        """Scores of two mounts on the views not used; patches are chosen with either."""
        stages = [_Stage(self, mount, 0, 1) for mount in (present, found)]
        scores = []
        for mount in (present, found):
            said = [stage.said(mount, np.zeros(2)) for stage in stages]
            p = [s[0] for s in said]
            e = [s[1] for s in said]
            photometric = sum(s.cost for s in p) / max(sum(s.seen for s in p), 1)
            rims = sum(s.cost for s in e) / max(sum(s.seen for s in e), 1)
            scores.append((photometric, rims, sum(s.seen for s in p), sum(s.seen for s in e)))
        p0, e0 = max(scores[0][0], 1e-12), max(scores[0][1], 1e-12)
        return (
            Score(scores[0][0], scores[0][1], 2.0, scores[0][2], scores[0][3]),
            Score(
                scores[1][0], scores[1][1], scores[1][0] / p0 + scores[1][1] / e0, scores[1][2], scores[1][3]
            ),
        )

    def around(self, index: int) -> tuple[F64, KDTree]:
        """Points around a photograph, and their tree."""
        if index not in self._trees:
            points = self._material.around(self._camera.photographs[index].stamp_ns)
            self._trees[index] = points, KDTree(points if len(points) else np.zeros((1, 3)))
        return self._trees[index]


class _Stage:
    """One level: views, patches and silhouettes as chosen with a mount."""

    def __init__(self, solver: CameraSolver, mount: CameraMount, level: int, phase: int) -> None:
        self._s, self._level = solver, level
        camera = solver._camera
        views, known = self._views(mount, level)
        fine = views if level == 0 else self._views(mount, 0)[0]
        every = max(2 * len(known) // _MOST_ANCHORED, 2)
        self._anchored = known[phase * every // 2 :: every]
        self._patches: dict[int, F64] = {}
        self._rims: dict[int, tuple[Silhouettes, F32, F32]] = {}
        reach = min(level, len(_REACHES_PX) - 1)
        self._reach = _REACHES_PX[reach] * max(camera.size[1] / 640.0, 1.0)
        for k in self._anchored:
            points, tree = solver.around(k)
            if len(points) < 1000:
                continue
            T_cam_world = mount.T_cam_lidar @ views[k].T_lidar_world
            self._patches[k] = select(views[k].grey, views[k].K, T_cam_world, points[::5], tree, level)
            rims = silhouettes(camera.size, fine[k].K, T_cam_world, points)
            solid = on_planes(rims.points, tree, T_cam_world)
            self._rims[k] = (
                Silhouettes(rims.points[solid], rims.across[solid]),
                *smooth_gradients(fine[k].grey, _SMOOTH_PX[reach]),
            )

    def patches(self) -> int:
        """How many there are."""
        return sum(len(p) for p in self._patches.values())

    def _views(self, mount: CameraMount, level: int) -> tuple[dict[int, View], list[int]]:
        camera = self._s._camera
        T, twist, known = self._s._material.views_of(camera, mount.time_offset_s)
        made = {
            k: View(*camera.photographs[k].at(level), np.ascontiguousarray(T[n]), twist[n])
            for n, k in enumerate(known)
        }
        return made, known

    def said(self, mount: CameraMount, swell: F64) -> tuple[_Said, _Said]:
        """What patches and silhouettes say about a mount."""
        views, known = self._views(mount, self._level)
        fine = views if self._level == 0 else self._views(mount, 0)[0]
        C = np.ascontiguousarray(mount.T_cam_lidar)
        H, g = np.zeros((2, _SIZE, _SIZE)), np.zeros((2, _SIZE))
        cost, count = np.zeros(2), np.zeros(2, np.int64)
        for k, patches in self._patches.items():
            if k not in views:
                continue
            for other in self._partners(k, known):
                p = compare(views[k], views[other], C, patches)
                H[0, :PARAMETERS, :PARAMETERS] += p.H
                g[0, :PARAMETERS] += p.g
                cost[0] += p.cost
                count[0] += p.seen
            rims, gx, gy = self._rims[k]
            e = attract(fine[k], gx, gy, C, rims.points, rims.across, swell, self._reach)
            H[1] += e.H
            g[1] += e.g
            cost[1] += e.cost
            count[1] += e.seen
        return (
            _Said(H[0], g[0], float(cost[0]), int(count[0])),
            _Said(H[1], g[1], float(cost[1]), int(count[1])),
        )

    def _partners(self, k: int, known: list[int]) -> list[int]:
        photographs = self._s._camera.photographs
        stamps = np.array([photographs[j].stamp_ns for j in known])
        found: list[int] = []
        if len(stamps) < 2:
            return found
        interval = float(np.median(np.diff(stamps))) * 1e-9
        for seconds in _BASELINES_S:
            steps = max(round(seconds / interval), 1)
            for other in (k - steps, k + steps):
                if other in known and other not in found:
                    found.append(other)
        return found

    def descend(self, mount: CameraMount, swell: F64, iterations: int) -> tuple[CameraMount, F64, F64]:
        """Gauss-Newton; returns mount, swelling and the information (9, 9) in the end."""
        information = np.zeros((_SIZE, _SIZE))
        for _ in range(iterations):
            said = self.said(mount, swell)
            information, pull = self._joined(said, mount, swell)
            x: F64 = np.asarray(-np.linalg.solve(information, pull), np.float64)
            best, step = np.inf, x
            for longer in (1.0, *_LONGER) if self._level == 0 else (1.0,):
                moved = self._moved(mount, longer * x)
                cost = self._cost(self.said(moved, swell + longer * x[PARAMETERS:]), said, moved)
                if cost >= best:
                    break
                best, step = cost, longer * x
            mount, swell = self._moved(mount, step), swell + step[PARAMETERS:]
            if np.abs(step[:PARAMETERS]).max() < _CONVERGED:
                break
        return mount, swell, information

    def _weights(self, said: tuple[_Said, _Said]) -> tuple[float, float]:
        p, e = said
        trust = _STATION_TRUST if self._s._time_known else 1.0
        wp = trust * _PIXELS * p.seen / (_ALIKE * p.cost) if p.cost > 0 else 0.0
        we = e.seen / (_ALIKE * e.cost) if e.cost > 0 else 0.0
        return wp, we

    def _joined(self, said: tuple[_Said, _Said], mount: CameraMount, swell: F64) -> tuple[F64, F64]:
        wp, we = self._weights(said)
        P = self._prior()
        off = np.concatenate([self._off(mount), swell])
        return wp * said[0].H + we * said[1].H + P, wp * said[0].g + we * said[1].g + P @ off

    def _prior(self) -> F64:
        still = self._s._time_known
        sigma_t = _STATION_SIGMA_T_M if still else _SIGMA_T_M
        sigma = [sigma_t] * 3 + [_SIGMA_R] * 3 + [1e-9 if still else _SIGMA_S] + [_SIGMA_SWELL_PX] * 2
        return np.diag(np.array(sigma) ** -2.0)

    def _off(self, mount: CameraMount) -> F64:
        """How far a mount is from that of the start (7,)."""
        start = self._s._start
        # place apart from attitude: turning a camera about the LiDAR is no displacement of it
        x = np.zeros(PARAMETERS)
        x[:6] = se3.log(np.ascontiguousarray(mount.T_cam_lidar @ np.linalg.inv(start.T_cam_lidar)))
        x[6] = mount.time_offset_s - start.time_offset_s
        return x

    @staticmethod
    def _moved(mount: CameraMount, x: F64) -> CameraMount:
        T = se3.orthonormal(se3.exp(np.ascontiguousarray(x[:6])) @ mount.T_cam_lidar)
        return CameraMount(T, mount.time_offset_s + float(x[6]), mount.model)

    def _cost(self, said: tuple[_Said, _Said], reference: tuple[_Said, _Said], mount: CameraMount) -> float:
        """What Gauss-Newton makes smaller, per patch and rim, for few of them may leave the views."""
        wp, we = self._weights(reference)
        p, e = said
        if p.seen == 0 or e.seen == 0:
            return float(p.cost + e.cost)
        off = self._off(mount)
        prior = float(off @ self._prior()[:PARAMETERS, :PARAMETERS] @ off)
        return wp * p.cost / p.seen * reference[0].seen + we * e.cost / e.seen * reference[1].seen + prior
