"""The browser view of a growing map: draws what the feed brings, a few regions at a time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import MeshDelta
from artemis_edge.lights import lit
from artemis_edge.status import QueryStatus
from artemis_edge.view.browser import Ask, Browser
from artemis_edge.view.kinds import Kind, coloured
from artemis_edge.view.live_mesh import BlockKey, LiveMesh, extent

# A browser on a tablet redraws this often, and takes this many regions each time: newest state wins.
_EVERY_S, _REGIONS_AT_ONCE = 0.5, 12
_HEAR_S = 1.0
_MIX = 0.75  # of a question's colour in what lights up


class Source(Protocol):
    """Where news of a growing map comes from: ``service.map_feed.MapReader``."""

    def take(self) -> list[MeshDelta]:
        """What has arrived, without waiting."""
        ...

    def close(self) -> None:
        """Detach."""
        ...


class LiveView:
    """Serves the map that ``source`` tells of until closed; ``ask`` answers the query box, if there is one.

    ``questions`` tells what is asked, and what of the mesh lights up for it; it is called once a second.
    """

    def __init__(
        self,
        source: Source,
        host: str,
        port: int,
        ask: Ask | None = None,
        questions: Callable[[], Sequence[QueryStatus]] = tuple,
    ) -> None:
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
        self._questions, self._asked = questions, list[QueryStatus]()
        self._heard_s = 0.0
        self._told = self.browser.note()

    def run(self) -> None:
        """Draw what comes until ``close``."""
        while not self._ended.wait(_EVERY_S):
            self.turn()

    def turn(self, most: int = _REGIONS_AT_ONCE) -> None:
        """Take the news and draw at most so many regions that changed."""
        with self._drawing:
            for delta in self._source.take():
                self._mesh.apply(delta)
            self._hear()
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

    def _hear(self) -> None:
        """Take over what is asked; where it lights up is drawn anew."""
        if time.monotonic() - self._heard_s < _HEAR_S:
            return
        self._heard_s = time.monotonic()
        asked = list(self._questions())
        before = {(q.colour, label) for q in self._asked for label in q.labels}
        after = {(q.colour, label) for q in asked for label in q.labels}
        changed = [label for _, label in before ^ after]
        boxes = [[q.labels, q.boxes] for q in self._asked], [[q.labels, q.boxes] for q in asked]
        if boxes[0] != boxes[1]:
            changed += [label for q in (*self._asked, *asked) if q.boxes for label in q.labels]
        self._asked = asked
        self._mesh.redraw(changed)
        self._told.content = "\n".join(f"- {sentence(query)}" for query in asked)

    def _recolour(self, kind: Kind) -> None:
        with self._drawing:
            for region in list(self._nodes):
                self._draw(region, kind)

    def _draw(self, region: BlockKey, kind: Kind) -> None:
        mesh: Mesh = lighted(coloured(self._mesh.region_mesh(region), kind), self._asked)
        before = self._nodes.get(region)
        self._nodes[region] = self.browser.set_mesh("/map/" + "_".join(str(k) for k in region), mesh)
        if self._nodes[region] is None and before is not None:
            before.remove()


def lighted(mesh: Mesh, asked: Sequence[QueryStatus]) -> Mesh:
    """The mesh with what is asked for in the colours of the questions."""
    colours = mesh.colours.copy()
    for rows, colour in lit(mesh.vertices, mesh.labels, asked):
        colours[rows] = (_MIX * np.array(colour) + (1.0 - _MIX) * colours[rows]).astype(np.uint8)
    return replace(mesh, colours=colours)


def sentence(query: QueryStatus) -> str:
    """A question and what became of it, in a line."""
    best = f", best {query.score:.2f}" if query.score > 0.0 else ""
    found = f"{query.count} found{best}" if query.count else query.status.replace("_", " ")
    return f"{query.text}: {found}" + (f" ({query.note})" if query.note else "")


def map_socket(path: Path) -> Path:
    """``path`` if a run tells its map there; InputError if not."""
    if not path.is_socket():
        raise InputError(
            f"no map is growing at {path}; start `artemis-edge run`, or map with --set view.socket={path}"
        )
    return path
