"""What the decoders of both Livox protocols share: rings, counters, state, and the IMU's packets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import njit
from artemis_drivers.livox_bytes import f32_at
from artemis_drivers.livox_slots import (
    STANDARD_GRAVITY,
    TRACK,
    ImuArrays,
    PointArrays,
    imu_arrays,
    point_arrays,
)
from artemis_drivers.ring import Ring

POINTS, IMU = 0, 1  # rows of the two streams' TRACK
IMU_PERIOD_NS = 5_000_000

BAD = np.dtype([("version", "i8"), ("type", "i8"), ("length", "i8"), ("time", "i8")])
"""Packets refused: unknown header version, unknown data type, wrong length for its type, impossible date."""

LAST = np.dtype([("status", "u4"), ("clock", "u1"), ("data_type", "u1")])
"""Status code, timestamp type and point data type of the latest packets."""


class RawArrays(NamedTuple):
    """Fields of a packet ring, for kernels."""

    rx_ns: NDArray[np.int64]
    size: NDArray[np.int32]
    data: NDArray[np.uint8]


class Streams(NamedTuple):
    """What kernels read and write: raw packets, slots, TRACK (2,), BAD (1,), LAST (1,)."""

    raw: RawArrays
    points: PointArrays
    imu: ImuArrays
    tracks: NDArray[np.void]
    bad: NDArray[np.void]
    last: NDArray[np.void]


@njit
def put_imu(
    b: NDArray[np.uint8], header: int, stamp: int, rx: int, clock: int, number: int, imu: ImuArrays, at: int
) -> None:
    """IMU packet into slot ``at``: six floats after a header of so many bytes, rad/s and multiples of gravity."""
    imu.stamp_ns[at], imu.rx_ns[at], imu.packet[at], imu.clock[at] = stamp, rx, number, clock
    for k in range(3):
        imu.gyro[at, k] = f32_at(b, header + 4 * k)
        imu.accel[at, k] = f32_at(b, header + 12 + 4 * k) * STANDARD_GRAVITY


class LivoxDecoder(ABC):
    """Decodes the raw packets of one device into a ring of points and a ring of IMU samples."""

    def __init__(self, packets: Ring, points: Ring, imu: Ring) -> None:
        """``packets`` of udp.PACKET, ``points`` of POINT_SLOT, ``imu`` of IMU_SLOT."""
        self.packets, self.points, self.imu = packets, points, imu
        self.tracks = np.zeros(2, TRACK)
        self.bad = np.zeros(1, BAD)
        self.last = np.zeros(1, LAST)
        raw = RawArrays(*packets.field.values())
        self.streams = Streams(raw, point_arrays(points), imu_arrays(imu), self.tracks, self.bad, self.last)

    @abstractmethod
    def _run(self, first: int, count: int, point_at: int, imu_at: int) -> tuple[int, int]:
        """Call the protocol's kernel; how many point and IMU slots it filled."""

    def decode(self, first: int, count: int) -> None:
        """Decode raw packets ``first .. first + count - 1`` and publish what they hold."""
        step = min(self.points.slots, self.imu.slots)
        for start in range(first, first + count, step):
            n = min(step, first + count - start)
            points, samples = self._run(start, n, self.points.claim(n), self.imu.claim(n))
            self.points.publish(points)
            self.imu.publish(samples)

    def warm_up(self) -> None:
        """Have the kernels compiled before the first packet arrives."""
        self._run(0, 0, 0, 0)

    def latest(self) -> tuple[int, int, int]:
        """Data type of the latest points, status code and timestamp type of the latest packet."""
        last = self.last[0]
        return int(last["data_type"]), int(last["status"]), int(last["clock"])

    def counters(self) -> dict[str, int]:
        """Losses of both streams by name, and packets that could not be understood."""
        names = ("packets", "lost", "gaps", "late", "duplicates", "clock_steps", "clock_changes")
        found = {
            f"{stream}_{name}": int(self.tracks[row][name])
            for row, stream in ((POINTS, "points"), (IMU, "imu"))
            for name in names
        }
        return found | {f"bad_{name}": int(self.bad[0][name]) for name in BAD.names or ()}
