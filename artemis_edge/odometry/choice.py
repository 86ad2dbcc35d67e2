"""Which odometry a rig gets: the filter where an IMU samples fast enough, else constant velocity."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import ImuSamples, SyncedFrame
from artemis_edge.odometry.image_update import ImageUpdate
from artemis_edge.odometry.imu import levelling
from artemis_edge.odometry.inertial_odometry import InertialOdometry
from artemis_edge.odometry.known_map import Start
from artemis_edge.odometry.lidar_odometry import LidarOdometry
from artemis_edge.odometry.propagation import HOLE_S

LOOKED_AT = 2  # frames
_LEAST_SAMPLES = 5  # in those frames

#: An odometry of either kind: both have ``lost``, counts by reason.
OwnOdometry = LidarOdometry | InertialOdometry


def odometry_for(
    config: OdometryConfig,
    frames: Callable[[], Iterator[SyncedFrame]],
    images: ImageUpdate | None = None,
    start: Start | None = None,
) -> OwnOdometry:
    """The odometry of a recording, which may be looked at from its start as often as needed.

    With a ``start`` it goes on in a known map.
    """
    first = list(islice(frames(), LOOKED_AT))
    if all(fast_enough(frame.imu) for frame in first) and first:
        return InertialOdometry.looking_ahead(config, first, images, start)
    return LidarOdometry.looking_ahead(config, first, start)


def fast_enough(imu: ImuSamples) -> bool:
    """Do the samples tell the motion in between, and does the accelerometer feel gravity at all?

    A car's 10 Hz do not, and slower ones only give a mean turn.
    """
    if len(imu.stamp_ns) < _LEAST_SAMPLES or np.median(np.diff(imu.stamp_ns)) * 1e-9 > HOLE_S:
        return False
    up = levelling(imu) @ imu.accel.mean(axis=0)
    return bool(up[2] > 0.0 and np.abs(up[:2]).max() < 1e-6 * up[2])
