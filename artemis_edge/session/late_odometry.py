"""The odometry of a stream: chosen when its first frames are there, which a recording can be asked for at once."""

from __future__ import annotations

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import SyncedFrame, TrackedFrame
from artemis_edge.odometry.choice import OwnOdometry, odometry_for
from artemis_edge.odometry.known_map import Start
from artemis_edge.odometry.visual import VisualUpdate

LOOKED_AT = 2  # frames, as odometry_for looks at


class LateOdometry:
    """An Odometry that takes frames once ``choose`` has seen the first ones; from a ``start`` in a known map."""

    def __init__(self, config: OdometryConfig) -> None:
        self.start: Start | None = None
        self._config = config
        self._chosen: OwnOdometry | None = None

    @property
    def lost(self) -> dict[str, int]:
        """Counts by reason."""
        return {} if self._chosen is None else self._chosen.lost

    @property
    def instruction(self) -> str | None:
        """A sentence for the operator, or None."""
        return None if self._chosen is None else self._chosen.instruction

    def choose(self, frames: list[SyncedFrame]) -> None:
        """Settle for what the first frames of the stream allow."""
        images = VisualUpdate() if self._config.visual else None
        self._chosen = odometry_for(self._config, lambda: iter(frames), images, self.start)

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        """As Odometry."""
        if self._chosen is None:
            raise RuntimeError("frames are tracked after the odometry was chosen")
        return self._chosen.track(frame)
