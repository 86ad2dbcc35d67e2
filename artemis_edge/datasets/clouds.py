"""Point clouds of ROS drivers as arrays: any field layout, and the conventions of their time and intensity.

Drivers agree on x, y, z and on little else. What a topic's time and intensity fields mean is settled once, on
its first cloud (CloudFormat), so that one odd cloud cannot change it halfway.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from artemis_edge.datasets.common import SECOND_NS, full_intensity, unit_intensity, valid_returns
from artemis_edge.frames import F32, F64
from artemis_edge.session.cdr import CdrError
from artemis_edge.session.messages import FIELD_CODES, LivoxCustomMsg, PointCloud2

Cloud = PointCloud2 | LivoxCustomMsg

_INTENSITY = ("intensity", "intensities", "reflectivity", "i")
_TIME = ("t", "time", "timestamp", "offset_time", "time_stamp", "time_offset", "timeOffset")
# Units of a time field in seconds, and the longest span within one cloud that they are taken for.
_UNITS = ((1.0, 2.0), (1e-3, 2e3), (1e-6, 2e6), (1e-9, np.inf))
# A value above this, in seconds, is a date and not an offset (3 years).
_EPOCH_S = 1e8
# An offset from the stamp beyond this shows that the points are timed by another clock than the header.
_OTHER_CLOCK_S = 10.0


@dataclass(frozen=True, slots=True)
class CloudFormat:
    """What the optional fields of a topic mean.

    ``time_field`` counts ``unit_s`` seconds: from the header's stamp, from the epoch (``absolute``) or, by
    a clock of its own, from the first point (``own_clock``). ``full_intensity`` stands for 1. ``start_s`` and
    ``end_s`` are the times of the first and last point of the first cloud relative to its stamp.
    """

    time_field: str | None = None
    unit_s: float = 1e-9
    absolute: bool = False
    own_clock: bool = False
    full_intensity: float = 1.0
    start_s: float = 0.0
    end_s: float = 0.0


@dataclass(frozen=True, slots=True)
class CloudPoints:
    """Valid points (n, 3) of a cloud, ``offset_s`` and ``intensity`` (n,) or None, and what was dropped."""

    points: F32
    offset_s: F32 | None
    intensity: F32 | None
    lost: dict[str, int]


def point_records(message: Cloud) -> NDArray[Any]:
    """The points as a structured view (n,) of the message; CdrError if they do not fit their layout."""
    if isinstance(message, LivoxCustomMsg):
        return message.points
    dtype, count = _layout(message), message.width * message.height
    if count == 0:
        return np.empty(0, dtype)
    row_step = message.row_step if message.height > 1 else message.width * message.point_step
    needed = (message.height - 1) * row_step + message.width * message.point_step
    if needed > len(message.data) or row_step < message.width * message.point_step:
        raise CdrError(
            f"a cloud of {count} points has {len(message.data)} bytes of data where {needed} are needed"
        )
    if row_step == message.width * message.point_step:
        return np.frombuffer(message.data, dtype, count)
    shape, strides = (message.height, message.width), (row_step, message.point_step)
    return np.ndarray(shape, dtype, message.data, strides=strides).reshape(-1)


def _layout(message: PointCloud2) -> np.dtype[Any]:
    """numpy dtype of a point: the fields that are of use here."""
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for item in message.fields:
        wanted = item.name in ("x", "y", "z", *_INTENSITY, *_TIME) and item.name not in names
        if wanted and item.datatype in FIELD_CODES:
            formats.append(np.dtype(order + FIELD_CODES[item.datatype]))
            names.append(item.name)
            offsets.append(item.offset)
            if item.offset + formats[-1].itemsize > message.point_step:
                raise CdrError(f"field {item.name} reaches beyond the {message.point_step} bytes of a point")
    if not {"x", "y", "z"} <= set(names):
        raise CdrError("a cloud lacks the fields x, y and z")
    if message.point_step > len(message.data) and message.width * message.height:
        raise CdrError("a point is larger than the cloud")
    layout: Any = {"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step}
    dtype: np.dtype[Any] = np.dtype(layout)
    return dtype


def settle_format(message: Cloud) -> CloudFormat:
    """What the fields of a topic mean, judged by one cloud of it."""
    records = point_records(message)
    with np.errstate(over="ignore", invalid="ignore"):
        return _settle(records, message.header.stamp_ns)


def _settle(records: NDArray[Any], stamp_ns: int) -> CloudFormat:
    names = records.dtype.names or ()
    intensity = _intensity_name(names)
    full = 1.0
    if intensity is not None:
        is_byte = records.dtype[intensity].itemsize == 1
        full = 255.0 if is_byte else full_intensity(records[intensity].astype(np.float32))
    time_field = next((name for name in _TIME if name in names), None)
    if time_field is None or len(records) == 0:
        return CloudFormat(full_intensity=full)
    unit, absolute = _time_unit(records[time_field])
    settled = CloudFormat(time_field, unit, absolute, False, full)
    offset = _offset_s(records, settled, stamp_ns)
    if np.abs(offset[np.isfinite(offset)]).max(initial=0.0) > _OTHER_CLOCK_S:
        settled = CloudFormat(time_field, unit, absolute, True, full)
        offset = _offset_s(records, settled, stamp_ns)
    finite = np.isfinite(offset)
    start = float(np.min(offset, initial=0.0, where=finite))
    end = float(np.max(offset, initial=0.0, where=finite))
    return CloudFormat(time_field, unit, absolute, settled.own_clock, full, start, end)


def _time_unit(values: NDArray[Any]) -> tuple[float, bool]:
    """Seconds per count of a time field, and whether it counts from the epoch.

    Integers are nanoseconds (Ouster ``t``, Livox ``offset_time``); floats whatever gives a plausible span.
    """
    real = values[np.isfinite(values)].astype(np.float64)
    if len(real) == 0:
        return 1.0, False
    top = float(np.abs(real).max())
    if values.dtype.kind in "iu":
        return 1e-9, top * 1e-9 > _EPOCH_S
    if top > _EPOCH_S:
        # An epoch time in seconds has 10 digits, in ms 13, in us 16, in ns 19.
        unit = next((unit for unit in (1e-9, 1e-6, 1e-3) if top * unit > _EPOCH_S), 1.0)
        if unit < 1.0 or np.ptp(real) < _UNITS[0][1]:
            return unit, True
    span = float(np.ptp(real)) or top
    return next(unit for unit, longest in _UNITS if span <= longest), False


def _offset_s(records: NDArray[Any], settled: CloudFormat, stamp_ns: int) -> F64:
    """Time (n,) of each point relative to the stamp."""
    values = records[settled.time_field]
    if values.dtype.kind in "iu":
        # In integers: a date in nanoseconds does not fit a float64.
        counts = values.astype(np.int64)
        origin = counts.min() if settled.own_clock else stamp_ns if settled.absolute else 0
        return np.asarray((counts - np.int64(origin)) * settled.unit_s, np.float64)
    times: F64 = values.astype(np.float64)
    start = stamp_ns / SECOND_NS / settled.unit_s if settled.absolute else 0.0
    start = float(times.min()) if settled.own_clock else start
    offset: F64 = (times - start) * settled.unit_s
    return offset


def decode_cloud(message: Cloud, settled: CloudFormat) -> CloudPoints:
    """Arrays of a cloud; points that are no measurements are dropped and counted.

    The arrays are copies: writable, aligned and contiguous, whatever the layout of the message. CdrError if
    the cloud does not fit its own description.
    """
    records = point_records(message)
    # A driver's garbage may not fit a float32: it becomes infinite and is dropped.
    with np.errstate(over="ignore", invalid="ignore"):
        return _arrays(records, settled, message.header.stamp_ns)


def _arrays(records: NDArray[Any], settled: CloudFormat, stamp_ns: int) -> CloudPoints:
    points = _coordinates(records)
    keep, lost = valid_returns(points)
    if keep is not None:
        points, records = points[keep], records[keep]
    names = records.dtype.names or ()
    intensity, field = None, _intensity_name(names)
    if field is not None:
        intensity = unit_intensity(records[field].astype(np.float32), settled.full_intensity)
    offset = None
    if settled.time_field in names and len(records):
        offset = _offset_s(records, settled, stamp_ns).astype(np.float32)
        # All at the stamp, as a driver writes that does not time its points.
        offset = offset if offset.any() and np.isfinite(offset).all() else None
    return CloudPoints(points, offset, intensity, lost)


def _coordinates(records: NDArray[Any]) -> F32:
    points = np.empty((len(records), 3), np.float32)
    for axis, name in enumerate("xyz"):
        points[:, axis] = records[name]
    return points


def _intensity_name(names: tuple[str, ...]) -> str | None:
    return next((name for name in _INTENSITY if name in names), None)
