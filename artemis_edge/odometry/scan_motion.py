"""How the sensor moved during one scan: short pieces of constant twist about a reference time.

A hand that turns or a gait that rolls the rig changes the twist within the 100 ms of a scan: with one twist a
scan, a head turn of 60 degrees in 1.5 s leaves 6 mrad of error, 9 cm on a wall at 15 m.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.frames import F64, ImuSamples
from artemis_edge.odometry import se3

PIECE_S = 0.01  # at 20 rad/s2, which a wrist can do, a piece of constant twist is 0.25 mrad off in its middle
_LEAST_SPAN_S = 1e-6


class ScanMotion(NamedTuple):
    """Pieces k of equal length: ``T_reference_lidar`` (k, 4, 4) at their starts, body ``twist`` (k, 6) in them.

    ``start_s`` is when the first begins, relative to the reference time; before it and after the last its and
    the last one's motion goes on.
    """

    start_s: float
    step_s: float
    T_reference_lidar: F64
    twist: F64

    def at(self, time_s: float) -> F64:
        """T_reference_lidar (4, 4) at a time after the reference, s."""
        k = int(np.clip((time_s - self.start_s) // self.step_s, 0, len(self.twist) - 1))
        T: F64 = self.T_reference_lidar[k] @ se3.exp(
            (time_s - self.start_s - k * self.step_s) * self.twist[k]
        )
        return T

    def referred_to(self, time_s: float) -> ScanMotion:
        """The same motion with another reference time, given relative to the present one."""
        T = se3.inverse(self.at(time_s)) @ self.T_reference_lidar
        return ScanMotion(self.start_s - time_s, self.step_s, T, self.twist)


def steady(twist: F64) -> ScanMotion:
    """One constant body twist (6,) through the reference time."""
    return ScanMotion(0.0, 1.0, np.eye(4)[None], np.ascontiguousarray(twist, np.float64)[None])


def times(first_s: float, last_s: float) -> F64:
    """Ends of the pieces (k + 1,) that cover a window, seconds; every piece has the same length."""
    span = max(last_s - first_s, _LEAST_SPAN_S)
    return np.linspace(first_s, first_s + span, max(int(np.ceil(span / PIECE_S)), 1) + 1)


def through(time_s: F64, T_reference_lidar: F64) -> ScanMotion:
    """Pieces between poses (k + 1, 4, 4) at equally spaced times (k + 1,) relative to the reference."""
    step = float(time_s[1] - time_s[0])
    twists = [se3.log(se3.inverse(a) @ b) / step for a, b in pairwise(T_reference_lidar)]
    return ScanMotion(float(time_s[0]), step, np.ascontiguousarray(T_reference_lidar[:-1]), np.array(twists))


def turning(imu: ImuSamples, reference_ns: int, velocity: F64, time_s: F64) -> ScanMotion:
    """Motion whose attitude is the gyroscope's and whose velocity (3,) in reference axes is constant.

    ``time_s`` (k + 1,) are the ends of the pieces. Samples must not be empty. Within a scan the bias of a
    gyroscope does not matter: 0.01 rad/s turn it by half a milliradian.
    """
    sample_s = (imu.stamp_ns - reference_ns) * 1e-9
    return through(time_s, _turned(sample_s, np.ascontiguousarray(imu.gyro), velocity, time_s))


def turning_or_steady(imu: ImuSamples, reference_ns: int, twist: F64, time_s: F64) -> ScanMotion:
    """Motion with the gyroscope's attitude where its samples cover the pieces' ends, else one twist (6,)."""
    first_ns, last_ns = (reference_ns + round(float(t) * 1e9) for t in (time_s[0], time_s[-1]))
    if not covers(imu, first_ns, last_ns):
        return steady(twist)
    return turning(during(imu, first_ns, last_ns), reference_ns, twist[:3], time_s)


@njit
def _turned(sample_s: F64, gyro: F64, velocity: F64, time_s: F64) -> F64:
    """Poses (n, 4, 4) relative to that at time 0: rates are linear between samples, constant beyond them."""
    n = len(time_s)
    out = np.empty((n, 4, 4))
    first = np.eye(4)
    for k in range(n):
        if k > 0:
            first = first @ _step(sample_s, gyro, time_s[k - 1], time_s[k])
        out[k] = first
    zero = 0
    while zero + 1 < n and time_s[zero + 1] <= 0.0:
        zero += 1
    start = se3.inverse(out[zero] @ _step(sample_s, gyro, time_s[zero], 0.0))
    for k in range(n):
        out[k] = start @ out[k]
        out[k, :3, 3] = time_s[k] * velocity
    return out


@njit
def _step(sample_s: F64, gyro: F64, start_s: float, stop_s: float) -> F64:
    """Turn from one time to another by the rate in the middle."""
    twist = np.zeros(6)
    middle = 0.5 * (start_s + stop_s)
    for axis in range(3):
        twist[3 + axis] = np.interp(middle, sample_s, gyro[:, axis]) * (stop_s - start_s)
    T: F64 = se3.exp(twist)
    return T


def during(imu: ImuSamples, first_ns: int, last_ns: int) -> ImuSamples:
    """The samples within a time, and one on either side so that the ends can be interpolated."""
    low = max(int(np.searchsorted(imu.stamp_ns, first_ns, "right")) - 1, 0)
    high = int(np.searchsorted(imu.stamp_ns, last_ns, "left")) + 1
    return ImuSamples(imu.stamp_ns[low:high], imu.gyro[low:high], imu.accel[low:high], imu.origin)


def covers(imu: ImuSamples, first_ns: int, last_ns: int, slack_ns: int = 20_000_000) -> bool:
    """Whether samples reach from one time to another but for ``slack_ns`` (two samples of a slow IMU)."""
    stamps = imu.stamp_ns
    return len(stamps) > 1 and stamps[0] <= first_ns + slack_ns and stamps[-1] >= last_ns - slack_ns
