"""What plain odometry takes from an IMU: which way is up at the start, and how fast the sensor turns.

Samples come in the axes of the LiDAR (the readers turn them).
"""

from __future__ import annotations

import numpy as np

from artemis_edge.frames import F64, ImuSamples
from artemis_edge.odometry import se3

_GRAVITY = 9.81
_HALF_SCAN_NS = 50_000_000  # a frame is a window of 100 ms
_STEADY = 0.3  # accepted deviation of the mean specific force from gravity, as a share of it


def levelling(imu: ImuSamples) -> F64:
    """Rotation (3, 3) R_world_lidar that turns the measured up to z by the shortest way, or identity.

    Accelerometers at rest measure the reaction to gravity, which points up. Samples whose mean is not about
    as strong as gravity (free fall, wrong unit) say nothing.
    """
    if len(imu.accel) == 0:
        return np.eye(3)
    force: F64 = imu.accel.mean(axis=0)
    strength = float(np.linalg.norm(force))
    if not abs(strength - _GRAVITY) <= _STEADY * _GRAVITY:
        return np.eye(3)
    return shortest_rotation(force / strength, np.array([0.0, 0.0, 1.0]))


def shortest_rotation(a: F64, b: F64) -> F64:
    """Rotation (3, 3) that takes the unit vector a to the unit vector b about their common normal."""
    axis, cosine = np.cross(a, b), float(a @ b)
    if cosine < -1.0 + 1e-9:  # opposite: half a turn about any normal
        normal = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
        normal /= np.linalg.norm(normal)
        return 2.0 * np.outer(normal, normal) - np.eye(3)
    W: F64 = se3.skew(axis)
    return np.eye(3) + W + W @ W / (1.0 + cosine)


def join(before: ImuSamples, after: ImuSamples) -> ImuSamples:
    """Samples of two frames in order of time, those at a time already seen left out."""
    start = before.stamp_ns[-1] if len(before.stamp_ns) else np.iinfo(np.int64).min
    new = after.stamp_ns > start
    return ImuSamples(
        np.concatenate([before.stamp_ns, after.stamp_ns[new]]),
        np.concatenate([before.gyro, after.gyro[new]]),
        np.concatenate([before.accel, after.accel[new]]),
        after.origin if len(after.stamp_ns) else before.origin,
    )


def mean_rate(imu: ImuSamples, start_ns: int, stop_ns: int) -> F64 | None:
    """Mean angular velocity (3,) of the samples within a time, rad/s in their axes; None without any."""
    inside = (imu.stamp_ns > start_ns) & (imu.stamp_ns <= stop_ns)
    return imu.gyro[inside].mean(axis=0) if inside.any() else None


def rate_during(imu: ImuSamples, middle_ns: int) -> F64 | None:
    """Mean angular velocity (3,) during the scan with this middle, rad/s; None without samples."""
    return mean_rate(imu, middle_ns - _HALF_SCAN_NS, middle_ns + _HALF_SCAN_NS)


def since(imu: ImuSamples, stamp_ns: int) -> ImuSamples:
    """The samples after a time."""
    keep = imu.stamp_ns > stamp_ns
    return ImuSamples(imu.stamp_ns[keep], imu.gyro[keep], imu.accel[keep], imu.origin)
