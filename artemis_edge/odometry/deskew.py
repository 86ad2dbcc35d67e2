"""Motion compensation: every point of a scan moved to where it would have been measured at the frame's stamp.

A window of 100 ms of a LiDAR on a car at 50 km/h covers 1.4 m of travel; uncorrected, walls are that thick.
"""

from __future__ import annotations

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.frames import F32, F64, DeskewedScan, LidarScan, SyncedFrame
from artemis_edge.odometry.scan_motion import ScanMotion

# Fused multiply-add: 1.8 -> 1.2 ms for 120 k points; deterministic, unlike the rest of fastmath.
_FUSED = {"contract"}


@njit(fastmath=_FUSED)
def move_points(
    points: F32, time_s: F64 | F32, shift_s: float, motion: ScanMotion, T_lidar_sensor: F64
) -> F32:
    """Points float32 (n, 3) of the sensor at their own times, as seen in the lidar frame at the reference time.

    ``time_s`` (n,) float seconds, to which ``shift_s`` is added, relative to the reference. With t the time in
    the piece and p the point's mounted place this is ``T_piece exp(t twist) p`` with everything constant drawn
    out (Rodrigues' formula with a fixed axis).
    """
    n = len(points)
    out = np.empty((n, 3), np.float32)
    R, o = T_lidar_sensor[:3, :3], T_lidar_sensor[:3, 3]
    pieces, turn = len(motion.twist), np.cross(motion.twist[:, 3:], motion.twist[:, :3])
    turn2 = np.cross(motion.twist[:, 3:], turn)
    for i in range(n):
        since = time_s[i] + shift_s - motion.start_s
        k = min(max(int(np.floor(since / motion.step_s)), 0), pieces - 1) if pieces > 1 else 0
        v, w, a, b, T = (
            motion.twist[k, :3],
            motion.twist[k, 3:],
            turn[k],
            turn2[k],
            motion.T_reference_lidar[k],
        )
        t = since - k * motion.step_s
        s, c, d = _series(t, (w[0] * w[0] + w[1] * w[1] + w[2] * w[2]) * t * t)
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        px = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + o[0]
        py = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + o[1]
        pz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + o[2]
        ux, uy, uz = w[1] * pz - w[2] * py, w[2] * px - w[0] * pz, w[0] * py - w[1] * px
        qx, qy, qz = w[1] * uz - w[2] * uy, w[2] * ux - w[0] * uz, w[0] * uy - w[1] * ux
        px += t * v[0] + s * ux + c * (qx + a[0]) + d * b[0]
        py += t * v[1] + s * uy + c * (qy + a[1]) + d * b[1]
        pz += t * v[2] + s * uz + c * (qz + a[2]) + d * b[2]
        out[i, 0] = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        out[i, 1] = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        out[i, 2] = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
    return out


@njit(fastmath=_FUSED)
def _series(t: float, q: float) -> tuple[float, float, float]:
    """``t sin(a)/a``, ``t^2 (1 - cos a)/a^2`` and ``t^3 (a - sin a)/a^3`` with q = a^2.

    Six Taylor terms: the error is below 1e-15 for half a radian in the window and 2e-5 for half a turn.
    """
    cosine = 1 / 2 - q * (1 / 24 - q * (1 / 720 - q * (1 / 40320 - q * (1 / 3628800 - q * (1 / 479001600)))))
    sine = 1 / 6 - q * (
        1 / 120 - q * (1 / 5040 - q * (1 / 362880 - q * (1 / 39916800 - q * (1 / 6227020800))))
    )
    return t * (1.0 - q * sine), t * t * cosine, t * t * t * sine


def window(frame: SyncedFrame) -> tuple[float, float]:
    """First and last time of the frame's points relative to its stamp, s; zeros without points."""
    ends = [
        (float(scan.offset_s.min()) + shift, float(scan.offset_s.max()) + shift)
        if scan.offset_s is not None
        else (shift, shift)
        for scan in frame.scans
        if len(scan.points)
        for shift in [(scan.stamp_ns - frame.stamp_ns) * 1e-9]
    ]
    return (min(e[0] for e in ends), max(e[1] for e in ends)) if ends else (0.0, 0.0)


def deskew_scan(scan: LidarScan, stamp_ns: int, motion: ScanMotion) -> DeskewedScan:
    """One LiDAR's window, corrected for the motion and mounted: points in the lidar frame at ``stamp_ns``."""
    time_s = np.zeros(len(scan.points), np.float32) if scan.offset_s is None else scan.offset_s
    shift_s = (scan.stamp_ns - stamp_ns) * 1e-9
    T = np.ascontiguousarray(scan.T_lidar_sensor, np.float64)
    points = move_points(np.ascontiguousarray(scan.points), time_s, shift_s, motion, T)
    return DeskewedScan(points, T[:3, 3].copy())


def deskew_frame(frame: SyncedFrame, motion: ScanMotion) -> tuple[DeskewedScan, ...]:
    """All scans of a frame at the frame's stamp, which is the reference time of ``motion``."""
    return tuple(deskew_scan(scan, frame.stamp_ns, motion) for scan in frame.scans)
