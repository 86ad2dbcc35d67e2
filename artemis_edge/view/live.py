"""The browser view of a growing map: draws what the feed brings, a few regions at a time."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

from artemis_edge.view.browser import Browser
from artemis_edge.view.feed import BlockKey, receive
from artemis_edge.view.kinds import Kind, coloured
from artemis_edge.view.live_mesh import LiveMesh, extent

# A browser on a tablet redraws this often, and takes this many regions each time: newest state wins.
_EVERY_S, _REGIONS_AT_ONCE = 0.5, 12


class LiveView:
    """Serves the map that grows at the other end of ``socket`` until closed or the run ends."""

    def __init__(self, socket: Path, host: str, port: int) -> None:
        self._mesh = LiveMesh()
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._nodes: dict[BlockKey, Any] = {}
        self._fault: BaseException | None = None
        updates = receive(socket)
        self._first = next(updates, None)
        self.browser = Browser(host, port, self._recolour)
        self._note = self.browser.note()
        self._looked = False
        self._reader = threading.Thread(target=self._read, args=(updates,), daemon=True, name="feed")
        self._reader.start()

    def run(self) -> None:
        """Draw until the feed ends; then what remains, once. Raises what the feed raised."""
        while not self._ended.wait(_EVERY_S):
            self.draw(_REGIONS_AT_ONCE)
        while self.draw(_REGIONS_AT_ONCE):
            pass
        if self._fault is not None:
            raise self._fault

    def draw(self, most: int) -> bool:
        """Draw at most so many regions that changed; whether there were any."""
        with self._lock:
            regions = self._mesh.take_dirty(most)
            meshes = [(region, self._mesh.region_mesh(region)) for region in regions]
            path, blocks = self._mesh.path, len(self._mesh.blocks)
            if not self._looked and len(self._mesh.blocks):
                self.browser.look_at(*extent(path, self._mesh.blocks))
                self._looked = True
        for region, mesh in meshes:
            self._nodes[region] = self._replace(region, coloured(mesh, self.browser.kind))
        if meshes:
            self.browser.set_path(path)
            state = "ended" if self._ended.is_set() else "growing"
            self._note.content = f"{state}: {blocks:,} blocks, {len(path):,} poses"
        return bool(meshes)

    def _replace(self, region: BlockKey, mesh: Any) -> Any:
        name = "/map/" + "_".join(str(k) for k in region)
        node = self.browser.set_mesh(name, mesh)
        if node is None and self._nodes.get(region) is not None:
            self._nodes[region].remove()
        return node

    def _recolour(self, kind: Kind) -> None:
        with self._lock:
            meshes = [(region, self._mesh.region_mesh(region)) for region in self._nodes]
        for region, mesh in meshes:
            self._nodes[region] = self._replace(region, coloured(mesh, kind))

    def _read(self, updates: Any) -> None:
        try:
            if self._first is not None:
                with self._lock:
                    self._mesh.apply(self._first)
            for update in updates:
                with self._lock:
                    self._mesh.apply(update)
        except BaseException as fault:  # told by run(), in the main thread
            self._fault = fault
        finally:
            self._ended.set()
