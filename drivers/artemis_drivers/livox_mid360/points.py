"""Data packets of Livox SDK 2 (Mid-360) decoded into the same slots as those of the Avia, compiled.

Header of 36 bytes: u8 version, u16 length, u16 duration of the packet in 0.1 us, u16 points, u16 packet counter,
u8 frame counter, u8 data type, u8 timestamp type, 12 reserved, u32 CRC, u64 ns. Data types 0 IMU, 1 i32 mm,
2 i16 cm, 3 spherical (source: livox_lidar_def.h of Livox SDK2). The four lasers fire in turn. The CRC is not
checked: UDP has one of its own. Loss is told by time, as with the Avia: what the packet counter counts over
(a frame or for ever) depends on model and firmware.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import njit
from artemis_drivers.livox_bytes import i16_at, i32_at, i64_at, u16_at, u32_at
from artemis_drivers.livox_decoder import IMU, IMU_PERIOD_NS, POINTS, LivoxDecoder, Streams, put_imu
from artemis_drivers.livox_slots import (
    DUPLICATE,
    POINTS_PER_SLOT,
    PointArrays,
    track,
)

HEADER_BYTES = 36
LINES = 4
POINT_BYTES = np.array([24, 14, 8, 10], np.int64)  # of data types 0 (IMU) to 3
_CLOCKS = 3  # timestamp types 0 none, 1 PTP, 2 GPS
_GPS = 2


class Decoder(LivoxDecoder):
    """Decodes the raw packets of one Mid-360."""

    def _run(self, first: int, count: int, point_at: int, imu_at: int) -> tuple[int, int]:
        made: tuple[int, int] = decode_packets(self.streams, first, count, point_at, imu_at)
        return made


@njit
def _sound(b: NDArray[np.uint8], size: int, bad: NDArray[np.void]) -> bool:
    """Whether version, type, number of points and length fit together; counts the packet when not."""
    if size < HEADER_BYTES or b[0] != 0:
        bad[0].version += 1
        return False
    if b[10] >= POINT_BYTES.size:
        bad[0].type += 1
        return False
    n = u16_at(b, 5)
    most = 1 if b[10] == 0 else POINTS_PER_SLOT
    if n < 1 or n > most or size != HEADER_BYTES + n * POINT_BYTES[b[10]] or u16_at(b, 1) != size:
        bad[0].length += 1
        return False
    return True


@njit
def decode_packets(s: Streams, first: int, count: int, point_at: int, imu_at: int) -> tuple[int, int]:
    """Raw slots ``first..`` into point slots from ``point_at`` and IMU slots from ``imu_at``; how many of each."""
    raw, points, imu, tracks, bad, last = s  # a field read in the loop would count references: a third slower
    n_points = n_imu = 0
    for number in range(first, first + count):
        row = number % raw.size.size
        b, rx = raw.data[row], raw.rx_ns[row]
        if not _sound(b, raw.size[row], bad):
            continue
        stamp = int(i64_at(b, 28))
        if stamp < 0 or b[11] >= _CLOCKS:
            bad[0].time += 1
            continue
        is_imu = b[10] == 0
        period = IMU_PERIOD_NS if is_imu else int(u16_at(b, 3)) * 100
        clock = 3 if b[11] == _GPS else np.int64(b[11])
        if track(tracks, IMU if is_imu else POINTS, stamp, clock, rx, max(period, 1)) == DUPLICATE:
            continue
        last[0].clock = clock
        if is_imu:
            at = (imu_at + n_imu) % imu.stamp_ns.size
            put_imu(b, HEADER_BYTES, stamp, rx, clock, number, imu, at)
            n_imu += 1
        else:
            last[0].data_type = b[10]
            at = (point_at + n_points) % points.stamp_ns.size
            _put_points(b, stamp, rx, clock, number, points, at)
            n_points += 1
    return n_points, n_imu


@njit
def _put_points(
    b: NDArray[np.uint8], stamp: int, rx: int, clock: int, number: int, p: PointArrays, at: int
) -> None:
    n, kind = int(u16_at(b, 5)), np.int64(b[10])
    p.stamp_ns[at], p.rx_ns[at], p.packet[at] = stamp, rx, number
    p.shot_ns[at], p.status[at] = u16_at(b, 3) * 100 / n, 0
    p.filled[at], p.returns[at], p.lines[at] = n, 1, LINES
    p.data_type[at], p.clock[at] = kind, clock
    xyz, step = p.xyz[at], POINT_BYTES[kind]
    for i in range(n):
        o = HEADER_BYTES + i * step
        if kind == 1:
            for k in range(3):
                xyz[i, k] = i32_at(b, o + 4 * k) * 1e-3
        elif kind == 2:
            for k in range(3):
                xyz[i, k] = i16_at(b, o + 2 * k) * 1e-2
        else:
            depth, unit = u32_at(b, o) * 1e-3, np.pi / 18_000
            theta, phi = u16_at(b, o + 4) * unit, u16_at(b, o + 6) * unit
            xyz[i, 0] = depth * np.sin(theta) * np.cos(phi)
            xyz[i, 1] = depth * np.sin(theta) * np.sin(phi)
            xyz[i, 2] = depth * np.cos(theta)
        p.reflectivity[at, i], p.tag[at, i] = b[o + step - 2], b[o + step - 1]
