"""From one state to a later one by an IMU: nominal values, covariance, and the path in between.

Between two samples turn rate and specific force are those of the middle. A hole in the samples is bridged with the
velocity and the turn rate held and the noise of a carrier that may accelerate; where its end is not yet known, the
error of the held rate is part of the state (``state.Known``).
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
from artemis_edge.odometry.state import (
    ACCEL_BIAS,
    CAMERAS,
    GRAVITY,
    GYRO_BIAS,
    ROTATION,
    Known,
    NormalEquations,
    State,
    iterated_update,
)

HOLE_S = 0.03  # samples farther apart do not tell what happened between them: a hand trembles at up to 12 Hz

_NEWS = 1e-3  # share of the variance below which it is not worth an update
_LASTS_S = 0.1  # how long a carrier's acceleration lasts: a fifth of a step


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
    bias, P, known = state.gyro_bias, state.P.copy(), state.known
    for first, last, lost in _stretches(nodes.hole):
        if lost and known is None:
            known = Known(bias, P[GYRO_BIAS, GYRO_BIAS].copy())
        elif known is not None and not lost:
            _restore(P, known)
            bias, known = known.bias, None
        gyro = nodes.gyro[first : last + 1].copy()
        if known is not None and last < m:
            gyro[-1] += bias - known.bias  # the sample that ends a hole has the gyroscope's own bias
        _integrate(
            nodes.time_s[first : last + 1], gyro, nodes.accel[first : last + 1], nodes.hole[first:last], lost,
            bias, state.accel_bias, state.gravity, np.array(noise), T[first : last + 1],
            velocity[first : last + 1], rate[first:last], acceleration[first:last], P,
        )  # fmt: skip
    end = replace(
        state,
        stamp_ns=stamp_ns,
        T_world_body=se3.orthonormal(T[-1]),
        velocity=velocity[-1],
        gyro_bias=bias,
        P=P,
        known=known,
    )
    path = Path(
        nodes.time_s[:-1] - span_s,
        T[:-1],
        velocity[:-1],
        rate,
        acceleration,
        end,
        origin,
        bool(nodes.hole.any()),
    )
    return end, path


def _stretches(hole: Bool) -> list[tuple[int, int, bool]]:
    """First piece, piece after the last, and: is it a hole whose other end is not in sight?"""
    m, within = len(hole), np.flatnonzero(~hole)
    lead, trail = (int(within[0]), int(within[-1]) + 1) if len(within) else (m, m)
    ends = ((0, lead, True), (lead, trail, False), (trail, m, True))
    return [stretch for stretch in ends if stretch[0] < stretch[1]]


def _restore(P: F64, known: Known) -> None:
    """Give the gyroscope its own bias back after a hole; nothing else is known to err with it."""
    P[GYRO_BIAS], P[:, GYRO_BIAS] = 0.0, 0.0
    P[GYRO_BIAS, GYRO_BIAS] = known.P


def steadied(before: State, state: State, noise: ImuNoise) -> State:
    """A state told that what carries the rig hardly accelerates, which says where down is when nothing else does.

    What the accelerometer measured on the way from the state ``before``, gravity added, is no more than the carrier's
    acceleration: nothing new in a usual frame, but all there is after a hole of the samples before a blank wall, where
    attitude is open by degrees.
    """
    span_s = (state.stamp_ns - before.stamp_ns) * 1e-9
    weight = span_s / (noise.acceleration**2 * _LASTS_S)
    turned2 = np.trace(state.P[ROTATION, ROTATION]) * float(state.gravity @ state.gravity)
    if span_s <= 0.0 or weight * turned2 < _NEWS:
        return state
    force = state.T_world_body[:3, :3].T @ ((state.velocity - before.velocity) / span_s - state.gravity)

    def linearise(s: State) -> NormalEquations:
        R, J = s.T_world_body[:3, :3], np.zeros((3, len(s)))
        J[:, ROTATION], J[:, ACCEL_BIAS], J[:, GRAVITY] = -R @ se3.skew(force), -R, np.eye(3)
        r = R @ (force - s.accel_bias + state.accel_bias) + s.gravity
        return NormalEquations(weight * J.T @ J, weight * J.T @ r)

    return iterated_update(state, linearise, 2)


def longest_hole_s(imu: ImuSamples, first_ns: int, last_ns: int) -> float:
    """The longest time between samples, s, of those that touch a window, or from its ends to the samples."""
    near = during(imu, first_ns, last_ns).stamp_ns
    ends = np.concatenate(
        [near, [first_ns] * (not (near <= first_ns).any()), [last_ns] * (not (near >= last_ns).any())]
    )
    return float(np.diff(np.sort(ends)).max(initial=0)) * 1e-9


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
    lost: bool,
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
    """Fill the path's arrays from their first row on and carry P (n, n) along, in place.

    ``lost``: the turn rate is held, and the state's bias is its error (``state.Known``).
    """
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
        _carry(P, R_middle, half @ half, f, dt, hole[k], lost, noise)


@njit
def _carry(P: F64, R: F64, turn: F64, force: F64, dt: float, hole: bool, lost: bool, noise: F64) -> None:
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
    # white noise gives density^2 dt; an unknown acceleration is white but for what lasts. Between samples the rate
    # that is interpolated is that of a middle as long ago
    spun = noise[4] ** 2 * _LASTS_S * dt if lost else 0.0
    turned = spun * dt * dt / 3.0 if lost else (noise[4] * dt * dt) ** 2 if hole else noise[0] ** 2 * dt
    pushed = noise[5] ** 2 * _LASTS_S * dt if hole else noise[1] ** 2 * dt
    for k in range(3):
        P[3 + k, 3 + k] += turned
        P[3 + k, 9 + k] -= 0.5 * spun * dt
        P[9 + k, 3 + k] -= 0.5 * spun * dt
        P[6 + k, 6 + k] += pushed
        P[k, k] += pushed * dt * dt / 3.0
        P[k, 6 + k] += 0.5 * pushed * dt
        P[6 + k, k] += 0.5 * pushed * dt
        P[9 + k, 9 + k] += spun + noise[2] ** 2 * dt
        P[12 + k, 12 + k] += noise[3] ** 2 * dt
