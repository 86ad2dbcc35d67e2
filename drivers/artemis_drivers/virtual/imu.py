"""An IMU on a moving body: analytic rates and forces; white noise, bias with flicker and random walk; saturation
and quantisation.

Noise terms and their Allan deviations are those of IEEE Std 952-1997, annex C: white noise N (N / sqrt(t)), bias
instability B (flicker of spectrum B^2 / (2 pi f), flat at 0.664 B) and rate random walk K (K sqrt(t / 3)). Flicker
is the sum of first-order Gauss-Markov processes at correlation times a factor four apart.

Not modelled: scale errors, misalignment, temperature, sensitivity of the gyroscopes to acceleration, bandwidth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from artemis_drivers.virtual.mesh_builder import F64
from artemis_drivers.virtual.motion import Motion

Rng = np.random.Generator
GRAVITY = 9.80665  # m/s2, standard gravity, along -z of the world
_DEG = np.pi / 180
_MG = 1e-3 * GRAVITY
_FLICKER_S = tuple(0.25 * 4.0**k for k in range(8))  # correlation times: flat from about 1 s to an hour
_FLICKER_SHARE = float(
    np.sqrt(np.log(4.0) / np.pi)
)  # sigma of each process / B, from the sum of their spectra


@dataclass(frozen=True, slots=True)
class ImuSpec:
    """Defaults: the BMI088 of the Livox Avia.

    Noise densities, 16 bits and ranges are of its data sheet (Bosch BST-BMI088-DS001: 0.014 deg/s/sqrt(Hz),
    175 ug/sqrt(Hz), widest ranges +-2000 deg/s and +-24 g). It gives no bias instability; taken are the published
    10 deg/h and 0.03 mg of the comparable :data:`MTI_1`. Random walk and turn-on bias after a factory calibration
    are our assumption (the data sheet's uncalibrated offsets, 1 deg/s and 20 mg, are larger).
    """

    rate_hz: float = 200.0
    gyro_noise: float = 0.014 * _DEG  # rad/s/sqrt(Hz)
    accel_noise: float = 0.175 * _MG  # m/s2/sqrt(Hz)
    gyro_instability: float = 10.0 / 3600 * _DEG  # rad/s
    accel_instability: float = 0.03 * _MG  # m/s2
    gyro_walk: float = 1.0e-5  # rad/s2/sqrt(Hz)
    accel_walk: float = 1.0e-4  # m/s3/sqrt(Hz)
    gyro_bias: float = 0.002  # rad/s, one sigma
    accel_bias: float = 0.02  # m/s2, one sigma
    gyro_range: float = 2000.0 * _DEG  # rad/s
    accel_range: float = 24.0 * GRAVITY  # m/s2
    bits: int = 16  # over the whole range; 0: not quantised

    def scaled(self, factor: float) -> ImuSpec:
        """All noise multiplied; 0 gives an ideal IMU, not quantised either."""
        names = ("noise", "instability", "walk", "bias")
        scaled = {f"{s}_{n}": getattr(self, f"{s}_{n}") * factor for s in ("gyro", "accel") for n in names}
        return replace(self, **scaled, bits=self.bits if factor > 0 else 0)


#: Xsens MTi-1 (its data sheet as tabulated in Transactions on Aerospace Research 2023/4, doi 10.2478/tar-2023-0022:
#: 0.007 deg/s/sqrt(Hz), 10 deg/h, 120 ug/sqrt(Hz), 0.03 mg, +-2000 deg/s, +-16 g); its messages carry floats.
MTI_1 = ImuSpec(
    gyro_noise=0.007 * _DEG, accel_noise=0.120 * _MG, accel_range=16.0 * GRAVITY, bits=0, rate_hz=400.0
)


@dataclass(frozen=True, slots=True)
class ImuRecord:
    """``time_s`` (n,), ``gyro`` rad/s and ``accel`` m/s2 (specific force) (n, 3) in the body's axes; the
    biases that are in them, (n, 3) each, are truth. ``clipped`` counts the samples beyond the range of an axis.
    """

    time_s: F64
    gyro: F64
    accel: F64
    gyro_bias: F64
    accel_bias: F64
    clipped: int


def measure(motion: Motion, spec: ImuSpec, seed: int, seconds: float) -> ImuRecord:
    """Samples at multiples of 1 / rate from 0 to ``seconds`` inclusive."""
    return measure_at(motion, spec, seed, np.arange(round(seconds * spec.rate_hz) + 1) / spec.rate_hz)


def measure_at(motion: Motion, spec: ImuSpec, seed: int, time_s: F64) -> ImuRecord:
    """Samples at true times ``time_s`` (n,), about 1 / rate apart (a clock of its own may shift them)."""
    rate = motion.angular_velocity(time_s)
    pull = motion.acceleration(time_s) + np.array([0.0, 0.0, GRAVITY])
    force = np.einsum("nji,nj->ni", motion.pose(time_s)[:, :3, :3], pull)
    rng = np.random.default_rng([seed, 31])
    n, hz = len(time_s), spec.rate_hz
    gyro_bias = bias(rng, n, hz, spec.gyro_bias, spec.gyro_instability, spec.gyro_walk)
    accel_bias = bias(rng, n, hz, spec.accel_bias, spec.accel_instability, spec.accel_walk)
    gyro = rate + gyro_bias + rng.normal(0, 1, (n, 3)) * spec.gyro_noise * np.sqrt(hz)
    accel = force + accel_bias + rng.normal(0, 1, (n, 3)) * spec.accel_noise * np.sqrt(hz)
    over = (np.abs(gyro) > spec.gyro_range).any(axis=1) | (np.abs(accel) > spec.accel_range).any(axis=1)
    return ImuRecord(
        time_s,
        _digital(gyro, spec.gyro_range, spec.bits),
        _digital(accel, spec.accel_range, spec.bits),
        gyro_bias,
        accel_bias,
        int(over.sum()),
    )


def bias(rng: Rng, count: int, rate_hz: float, turn_on: float, instability: float, walk: float) -> F64:
    """Bias over time (count, 3): turn-on value, flicker and random walk."""
    out = rng.normal(0, 1, 3) * turn_on + np.zeros((count, 3))
    out += np.cumsum(rng.normal(0, 1, (count, 3)), axis=0) * walk / np.sqrt(rate_hz)
    for correlation_s in _FLICKER_S:
        keep = np.exp(-1 / (rate_hz * correlation_s))
        drive = rng.normal(0, 1, (count, 3)) * np.sqrt(1 - keep**2)
        drive[:1] /= np.sqrt(1 - keep**2)  # begins in its stationary state
        out += lfilter([1.0], [1.0, -keep], drive, axis=0) * instability * _FLICKER_SHARE
    return out


def _digital(value: F64, limit: float, bits: int) -> F64:
    """What a converter of ``bits`` over -limit..limit makes of it."""
    if bits == 0:
        return np.clip(value, -limit, limit)
    step = limit / 2 ** (bits - 1)
    return np.asarray(np.clip(np.rint(value / step), -(2 ** (bits - 1)), 2 ** (bits - 1) - 1) * step)
