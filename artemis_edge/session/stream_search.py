"""Before a stream is mapped into a map made before: finding out where in that map it is recorded."""

from __future__ import annotations

from artemis_edge.config import Config
from artemis_edge.continuing import EarlierMap
from artemis_edge.errors import InputError
from artemis_edge.loop.recognition import Recognition
from artemis_edge.loop.relocate import Found, Search
from artemis_edge.session.assembly import FrameAssembler
from artemis_edge.session.late_odometry import LateOdometry
from artemis_edge.session.message_ring import Sent

_PATIENCE_S = 60.0  # after which the stream is mapped on its own


class StreamSearch:
    """Takes messages in their order until the place is recognised; ``given_up`` when that took too long."""

    def __init__(self, config: Config, earlier: EarlierMap) -> None:
        self.earlier = earlier
        self.given_up = False
        self.first_ns: int | None = None
        self._assembler = FrameAssembler()
        self._odometry = LateOdometry(config.odometry)
        self._search = Search(Recognition(earlier.vertices))

    def take(self, sent: Sent) -> Found | None:
        """Where the stream's own world lies, once a message completed the frame that shows it."""
        frame = self._assembler.take(sent)
        if frame is None:
            return None
        if self.first_ns is None:
            self.first_ns = frame.stamp_ns
        for ready in self._odometry.ready(frame):
            try:
                found = self._search.add(self._odometry.track(ready))
            except InputError:
                continue  # the mapping will meet and count it
            if found is not None:
                return found
        self.given_up = (frame.stamp_ns - self.first_ns) * 1e-9 > _PATIENCE_S
        return None

    def last_look(self) -> Found | None:
        """The stream has ended: with all there is."""
        return self._search.last_look()

    def sentence(self) -> str:
        """What the operator should know and do."""
        if self.given_up:
            return f"{self.earlier.unknown('the place')}; it is mapped on its own"
        return f"looking for the place in {self.earlier.root}: look at walls and corners that the map shows"
