"""Data packets of Livox SDK 2 from arrays: what a virtual device sends, and the counterpart of points.py."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from artemis_drivers.livox_slots import STANDARD_GRAVITY

POINT = {
    1: np.dtype([("xyz", "<i4", (3,)), ("reflectivity", "u1"), ("tag", "u1")]),
    2: np.dtype([("xyz", "<i2", (3,)), ("reflectivity", "u1"), ("tag", "u1")]),
    3: np.dtype(
        [("depth", "<u4"), ("zenith", "<u2"), ("azimuth", "<u2"), ("reflectivity", "u1"), ("tag", "u1")]
    ),
}
_HEADER = np.dtype(
    [
        ("version", "u1"),
        ("length", "<u2"),
        ("duration", "<u2"),
        ("points", "<u2"),
        ("packet", "<u2"),
        ("frame", "u1"),
        ("data_type", "u1"),
        ("clock", "u1"),
        ("reserved", "u1", (12,)),
        ("crc", "<u4"),
        ("time", "<u8"),
    ]
)


def packet(
    data_type: int, points: NDArray[Any], *, time_ns: int, duration_ns: int, counter: int = 0, clock: int = 0
) -> bytes:
    """One packet of records (or, of type 0, of the six floats of an IMU sample)."""
    body = points.tobytes()
    head = np.zeros(1, _HEADER)
    head["length"], head["duration"] = _HEADER.itemsize + len(body), duration_ns // 100
    head["points"], head["packet"] = 1 if data_type == 0 else len(points), counter & 0xFFFF
    head["data_type"], head["clock"], head["time"] = data_type, clock, time_ns
    head["crc"] = zlib.crc32(head.tobytes()[-8:] + body)
    return head.tobytes() + body


def imu_packet(time_ns: int, gyro: ArrayLike, accel: ArrayLike, *, counter: int = 0, clock: int = 0) -> bytes:
    """IMU packet: ``gyro`` rad/s, ``accel`` m/s2 (sent in multiples of standard gravity)."""
    values = np.concatenate([np.asarray(gyro, float), np.asarray(accel, float) / STANDARD_GRAVITY])
    return packet(0, values.astype("<f4"), time_ns=time_ns, duration_ns=0, counter=counter, clock=clock)
