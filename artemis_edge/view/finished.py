"""The browser view of a finished map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge import ask
from artemis_edge.errors import InputError
from artemis_edge.frames import Bool
from artemis_edge.highlighted import highlighted_triangles
from artemis_edge.opened_map import open_map
from artemis_edge.trajectory import read_tum
from artemis_edge.view.browser import Answer, Ask, Browser
from artemis_edge.view.kinds import Kind, coloured

_TRAJECTORY = "trajectory.tum"


class FinishedView:
    """Serves a map until closed; ``answer`` answers the query box (None: the map and its photographs)."""

    def __init__(self, map_path: Path, host: str, port: int, answer: Ask | None = None) -> None:
        self._mesh, self._atlas = open_map(map_path)
        if len(self._mesh.faces) == 0:
            raise InputError(f"{map_path} has no triangles; there is nothing to see")
        self._map_path = map_path
        self._nodes: dict[Kind, Any] = {}
        self.browser = Browser(host, port, self.show)
        vertices = self._mesh.vertices
        low, high = np.percentile(vertices, 2, axis=0), np.percentile(vertices, 98, axis=0)
        self.browser.look_at(low.astype(np.float32), high.astype(np.float32))
        self._show_trajectory()
        self.browser.add_query(answer or self._answer, lambda triangles: self.highlight(triangles))
        self.browser.note().content = f"{len(self._mesh.faces):,} triangles, {len(vertices):,} vertices"
        self.show(self.browser.kind)

    def show(self, kind: Kind) -> None:
        """Show one kind of colours; made when it is first asked for."""
        if kind not in self._nodes:
            atlas = self._atlas if kind == "texture" else None
            mesh = coloured(self._mesh, kind, self._atlas)
            self._nodes[kind] = self.browser.set_mesh(f"/map/{kind}", mesh, atlas)
        for name, node in self._nodes.items():
            node.visible = name == kind

    def highlight(self, triangles: Bool | None) -> None:
        """Mark triangles, or none."""
        self.browser.highlight(self._mesh, triangles)

    def _answer(self, text: str) -> Answer:
        """What the map already knows, else what its photographs tell."""
        try:
            found = highlighted_triangles(self._map_path, self._mesh, text)
        except InputError as unknown:
            return self._look(text, unknown)
        return Answer(f"'{text}': {int(found.sum()):,} triangles", found)

    def _look(self, text: str, unknown: InputError) -> Answer:
        try:
            replies = ask.ask(self._map_path, [text])
        except InputError as fault:
            return Answer(f"{unknown}; its photographs cannot be asked: {fault}")
        triangles = np.zeros(len(self._mesh.faces), bool)
        for reply in replies:
            for found in reply.found:
                triangles[found.item.triangles] = True
        return Answer(ask.to_text(replies), triangles)

    def _show_trajectory(self) -> None:
        root = self._map_path if self._map_path.is_dir() else self._map_path.parent
        if (root / _TRAJECTORY).is_file():
            self.browser.set_path(read_tum(root / _TRAJECTORY).T_world_lidar[:, :3, 3].astype(np.float32))
