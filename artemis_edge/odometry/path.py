"""Where the body was at any time around a state, and how an error of the state moves it there.

An IMU measures changes: turn dR, and dv, dp in the axes of the earlier time, from a time t to that of the state,

    R_e = R_t dR        v_e = v_t + g dt + R_t dv        p_e = p_t + v_t dt + g dt^2 / 2 + R_t dp

(Forster et al., On-Manifold Preintegration, T-RO 2017). Given a state at e this is solved for t, so that a
correction of the state at the end of a scan also corrects the motion within it, and an image in the middle of a scan
measures the state at its end. Times are seconds relative to the state's stamp, negative before it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from artemis_edge.frames import F64
from artemis_edge.odometry import se3
from artemis_edge.odometry.scan_motion import ScanMotion, through, times
from artemis_edge.odometry.state import GRAVITY, POSITION, ROTATION, VELOCITY, State


class PoseAt(NamedTuple):
    """The LiDAR at a time: ``T_world_lidar`` (4, 4), body ``twist`` (6,) m/s and rad/s in the lidar frame.

    ``J`` (6, n): right perturbation of ``T_world_lidar`` (linear first) by an error (n,) of the state. A change
    of the time by dt is the right perturbation ``twist * dt``.
    """

    T_world_lidar: F64
    twist: F64
    J: F64


class Path(NamedTuple):
    """Nominal motion of the body over a window that ends with the state's stamp: m pieces.

    Piece k runs from ``time_s[k]`` (m,), begins at ``T_world_body[k]`` with ``velocity[k]`` (world) and has
    a constant ``turn_rate[k]`` (body axes, rad/s) and ``acceleration[k]`` (world, gravity included, m/s2). Its
    nominal end is ``end``. ``origin`` (3,) is the LiDAR's place in the body; ``bridged``: no IMU sample told any
    of it, velocity and turn rate are held.
    """

    time_s: F64
    T_world_body: F64
    velocity: F64
    turn_rate: F64
    acceleration: F64
    end: State
    origin: F64
    bridged: bool = False

    def at(self, state: State, time_s: float) -> PoseAt:
        """The LiDAR at a time by a state (at the stamp of the path's end), and how the state's error moves it."""
        T, velocity, rate, arm = self._body(state, time_s)
        R = T[:3, :3]
        n = len(state)
        dR = R.T @ state.T_world_body[:3, :3]
        turned, moved = np.zeros((3, n)), np.zeros((3, n))
        turned[:, ROTATION] = dR
        moved[:, POSITION] = np.eye(3)
        moved[:, VELOCITY] = time_s * np.eye(3)
        moved[:, GRAVITY] = 0.5 * time_s**2 * np.eye(3)
        moved -= R @ se3.skew(arm + self.origin) @ turned
        T_world_lidar = T.copy()
        T_world_lidar[:3, 3] += R @ self.origin
        twist = np.concatenate([R.T @ velocity + np.cross(rate, self.origin), rate])
        return PoseAt(T_world_lidar, twist, np.vstack([R.T @ moved, turned]))

    def motion(self, state: State, first_s: float, last_s: float) -> ScanMotion:
        """The LiDAR's motion over a window, referred to its pose at the state's stamp."""
        T_lidar_world = se3.inverse(self.at(state, 0.0).T_world_lidar)
        ends = times(first_s, last_s)
        poses = np.empty((len(ends), 4, 4))
        for k, t in enumerate(ends):
            poses[k] = self._body(state, float(t))[0]
            poses[k, :3, 3] += poses[k, :3, :3] @ self.origin
        return through(ends, T_lidar_world @ poses)

    def _nominal(self, time_s: float) -> tuple[F64, F64, F64]:
        """T_world_body, velocity and turn rate as propagated; the first and last piece go on beyond the ends."""
        k = max(int(np.searchsorted(self.time_s, time_s, "right")) - 1, 0)
        t = time_s - self.time_s[k]
        turn = np.zeros(6)
        turn[3:] = t * self.turn_rate[k]
        T: F64 = self.T_world_body[k] @ se3.exp(turn)
        T[:3, 3] = self.T_world_body[k, :3, 3] + t * self.velocity[k] + 0.5 * t * t * self.acceleration[k]
        return T, self.velocity[k] + t * self.acceleration[k], self.turn_rate[k]

    def _body(self, state: State, time_s: float) -> tuple[F64, F64, F64, F64]:
        """T_world_body, velocity (world), turn rate (body), and R' (place - what follows without the turn)."""
        T, velocity, rate = self._nominal(time_s)
        dt, end, R0 = -time_s, self.end, T[:3, :3]
        dv = R0.T @ (end.velocity - velocity - end.gravity * dt)
        dp = R0.T @ (end.T_world_body[:3, 3] - T[:3, 3] - velocity * dt - 0.5 * end.gravity * dt * dt)
        arm = dv * dt - dp
        out = np.eye(4)
        R = state.T_world_body[:3, :3] @ end.T_world_body[:3, :3].T @ R0
        out[:3, :3] = R
        out[:3, 3] = state.T_world_body[:3, 3] - state.velocity * dt + 0.5 * state.gravity * dt * dt + R @ arm
        return out, state.velocity - state.gravity * dt - R @ dv, rate, arm
