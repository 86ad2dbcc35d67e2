"""The state of the filter: nominal values, and the covariance of a small error about them.

Body is the frame of the IMU's place in the axes of the LiDAR; a rig without an IMU has it in the LiDAR. The error
state (n,) is, in this order,

    POSITION   0:3    of the body in world, m
    ROTATION   3:6    of the body, right perturbation R_world_body exp(.), rad
    VELOCITY   6:9    of the body in world, m/s
    GYRO_BIAS  9:12   rad/s, in body axes; in a hole of the samples, of the turn rate that is held (``Known``)
    ACCEL_BIAS 12:15  m/s2, in body axes
    GRAVITY    15:18  acceleration of free fall in world, m/s2
    CAMERAS    18:    of every camera two: log of the inverse exposure, and the delay of its stamps, s

After Xu et al., FAST-LIO2 (T-RO 2022) and Zheng et al., FAST-LIVO2 (T-RO 2024); here gravity has three
components, of which an accelerometer that stood still fixes the length, and the exposure is a logarithm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from artemis_edge.frames import F64
from artemis_edge.odometry import se3

POSITION = slice(0, 3)
ROTATION = slice(3, 6)
POSE = slice(0, 6)
VELOCITY = slice(6, 9)
GYRO_BIAS = slice(9, 12)
ACCEL_BIAS = slice(12, 15)
GRAVITY = slice(15, 18)
CAMERAS = 18
_PER_CAMERA = 2


class Known(NamedTuple):
    """The gyroscope's ``bias`` (3,) and its covariance ``P`` (3, 3), put aside while no samples come.

    Meanwhile the turn rate is held, like that of a gyroscope whose bias walks as fast as a carrier may turn: the
    state's bias is then the error of that rate, and what a LiDAR sees of it is weighed like everything else.
    """

    bias: F64
    P: F64


@dataclass(frozen=True, slots=True)
class State:
    """State at ``stamp_ns``.

    ``T_world_body`` (4, 4); ``velocity``, ``gravity`` (3,) in world; biases (3,) in body axes, to be subtracted
    from what is measured. Of every camera in ``cameras``: ``log_inverse_exposure`` (c,), relative to the first
    image, and ``image_delay_s`` (c,): an image was taken at its stamp minus this. ``P`` (n, n), n = 18 + 2 c, is the
    covariance of the error. ``known``: None but in a hole of the samples.
    """

    stamp_ns: int
    T_world_body: F64
    velocity: F64
    gyro_bias: F64
    accel_bias: F64
    gravity: F64
    P: F64
    cameras: tuple[str, ...] = ()
    log_inverse_exposure: F64 = field(default_factory=lambda: np.zeros(0))
    image_delay_s: F64 = field(default_factory=lambda: np.zeros(0))
    known: Known | None = None

    def __len__(self) -> int:
        """Length of the error state."""
        return CAMERAS + _PER_CAMERA * len(self.cameras)

    def plus(self, error: F64) -> State:
        """The state moved by an error (n,); the covariance is left as it is."""
        T = self.T_world_body.copy()
        turn = np.zeros(6)
        turn[3:] = error[ROTATION]
        T[:3, :3] = (self.T_world_body @ se3.exp(turn))[:3, :3]
        T[:3, 3] += error[POSITION]
        return replace(
            self,
            T_world_body=se3.orthonormal(T),
            velocity=self.velocity + error[VELOCITY],
            gyro_bias=self.gyro_bias + error[GYRO_BIAS],
            accel_bias=self.accel_bias + error[ACCEL_BIAS],
            gravity=self.gravity + error[GRAVITY],
            log_inverse_exposure=self.log_inverse_exposure + error[CAMERAS::_PER_CAMERA],
            image_delay_s=self.image_delay_s + error[CAMERAS + 1 :: _PER_CAMERA],
        )

    def minus(self, other: State) -> F64:
        """The error (n,) by which ``other`` is moved to this state; both have the same cameras."""
        error = np.empty(len(self))
        R = np.eye(4)
        R[:3, :3] = other.T_world_body[:3, :3].T @ self.T_world_body[:3, :3]
        error[POSITION] = self.T_world_body[:3, 3] - other.T_world_body[:3, 3]
        error[ROTATION] = se3.log(R)[3:]
        error[VELOCITY] = self.velocity - other.velocity
        error[GYRO_BIAS] = self.gyro_bias - other.gyro_bias
        error[ACCEL_BIAS] = self.accel_bias - other.accel_bias
        error[GRAVITY] = self.gravity - other.gravity
        error[CAMERAS::_PER_CAMERA] = self.log_inverse_exposure - other.log_inverse_exposure
        error[CAMERAS + 1 :: _PER_CAMERA] = self.image_delay_s - other.image_delay_s
        return error

    def moved(self, T_new_old: F64) -> State:
        """The same state in another world frame; T_new_old (4, 4)."""
        R = T_new_old[:3, :3]
        J = np.eye(len(self))
        for part in (POSITION, VELOCITY, GRAVITY):
            J[part, part] = R
        return replace(
            self,
            T_world_body=se3.orthonormal(T_new_old @ self.T_world_body),
            velocity=R @ self.velocity,
            gravity=R @ self.gravity,
            P=J @ self.P @ J.T,
        )

    def with_camera(self, name: str, exposure_sigma: float, delay_sigma_s: float) -> State:
        """The state with another camera, exposure as in its first image (sigma of the log) and no delay."""
        n = len(self)
        P = np.zeros((n + _PER_CAMERA, n + _PER_CAMERA))
        P[:n, :n] = self.P
        P[n, n], P[n + 1, n + 1] = exposure_sigma**2, delay_sigma_s**2
        return replace(
            self,
            P=P,
            cameras=(*self.cameras, name),
            log_inverse_exposure=np.append(self.log_inverse_exposure, 0.0),
            image_delay_s=np.append(self.image_delay_s, 0.0),
        )

    def exposure_column(self, name: str) -> int:
        """Where in the error state a camera's log inverse exposure is; its delay comes next."""
        return CAMERAS + _PER_CAMERA * self.cameras.index(name)


class NormalEquations(NamedTuple):
    """What measurements say about an error at a state: ``H`` (n, n) = sum J' W J and ``g`` (n,) = sum J' W r.

    r are residuals (measured by the state minus wanted), J their derivatives, W their inverse variances, robust
    weights included.
    """

    H: F64
    g: F64

    @classmethod
    def none(cls, n: int) -> NormalEquations:
        """Of no measurement."""
        return cls(np.zeros((n, n)), np.zeros(n))


#: Linearises measurements at a state.
Linearise = Callable[[State], NormalEquations]


def iterated_update(
    prior: State,
    linearise: Linearise,
    iterations: int = 4,
    converged: float = 1e-4,
    start: State | None = None,
) -> State:
    """The most likely state after measurements, and its covariance: Gauss-Newton on prior and measurements.

    ``prior.P`` need not be invertible. Stops when the pose moves by less than ``converged`` (m and rad). A
    second kind of measurement is a second update whose prior is the result of the first. ``start``: where to begin, if
    not at the prior.
    """
    state = prior if start is None else start
    step = np.zeros(len(prior))
    for _ in range(max(iterations, 1)):
        said = linearise(state)
        step, P = gauss_newton_step(prior, state, said)
        state = replace(state.plus(step), P=P)
        if np.abs(step[POSE]).max() < converged:
            break
    return state


def gauss_newton_step(prior: State, state: State, said: NormalEquations) -> tuple[F64, F64]:
    """Step (n,) from ``state`` towards the optimum, and the covariance (n, n) there.

    Solves (P^-1 + H) x = -(g + P^-1 d), d the way from the prior to the state, multiplied by P so that P may be
    singular. P is first carried into the tangent space of the state.
    """
    n = len(prior)
    J = np.eye(n)
    J[ROTATION, ROTATION] = right_jacobian(state.minus(prior)[ROTATION])
    P = J @ prior.P @ J.T
    A = np.eye(n) + P @ said.H
    solved = np.asarray(
        np.linalg.solve(A, np.column_stack([P @ said.g + J @ state.minus(prior), P])), np.float64
    )
    step = -solved[:, 0]
    covariance = 0.5 * (solved[:, 1:] + solved[:, 1:].T)
    return np.asarray(step, np.float64), np.asarray(covariance, np.float64)


def right_jacobian(turn: F64) -> F64:
    """J (3, 3) with exp(turn + J^-1 x) = exp(turn) exp(x) to first order in x (Barfoot, 7.76)."""
    angle = float(np.linalg.norm(turn))
    W: F64 = se3.skew(turn)
    if angle < 1e-6:
        return np.eye(3) - 0.5 * W
    a = (1.0 - np.cos(angle)) / angle**2
    b = (angle - np.sin(angle)) / angle**3
    J: F64 = np.eye(3) - a * W + b * (W @ W)
    return J
