"""The odometry of a stream: chosen when its first frames are there, which a recording can be asked for at once."""

from __future__ import annotations

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import SyncedFrame, TrackedFrame
from artemis_edge.odometry.choice import LOOKED_AT, OwnOdometry, odometry_for
from artemis_edge.odometry.known_map import Start
from artemis_edge.odometry.visual import VisualUpdate


class LateOdometry:
    """An Odometry for the frames that ``ready`` gives back; from a ``start`` in a known map.

    The first frames of a stream wait for each other: by them it is chosen.
    """

    def __init__(self, config: OdometryConfig) -> None:
        self.start: Start | None = None
        self._config = config
        self._chosen: OwnOdometry | None = None
        self._first: list[SyncedFrame] = []

    @property
    def lost(self) -> dict[str, int]:
        """Counts by reason."""
        return {} if self._chosen is None else self._chosen.lost

    @property
    def instruction(self) -> str | None:
        """A sentence for the operator, or None."""
        return None if self._chosen is None else self._chosen.instruction

    def ready(self, frame: SyncedFrame) -> list[SyncedFrame]:
        """Frames that can be tracked now, with this one the latest."""
        if self._chosen is not None:
            return [frame]
        self._first.append(frame)
        return self.release() if len(self._first) == LOOKED_AT else []

    def release(self) -> list[SyncedFrame]:
        """At the end of the stream: the frames that still wait, however few there are."""
        first, self._first = self._first, []
        if self._chosen is None:
            images = VisualUpdate() if self._config.visual else None
            self._chosen = odometry_for(self._config, lambda: iter(first), images, self.start)
        return first

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        """As Odometry."""
        if self._chosen is None:
            raise RuntimeError("frames are tracked after the odometry was chosen")
        return self._chosen.track(frame)
