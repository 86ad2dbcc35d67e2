"""What both views have in common: the server, the panel, the camera. viser is used in this folder only."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.export.atlas import Atlas
from artemis_edge.export.glb import write_glb
from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import F32, Bool
from artemis_edge.view.gate import Gate
from artemis_edge.view.kinds import KINDS, Kind

LOOPBACK = ("127.0.0.1", "localhost", "::1")
# glTF is y up: back to z up
_WXYZ_Z_UP = (float(np.sqrt(0.5)), float(np.sqrt(0.5)), 0.0, 0.0)
_HIGHLIGHT, _PATH = (255, 64, 0), (230, 60, 40)
_LIFT_M = 0.01  # what is highlighted lies on top of itself
_TITLE = "Artemis Edge"


@dataclass(frozen=True, slots=True)
class Answer:
    """What was found for a question: a sentence, and where on the mesh, bool (m,), if known."""

    sentence: str
    triangles: Bool | None = None


#: Answers a text; may take its time, the browser stays alive.
Ask = Callable[[str], Answer]


class Browser:
    """The web server with a scene and a panel. ``url`` is what to open.

    It listens on this machine only, or for ``host`` behind a gate that asks for a token.
    """

    def __init__(self, host: str, port: int, show: Callable[[Kind], None]) -> None:
        viser = _viser()
        wide = host not in LOOPBACK
        with redirect_stdout(StringIO()):  # it announces itself
            self.server: Any = viser.ViserServer(
                host="127.0.0.1", port=0 if wide else port, label=_TITLE, verbose=False
            )
        self._gate = Gate(host, port, self.server.get_port()) if wide else None
        if self._gate is not None:
            self.url = f"http://{host}:{self._gate.port}/?token={self._gate.token}"
        else:
            self.url = f"http://127.0.0.1:{self.server.get_port()}/"
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.scene.set_up_direction("+z")
        self.server.scene.configure_environment_map(None)
        self.server.scene.world_axes.visible = False
        self._kinds = self.server.gui.add_dropdown("colours", KINDS, initial_value=KINDS[0])
        self._kinds.on_update(lambda _: show(self._kinds.value))
        self._trajectory = self.server.gui.add_checkbox("trajectory", True)
        self._trajectory.on_update(lambda _: self._show_path())
        self._path_node: Any = None
        self._highlight_node: Any = None

    @property
    def kind(self) -> Kind:
        """The colours chosen."""
        chosen: Kind = self._kinds.value
        return chosen

    def note(self) -> Any:
        """A line of text in the panel; set its ``content``."""
        return self.server.gui.add_markdown("")

    def add_query(self, ask: Ask, mark: Callable[[Bool | None], None]) -> None:
        """A box to ask in; what is found is told below it and marked."""
        box = self.server.gui.add_text("find", "")
        button = self.server.gui.add_button("find")
        told = self.note()

        def asked(_: Any) -> None:
            text = box.value.strip()
            if not text:
                told.content = ""
                mark(None)
                return
            told.content = "looking …"
            try:
                answer = ask(text)
            except InputError as error:
                answer = Answer(str(error))
            told.content = answer.sentence
            mark(answer.triangles)

        button.on_click(asked)

    def set_mesh(self, name: str, mesh: Mesh, atlas: Atlas | None = None) -> Any:
        """Show or replace a mesh; None, and nothing shown, for one without triangles."""
        if len(mesh.faces) == 0:
            return None
        content = glb_bytes(mesh, atlas)
        return self.server.scene.add_glb(
            name, content, wxyz=_WXYZ_Z_UP, cast_shadow=False, receive_shadow=False
        )

    def highlight(self, mesh: Mesh, triangles: Bool | None) -> None:
        """Mark triangles of a mesh, or none."""
        if self._highlight_node is not None:
            self._highlight_node.remove()
            self._highlight_node = None
        if triangles is None or not triangles.any():
            return
        used, faces = np.unique(mesh.faces[triangles], return_inverse=True)
        raised = mesh.vertices[used] + np.float32(_LIFT_M) * mesh.normals[used]
        self._highlight_node = self.server.scene.add_mesh_simple(
            "/highlight", raised, faces.reshape(-1, 3), color=_HIGHLIGHT, opacity=0.6, side="double",
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def set_path(self, path: F32) -> None:
        """Show where the sensor was, float32 (p, 3)."""
        if len(path) > 1:
            pieces = np.stack([path[:-1], path[1:]], axis=1)
            self._path_node = self.server.scene.add_line_segments(
                "/trajectory", pieces, _PATH, thickness=3.0, thickness_units="screen"
            )
            self._show_path()

    def look_at(self, low: F32, high: F32) -> None:
        """Where a browser looks from when it comes: behind and above the middle."""
        middle = 0.5 * (low + high)
        reach = max(float(np.linalg.norm((high - low)[:2])), 1.0)
        camera = self.server.initial_camera
        camera.position = tuple((middle + reach * np.array([-0.55, -0.2, 0.45])).tolist())
        camera.look_at = tuple(middle.tolist())
        camera.up = (0.0, 0.0, 1.0)

    def close(self) -> None:
        """Stop serving."""
        if self._gate is not None:
            self._gate.close()
        with redirect_stdout(StringIO()):
            self.server.stop()

    def _show_path(self) -> None:
        if self._path_node is not None:
            self._path_node.visible = bool(self._trajectory.value)


def glb_bytes(mesh: Mesh, atlas: Atlas | None) -> bytes:
    """The GLB of a mesh."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.glb"
        write_glb(path, mesh, atlas)
        return path.read_bytes()


def _viser() -> Any:
    try:
        import viser
    except ImportError:
        raise InputError(
            "the browser view needs the extra 'view': pip install 'artemis-edge[view]'"
        ) from None
    return viser
