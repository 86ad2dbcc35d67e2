"""What Livox LiDARs of both protocols deliver: slots of points and IMU samples, time, and loss.

A data packet becomes one slot. Livox packets carry no sequence number, so loss shows only as a gap in time: the
next packet is due when the last point of this one is (the official driver calls more than 1.8 periods a loss).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import kernel, njit
from artemis_drivers.ring import Ring

POINTS_PER_SLOT = 96
STANDARD_GRAVITY = 9.80665  # m/s2: Livox IMUs give acceleration in multiples of it

POINT_SLOT = np.dtype(
    [
        ("stamp_ns", "i8"),  # device time of the first shot
        ("rx_ns", "i8"),  # host monotonic time of arrival
        ("packet", "i8"),  # number of the slot in the ring of raw packets
        ("shot_ns", "f4"),  # time between shots; returns of one shot share a time
        ("status", "u4"),
        ("filled", "i2"),  # points, returns counted separately
        ("returns", "u1"),
        ("lines", "u1"),  # lasers, fired in turn
        ("data_type", "u1"),
        ("clock", "u1"),
        ("xyz", "f4", (POINTS_PER_SLOT, 3)),  # metres in the sensor's frame; 0, 0, 0: no return
        ("reflectivity", "u1", (POINTS_PER_SLOT,)),
        ("tag", "u1", (POINTS_PER_SLOT,)),
    ]
)
IMU_SLOT = np.dtype(
    [
        ("stamp_ns", "i8"),
        ("rx_ns", "i8"),
        ("packet", "i8"),
        ("clock", "u1"),
        ("gyro", "f4", (3,)),  # rad/s
        ("accel", "f4", (3,)),  # m/s2
    ]
)

CLOCK_NONE, CLOCK_PTP, CLOCK_GPS, CLOCK_PPS = 0, 1, 3, 4
CLOCK_NAMES = {CLOCK_NONE: "free", CLOCK_PTP: "ptp", CLOCK_GPS: "gps", CLOCK_PPS: "pps"}

_HISTORY = 256  # stamps remembered to tell a late packet from a repeated one: 100 ms of points
TRACK = np.dtype(
    [
        ("started", "i8"),
        ("clock", "i8"),
        ("first_ns", "i8"),
        ("last_ns", "i8"),
        ("last_rx_ns", "i8"),
        ("period_ns", "i8"),
        ("packets", "i8"),
        ("lost", "i8"),
        ("gaps", "i8"),
        ("late", "i8"),
        ("duplicates", "i8"),
        ("clock_steps", "i8"),
        ("clock_changes", "i8"),
        ("recent", "i8", (_HISTORY,)),
    ]
)
"""State of one stream. ``lost`` packets in ``gaps`` gaps; ``late`` ones came out of order and are not lost;
``clock_steps``: device time and host time disagree by more than half a second from one packet to the next."""

NEW, LATE, DUPLICATE = 0, 1, 2
_GAP = 1.8  # periods, as the official driver
_STEP_NS = 500_000_000
_NS = 1_000_000_000


class PointArrays(NamedTuple):
    """Fields of a point ring, in the order of POINT_SLOT, for kernels."""

    stamp_ns: NDArray[np.int64]
    rx_ns: NDArray[np.int64]
    packet: NDArray[np.int64]
    shot_ns: NDArray[np.float32]
    status: NDArray[np.uint32]
    filled: NDArray[np.int16]
    returns: NDArray[np.uint8]
    lines: NDArray[np.uint8]
    data_type: NDArray[np.uint8]
    clock: NDArray[np.uint8]
    xyz: NDArray[np.float32]
    reflectivity: NDArray[np.uint8]
    tag: NDArray[np.uint8]


class ImuArrays(NamedTuple):
    """Fields of an IMU ring, in the order of IMU_SLOT, for kernels."""

    stamp_ns: NDArray[np.int64]
    rx_ns: NDArray[np.int64]
    packet: NDArray[np.int64]
    clock: NDArray[np.uint8]
    gyro: NDArray[np.float32]
    accel: NDArray[np.float32]


def point_arrays(ring: Ring) -> PointArrays:
    """Arrays of a ring of POINT_SLOT."""
    return PointArrays(*ring.field.values())


def imu_arrays(ring: Ring) -> ImuArrays:
    """Arrays of a ring of IMU_SLOT."""
    return ImuArrays(*ring.field.values())


@njit
def track(t: NDArray[np.void], stream: int, stamp: int, clock: int, rx: int, period: int) -> int:
    """Place a packet in its stream: NEW, LATE (out of order) or DUPLICATE; counts what is missing.

    ``t`` is an array of TRACK, ``stamp`` and ``rx`` are device and host time in ns, ``period`` how long the
    packet lasts.
    """
    s = t[stream]
    delta = stamp - s.last_ns
    stepped = abs(delta - (rx - s.last_rx_ns)) > _STEP_NS
    if s.started == 0 or clock != s.clock or stepped:
        if s.started:
            s.clock_changes += clock != s.clock
            s.clock_steps += clock == s.clock
        s.started, s.clock, s.first_ns = 1, clock, stamp
        s.recent[:] = stamp - 1
    elif delta <= 0:
        for k in range(s.recent.size):
            if s.recent[k] == stamp:
                s.duplicates += 1
                return DUPLICATE
        s.late += 1
        s.lost -= stamp > s.first_ns and s.lost > 0
        s.recent[s.packets % s.recent.size] = stamp
        s.packets += 1
        return LATE
    elif delta > _GAP * s.period_ns:
        s.gaps += 1
        s.lost += round(delta / s.period_ns) - 1
    s.last_ns, s.last_rx_ns, s.period_ns = stamp, rx, period
    s.recent[s.packets % s.recent.size] = stamp
    s.packets += 1
    return NEW


@kernel
def unwrapped_second(phase: int, last_ns: int, last_rx: int, rx: int) -> int:
    """Time since the last pulse made continuous: whole seconds added so that it follows the host's time best.

    ``last_ns`` is the previous result, received at ``last_rx``.
    """
    behind = last_ns + (rx - last_rx) - phase
    return phase + (behind + _NS // 2) // _NS * _NS


@kernel
def days_of(year: int, month: int, day: int) -> int:
    """Days from 1970-01-01 to a date of the years 2000..2255; -1 when there is no such day."""
    leap = year % 4 == 0 and (year % 100 != 0 or year % 400 == 0)
    if not 1 <= month <= 12:
        return -1
    length = 30 + (month + month // 8) % 2 if month != 2 else 28 + leap
    if not 1 <= day <= length:
        return -1
    # days of the months before this one, in a year with February of 30 days, less what February lacks
    before = 30 * (month - 1) + (month + month // 9) // 2
    if month > 2:
        before -= 2 - leap
    y = year - 2000
    leaps_before = (y + 3) // 4 - (y > 100) - (y > 200)
    return 10957 + 365 * y + leaps_before + before + day - 1


Slots = dict[str, NDArray[Any]]
"""Slots read of a point ring: an array for each field."""


def collect(
    batches: Sequence[tuple[Slots, int]], start_ns: int, end_ns: int, point: np.dtype[np.void]
) -> NDArray[np.void]:
    """Points measured in ``start_ns <= t < end_ns``, in the order of arrival; shots that found nothing are left out.

    ``batches`` are slots and what is added to their device time. ``point`` is the type of a row, with fields x, y, z
    (m), intensity (reflectivity, 0..1), tag, line and t (ns from the start).
    """
    cloud, count = np.empty(sum(int(slots["filled"].sum()) for slots, _ in batches), point), 0
    for slots, offset_ns in batches:
        arrays = PointArrays(*(slots[name] for name in PointArrays._fields))
        count = _collect(arrays, offset_ns - start_ns, end_ns - start_ns, cloud, count)
    return cloud[:count]


@njit
def _collect(p: PointArrays, shift: int, span: int, cloud: NDArray[np.void], n: int) -> int:
    """Points at 0 <= device time + ``shift`` < ``span`` into rows from ``n`` on; the row after the last."""
    for k in range(p.stamp_ns.size):
        first = p.stamp_ns[k] + shift
        for i in range(p.filled[k]):
            shot = i // p.returns[k]
            t = first + shot * float(p.shot_ns[k])
            x, y, z = p.xyz[k, i, 0], p.xyz[k, i, 1], p.xyz[k, i, 2]
            if t < 0 or t >= span or (x == 0 and y == 0 and z == 0):
                continue
            row = cloud[n]
            row.x, row.y, row.z = x, y, z
            row.intensity = np.float32(p.reflectivity[k, i]) / np.float32(255)
            row.tag, row.line, row.t = p.tag[k, i], shot % p.lines[k], round(t)
            n += 1
    return n
