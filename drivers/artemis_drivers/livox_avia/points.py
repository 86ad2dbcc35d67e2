"""Data packets of Livox SDK 1 (data types 2 to 8) decoded into slots, compiled.

Header of 18 bytes: version 5, slot, id, reserved, u32 status, u8 timestamp type, u8 data type, 8 bytes of
time; then points. Layouts from livox_def.h of Livox SDK v2.3.0; millimetres and hundredths of a degree become
metres. Point i was fired by laser (shot mod 6) at the packet's time + shot x 4.1667 us.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import njit
from artemis_drivers.livox_bytes import i32_at, i64_at, u16_at, u32_at
from artemis_drivers.livox_decoder import IMU, IMU_PERIOD_NS, POINTS, LivoxDecoder, Streams, put_imu
from artemis_drivers.livox_slots import (
    CLOCK_GPS,
    CLOCK_NONE,
    CLOCK_PPS,
    CLOCK_PTP,
    DUPLICATE,
    PointArrays,
    days_of,
    track,
    unwrapped_second,
)
from artemis_drivers.ring import Ring

VERSION = 5
HEADER_BYTES = 18
SHOT_NS = 1e9 / 240_000
LINES = 6
IMU_TYPE = 6

# per data type 0..8: shots a packet, returns a shot, bytes a shot (0: not known here); 3, 5, 8 are spherical
SHOTS = np.array([0, 0, 96, 96, 48, 48, 1, 30, 30], np.int64)
RETURNS = np.array([0, 0, 1, 1, 2, 2, 1, 3, 3], np.int64)
SHOT_BYTES = np.array([0, 0, 14, 10, 28, 16, 24, 42, 22], np.int64)
_SPHERICAL = np.array([0, 0, 0, 1, 0, 1, 0, 0, 1], np.int64)


class Decoder(LivoxDecoder):
    """Decodes the raw packets of one Avia."""

    def __init__(self, packets: Ring, points: Ring, imu: Ring) -> None:
        super().__init__(packets, points, imu)
        self._anchor = np.zeros(3, np.int64)

    def _run(self, first: int, count: int, point_at: int, imu_at: int) -> tuple[int, int]:
        made: tuple[int, int] = decode_packets(self.streams, first, count, point_at, imu_at, self._anchor)
        return made


@njit
def packet_time(b: NDArray[np.uint8], rx: int, anchor: NDArray[np.int64]) -> int:
    """Device time of a packet in ns by its timestamp type; -1 when it is none.

    Types 0 and 1: as sent; 3 (GPS): since 1970; 4 (time since the pulse): seconds counted on with the host's
    clock, beginning with 0. ``anchor`` (3,) remembers the last of type 4.
    """
    kind = b[8]
    if kind == CLOCK_GPS:
        days = days_of(2000 + np.int64(b[10]), np.int64(b[11]), np.int64(b[12]))
        microseconds = int(u32_at(b, 14))
        if days < 0 or b[13] > 23 or microseconds >= 3_600_000_000:
            return -1
        return int(((days * 24 + np.int64(b[13])) * 3_600_000_000 + microseconds) * 1000)
    time = int(i64_at(b, 10))
    if time < 0 or kind not in (CLOCK_NONE, CLOCK_PTP, CLOCK_PPS):
        return -1
    if kind == CLOCK_PPS:
        if time > 1 << 62:
            return -1
        if anchor[2]:
            time = unwrapped_second(time, anchor[0], anchor[1], rx)
        anchor[0], anchor[1], anchor[2] = time, rx, 1
    return time


@njit
def _cartesian(
    b: NDArray[np.uint8], n: int, xyz: NDArray[np.float32], refl: NDArray[np.uint8], tag: NDArray[np.uint8]
) -> None:
    """Points of 14 bytes: i32 x, y, z in mm, reflectivity, tag; returns of a shot follow one another."""
    for i in range(n):
        at = HEADER_BYTES + 14 * i
        xyz[i, 0] = i32_at(b, at) * 1e-3
        xyz[i, 1] = i32_at(b, at + 4) * 1e-3
        xyz[i, 2] = i32_at(b, at + 8) * 1e-3
        refl[i], tag[i] = b[at + 12], b[at + 13]


@njit
def _spherical(
    b: NDArray[np.uint8],
    shots: int,
    returns: int,
    xyz: NDArray[np.float32],
    refl: NDArray[np.uint8],
    tag: NDArray[np.uint8],
) -> None:
    """Shots of u16 zenith and azimuth in 0.01 degree, and u32 depth in mm, reflectivity, tag for each return.

    With a single return the depth comes before the angles.
    """
    unit = np.pi / 18_000
    for s in range(shots):
        at = HEADER_BYTES + s * (4 + 6 * returns)
        angles = at + 4 if returns == 1 else at
        theta, phi = u16_at(b, angles) * unit, u16_at(b, angles + 2) * unit
        x, y, z = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
        for r in range(returns):
            i = s * returns + r
            echo = at if returns == 1 else at + 4 + 6 * r
            depth = u32_at(b, echo) * 1e-3
            xyz[i, 0], xyz[i, 1], xyz[i, 2] = depth * x, depth * y, depth * z
            rest = at + 8 if returns == 1 else echo + 4
            refl[i], tag[i] = b[rest], b[rest + 1]


@njit
def _sound(b: NDArray[np.uint8], size: int, bad: NDArray[np.void]) -> bool:
    """Whether a packet's version, type and length fit together; counts it when not."""
    if size < HEADER_BYTES or b[0] != VERSION:
        bad[0].version += 1
        return False
    kind = b[9]
    if kind >= SHOTS.size or SHOTS[kind] == 0:
        bad[0].type += 1
        return False
    if size != HEADER_BYTES + SHOTS[kind] * SHOT_BYTES[kind]:
        bad[0].length += 1
        return False
    return True


@njit
def decode_packets(
    s: Streams, first: int, count: int, point_at: int, imu_at: int, anchor: NDArray[np.int64]
) -> tuple[int, int]:
    """Raw slots ``first..`` into point slots from ``point_at`` and IMU slots from ``imu_at``; how many of each."""
    raw, points, imu, tracks, bad, last = s  # a field read in the loop would count references: a third slower
    n_points = n_imu = 0
    for number in range(first, first + count):
        row = number % raw.size.size
        b, rx = raw.data[row], raw.rx_ns[row]
        if not _sound(b, raw.size[row], bad):
            continue
        stamp = packet_time(b, rx, anchor)
        if stamp < 0:
            bad[0].time += 1
            continue
        kind = np.int64(b[9])
        stream = IMU if kind == IMU_TYPE else POINTS
        period = IMU_PERIOD_NS if kind == IMU_TYPE else int(SHOTS[kind] * SHOT_NS)
        if track(tracks, stream, stamp, np.int64(b[8]), rx, period) == DUPLICATE:
            continue
        last[0].status, last[0].clock = u32_at(b, 4), b[8]
        if kind == IMU_TYPE:
            at = (imu_at + n_imu) % imu.stamp_ns.size
            put_imu(b, HEADER_BYTES, stamp, rx, b[8], number, imu, at)
            n_imu += 1
        else:
            last[0].data_type = kind
            at = (point_at + n_points) % points.stamp_ns.size
            _put_points(b, stamp, rx, number, points, at)
            n_points += 1
    return n_points, n_imu


@njit
def _put_points(b: NDArray[np.uint8], stamp: int, rx: int, number: int, p: PointArrays, at: int) -> None:
    kind = np.int64(b[9])
    shots, returns = SHOTS[kind], RETURNS[kind]
    p.stamp_ns[at], p.rx_ns[at], p.packet[at] = stamp, rx, number
    p.shot_ns[at], p.status[at] = SHOT_NS, u32_at(b, 4)
    p.filled[at], p.returns[at], p.lines[at] = shots * returns, returns, LINES
    p.data_type[at], p.clock[at] = kind, b[8]
    if _SPHERICAL[kind]:
        _spherical(b, shots, returns, p.xyz[at], p.reflectivity[at], p.tag[at])
    else:
        _cartesian(b, shots * returns, p.xyz[at], p.reflectivity[at], p.tag[at])
