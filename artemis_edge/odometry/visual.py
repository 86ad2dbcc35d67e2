"""The visual update of the filter: grey values of patches on the planes of the map (section III-A).

No features are extracted. Patches are anchored on LiDAR points of planes, one a cell of the image, where an image has
contrast; they keep the grey values of the image that they were taken from as long as they are seen, so that a standing
or slowly moving camera does not drift.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import cv2
import numpy as np

from artemis_edge.frames import F32, F64, I64, U8, Bool, CameraImage
from artemis_edge.odometry import se3
from artemis_edge.odometry.image_update import SeenScan
from artemis_edge.odometry.path import Path, PoseAt
from artemis_edge.odometry.plane_map import PlaneMap
from artemis_edge.odometry.registration import match
from artemis_edge.odometry.silhouette import nearest_depth, partly_covered
from artemis_edge.odometry.state import ROTATION, NormalEquations, State, iterated_update
from artemis_edge.odometry.visual_patch import (
    NEAREST_M,
    SIDE,
    UNKNOWNS,
    Comparison,
    Eye,
    Patches,
    anchors_on,
    brightness,
    compare,
    take,
)

_LEVELS = 3
_WIDEST = 800  # pixels; a larger photograph is decoded at half its size
_TRIED = 3  # candidates of a cell
_CELLS = 24  # along the width of an image; at most one patch each
_FARTHEST_M = 40.0
_LEAST_TELL = 4.0  # (grey levels a pixel)^2: contrast that a patch must have
_PIXELS = SIDE * SIDE
_SIGMA = 20.0  # grey levels: noise, and what a plane, a gain and blur do not explain
_DELAY_SIGMA_S = 0.02  # what is expected of unsynchronised cameras
_EXPOSURE_SIGMA = 0.1  # of the logarithm, after the median brightness is followed
_LEAST_PATCHES = 15
_OPEN_RAD = 0.005  # deviation of the attitude, some two pixels, beyond which no patches are taken
_UNSEEN = 10  # images after which a patch that is not seen is forgotten
_FITS, _FAILURES = 0.4, 3  # a patch that fits less so often in a row is hidden or moved
_ITERATIONS = 4  # one on each coarse level, the rest on the finest
_LEAST_SCORE = 0.3  # mean fit of all patches below which an image is not believed
# An image that fits much worse than those before is where the patches pull to a wrong place; of a scan it is 85 %, too
_OF_USUAL, _NEW = 0.85, 0.1
_NOISE_M = 0.03


class Picture(NamedTuple):
    """An image ready to be sampled: grey levels, each half the last, and the camera at each of them."""

    pyramid: tuple[U8, ...]
    eyes: tuple[Eye, ...]


def picture(image: CameraImage) -> Picture | None:
    """Decode an image, at half its size where it is wide; None if it cannot be or, held out, has no data."""
    if not image.encoded:
        return None
    model = image.model
    half = model.width > _WIDEST
    flag = cv2.IMREAD_REDUCED_GRAYSCALE_2 if half else cv2.IMREAD_GRAYSCALE
    grey = cv2.imdecode(np.frombuffer(image.encoded, np.uint8), flag)
    if grey is None:
        return None
    levels = [np.asarray(grey, np.uint8)]
    for _ in range(_LEVELS - 1):
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.uint8))
    distortion, T = np.array(model.distortion), np.ascontiguousarray(image.T_cam_lidar)
    eyes = []
    for level in range(_LEVELS):
        scale = 0.5 ** (level + half)
        centre = (model.cx + 0.5) * scale - 0.5, (model.cy + 0.5) * scale - 0.5
        eyes.append(Eye(np.array([model.fx * scale, model.fy * scale, *centre]), distortion, T))
    return Picture(tuple(levels), tuple(eyes))


@dataclass(slots=True)
class _Kept:
    """Patches of one camera; images since each was seen, and since it fitted."""

    patches: Patches
    unseen: I64
    failed: I64

    @classmethod
    def none(cls) -> _Kept:
        grey = np.empty((0, _LEVELS, _PIXELS), np.float32)
        empty = Patches(np.empty((0, 9)), grey, grey.copy(), grey.copy(), np.empty(0))
        return cls(empty, np.empty(0, np.int64), np.empty(0, np.int64))

    def joined(self, new: Patches) -> _Kept:
        old = self.patches
        both = Patches(
            np.concatenate([old.anchor, new.anchor]),
            np.concatenate([old.grey, new.grey]),
            np.concatenate([old.slope_s, new.slope_s]),
            np.concatenate([old.slope_t, new.slope_t]),
            np.concatenate([old.log_inverse_exposure, new.log_inverse_exposure]),
        )
        zeros = np.zeros(len(new.anchor), np.int64)
        return _Kept(both, np.concatenate([self.unseen, zeros]), np.concatenate([self.failed, zeros]))

    def only(self, keep: Bool) -> _Kept:
        p = self.patches
        kept = Patches(
            p.anchor[keep], p.grey[keep], p.slope_s[keep], p.slope_t[keep], p.log_inverse_exposure[keep]
        )
        return _Kept(kept, self.unseen[keep], self.failed[keep])


@dataclass(slots=True)
class VisualUpdate:
    """An ``image_update.ImageUpdate``; patches and exposure are kept for each camera by name."""

    lost: dict[str, int] = field(default_factory=dict)
    _kept: dict[str, _Kept] = field(default_factory=dict)
    _last: tuple[str, int, Picture | None] | None = None
    _scores: dict[str, float] = field(default_factory=dict)

    def update(self, state: State, path: Path, image: CameraImage, scan: SeenScan, planes: PlaneMap) -> State:
        """The state after an image, or itself where the image says nothing."""
        if image.name not in state.cameras:
            state = state.with_camera(image.name, _EXPOSURE_SIGMA, _DELAY_SIGMA_S)
        seen, kept = self._picture(image), self._kept.get(image.name)
        if seen is None or kept is None or len(kept.patches.anchor) < _LEAST_PATCHES:
            return state
        measured = _Measurement(seen, kept.patches, path, image)
        prior = measured.with_exposure(state)
        if prior is None:
            self._count("images without patches")
            return state
        found = iterated_update(prior, measured, _ITERATIONS, 0.0)
        last = measured.compare(found, 0)
        usual = self._usual(image.name, last.score)
        least = max(_LEAST_SCORE, measured.compare(prior, 0).score, _OF_USUAL * usual)
        if last.seen < _LEAST_PATCHES or last.score < least:
            self._count("images not believed")
            return prior
        return found

    def _usual(self, camera: str, score: float) -> float:
        """The running mean of a camera's scores before this one, which joins it."""
        usual = self._scores.get(camera, score)
        self._scores[camera] = usual + _NEW * (score - usual)
        return usual

    def remember(
        self, state: State, path: Path, image: CameraImage, scan: SeenScan, planes: PlaneMap
    ) -> None:
        """Judge the patches in an image at the frame's final state, and take new ones in free cells."""
        seen = self._picture(image)
        if seen is None or image.name not in state.cameras:
            return
        kept = self._kept.get(image.name, _Kept.none())
        measured = _Measurement(seen, kept.patches, path, image)
        share = measured.compare(state, 0).share
        kept.unseen = np.where(share < 0.0, kept.unseen + 1, 0)
        kept.failed = np.where(share < 0.0, kept.failed, np.where(share < _FITS, kept.failed + 1, 0))
        kept = kept.only((kept.unseen < _UNSEEN) & (kept.failed < _FAILURES))
        self._kept[image.name] = kept
        if np.sqrt(np.diag(state.P)[ROTATION].max()) > _OPEN_RAD:
            return  # patches taken now would hold the error of the attitude for true
        T_world_lidar = path.at(state, 0.0).T_world_lidar
        T_cam_world = measured.T_cam_world(measured.pose(state))
        new = self._new(seen, T_cam_world, T_world_lidar, scan.points, planes, kept.patches)
        light = state.log_inverse_exposure[state.cameras.index(image.name)]
        self._kept[image.name] = kept.joined(
            new._replace(log_inverse_exposure=np.full(len(new.anchor), light))
        )

    def _new(
        self,
        seen: Picture,
        T_cam_world: F64,
        T_world_lidar: F64,
        points: F32,
        planes: PlaneMap,
        known: Patches,
    ) -> Patches:
        """The most telling patch of each free cell of an image."""
        free = _free(seen, T_cam_world, known.anchor[:, :3])
        T_cam_lidar = T_cam_world @ T_world_lidar
        ahead = points @ T_cam_lidar[:3, :3].T + T_cam_lidar[:3, 3]
        points = points[
            free[_cells(seen, T_cam_lidar, points.astype(np.float64))]
        ]  # most cells have their patch already
        matched = match(planes, points, T_world_lidar, 0, _NOISE_M**2)
        centres = matched[:, :3] @ T_world_lidar[:3, :3].T + T_world_lidar[:3, 3]
        normals = matched[:, 3:6]
        centres -= (np.einsum("ij,ij->i", normals, centres) - matched[:, 6])[:, None] * normals
        cell = np.where(
            _whole(seen, T_cam_world, ahead, centres, normals), _cells(seen, T_cam_world, centres), -1
        )
        chosen = _strongest(seen, T_cam_world, centres, np.where(free[cell], cell, -1))
        T_world_cam = se3.inverse(T_cam_world)
        anchors, inside = anchors_on(seen.eyes[0], T_world_cam, centres[chosen], normals[chosen])
        cell = cell[chosen][inside]
        grey, slope_s, slope_t, tell = take(seen.pyramid, seen.eyes, T_cam_world, anchors)
        order = np.lexsort((-tell, cell))
        best = order[np.flatnonzero(np.r_[True, np.diff(cell[order]) > 0])] if len(order) else order
        best = best[tell[best] > _LEAST_TELL]
        return Patches(anchors[best], grey[best], slope_s[best], slope_t[best], np.zeros(len(best)))

    def _picture(self, image: CameraImage) -> Picture | None:
        """Decoded once for both calls."""
        if self._last is None or self._last[:2] != (image.name, image.stamp_ns):
            decoded = picture(image)
            if decoded is None and image.encoded:
                self._count("images not decodable")
            self._last = image.name, image.stamp_ns, decoded
        return self._last[2]

    def _count(self, reason: str) -> None:
        self.lost[reason] = self.lost.get(reason, 0) + 1


@dataclass(slots=True)
class _Measurement:
    """What an image says about a state: coarse levels first, then the finest (a ``state.Linearise``)."""

    seen: Picture
    patches: Patches
    path: Path
    image: CameraImage
    _calls: int = 0

    def __call__(self, state: State) -> NormalEquations:
        level = max(_LEVELS - 1 - self._calls, 0)
        self._calls += 1
        at = self.pose(state)
        said = self._at(state, at, level)
        A = np.zeros((UNKNOWNS, len(state)))
        column = state.exposure_column(self.image.name)
        A[:6] = at.J
        A[:6, column + 1] -= at.twist
        A[6, column] = 1.0
        return NormalEquations(A.T @ said.H @ A, A.T @ said.g)

    def pose(self, state: State) -> PoseAt:
        """The LiDAR when the image was taken."""
        delay = state.image_delay_s[state.cameras.index(self.image.name)]
        return self.path.at(state, (self.image.stamp_ns - state.stamp_ns) * 1e-9 - float(delay))

    def T_cam_world(self, at: PoseAt) -> F64:
        """World to camera."""
        T: F64 = self.seen.eyes[0].T_cam_lidar @ se3.inverse(at.T_world_lidar)
        return T

    def compare(self, state: State, level: int) -> Comparison:
        """All patches at a state."""
        return self._at(state, self.pose(state), level)

    def with_exposure(self, state: State) -> State | None:
        """The state with the exposure that the brightness of the patches suggests; None if hardly any is seen.

        Exposure may jump from one image to the next, so that nothing is kept of what was known of it.
        """
        T, coarsest = self.T_cam_world(self.pose(state)), _LEVELS - 1
        ratio = brightness(self.seen.pyramid[coarsest], self.seen.eyes[coarsest], T, self.patches, coarsest)
        ratio = ratio[np.isfinite(ratio)]
        if len(ratio) < _LEAST_PATCHES:
            return None
        number, column = state.cameras.index(self.image.name), state.exposure_column(self.image.name)
        light, P = state.log_inverse_exposure.copy(), state.P.copy()
        light[number] = -np.median(ratio)
        P[column], P[:, column] = 0.0, 0.0
        P[column, column] = _EXPOSURE_SIGMA**2
        return replace(state, log_inverse_exposure=light, P=P)

    def _at(self, state: State, at: PoseAt, level: int) -> Comparison:
        light = float(state.log_inverse_exposure[state.cameras.index(self.image.name)])
        said: Comparison = compare(
            self.seen.pyramid[level],
            self.seen.eyes[level],
            self.T_cam_world(at),
            self.patches,
            level,
            light,
            _SIGMA,
        )
        return said


def _strongest(seen: Picture, T_cam_world: F64, points: F64, cell: I64) -> I64:
    """The few points (k,) of each cell, -1 none, at which the image changes most, at half its size."""
    use = np.flatnonzero(cell >= 0)
    p = points[use] @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    fx, fy, cx, cy = seen.eyes[1].K
    grey = seen.pyramid[1].astype(np.int16)
    column = np.clip(np.rint(fx * p[:, 0] / p[:, 2] + cx), 1, grey.shape[1] - 2).astype(np.int64)
    row = np.clip(np.rint(fy * p[:, 1] / p[:, 2] + cy), 1, grey.shape[0] - 2).astype(np.int64)
    across = grey[row, column + 1] - grey[row, column - 1]
    down = grey[row + 1, column] - grey[row - 1, column]
    change = across.astype(np.int64) ** 2 + down.astype(np.int64) ** 2
    order = np.lexsort((-change, cell[use]))
    ranked = cell[use][order]
    rank = np.arange(len(ranked)) - np.searchsorted(ranked, ranked)
    return use[order[rank < _TRIED]]


def _free(seen: Picture, T_cam_world: F64, anchors: F64) -> Bool:
    """Which cells (n + 1,) of an image hold none of the anchors (m, 3); the last stands for what lies outside."""
    height, width = seen.pyramid[0].shape
    free = np.ones(_CELLS * int(np.ceil(_CELLS * height / width)) + 1, np.bool_)
    free[_cells(seen, T_cam_world, anchors)] = False
    free[-1] = False
    return free


def _whole(seen: Picture, T_cam_world: F64, points: F64, centres: F64, normals: F64) -> Bool:
    """Which patches on planes (n, 3) of the world no nearer point (m, 3) of the camera's frame covers a part of."""
    height, width = seen.pyramid[0].shape
    K, R = seen.eyes[0].K, T_cam_world[:3, :3]
    nearest = nearest_depth(points, K, width, height)
    whole: Bool = ~partly_covered(centres @ R.T + T_cam_world[:3, 3], normals @ R.T, nearest, K)
    return whole


def _cells(seen: Picture, T_cam_world: F64, points: F64) -> I64:
    """Cell of the image (n,) that each point falls into, by the undistorted pinhole; -1 outside."""
    p = points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    height, width = seen.pyramid[0].shape
    fx, fy, cx, cy = seen.eyes[0].K
    ahead = (p[:, 2] > NEAREST_M) & (p[:, 2] < _FARTHEST_M)
    z = np.where(ahead, p[:, 2], 1.0)
    u, v = fx * p[:, 0] / z + cx, fy * p[:, 1] / z + cy
    inside = ahead & (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height)
    size = width / _CELLS
    cell = np.floor(v / size).astype(np.int64) * _CELLS + np.floor(u / size).astype(np.int64)
    return np.where(inside, cell, -1)
