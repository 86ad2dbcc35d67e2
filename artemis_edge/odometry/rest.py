"""The filter's first state, from the first IMU samples: which way gravity pulls, what the gyroscope shows at rest."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from artemis_edge.frames import F64, ImuSamples
from artemis_edge.odometry.imu import levelling
from artemis_edge.odometry.state import (
    ACCEL_BIAS,
    CAMERAS,
    GRAVITY,
    GYRO_BIAS,
    ROTATION,
    VELOCITY,
    State,
)

INSTRUCTION = (
    "the IMU says that the rig moved when the recording began; hold it still for a second at the start, so that "
    "gravity and the gyroscope's bias are known from the first frame on"
)

# What a hand that tries to be still does (tremor of 0.1 deg at 1 to 9 Hz), per axis
_STILL_GYRO = 0.05  # rad/s
_STILL_ACCEL = 0.3  # m/s2
# One sigma: biases of a small IMU after calibration, and how far a mean over tremor may be off
_ACCEL_BIAS = 0.05  # m/s2
_GYRO_BIAS = 0.01  # rad/s
_GYRO_BIAS_AT_REST = 1e-3  # rad/s
_FORCE_AT_REST = 0.01  # m/s2
_FORCE_MOVING = 0.5  # m/s2; a walker's mean over a tenth of a second
_SPEED_AT_REST = 0.1  # m/s
_SPEED_KNOWN = 0.5  # m/s; from two scans
_SMOOTH_RIDE = 1.5  # m/s from which two scans that say so are believed although the IMU feels nothing
_LEVEL_RAD = 1e-4  # the first pose defines the world


class Rest(NamedTuple):
    """Means over samples: specific ``force`` (3,) m/s2, ``rate`` (3,) rad/s; ``still``: nothing moved."""

    force: F64
    rate: F64
    still: bool


def observe(imu: ImuSamples) -> Rest:
    """What the samples (at least one) say if they were taken at rest."""
    force, rate = imu.accel.mean(axis=0), imu.gyro.mean(axis=0)
    shaken = max(imu.gyro.std(axis=0).max() / _STILL_GYRO, imu.accel.std(axis=0).max() / _STILL_ACCEL)
    still = bool(shaken < 1.0 and np.abs(rate).max() < _STILL_GYRO)
    return Rest(np.asarray(force, np.float64), np.asarray(rate, np.float64), still)


def first_state(
    stamp_ns: int, imu: ImuSamples, velocity: F64 | None, start_speed: float
) -> tuple[State, bool]:
    """State of a body whose LiDAR is in the origin, levelled (z up), and whether it stood still.

    ``velocity`` (3,) m/s in body axes where it is known already. Gravity is what the accelerometer showed, so
    that an error of its bias is an error of gravity and nothing else until the body turns.
    """
    rest = observe(imu)
    stands = rest.still and (velocity is None or float(np.linalg.norm(velocity)) < _SMOOTH_RIDE)
    T = np.eye(4)
    T[:3, :3] = levelling(imu)
    R = T[:3, :3]
    T[:3, 3] = R @ imu.origin
    bias_sigma = _GYRO_BIAS_AT_REST if rest.still else _GYRO_BIAS
    force_sigma = _FORCE_AT_REST if rest.still else _FORCE_MOVING
    if stands:
        speed_sigma, velocity = _SPEED_AT_REST, np.zeros(3)
    else:
        speed_sigma = start_speed if velocity is None else _SPEED_KNOWN
    P = np.zeros((CAMERAS, CAMERAS))
    eye = np.eye(3)
    P[ROTATION, ROTATION] = _LEVEL_RAD**2 * eye
    P[VELOCITY, VELOCITY] = speed_sigma**2 * eye
    P[GYRO_BIAS, GYRO_BIAS] = bias_sigma**2 * eye
    P[ACCEL_BIAS, ACCEL_BIAS] = _ACCEL_BIAS**2 * eye
    P[GRAVITY, GRAVITY] = (_ACCEL_BIAS**2 + force_sigma**2) * eye
    P[GRAVITY, ACCEL_BIAS] = _ACCEL_BIAS**2 * R
    P[ACCEL_BIAS, GRAVITY] = _ACCEL_BIAS**2 * R.T
    state = State(
        stamp_ns,
        T,
        np.zeros(3) if velocity is None else R @ velocity,
        rest.rate if rest.still else np.zeros(3),
        np.zeros(3),
        -(R @ rest.force),
        P,
    )
    return state, rest.still
