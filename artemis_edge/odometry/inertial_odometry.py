"""LiDAR-inertial(-visual) odometry: an iterated error-state Kalman filter (section III-A).

Every frame: propagate the state to the end of the scan by the IMU, move its points there, update by the planes of the
local map, then by one image after the other; then add the scan to the map.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import F32, F64, CameraImage, ImuSamples, SyncedFrame, TrackedFrame
from artemis_edge.odometry import imu as inertial
from artemis_edge.odometry.deskew import deskew_frame, move_points, window
from artemis_edge.odometry.image_update import ImageUpdate, SeenScan
from artemis_edge.odometry.known_map import Start
from artemis_edge.odometry.lidar_odometry import LidarOdometry
from artemis_edge.odometry.local_map import LocalMap
from artemis_edge.odometry.normals import weakest_direction
from artemis_edge.odometry.parts import Steps, in_parts
from artemis_edge.odometry.path import Path
from artemis_edge.odometry.plane_update import Explained, PlaneMeasurement, expected_miss_m
from artemis_edge.odometry.propagation import HOLE_S, ImuNoise, longest_hole_s, propagate, steadied
from artemis_edge.odometry.recovery import Registered, opened, registered, searched
from artemis_edge.odometry.registration import arm_m
from artemis_edge.odometry.rest import INSTRUCTION, first_state
from artemis_edge.odometry.scan_motion import steady
from artemis_edge.odometry.state import POSITION, ROTATION, State
from artemis_edge.odometry.thin import Thinner, ThinScan, TimedPoints

_START_FRAMES = 2  # looked at beforehand to know how fast a recording begins
_MIN_MATCHES = 50  # fewer planes do not fix six numbers against outliers
_LOST = 0.4  # share of the usual score below which the update is not believed
_MEMORY = 0.1  # weight of a new frame in the usual score
_UNSURE = 0.85  # the same, where the state was unsure before: another place may explain half of a scan
_PART_S = (
    0.025  # of a scan without IMU: a wrist's 20 rad/s2 turn half a radian/s faster in it, points by 6 mrad
)
_SURE_M = 0.1  # expected miss at the points up to which the IMU's word is as good as a registration
_KEPT_NS = 200_000_000  # samples kept behind the state, so that its own time can be interpolated
_DOUBT_S = 0.45  # for so long a scan that fits worse than usual is taken to be at another place than it seems
_GIVE_UP_S = 0.95  # lost for more, ten frames, the map is begun anew at the predicted pose
_PLACED_M, _PLACED_RAD = 0.1, 0.01  # one sigma of the first pose in a known map


class _Arrived(NamedTuple):
    """A scan at the end of its window: the prior state there, the path to it, the scan."""

    prior: State
    path: Path
    scan: ThinScan

    def points(self, timed: TimedPoints, state: State) -> F32:
        """Points float32 (n, 3) in the lidar frame at the state's stamp."""
        shift_s = (self.scan.stamp_ns - state.stamp_ns) * 1e-9
        if len(timed.points) == 0:
            return timed.points
        first, last = float(timed.time_s.min()) + shift_s, float(timed.time_s.max()) + shift_s
        motion = self.path.motion(state, first, last)
        return np.asarray(move_points(timed.points, timed.time_s, shift_s, motion, np.eye(4)), np.float32)


class InertialOdometry:
    """Pose of every frame of a rig with an IMU; world is the first LiDAR frame, levelled (z up).

    ``lost`` counts by reason; ``instruction`` is a sentence for the operator, or None.
    """

    def __init__(
        self,
        config: OdometryConfig,
        images: ImageUpdate | None = None,
        start_velocity: F64 | None = None,
        start: Start | None = None,
    ) -> None:
        """``start_velocity`` (3,) m/s in the lidar frame, where it is known; ``start`` to go on in a known map."""
        self.lost: dict[str, int] = {}
        self.instruction: str | None = None
        self._config = config
        self._images = images
        self._start_velocity = start_velocity
        self._noise = ImuNoise(
            config.gyro_noise,
            config.accel_noise,
            config.gyro_walk,
            config.accel_walk,
            config.angular_acceleration,
            config.acceleration,
        )
        self._thinner = Thinner(config)
        self._start = start
        self._map = LocalMap(config, None if start is None else start.known)
        self._imu = ImuSamples.empty()
        self._state: State | None = None
        self._turn_rate = np.zeros(3)
        self._usual_score = 0.0
        self._lost_s = 0.0

    @classmethod
    def looking_ahead(
        cls,
        config: OdometryConfig,
        frames: Iterable[SyncedFrame],
        images: ImageUpdate | None = None,
        start: Start | None = None,
    ) -> InertialOdometry:
        """For a recording: two frames are registered beforehand to know how fast it begins."""
        trial = LidarOdometry(config)
        for frame in islice(frames, _START_FRAMES):
            trial.track(frame)
        return cls(config, images, trial.twist[:3], start)

    @property
    def state(self) -> State | None:
        """The filter's state after the last frame."""
        return self._state

    @property
    def losses(self) -> dict[str, int]:
        """``lost``, and what the visual update could not use."""
        return self.lost | (self._images.lost if self._images is not None else {})

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        """Pose of the frame, its points moved to its stamp; a frame without scans is propagated."""
        self._imu = inertial.join(self._imu, frame.imu)
        if self._state is None and not len(self._imu.stamp_ns):
            self._count("frames before the first IMU sample")
            return TrackedFrame(
                frame.index,
                frame.stamp_ns,
                np.eye(4),
                deskew_frame(frame, steady(np.zeros(6))),
                images=frame.images,
            )
        if self._state is None:
            self._state = self._begin(frame.stamp_ns)
        parts = in_parts(frame, _PART_S) if self._hole(frame) else (frame,)
        steps, points = zip(*(self._step(part) for part in parts), strict=True)
        if frame.scans and sum(points) == 0:
            self._count("no points")
        self._imu = inertial.since(self._imu, self._state.stamp_ns - _KEPT_NS)
        return self._tracked(frame, Steps(steps))

    def _hole(self, frame: SyncedFrame) -> bool:
        """Does the IMU say nothing about some of the frame?"""
        assert self._state is not None
        end_ns = frame.stamp_ns + round(window(frame)[1] * 1e9)
        return longest_hole_s(self._imu, self._state.stamp_ns, end_ns) > HOLE_S

    def _step(self, frame: SyncedFrame) -> tuple[tuple[Path, State], int]:
        """Propagate to the end of a frame or a part of one, and update there; also how many points that had."""
        scan = self._thinner.thin(frame) if frame.scans else _nothing(frame.stamp_ns)
        arrived = self._arrive(frame, scan)
        held = arrived.path.turn_rate[-1] + arrived.prior.gyro_bias
        state, explained = self._by_planes(arrived)
        state = self._by_images(frame, arrived, state)
        if len(scan.dense.points):
            state = self._add(arrived, state, explained is not None)
        self._state, self._turn_rate = state, held - state.gyro_bias
        return (arrived.path, state), len(scan.dense.points)

    def _arrive(self, frame: SyncedFrame, scan: ThinScan) -> _Arrived:
        """Propagate to the end of the frame's window; to its middle, if no sample tells how the rig turns at the end.

        In the middle a wrong turn rate moves the points by its square only.
        """
        first_s, last_s = window(frame)
        before, (prior, path) = self._state, self._propagated(frame.stamp_ns + round(last_s * 1e9))
        if prior.known is not None:
            prior, path = self._propagated(frame.stamp_ns + round(0.5e9 * (first_s + last_s)))
        if before is not None and not path.holes:
            prior = steadied(before, prior, self._noise)
        return _Arrived(prior, path, scan)

    def _propagated(self, stamp_ns: int) -> tuple[State, Path]:
        """The state and the path to a time, at the earliest its own."""
        assert self._state is not None
        stamp_ns = max(stamp_ns, self._state.stamp_ns)
        return propagate(self._state, stamp_ns, self._imu, self._noise, -self._imu.origin, self._turn_rate)

    def _begin(self, stamp_ns: int) -> State:
        state, still = first_state(stamp_ns, self._imu, self._start_velocity, self._config.start_speed)
        if not still:
            self._count("moving at the start")
            self.instruction = INSTRUCTION
        return state if self._start is None else self._placed(state, self._start)

    def _placed(self, state: State, start: Start) -> State:
        """The first state in the frame of a known map, whose planes are ready for the first scan."""
        state = state.moved(start.T_map_world)
        P = state.P.copy()
        P[POSITION, POSITION] += _PLACED_M**2 * np.eye(3)
        P[ROTATION, ROTATION] += _PLACED_RAD**2 * np.eye(3)
        self._map.begin(np.empty((0, 3), np.float32), state.T_world_body)
        return replace(state, P=P)

    def _by_planes(self, arrived: _Arrived) -> tuple[State, Explained | None]:
        """The state after the LiDAR update, or the prior and None if the scan does not fit the map."""
        prior, path, scan = arrived
        if len(self._map.planes) == 0 or len(scan.sparse.points) == 0:
            return prior, None
        points = arrived.points(scan.sparse, prior)
        tau = expected_miss_m(prior, path, arm_m(points))
        share, found = _LOST, registered(prior, self._measured(arrived, points, tau))
        if tau > _SURE_M and self._lost_s < _DOUBT_S:
            share = _UNSURE
            if found.explained.score < share * self._usual_score:
                found = self._searched(arrived, points, tau)
        state, explained = found
        if explained.matches < _MIN_MATCHES or explained.score < share * self._usual_score:
            self._count("not registered")
            return prior, None
        first = self._usual_score == 0.0
        self._usual_score += (1.0 if first else _MEMORY) * (explained.score - self._usual_score)
        return state, explained

    def _measured(self, arrived: _Arrived, points: F32, tau_m: float) -> PlaneMeasurement:
        """Points (n, 3) against the map, wrong by about ``tau_m``."""
        return PlaneMeasurement(
            self._map.planes, points, arrived.path, self._config.sigma_m, tau_m, arrived.prior
        )

    def _searched(self, arrived: _Arrived, points: F32, tau_m: float) -> Registered:
        """The best registration from states all over the prior."""
        self._count("searched")
        return searched(arrived.prior, lambda share: self._measured(arrived, points, share * tau_m))

    def _by_images(self, frame: SyncedFrame, arrived: _Arrived, state: State) -> State:
        """The state after the images, in order of time."""
        if self._images is None or not frame.images:
            return state
        images = sorted(frame.images, key=lambda image: image.stamp_ns)
        seen = SeenScan(arrived.points(arrived.scan.dense, state))
        for image in images:
            state = self._images.update(state, arrived.path, image, seen, self._map.planes)
        seen = SeenScan(arrived.points(arrived.scan.dense, state))
        for image in images:
            self._images.remember(state, arrived.path, image, seen, self._map.planes)
        return state

    def _add(self, arrived: _Arrived, state: State, registered: bool) -> State:
        """Add a scan to the map where the state has it; after many that were not registered begin a new map.

        A scan that was not registered is added if the IMU alone knows where: it may show what was never seen.
        Returns the state, less sure where the map begins anew.
        """
        points = arrived.points(arrived.scan.dense, state)
        T = arrived.path.at(state, 0.0).T_world_lidar
        if len(self._map.planes) == 0:
            self._map.begin(points, T)
        elif registered or expected_miss_m(state, arrived.path, arm_m(points)) < _SURE_M:
            self._lost_s = 0.0
            if refused := self._map.add(points, T):
                self._count("points without room in the local map", refused)
        else:
            self._lost_s -= float(arrived.path.time_s[0])
            if self._lost_s > _GIVE_UP_S and len(points):
                self._count("restarts")
                self._map.begin(points, T)
                self._lost_s, self._usual_score = 0.0, 0.0
                return opened(state, self._config.start_speed)
        return state

    def _tracked(self, frame: SyncedFrame, steps: Steps) -> TrackedFrame:
        at = steps.at(frame.stamp_ns)
        scans = deskew_frame(frame, steps.motion(frame.stamp_ns, *window(frame)))
        weakest = weakest_direction(scans, self._map.planes, at.T_world_lidar, self._config.sigma_m)
        degenerate = weakest is not None and weakest.degenerate
        state = steps.last
        return TrackedFrame(
            frame.index,
            frame.stamp_ns,
            at.T_world_lidar,
            scans,
            degenerate,
            frame.images,
            tuple(steps.at(_taken_ns(image, state)).T_world_lidar for image in frame.images),
            at.twist,
            at.T_world_lidar[:3, :3] @ weakest.direction if weakest is not None and degenerate else None,
        )

    def _count(self, reason: str, number: int = 1) -> None:
        self.lost[reason] = self.lost.get(reason, 0) + number


def _nothing(stamp_ns: int) -> ThinScan:
    none = TimedPoints(np.empty((0, 3), np.float32), np.empty(0, np.float32))
    return ThinScan(stamp_ns, none, none)


def _taken_ns(image: CameraImage, state: State) -> int:
    """When an image was taken, its estimated delay taken off, ns."""
    if image.name not in state.cameras:
        return image.stamp_ns
    return image.stamp_ns - round(1e9 * float(state.image_delay_s[state.cameras.index(image.name)]))
