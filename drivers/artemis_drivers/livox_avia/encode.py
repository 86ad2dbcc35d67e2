"""Data packets of Livox SDK 1 from arrays: what a virtual device sends, and the counterpart of points.py.

Written with packed numpy records instead of offsets, so that it is an independent reading of the layouts.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from artemis_drivers.livox_avia.payloads import encode_utc
from artemis_drivers.livox_slots import CLOCK_GPS, STANDARD_GRAVITY

_ECHO = np.dtype([("xyz", "<i4", (3,)), ("reflectivity", "u1"), ("tag", "u1")])
_RANGE = np.dtype([("depth", "<u4"), ("reflectivity", "u1"), ("tag", "u1")])
_HEADER = np.dtype(
    [
        ("version", "u1"),
        ("slot", "u1"),
        ("id", "u1"),
        ("reserved", "u1"),
        ("status", "<u4"),
        ("clock", "u1"),
        ("data_type", "u1"),
        ("time", "u1", (8,)),
    ]
)
SHOT = {
    2: np.dtype([("echo", _ECHO, (1,))]),
    3: np.dtype(
        [("depth", "<u4"), ("zenith", "<u2"), ("azimuth", "<u2"), ("reflectivity", "u1"), ("tag", "u1")]
    ),
    4: np.dtype([("echo", _ECHO, (2,))]),
    5: np.dtype([("zenith", "<u2"), ("azimuth", "<u2"), ("echo", _RANGE, (2,))]),
    7: np.dtype([("echo", _ECHO, (3,))]),
    8: np.dtype([("zenith", "<u2"), ("azimuth", "<u2"), ("echo", _RANGE, (3,))]),
}
SHOTS_PER_PACKET = {2: 96, 3: 96, 4: 48, 5: 48, 7: 30, 8: 30}
CARTESIAN = (2, 4, 7)


def header(status: int, clock: int, data_type: int, time_ns: int) -> bytes:
    """The 18 bytes before the points. ``time_ns``: ns since 1970 for GPS time, else as the type says."""
    record = np.zeros(1, _HEADER)
    record["version"], record["slot"], record["id"] = 5, 1, 1
    record["status"], record["clock"], record["data_type"] = status, clock, data_type
    time = encode_utc(time_ns) if clock == CLOCK_GPS else int(time_ns).to_bytes(8, "little")
    record["time"] = np.frombuffer(time, np.uint8)
    return record.tobytes()


def shots_mm(
    data_type: int, xyz_mm: NDArray[np.int32], reflectivity: NDArray[np.uint8], tag: NDArray[np.uint8]
) -> NDArray[Any]:
    """Cartesian shots (types 2, 4, 7) as records: ``xyz_mm`` (shots, returns, 3), the others (shots, returns)."""
    record = np.zeros(len(xyz_mm), SHOT[data_type])
    record["echo"]["xyz"], record["echo"]["reflectivity"], record["echo"]["tag"] = xyz_mm, reflectivity, tag
    return record


def shots_spherical(
    data_type: int,
    depth_mm: NDArray[np.uint32],
    zenith: NDArray[np.uint16],
    azimuth: NDArray[np.uint16],
    reflectivity: NDArray[np.uint8],
    tag: NDArray[np.uint8],
) -> NDArray[Any]:
    """Spherical shots (types 3, 5, 8): angles (shots,) in 0.01 degree, the others (shots, returns)."""
    record = np.zeros(len(zenith), SHOT[data_type])
    record["zenith"], record["azimuth"] = zenith, azimuth
    single = data_type == 3
    echo = record if single else record["echo"]
    pick = (slice(None), 0) if single else (slice(None), slice(None))
    echo["depth"], echo["reflectivity"], echo["tag"] = depth_mm[pick], reflectivity[pick], tag[pick]
    return record


def imu_packet(status: int, clock: int, time_ns: int, gyro: ArrayLike, accel: ArrayLike) -> bytes:
    """IMU packet: ``gyro`` rad/s, ``accel`` m/s2 (sent in multiples of standard gravity)."""
    values = np.concatenate([np.asarray(gyro, float), np.asarray(accel, float) / STANDARD_GRAVITY])
    return header(status, clock, 6, time_ns) + values.astype("<f4").tobytes()
