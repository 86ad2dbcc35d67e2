"""Frames of either protocol become samples in one form."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np

from artemis_drivers.base import Applied
from artemis_drivers.imu_serial import mtdata2, vectornav
from artemis_drivers.imu_serial.clock import VECTORNAV_CLOCK, XSENS_CLOCK, DeviceClock
from artemis_drivers.imu_serial.configure import configure_mti, configure_vectornav
from artemis_drivers.imu_serial.link import Port
from artemis_drivers.imu_serial.mtdata2 import MalformedError, Mid, Type
from artemis_drivers.imu_serial.settings import ImuSettings, MtiSettings, VectorNavSettings
from artemis_drivers.imu_serial.stream import Framing

IMU_SAMPLE = np.dtype(
    [
        ("rx_ns", "i8"),
        ("device_ns", "i8"),
        ("count", "i8"),
        ("lost", "i4"),
        ("boot", "i4"),
        ("gyro", "f8", (3,)),
        ("accel", "f8", (3,)),
        ("status", "u4"),
        ("sync_in_count", "i8"),
        ("sync_in_ns", "i8"),
    ]
)
"""One sample: host time of its chunk, device time, sample number, samples lost just before it, restarts of
the device; rad/s and m/s2 in the IMU's axes; pulses on its sync input and device time of the last one
(-1 without)."""


_LONGEST_NS = 2**62


@dataclass(frozen=True, slots=True)
class Sample:
    """What a frame says, in device units: ``counter`` and ``ticks`` still wrap."""

    ticks: int
    counter: int
    gyro: tuple[float, ...]
    accel: tuple[float, ...]
    status: int = 0
    sync_in_count: int = -1
    since_sync_in_ns: int = -1


@dataclass(frozen=True, slots=True)
class Protocol:
    """What differs between the makers. ``sample`` gives None for a frame that is no sample, and raises
    MalformedError for one that ought to be.
    """

    framing: Framing
    clock: DeviceClock
    configure: Callable[[Port], tuple[Applied, ...]]
    sample: Callable[[bytes], Sample | None]


def protocol(settings: ImuSettings) -> Protocol:
    """The protocol of the configured device."""
    if isinstance(settings, MtiSettings):
        mti: MtiSettings = settings
        clock = DeviceClock(XSENS_CLOCK, mti.rate_hz)
        return Protocol(mtdata2.XbusFraming(), clock, lambda port: configure_mti(port, mti), MtiReader())
    vn: VectorNavSettings = settings
    clock = DeviceClock(VECTORNAV_CLOCK, vn.rate_hz)
    configure = lambda port: configure_vectornav(port, vn)  # noqa: E731
    return Protocol(vectornav.VectorNavFraming(), clock, configure, vectornav_sample)


def mti_sample(frame: bytes) -> Sample | None:
    """The sample in an Xbus frame; any precision and coordinate system."""
    message = mtdata2.decode(frame)
    if message.mid != Mid.MTDATA2:
        return None
    values: dict[int, tuple[Any, ...]] = {}
    for item in mtdata2.decode_items(message.data):
        values[item.type] = item.values
    gyro = values.get(Type.RATE_OF_TURN) or values.get(Type.RATE_OF_TURN_HR)
    accel = values.get(Type.ACCELERATION) or values.get(Type.ACCELERATION_HR)
    if gyro is None or accel is None:
        return None  # a packet of the slower outputs
    try:
        ticks, counter = values[Type.SAMPLE_TIME_FINE][0], values[Type.PACKET_COUNTER][0]
    except KeyError as missing:
        raise MalformedError("a sample without counter or time") from missing
    _require_finite(gyro, accel)
    return Sample(ticks, counter, gyro, accel, values.get(Type.STATUS_WORD, (0,))[0])


class MtiReader:
    """``mti_sample`` for a stream whose frames are laid out alike: then one ``struct`` reads the whole frame.

    Frames as FrameSplitter hands them out, their check sum verified.
    """

    def __init__(self) -> None:
        self._layout: _Layout | None = None

    def __call__(self, frame: bytes) -> Sample | None:
        """The sample in an Xbus frame; None and MalformedError as ``mti_sample``."""
        if self._layout is not None and (sample := self._layout.read(frame)) is not None:
            return sample
        sample = mti_sample(frame)
        if sample is not None:
            self._layout = _layout_of(frame)
        return sample


@dataclass(frozen=True, slots=True)
class _Layout:
    """A frame is ``heads`` (everything that is not a value) at ``head_at`` of what ``whole`` unpacks; the values of a
    sample begin at ``ticks``, ``counter``, ``gyro``, ``accel`` and ``status`` (None: not sent).
    """

    whole: struct.Struct
    head_at: Callable[[tuple[Any, ...]], Any]
    heads: Any
    ticks: int
    counter: int
    gyro: int
    accel: int
    status: int | None

    def read(self, frame: bytes) -> Sample | None:
        """None for a frame that is laid out otherwise."""
        if len(frame) != self.whole.size:
            return None
        v = self.whole.unpack(frame)
        if self.head_at(v) != self.heads:
            return None
        gyro, accel = v[self.gyro : self.gyro + 3], v[self.accel : self.accel + 3]
        _require_finite(gyro, accel)
        return Sample(
            v[self.ticks], v[self.counter], gyro, accel, 0 if self.status is None else v[self.status]
        )


def _layout_of(frame: bytes) -> _Layout | None:
    """Of a frame that holds a sample; None where its numbers are of a kind that ``struct`` does not know."""
    items = mtdata2.item_layouts(mtdata2.decode(frame).data)
    if items is None:
        return None
    first = len(frame) - 1 - sum(len(head) + layout.size for head, layout in items)
    codes, place, at, head_at = [f"{first}s"], dict[int, int](), 1, [0]
    for head, layout in items:
        head_at.append(at)
        place[mtdata2.type_of(head)] = at + 1
        codes += [f"{len(head)}s", layout.format[1:]]
        at += 1 + len(layout.unpack(bytes(layout.size)))
    gyro = place.get(Type.RATE_OF_TURN, place.get(Type.RATE_OF_TURN_HR))
    accel = place.get(Type.ACCELERATION, place.get(Type.ACCELERATION_HR))
    ticks, counter = place.get(Type.SAMPLE_TIME_FINE), place.get(Type.PACKET_COUNTER)
    if gyro is None or accel is None or ticks is None or counter is None or len(place) < len(items):
        return None
    whole, heads = struct.Struct(">" + "".join(codes) + "x"), itemgetter(*head_at)
    values = whole.unpack(frame)
    return _Layout(whole, heads, heads(values), ticks, counter, gyro, accel, place.get(Type.STATUS_WORD))


def vectornav_sample(frame: bytes) -> Sample | None:
    """The sample in a VectorNav binary message that holds the fields we configure."""
    if frame[0] != vectornav.SYNC:
        return None
    fields: dict[str, tuple[Any, ...]] = vectornav.decode(frame).fields
    gyro, accel = fields.get("common.angular_rate"), fields.get("common.acceleration")
    if gyro is None or accel is None:
        return None
    if "common.time_startup_ns" not in fields:
        raise MalformedError("a sample without its time")
    if fields["common.time_startup_ns"][0] >= _LONGEST_NS:
        raise MalformedError("a sample of a device that runs since a century")
    _require_finite(gyro, accel)
    return Sample(
        fields["common.time_startup_ns"][0],
        0,
        gyro,
        accel,
        0,
        fields.get("common.sync_in_count", (-1,))[0],
        fields.get("common.time_sync_in_ns", (-1,))[0],
    )


def _require_finite(gyro: tuple[float, ...], accel: tuple[float, ...]) -> None:
    if not math.isfinite(sum(gyro) + sum(accel)):
        raise MalformedError("a sample that is no number")
