"""A recording opened for calibration: with its own mounts or a file's, and poses that do not rest on images."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec

from artemis_edge.calibrate.refine import MakeOdometry
from artemis_edge.config import Config, InputConfig
from artemis_edge.datasets import lidar_poses, open_input
from artemis_edge.frames import FrameSource, Odometry
from artemis_edge.odometry.choice import odometry_for
from artemis_edge.odometry.given_poses import GivenPoses
from artemis_edge.trajectory import read_tum

_TURN_RATE, _TURN_S = 0.5, 0.5  # rad/s, s: of a rig that is turned about all axes by hand


def open_for_calibration(
    path: Path, start: Path | None, poses: Path | None, own_odometry: bool
) -> tuple[FrameSource, MakeOdometry]:
    """The frames, and what makes their odometry: given poses, else the input's, else LiDAR and IMU."""
    source = open_input(path, InputConfig(calibration="" if start is None else str(start)))
    given = None if poses is None else lidar_poses(source, read_tum(poses))
    if given is None and source.poses is not None and len(source.poses) and not own_odometry:
        given = source.poses
    if given is not None:
        known = GivenPoses(given)
        return source, lambda _seen, _unsure_rad: known
    config = Config().odometry

    def estimate(seen: FrameSource, unsure_rad: float) -> Odometry:
        # a turned IMU shows a turn about a wrong axis as long as the turn lasts
        wrong = unsure_rad * _TURN_RATE * math.sqrt(_TURN_S)
        noise = math.hypot(config.gyro_noise, wrong)
        return odometry_for(msgspec.structs.replace(config, gyro_noise=noise), lambda: seen.frames())

    return source, estimate
