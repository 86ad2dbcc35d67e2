"""The deltas of a run for whoever watches it grow, if anybody may (``view.socket``)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from artemis_edge.config import ViewConfig
from artemis_edge.errors import InputError
from artemis_edge.frames import MeshDelta
from artemis_edge.mapping_run import Mapper
from artemis_edge.service.map_feed import MapFeed

_ONLY_THIS_USER = 0o600
# What viewers may take to fetch the end of the map, once, after the last frame.
_FAREWELL_S, _FAREWELL_EVERY_S = 5.0, 0.01


class Telling:
    """Hands deltas to the feed, which never waits; without one to nobody."""

    def __init__(self, feed: MapFeed | None) -> None:
        self._feed = feed

    def watching(self, mapper: Mapper) -> Callable[[MeshDelta], None]:
        """What to call with every delta of a mapper."""

        def publish(delta: MeshDelta) -> None:
            feed = self._feed
            if feed is None:
                return
            feed.add(delta)
            if feed.turn():
                mapper.tell_everything()

        return publish


@contextmanager
def telling(rules: ViewConfig) -> Iterator[Telling]:
    """The feed of ``view.socket`` while the block runs; InputError if it cannot be there."""
    if not rules.socket:
        yield Telling(None)
        return
    feed = _feed(Path(rules.socket))
    try:
        yield Telling(feed)
        end = time.monotonic() + _FAREWELL_S
        while feed.waiting and time.monotonic() < end:
            feed.turn()
            time.sleep(_FAREWELL_EVERY_S)
    finally:
        feed.close()


def _feed(path: Path) -> MapFeed:
    if path.exists() and not path.is_socket():
        raise InputError(f"{path} is there and no socket; give another view.socket")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return MapFeed(path, _ONLY_THIS_USER)
    except OSError as error:
        raise InputError(
            f"cannot make the socket {path}: {error.strerror or error}; give another view.socket"
        ) from None
