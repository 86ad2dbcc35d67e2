"""Rigid motions: exponential, logarithm, inverse, as compiled kernels.

A twist is float64 (6,): linear part first, angular part second, both in the moving (body) frame, so that
``T_world_body(t) = T_world_body(0) @ exp(t * twist)`` for constant twist. The formulas are those of Barfoot,
State Estimation for Robotics, chapter 7.
"""

from __future__ import annotations

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.frames import F64

# Below this angle (rad) the series are exact in float64: the next term is smaller than 1e-17.
_SMALL = 1e-4


@njit
def skew(v: F64) -> F64:
    """Cross-product matrix (3, 3) of a vector (3,)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@njit
def exp(twist: F64) -> F64:
    """Transform (4, 4) reached after unit time with a constant twist (6,)."""
    W = skew(twist[3:])
    angle2 = twist[3] ** 2 + twist[4] ** 2 + twist[5] ** 2
    angle = np.sqrt(angle2)
    if angle < _SMALL:
        a, b, c = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    else:
        a = np.sin(angle) / angle
        b = 2.0 * (np.sin(0.5 * angle) / angle) ** 2
        c = (1.0 - a) / angle2
    W2 = W @ W
    T = np.eye(4)
    T[:3, :3] += a * W + b * W2
    v = np.ascontiguousarray(twist[:3])
    T[:3, 3] = v + b * (W @ v) + c * (W2 @ v)
    return T


@njit
def quaternion(R: F64) -> F64:
    """Unit quaternion (x, y, z, w), w >= 0, of a rotation (3, 3), stable for every angle (Shepperd 1978)."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    q = np.empty(4)
    if trace > 0.0:
        q[3] = 1.0 + trace
        q[0], q[1], q[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i = 0
        if R[1, 1] > R[0, 0]:
            i = 1
        if R[2, 2] > R[i, i]:
            i = 2
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        q[j], q[k], q[3] = R[j, i] + R[i, j], R[k, i] + R[i, k], R[k, j] - R[j, k]
    q /= np.sqrt((q**2).sum())
    return q if q[3] >= 0.0 else -q


@njit
def log(T: F64) -> F64:
    """Twist (6,) whose exponential is the transform (4, 4); rotation angle within [0, pi]."""
    q = quaternion(T[:3, :3])
    sine = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
    angle = 2.0 * np.arctan2(sine, q[3])
    scale = angle / sine if sine > _SMALL else 2.0 + sine**2 / 3.0
    twist = np.empty(6)
    twist[3:] = scale * q[:3]
    if angle < _SMALL:  # noqa: SIM108
        d = 1.0 / 12.0 + angle**2 / 720.0
    else:
        d = (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2
    W = skew(twist[3:])
    t = np.ascontiguousarray(T[:3, 3])
    twist[:3] = t - 0.5 * (W @ t) + d * (W @ (W @ t))
    return twist


@njit
def inverse(T: F64) -> F64:
    """Inverse (4, 4) of a rigid transform."""
    out = np.eye(4)
    Rt = np.ascontiguousarray(T[:3, :3].T)
    out[:3, :3] = Rt
    out[:3, 3] = -(Rt @ np.ascontiguousarray(T[:3, 3]))
    return out


@njit
def orthonormal(T: F64) -> F64:
    """The nearest proper rigid transform: removes the drift of long products and of printed poses."""
    q = quaternion(T[:3, :3])
    x, y, z, w = q[0], q[1], q[2], q[3]
    out = np.eye(4)
    out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    out[:3, 3] = T[:3, 3]
    return out
