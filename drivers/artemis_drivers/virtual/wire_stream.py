"""What a virtual LiDAR streams: shots and IMU samples at true times, and the bytes of a packet of shots."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_drivers.livox_avia import encode

SHOTS_PER_S = 240_000
_S = 1_000_000_000


class Shots(NamedTuple):
    """Shots at 240 kHz from ``start_ns`` of the true clock on: ``xyz`` float32 (shots, returns, 3) metres in the
    LiDAR's frame (0, 0, 0: no return), ``reflectivity`` and ``tag`` uint8 (shots, returns)."""

    start_ns: int
    xyz: NDArray[np.float32]
    reflectivity: NDArray[np.uint8]
    tag: NDArray[np.uint8]


class ImuSample(NamedTuple):
    """A sample of the built-in IMU: true time, rad/s, m/s2 (gravity included)."""

    time_ns: int
    gyro: tuple[float, float, float]
    accel: tuple[float, float, float]


def body(data_type: int, shots: Shots) -> bytes:
    """Points of a packet; missing shots and returns are sent as 'no return'."""
    n, returns = encode.SHOTS_PER_PACKET[data_type], {2: 1, 3: 1, 4: 2, 5: 2, 7: 3, 8: 3}[data_type]
    xyz = np.zeros((n, returns, 3))
    reflectivity, tag = np.zeros((n, returns), np.uint8), np.zeros((n, returns), np.uint8)
    r = min(returns, shots.xyz.shape[1])
    m = len(shots.xyz)
    xyz[:m, :r] = shots.xyz[:, :r]
    reflectivity[:m, :r], tag[:m, :r] = shots.reflectivity[:, :r], shots.tag[:, :r]
    if data_type in encode.CARTESIAN:
        return encode.shots_mm(data_type, np.rint(xyz * 1e3).astype(np.int32), reflectivity, tag).tobytes()
    depth = np.linalg.norm(xyz, axis=2)
    first = xyz[:, 0]  # all returns of a shot lie on one ray
    zenith = np.degrees(np.arctan2(np.hypot(first[:, 0], first[:, 1]), first[:, 2]))
    azimuth = np.degrees(np.arctan2(first[:, 1], first[:, 0])) % 360
    hundredths = np.rint(zenith * 100).astype(np.uint16), np.rint(azimuth * 100).astype(np.uint16)
    return encode.shots_spherical(
        data_type, np.rint(depth * 1e3).astype(np.uint32), *hundredths, reflectivity, tag
    ).tobytes()


def steady_shots(start_ns: int, seconds: float, returns: int = 1, batch: int = 2400) -> Iterator[Shots]:
    """A plain test stream: points that wander over a sphere, so that each has its own value."""
    total = round(seconds * SHOTS_PER_S)
    for first in itertools.count(0, batch):
        if first >= total:
            return
        k = np.arange(first, min(first + batch, total))
        r = 5 + 0.5 * np.arange(returns) + (k[:, None] % 1000) * 1e-3
        a, b = k * 1e-4, 0.3 * np.sin(k * 3e-4)
        ray = np.column_stack([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)])
        value = np.broadcast_to((k % 256).astype(np.uint8)[:, None], r.shape)
        xyz = (r[:, :, None] * ray[:, None, :]).astype(np.float32)
        yield Shots(start_ns + first * _S // SHOTS_PER_S, xyz, value, np.zeros(r.shape, np.uint8))


def steady_imu(start_ns: int, seconds: float) -> Iterator[ImuSample]:
    """200 Hz of a device at rest that turns slowly."""
    for k in range(round(seconds * 200)):
        yield ImuSample(start_ns + k * 5_000_000, (0.0, 0.0, 0.01), (0.0, 0.0, 9.80665))
