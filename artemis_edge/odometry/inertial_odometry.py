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
from artemis_edge.odometry import se3
from artemis_edge.odometry.deskew import deskew_frame, move_points, window
from artemis_edge.odometry.image_update import ImageUpdate, SeenScan
from artemis_edge.odometry.known_map import Start
from artemis_edge.odometry.lidar_odometry import LidarOdometry
from artemis_edge.odometry.local_map import LocalMap
from artemis_edge.odometry.normals import weakest_direction
from artemis_edge.odometry.path import Path
from artemis_edge.odometry.plane_update import Explained, PlaneMeasurement, expected_miss_m
from artemis_edge.odometry.propagation import ImuNoise, propagate
from artemis_edge.odometry.registration import arm_m
from artemis_edge.odometry.rest import INSTRUCTION, first_state
from artemis_edge.odometry.scan_motion import steady
from artemis_edge.odometry.state import POSITION, ROTATION, State, iterated_update
from artemis_edge.odometry.thin import Thinner, ThinScan, TimedPoints

_START_FRAMES = 2  # looked at beforehand to know how fast a recording begins
_MIN_MATCHES = 50  # fewer planes do not fix six numbers against outliers
_LOST = 0.4  # share of the usual score below which the update is not believed
_MEMORY = 0.1  # weight of a new frame in the usual score
_ITERATIONS = 8
_CONVERGED = 2e-4  # m and rad
_SURE_M = 0.1  # expected miss at the points up to which the IMU's word is as good as a registration
_SAME_TIME_S = 1e-3  # frames that share a stamp are taken to be a millisecond apart
_KEPT_NS = 200_000_000  # samples kept behind the state, so that its own time can be interpolated
_GIVE_UP = 10  # frames lost in a row after which the map is begun anew at the predicted pose
_PLACED_M, _PLACED_RAD = 0.1, 0.01  # one sigma of the first pose in a known map


class _Arrived(NamedTuple):
    """A scan at the end of its window: the state before, the prior state there, the path between, the scan."""

    start: State
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
        self._lost_in_a_row = 0

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
        scan = self._thinner.thin(frame) if frame.scans else _nothing(frame.stamp_ns)
        arrived = self._arrive(frame, scan)
        state, explained = self._by_planes(arrived)
        if arrived.path.bridged and explained is not None:
            self._turn_rate = _mean_rate(arrived.start, state)
            arrived = self._arrive(frame, scan)
            state, explained = self._by_planes(arrived)
        state = self._by_images(frame, arrived, state)
        if frame.scans and len(scan.dense.points) == 0:
            self._count("no points")
        elif frame.scans:
            self._add(arrived, state, explained is not None)
        self._state, self._turn_rate = state, arrived.path.turn_rate[-1]
        self._imu = inertial.since(self._imu, state.stamp_ns - _KEPT_NS)
        return self._tracked(frame, arrived.path, state)

    def _arrive(self, frame: SyncedFrame, scan: ThinScan) -> _Arrived:
        """Propagate to the end of the frame's window."""
        if self._state is None:
            self._state = self._begin(frame.stamp_ns)
        end_ns = frame.stamp_ns + round(window(frame)[1] * 1e9)
        stamp_ns = max(end_ns, self._state.stamp_ns)
        prior, path = propagate(
            self._state, stamp_ns, self._imu, self._noise, -self._imu.origin, self._turn_rate
        )
        return _Arrived(self._state, prior, path, scan)

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
        _, prior, path, scan = arrived
        if len(self._map.planes) == 0 or len(scan.sparse.points) == 0:
            return prior, None
        points = arrived.points(scan.sparse, prior)
        tau = expected_miss_m(prior, path, arm_m(points))
        measured = PlaneMeasurement(self._map.planes, points, path, self._config.sigma_m, tau)
        state = iterated_update(prior, measured, _ITERATIONS, _CONVERGED)
        explained = measured.explained(state)
        if explained.matches < _MIN_MATCHES or explained.score < _LOST * self._usual_score:
            self._count("not registered")
            return prior, None
        first = self._usual_score == 0.0
        self._usual_score += (1.0 if first else _MEMORY) * (explained.score - self._usual_score)
        return state, explained

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

    def _add(self, arrived: _Arrived, state: State, registered: bool) -> None:
        """Add a scan to the map where the state has it; after many that were not registered begin a new map.

        A scan that was not registered is added if the IMU alone knows where: it may show what was never seen.
        """
        points = arrived.points(arrived.scan.dense, state)
        T = arrived.path.at(state, 0.0).T_world_lidar
        if len(self._map.planes) == 0:
            self._map.begin(points, T)
        elif registered or expected_miss_m(state, arrived.path, arm_m(points)) < _SURE_M:
            self._lost_in_a_row = 0
            if refused := self._map.add(points, T):
                self._count("points without room in the local map", refused)
        else:
            self._lost_in_a_row += 1
            if self._lost_in_a_row >= _GIVE_UP and len(points):
                self._count("restarts")
                self._map.begin(points, T)
                self._lost_in_a_row, self._usual_score = 0, 0.0

    def _tracked(self, frame: SyncedFrame, path: Path, state: State) -> TrackedFrame:
        since_s = (frame.stamp_ns - state.stamp_ns) * 1e-9
        at = path.at(state, since_s)
        first_s, last_s = window(frame)
        motion = path.motion(state, first_s + since_s, last_s + since_s)
        scans = deskew_frame(frame, motion.referred_to(since_s))
        weakest = weakest_direction(scans, self._map.planes, at.T_world_lidar, self._config.sigma_m)
        degenerate = weakest is not None and weakest.degenerate
        return TrackedFrame(
            frame.index,
            frame.stamp_ns,
            at.T_world_lidar,
            scans,
            degenerate,
            frame.images,
            tuple(path.at(state, _taken_s(image, state)).T_world_lidar for image in frame.images),
            at.twist,
            at.T_world_lidar[:3, :3] @ weakest.direction if weakest is not None and degenerate else None,
        )

    def _count(self, reason: str, number: int = 1) -> None:
        self.lost[reason] = self.lost.get(reason, 0) + number


def _nothing(stamp_ns: int) -> ThinScan:
    none = TimedPoints(np.empty((0, 3), np.float32), np.empty(0, np.float32))
    return ThinScan(stamp_ns, none, none)


def _mean_rate(before: State, after: State) -> F64:
    """Mean turn rate (3,) rad/s in body axes between two states."""
    T_before_after = se3.inverse(before.T_world_body) @ after.T_world_body
    elapsed_s = max((after.stamp_ns - before.stamp_ns) * 1e-9, _SAME_TIME_S)
    rate: F64 = se3.log(T_before_after)[3:] / elapsed_s
    return rate


def _taken_s(image: CameraImage, state: State) -> float:
    """When an image was taken after the state's stamp, its estimated delay taken off, s."""
    delay_s = (
        float(state.image_delay_s[state.cameras.index(image.name)]) if image.name in state.cameras else 0.0
    )
    return (image.stamp_ns - state.stamp_ns) * 1e-9 - delay_s
