"""An IMU on a moving body: analytic rates and forces, white noise, turn-on bias and bias random walk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from artemis_drivers.virtual.mesh_builder import F64
from artemis_drivers.virtual.motion import Motion

GRAVITY = 9.80665  # m/s2, standard gravity, along -z of the world


@dataclass(frozen=True, slots=True)
class ImuSpec:
    """Noise of a BMI088: densities of the data sheet (Bosch BST-BMI088-DS001: 0.014 deg/s/sqrt(Hz) and
    175 ug/sqrt(Hz)); bias random walk and turn-on bias after a factory calibration are our assumption (the
    data sheet's uncalibrated offsets, 1 deg/s and 20 mg, are larger).
    """

    rate_hz: float = 200.0
    gyro_noise: float = 0.014 * np.pi / 180  # rad/s/sqrt(Hz)
    accel_noise: float = 175e-6 * GRAVITY  # m/s2/sqrt(Hz)
    gyro_walk: float = 1.0e-5  # rad/s2/sqrt(Hz)
    accel_walk: float = 1.0e-4  # m/s3/sqrt(Hz)
    gyro_bias: float = 0.002  # rad/s, one sigma
    accel_bias: float = 0.02  # m/s2, one sigma

    def scaled(self, factor: float) -> ImuSpec:
        """All noise multiplied; 0 gives an ideal IMU."""
        s = factor
        return ImuSpec(
            self.rate_hz,
            self.gyro_noise * s,
            self.accel_noise * s,
            self.gyro_walk * s,
            self.accel_walk * s,
            self.gyro_bias * s,
            self.accel_bias * s,
        )


@dataclass(frozen=True, slots=True)
class ImuRecord:
    """``time_s`` (n,), ``gyro`` rad/s and ``accel`` m/s2 (specific force) (n, 3) in the body's axes; the
    biases that are in them, (n, 3) each, are truth.
    """

    time_s: F64
    gyro: F64
    accel: F64
    gyro_bias: F64
    accel_bias: F64


def measure(motion: Motion, spec: ImuSpec, seed: int, seconds: float) -> ImuRecord:
    """Samples at multiples of 1 / rate from 0 to ``seconds`` inclusive."""
    time = np.arange(round(seconds * spec.rate_hz) + 1) / spec.rate_hz
    gyro = motion.angular_velocity(time)
    force = motion.acceleration(time) + np.array([0.0, 0.0, GRAVITY])
    accel = np.einsum("nji,nj->ni", motion.pose(time)[:, :3, :3], force)
    rng = np.random.default_rng([seed, 31])
    step, root = np.sqrt(1 / spec.rate_hz), np.sqrt(spec.rate_hz)
    shape = gyro.shape
    gyro_bias = (
        rng.normal(0, 1, 3) * spec.gyro_bias
        + np.cumsum(rng.normal(0, 1, shape), axis=0) * spec.gyro_walk * step
    )
    accel_bias = (
        rng.normal(0, 1, 3) * spec.accel_bias
        + np.cumsum(rng.normal(0, 1, shape), axis=0) * spec.accel_walk * step
    )
    gyro = gyro + gyro_bias + rng.normal(0, 1, shape) * spec.gyro_noise * root
    accel = accel + accel_bias + rng.normal(0, 1, shape) * spec.accel_noise * root
    return ImuRecord(time, gyro, accel, gyro_bias, accel_bias)
