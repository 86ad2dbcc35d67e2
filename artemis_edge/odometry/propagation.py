"""From one state to a later one by an IMU: nominal values, covariance, and the path in between.

Between two samples turn rate and specific force are those of the middle. A hole in the samples is bridged with the
velocity and the turn rate held and the noise of a carrier that may accelerate, which is also how a rig without
an IMU is predicted.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.frames import F64, Bool, ImuSamples
from artemis_edge.odometry import se3
from artemis_edge.odometry.path import Path
from artemis_edge.odometry.scan_motion import during
from artemis_edge.odometry.state import CAMERAS, State

HOLE_S = 0.03  # samples farther apart do not tell what happened between them: a hand trembles at up to 12 Hz


class ImuNoise(NamedTuple):
    """White noise of gyroscope (rad/s/sqrt(Hz)) and accelerometer (m/s2/sqrt(Hz)), random walk of their biases
    (rad/s2/sqrt(Hz), m/s3/sqrt(Hz)), and what a carrier may do in a hole: rad/s2 and m/s2, one sigma.
    """

    gyro: float
    accel: float
    gyro_walk: float
    accel_walk: float
    angular_acceleration: float
    acceleration: float


class _Nodes(NamedTuple):
    """Times (m + 1,) s after the state, measured rate and force (m + 1, 3), is the piece after a node a hole (m,)."""

    time_s: F64
    gyro: F64
    accel: F64
    hole: Bool


def propagate(
    state: State, stamp_ns: int, imu: ImuSamples, noise: ImuNoise, origin: F64, turn_rate: F64
) -> tuple[State, Path]:
    """The state at a later stamp and the path there; ``origin`` (3,) is the LiDAR's place in the body.

    ``turn_rate`` (3,) rad/s, bias removed, is held from the state on where samples begin later. Samples may reach
    beyond both ends.
    """
    span_s = (stamp_ns - state.stamp_ns) * 1e-9
    nodes = _nodes(state, stamp_ns, imu, turn_rate)
    m = len(nodes.hole)
    T, velocity = np.empty((m + 1, 4, 4)), np.empty((m + 1, 3))
    rate, acceleration = np.empty((m, 3)), np.empty((m, 3))
    T[0], velocity[0] = state.T_world_body, state.velocity
    P = state.P.copy()
    _integrate(
        nodes.time_s, nodes.gyro, nodes.accel, nodes.hole, state.gyro_bias, state.accel_bias, state.gravity,
        np.array(noise), T, velocity, rate, acceleration, P,
    )  # fmt: skip
    end = replace(state, stamp_ns=stamp_ns, T_world_body=se3.orthonormal(T[-1]), velocity=velocity[-1], P=P)
    path = Path(
        nodes.time_s[:-1] - span_s,
        T[:-1],
        velocity[:-1],
        rate,
        acceleration,
        end,
        origin,
        bool(nodes.hole.all()),
    )
    return end, path


def _nodes(state: State, stamp_ns: int, imu: ImuSamples, turn_rate: F64) -> _Nodes:
    """The state's time, the samples within, the target time; values at both ends are interpolated."""
    near = during(imu, state.stamp_ns, stamp_ns)
    sample_s: F64 = np.asarray((near.stamp_ns - state.stamp_ns) * 1e-9, np.float64)
    span_s = (stamp_ns - state.stamp_ns) * 1e-9
    inside = (sample_s > 0.0) & (sample_s < span_s)
    time_s: F64 = np.concatenate([[0.0], sample_s[inside], [span_s]], dtype=np.float64)
    held = turn_rate + state.gyro_bias
    if not inside.any() and (len(sample_s) < 2 or sample_s[-1] - sample_s[0] > HOLE_S):
        return _Nodes(time_s, np.tile(held, (2, 1)), np.zeros((2, 3)), np.ones(1, np.bool_))
    gyro = np.column_stack([np.interp(time_s, sample_s, near.gyro[:, k]) for k in range(3)])
    accel = np.column_stack([np.interp(time_s, sample_s, near.accel[:, k]) for k in range(3)])
    hole = _holes(time_s, sample_s)
    if hole[0]:
        gyro[0] = held
    return _Nodes(time_s, gyro, accel, hole)


def _holes(time_s: F64, sample_s: F64) -> Bool:
    """Which pieces between nodes lie in a hole of the samples, or too far beyond their first or last."""
    middle = 0.5 * (time_s[1:] + time_s[:-1])
    after = np.searchsorted(sample_s, middle)
    before = np.concatenate([[-np.inf], sample_s])[after]
    behind = np.concatenate([sample_s, [np.inf]])[after]
    before = np.where(np.isfinite(before), before, time_s[0])
    behind = np.where(np.isfinite(behind), behind, time_s[-1])
    return np.asarray(behind - before > HOLE_S)


@njit
def _integrate(
    time_s: F64,
    gyro: F64,
    accel: F64,
    hole: Bool,
    gyro_bias: F64,
    accel_bias: F64,
    gravity: F64,
    noise: F64,
    T: F64,
    velocity: F64,
    rate: F64,
    acceleration: F64,
    P: F64,
) -> None:
    """Fill the path's arrays from their first row on and carry P (n, n) along, in place."""
    turn = np.zeros(6)
    for k in range(len(hole)):
        dt = time_s[k + 1] - time_s[k]
        R = np.ascontiguousarray(T[k, :3, :3])
        w = 0.5 * (gyro[k] + gyro[k + 1]) - gyro_bias
        f = 0.5 * (accel[k] + accel[k + 1]) - accel_bias
        turn[3:] = 0.5 * dt * w
        half = np.ascontiguousarray(se3.exp(turn)[:3, :3])
        R_middle = R @ half
        a = np.zeros(3) if hole[k] else R_middle @ f + gravity
        rate[k], acceleration[k] = w, a
        T[k + 1] = T[k]
        T[k + 1, :3, :3] = R_middle @ half
        T[k + 1, :3, 3] += dt * velocity[k] + 0.5 * dt * dt * a
        velocity[k + 1] = velocity[k] + dt * a
        _carry(P, R_middle, half @ half, f, dt, hole[k], noise)


@njit
def _carry(P: F64, R: F64, turn: F64, force: F64, dt: float, hole: bool, noise: F64) -> None:
    """P <- F P F' + Q over one piece; cameras do not change and are noiseless."""
    n = len(P)
    F = np.eye(CAMERAS)
    F[:3, 6:9] = dt * np.eye(3)
    F[3:6, 3:6] = turn.T
    F[3:6, 9:12] = -dt * np.eye(3)
    if not hole:
        lever = -dt * (R @ se3.skew(force))
        F[6:9, 3:6], F[6:9, 12:15], F[6:9, 15:18] = lever, -dt * R, dt * np.eye(3)
        F[:3, 3:6], F[:3, 12:15], F[:3, 15:18] = (
            0.5 * dt * lever,
            -0.5 * dt * dt * R,
            0.5 * dt * dt * np.eye(3),
        )
    core = F @ np.ascontiguousarray(P[:CAMERAS, :CAMERAS]) @ F.T
    P[:CAMERAS, :CAMERAS] = core
    if n > CAMERAS:
        cross = F @ np.ascontiguousarray(P[:CAMERAS, CAMERAS:])
        P[:CAMERAS, CAMERAS:] = cross
        P[CAMERAS:, :CAMERAS] = cross.T
    # white noise gives density^2 dt; in a hole the unknown acceleration lasts as long as the piece, and the rate
    # that is held is that of a middle as long ago
    turned = (noise[4] * dt * dt) ** 2 if hole else noise[0] ** 2 * dt
    pushed = (noise[5] * dt) ** 2 if hole else noise[1] ** 2 * dt
    for k in range(3):
        P[3 + k, 3 + k] += turned
        P[6 + k, 6 + k] += pushed
        P[k, k] += 0.25 * pushed * dt * dt
        P[k, 6 + k] += 0.5 * pushed * dt
        P[6 + k, k] += 0.5 * pushed * dt
        P[9 + k, 9 + k] += noise[2] ** 2 * dt
        P[12 + k, 12 + k] += noise[3] ** 2 * dt
