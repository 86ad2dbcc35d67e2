"""The deltas of a run for whoever watches it grow, if anybody may (``view.socket``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from artemis_edge.config import ViewConfig
from artemis_edge.frames import MeshDelta
from artemis_edge.mapping_run import Mapper
from artemis_edge.view.feed import LiveFeed

# What a viewer may take to fetch the end of the map, once, after the last frame.
_FAREWELL_S = 5.0


class Telling:
    """Hands deltas to the feed; without one to nobody."""

    def __init__(self, feed: LiveFeed | None) -> None:
        self._feed = feed

    def watching(self, mapper: Mapper) -> Callable[[MeshDelta], None]:
        """What to call with every delta of a mapper."""

        def publish(delta: MeshDelta) -> None:
            feed = self._feed
            if feed is None:
                return
            feed.publish(delta, mapper.trajectory[-1][1] if mapper.trajectory else None)
            if feed.attached:
                feed.attached = False
                mapper.tell_again()

        return publish


@contextmanager
def telling(rules: ViewConfig) -> Iterator[Telling]:
    """The feed of ``view.socket`` while the block runs, emptied at its end."""
    if not rules.socket:
        yield Telling(None)
        return
    feed = LiveFeed(Path(rules.socket), rules.most_hz)
    try:
        yield Telling(feed)
        feed.drain(_FAREWELL_S)
    finally:
        feed.close()
