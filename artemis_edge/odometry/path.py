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

from artemis_edge._jit import njit
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
    nominal end is ``end``. ``origin`` (3,) is the LiDAR's place in the body; ``holes``: of some of it no
    IMU sample told, velocity and turn rate are held there.
    """

    time_s: F64
    T_world_body: F64
    velocity: F64
    turn_rate: F64
    acceleration: F64
    end: State
    origin: F64
    holes: bool = False

    def at(self, state: State, time_s: float) -> PoseAt:
        """The LiDAR at a time by a state (at the stamp of the path's end), and how the state's error moves it."""
        T, velocity, rate, arm = (values[0] for values in self._bodies(state, np.array([time_s])))
        R, skew_origin = T[:3, :3], se3.skew(self.origin)
        turned, moved = np.zeros((3, len(state))), np.zeros((3, len(state)))
        turned[:, ROTATION] = R.T @ state.T_world_body[:3, :3]
        moved[:, POSITION] = np.eye(3)
        moved[:, VELOCITY] = time_s * np.eye(3)
        moved[:, GRAVITY] = 0.5 * time_s**2 * np.eye(3)
        moved -= R @ (se3.skew(arm) + skew_origin) @ turned
        T[:3, 3] += R @ self.origin
        twist = np.concatenate([R.T @ velocity - skew_origin @ rate, rate])
        return PoseAt(T, twist, np.vstack([R.T @ moved, turned]))

    def motion(self, state: State, first_s: float, last_s: float) -> ScanMotion:
        """The LiDAR's motion over a window, referred to its pose at the state's stamp."""
        ends = times(first_s, last_s)
        poses = self._bodies(state, np.append(ends, 0.0))[0]
        poses[:, :3, 3] += poses[:, :3, :3] @ self.origin
        return through(ends, se3.inverse(poses[-1]) @ poses[:-1])

    def _bodies(self, state: State, time_s: F64) -> tuple[F64, F64, F64, F64]:
        """As ``_trace``: by a state, at times (n,)."""
        begins = (self.time_s, self.T_world_body, self.velocity, self.turn_rate, self.acceleration)
        nominal = (self.end.T_world_body, self.end.velocity, self.end.gravity)
        present = (state.T_world_body, state.velocity, state.gravity)
        out: tuple[F64, F64, F64, F64] = _trace(begins, nominal, present, time_s)
        return out


@njit
def _trace(
    begins: tuple[F64, F64, F64, F64, F64],
    nominal: tuple[F64, F64, F64],
    present: tuple[F64, F64, F64],
    time_s: F64,
) -> tuple[F64, F64, F64, F64]:
    """T_world_body (n, 4, 4), velocity (world), turn rate (body) and ``dv dt - dp`` (n, 3) at times (n,).

    The path's nominal values give dR, dv and dp, which hold for the present state (pose, velocity, gravity) too.
    The first and the last piece go on beyond the ends.
    """
    starts, poses, velocities, rates, accelerations = begins
    T_end, v_end, g_end = nominal
    T_now, v_now, g_now = present
    R_now_end = np.ascontiguousarray(T_now[:3, :3]) @ np.ascontiguousarray(T_end[:3, :3]).T
    n, turn = len(time_s), np.zeros(6)
    T, velocity, rate, arms = np.empty((n, 4, 4)), np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    for i in range(n):
        k = max(np.searchsorted(starts, time_s[i], "right") - 1, 0)
        t, dt = time_s[i] - starts[k], -time_s[i]
        turn[3:] = t * rates[k]
        T[i] = poses[k] @ se3.exp(turn)
        R = np.ascontiguousarray(T[i, :3, :3])
        place = poses[k, :3, 3] + t * velocities[k] + 0.5 * t * t * accelerations[k]
        v = velocities[k] + t * accelerations[k]
        dv = R.T @ (v_end - v - g_end * dt)
        arm = dv * dt - R.T @ (T_end[:3, 3] - place - v * dt - 0.5 * g_end * dt * dt)
        R = R_now_end @ R
        T[i, :3, :3] = R
        T[i, :3, 3] = T_now[:3, 3] - v_now * dt + 0.5 * g_now * dt * dt + R @ arm
        velocity[i], rate[i], arms[i] = v_now - g_now * dt - R @ dv, rates[k], arm
    return T, velocity, rate, arms
