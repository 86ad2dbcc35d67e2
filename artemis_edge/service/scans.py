"""Windows of 100 ms of session time, cut from the packets of one LiDAR."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from artemis_drivers.livox_avia.status import has_pulse
from artemis_drivers.livox_host import LivoxLidar
from artemis_drivers.livox_slots import Slots, collect
from artemis_drivers.ring import RingReader
from numpy.typing import NDArray

from artemis_edge.session.writer import POINT
from artemis_edge.session_clocks import LidarClock
from artemis_edge.sync import Synchroniser

WINDOW_NS = 100_000_000
_MOST_PENDING = 64  # batches: seconds of data while time is not known yet
_CLOCKS = {int(clock) for clock in LidarClock}


@dataclass(frozen=True, slots=True)
class _Batch:
    """Slots that were read together: session time is device time plus ``offset_ns``."""

    slots: Slots
    offset_ns: int
    first_ns: int
    end_ns: int


class ScanCutter:
    """Takes what a LiDAR delivered, dates it, and gives out whole windows. ``latest_ns`` is session time, 0 unknown."""

    def __init__(self, lidar: LivoxLidar) -> None:
        self.lidar, self.name = lidar, lidar.name
        self.latest_ns = 0
        self.undated = 0
        self._points, self._imu = RingReader(lidar.points), RingReader(lidar.imu)
        self._batches: deque[_Batch] = deque()
        self._offset_ns: int | None = None

    @property
    def overwritten(self) -> int:
        """Packets that came faster than they were taken."""
        return self._points.lost

    def read(self, sync: Synchroniser | None) -> None:
        """Take in the packets that have arrived."""
        _, slots = self._points.read()
        count = len(slots["stamp_ns"])
        if count == 0:
            return
        offset = None if sync is None else self._date(sync, slots)
        if offset is None:
            self.undated += count
            return
        self._offset_ns = offset
        last = count - 1
        shots = -(-int(slots["filled"][last]) // max(int(slots["returns"][last]), 1))
        end = int(slots["stamp_ns"][last]) + offset + round(shots * float(slots["shot_ns"][last]))
        first = int(slots["stamp_ns"].min()) + offset
        self._batches.append(_Batch(slots, offset, first, end))
        self.latest_ns = max(self.latest_ns, end)
        while len(self._batches) > _MOST_PENDING:
            self.undated += len(self._batches.popleft().slots["stamp_ns"])

    def read_imu(self) -> list[tuple[int, int, Any, Any]]:
        """Samples of the built-in IMU: session time, host time, rad/s, m/s2; none while time is not known."""
        _, slots = self._imu.read()
        if self._offset_ns is None:
            return []
        stamps = (slots["stamp_ns"] + self._offset_ns).tolist()
        columns = slots["rx_ns"], slots["gyro"].astype(np.float64), slots["accel"].astype(np.float64)
        return list(zip(stamps, *(column.tolist() for column in columns), strict=True))

    def cut(self, start_ns: int) -> NDArray[np.void]:
        """The points (n,) of dtype POINT of the window from ``start_ns`` on; what is older is dropped."""
        end = start_ns + WINDOW_NS
        parts = [
            (batch.slots, batch.offset_ns)
            for batch in self._batches
            if batch.end_ns > start_ns and batch.first_ns < end
        ]
        while self._batches and self._batches[0].end_ns <= end:
            self._batches.popleft()
        nothing = {name: array[:0] for name, array in self.lidar.points.field.items()}
        return collect(parts or [(nothing, 0)], start_ns, end, POINT)

    def _date(self, sync: Synchroniser, slots: Slots) -> int | None:
        """What is added to device time: by the last packet of the batch."""
        last = len(slots["stamp_ns"]) - 1
        kind, stamp = int(slots["clock"][last]), int(slots["stamp_ns"][last])
        clock = LidarClock(kind) if kind in _CLOCKS else LidarClock.FREE
        pulse = has_pulse(int(slots["status"][last]))  # the board may not be heard, and the cable may be cut
        dated = sync.lidar(self.name, stamp, clock, int(slots["rx_ns"][last]), pulse=pulse)
        if dated is None:
            return None
        return dated.stamp_ns - stamp
