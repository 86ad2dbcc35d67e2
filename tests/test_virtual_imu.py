"""The virtual IMU: strapdown integration returns the truth, Allan deviation returns the configuration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from artemis_drivers.virtual import street
from artemis_drivers.virtual.imu import GRAVITY, MTI_1, ImuSpec, bias, measure, measure_at
from artemis_drivers.virtual.mesh_builder import F64
from artemis_drivers.virtual.motion import Motion
from artemis_drivers.virtual.walk import Gait, walk
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

NODES, WEIGHTS = np.polynomial.legendre.leggauss(3)


def at_rest(seconds: float) -> Motion:
    time = np.linspace(0, seconds, 12)
    return Motion.through(time, np.zeros((12, 3)), np.zeros((12, 3)))


def turned(rate: object, start: F64, h: float | F64) -> Rotation:
    """Rotation over h from ``start``: fourth-order Magnus step (Iserles & Norsett 1999), all steps at once."""
    c = np.sqrt(3) / 6
    a, b = rate(start + (0.5 - c) * h), rate(start + (0.5 + c) * h)  # type: ignore[operator]
    return Rotation.from_rotvec(h * (a + b) / 2 + np.sqrt(3) / 12 * h**2 * np.cross(a, b))


def integrate(time: F64, gyro: F64, accel: F64, start: F64, velocity: F64) -> F64:
    """Positions at the samples: signals as quintic splines, attitude by Magnus, force by Gauss quadrature."""
    h, begin = time[1] - time[0], time[:-1]
    rate, force = make_interp_spline(time, gyro, 5), make_interp_spline(time, accel, 5)
    attitude = [Rotation.from_matrix(start[:3, :3])]
    for step in turned(rate, begin, h):
        attitude.append(attitude[-1] * step)
    before = Rotation.concatenate(attitude[:-1])
    share, weight = (NODES + 1) / 2, WEIGHTS / 2
    gain, reach = np.zeros((len(begin), 3)), np.zeros((len(begin), 3))
    for s, w in zip(share, weight, strict=True):
        pull = (before * turned(rate, begin, s * h)).apply(force(begin + s * h)) - [0, 0, GRAVITY]
        gain += w * h * pull
        reach += w * (1 - s) * h**2 * pull
    speed = velocity + np.concatenate([np.zeros((1, 3)), np.cumsum(gain, axis=0)])
    return np.asarray(
        start[:3, 3] + np.concatenate([np.zeros((1, 3)), np.cumsum(speed[:-1] * h + reach, axis=0)])
    )


@pytest.mark.parametrize("rate_hz", [200.0, 400.0])
def test_integrating_the_ideal_imu_for_a_minute_gives_the_true_trajectory(rate_hz: float) -> None:
    motion = walk(street.build(4, 100.0).path, 61.0, 4, Gait(turn_deg_s=150.0))
    record = measure(motion, replace(ImuSpec(), rate_hz=rate_hz).scaled(0.0), 4, 60.0)
    assert len(record.time_s) == 60 * rate_hz + 1
    start, velocity = motion.pose(0.0)[0], motion.velocity(0.0)[0]
    truth = motion.position(record.time_s)
    error = np.linalg.norm(
        integrate(record.time_s, record.gyro, record.accel, start, velocity) - truth, axis=1
    )
    assert error.max() < 1e-3
    wrong = record.gyro + np.array([0.0, 1e-6, 0.0])  # the test must be able to fail
    drift = integrate(record.time_s, wrong, record.accel, start, velocity)
    assert np.linalg.norm(drift - truth, axis=1).max() > 1e-2


def test_at_rest_it_measures_gravity_upwards() -> None:
    ideal = measure(at_rest(2.0), ImuSpec().scaled(0.0), 0, 1.0)
    np.testing.assert_allclose(ideal.accel, np.tile([0, 0, GRAVITY], (201, 1)), atol=1e-12)
    np.testing.assert_allclose(ideal.gyro, 0.0, atol=1e-12)


def allan(signal: F64, rate_hz: float, span_s: float) -> float:
    """Overlapping Allan deviation of (n, axes), root mean square over the axes."""
    m = round(span_s * rate_hz)
    total = np.concatenate([np.zeros((1, signal.shape[1])), np.cumsum(signal, axis=0)]) / rate_hz
    second = total[2 * m :] - 2 * total[m:-m] + total[: -2 * m]
    return float(np.sqrt((second**2).mean() / 2) / (m / rate_hz))


SPANS = (0.5, 1.0, 4.0, 16.0, 64.0, 200.0)


def test_allan_deviation_of_the_bias_instability_is_flat_as_configured() -> None:
    rng = np.random.default_rng(2)
    flicker = np.concatenate([bias(rng, 400_000, 20.0, 0.0, 1.0, 0.0) for _ in range(3)], axis=1)
    measured = [allan(flicker, 20.0, s) for s in SPANS]
    np.testing.assert_allclose(measured[1:], 0.664, rtol=0.15)
    doubled = bias(np.random.default_rng(2), 1000, 20.0, 0.0, 2.0, 0.0)
    np.testing.assert_allclose(doubled, 2 * bias(np.random.default_rng(2), 1000, 20.0, 0.0, 1.0, 0.0))


@pytest.mark.parametrize("name", ["gyro", "accel"])
def test_allan_deviation_matches_the_configuration(name: str) -> None:
    """Over all terms together: 3 % where white noise rules (below 1 s), 15 % beyond (few independent spans)."""
    spec = replace(ImuSpec(), rate_hz=50.0, bits=0)
    record = measure(at_rest(8100.0), spec, 5, 8000.0)
    signal = getattr(record, name)
    noise, flicker, walk = (getattr(spec, f"{name}_{n}") for n in ("noise", "instability", "walk"))
    for span in SPANS:
        expected = np.sqrt(noise**2 / span + (0.664 * flicker) ** 2 + walk**2 * span / 3)
        assert allan(signal, 50.0, span) == pytest.approx(expected, rel=0.03 if span <= 1 else 0.15)
    assert np.abs(record.gyro_bias[0]).max() < 4 * spec.gyro_bias


def test_random_walk_alone() -> None:
    wander = bias(np.random.default_rng(3), 300_000, 20.0, 0.0, 0.0, 2.0)
    for span in (1.0, 8.0, 64.0):
        assert allan(wander, 20.0, span) == pytest.approx(2.0 * np.sqrt(span / 3), rel=0.15)


def test_saturation_is_clipped_and_counted() -> None:
    t = np.linspace(0, 2, 60)
    spin = Motion.through(t, np.zeros((60, 3)), np.column_stack([20.0 * t, 0 * t, 0 * t]))  # 1146 deg/s
    spec = replace(ImuSpec(), gyro_range=np.radians(500), accel_range=0.5 * GRAVITY)
    record = measure(spin, spec, 0, 1.5)
    assert record.clipped == len(record.time_s)
    assert record.gyro[:, 2].max() == pytest.approx(np.radians(500), rel=1e-4)
    assert record.accel[:, 2].max() == pytest.approx(0.5 * GRAVITY, rel=1e-4)
    assert measure(spin, ImuSpec(), 0, 1.5).clipped == 0


def test_quantisation_is_that_of_sixteen_bits() -> None:
    record = measure(at_rest(5.0), ImuSpec(), 0, 4.0)
    step = np.radians(2000.0) / 32768
    np.testing.assert_allclose(record.gyro / step, np.rint(record.gyro / step), atol=1e-6)
    floats = measure(at_rest(5.0), MTI_1, 0, 4.0)
    assert len(np.unique(floats.gyro)) == floats.gyro.size
    assert len(floats.time_s) == 1601


def test_samples_at_times_of_another_clock() -> None:
    motion = walk(street.build(4, 100.0).path, 6.0, 4)
    ideal, at = ImuSpec().scaled(0.0), np.arange(0, 5, 0.005) * 1.0001 + 0.0003
    record = measure_at(motion, ideal, 0, at)
    np.testing.assert_allclose(record.gyro, motion.angular_velocity(at))


def test_same_seed_same_record() -> None:
    one, two, other = (measure(at_rest(2.0), ImuSpec(), seed, 1.0) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.gyro, two.gyro)
    assert not np.array_equal(one.gyro, other.gyro)
