"""A recording opened for calibration: with its own mounts or a file's, and poses that do not rest on images."""

from __future__ import annotations

from pathlib import Path

from artemis_edge.calibrate.refine import MakeOdometry
from artemis_edge.config import Config, InputConfig
from artemis_edge.datasets import lidar_poses, open_input
from artemis_edge.frames import FrameSource, Odometry
from artemis_edge.odometry.choice import odometry_for
from artemis_edge.odometry.given_poses import GivenPoses
from artemis_edge.trajectory import read_tum


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
        return source, lambda _: known
    config = Config().odometry

    def estimate(seen: FrameSource) -> Odometry:
        return odometry_for(config, lambda: seen.frames())

    return source, estimate
