"""The browser view of a growing map: draws what the feed brings, a few regions at a time."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any, Protocol

from artemis_edge.errors import InputError
from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import MeshDelta
from artemis_edge.view.browser import Ask, Browser
from artemis_edge.view.kinds import Kind, coloured
from artemis_edge.view.live_mesh import BlockKey, LiveMesh, extent

# A browser on a tablet redraws this often, and takes this many regions each time: newest state wins.
_EVERY_S, _REGIONS_AT_ONCE = 0.5, 12


class Source(Protocol):
    """Where news of a growing map comes from: ``service.map_feed.MapReader``."""

    def take(self) -> list[MeshDelta]:
        """What has arrived, without waiting."""
        ...

    def close(self) -> None:
        """Detach."""
        ...


class LiveView:
    """Serves the map that ``source`` tells of until closed; ``ask`` answers the query box, if there is one."""

    def __init__(self, source: Source, host: str, port: int, ask: Ask | None = None) -> None:
        self._source = source
        self._mesh = LiveMesh()
        self._drawing = threading.Lock()
        self._ended = threading.Event()
        self._nodes: dict[BlockKey, Any] = {}
        self._looked = False
        self.browser = Browser(host, port, self._recolour)
        if ask is not None:
            self.browser.add_query(ask, lambda triangles: None)
        self._note = self.browser.note()
        self._note.content = "waiting for the map"

    def run(self) -> None:
        """Draw what comes until ``close``."""
        while not self._ended.wait(_EVERY_S):
            self.turn()

    def turn(self, most: int = _REGIONS_AT_ONCE) -> None:
        """Take the news and draw at most so many regions that changed."""
        with self._drawing:
            for delta in self._source.take():
                self._mesh.apply(delta)
            regions = self._mesh.take_dirty(most)
            for region in regions:
                self._draw(region, self.browser.kind)
            if regions:
                self._note.content = f"{len(self._mesh.blocks):,} blocks"
            if regions and not self._looked:
                self.browser.look_at(*extent(self._mesh.blocks))
                self._looked = True

    def close(self) -> None:
        """Stop serving and detach."""
        self._ended.set()
        with self._drawing:
            self._source.close()
            self.browser.close()

    def _recolour(self, kind: Kind) -> None:
        with self._drawing:
            for region in list(self._nodes):
                self._draw(region, kind)

    def _draw(self, region: BlockKey, kind: Kind) -> None:
        mesh: Mesh = coloured(self._mesh.region_mesh(region), kind)
        before = self._nodes.get(region)
        self._nodes[region] = self.browser.set_mesh("/map/" + "_".join(str(k) for k in region), mesh)
        if self._nodes[region] is None and before is not None:
            before.remove()


def map_socket(path: Path) -> Path:
    """``path`` if a run tells its map there; InputError if not."""
    if not path.is_socket():
        raise InputError(
            f"no map is growing at {path}; start `artemis-edge run`, or map with --set view.socket={path}"
        )
    return path
