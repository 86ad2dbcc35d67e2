"""The browser view in headless Chromium without a network: a finished map, a growing one, the token."""

import itertools
import json
import os
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from artemis_edge.config import ViewConfig
from artemis_edge.export.atlas import write_atlas
from artemis_edge.export.ply import write_ply
from artemis_edge.service.map_feed import MapReader
from artemis_edge.telling import Telling, telling
from artemis_edge.view.live_mesh import Patch
from tests.test_view import delta_of
from tests.textured import square_room
from tests.viewer.browser import CHROMIUM, Page, page

pytest.importorskip("viser")
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine"),
    # software rendering takes half a minute of a core, too much for every run of the tests
    pytest.mark.skipif("ARTEMIS_VIEWER" not in os.environ, reason="run `make viewer-test`"),
]
WIDTH, HEIGHT, PANEL = 900, 500, 330
ORANGE = np.array([255, 64, 0])
_BUTTON = "[...document.querySelectorAll('button')].find(b => b.textContent.trim() == 'find')"
_BOX = "[...document.querySelectorAll('input')].filter(i => i.type == 'text').at(-1)"


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """The output directory of a textured map whose floor is a class."""
    mesh, atlas = square_room()
    mesh.labels[16:] = 3
    mesh.label_names.update({0: "background", 3: "floor"})
    write_ply(tmp_path / "mesh.ply", mesh)
    (tmp_path / "map").mkdir()
    write_atlas(tmp_path / "map", atlas)
    (tmp_path / "objects.json").write_text(json.dumps({"objects": []}))
    (tmp_path / "trajectory.tum").write_text("0 -1 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    return tmp_path


def scene(shown: Page) -> np.ndarray:
    """What is to be seen of the map, without the panel and the note about software rendering."""
    return shown.picture()[190:, : WIDTH - PANEL].astype(int)


def colourful(picture: np.ndarray) -> float:
    """Share of pixels that are neither grey nor white."""
    return float((np.ptp(picture, axis=2) > 30).mean())


def settled(shown: Page, good: Callable[[np.ndarray], bool], what: str) -> np.ndarray:
    """The scene once it is as expected."""
    return shown.until(lambda: (s,) if good(s := scene(shown)) else None, what)[0]


def test_a_finished_map_with_texture_query_and_colours_offline(room: Path) -> None:
    from artemis_edge.view.finished import FinishedView

    view = FinishedView(room, "127.0.0.1", 0)
    try:
        with page(view.browser.url, room, WIDTH, HEIGHT) as shown:
            textured = settled(shown, lambda s: colourful(s) > 0.1, "the textured map")
            hues = {tuple(c) for c in (textured[np.ptp(textured, axis=2) > 30] // 64).tolist()}
            assert len(hues) > 10  # pictures on the walls, not one colour
            shown.until(lambda: shown.evaluate(f"!!({_BUTTON} && {_BOX})"), "the panel")
            place = f"(r => [r.x + r.width / 2, r.y + r.height / 2])(({_BOX}).getBoundingClientRect())"
            shown.click(*shown.evaluate(place))
            shown.write("floor")
            shown.evaluate(f"({_BUTTON}).click()")
            shown.until(lambda: "2 triangles" in shown.evaluate("document.body.innerText"), "the answer")
            changed = settled(shown, lambda s: np.abs(s - textured).max(axis=2).mean() > 1, "the highlight")
            where = np.abs(changed - textured).max(axis=2) > 20
            assert (changed[where][:, 0] > changed[where][:, 2]).mean() > 0.9  # reddish
            view.highlight(None)
            view.show("coverage")
            green = settled(shown, lambda s: (s[..., 1] - s[..., 0] > 40).mean() > 0.05, "the coverage")
            assert (green[..., 0] - green[..., 2] > 80).mean() > 0.01  # the floor has no photograph: orange
            local = (view.browser.url, view.browser.url.replace("http", "ws"), "data:", "blob:")
            assert shown.failed == [] and all(url.startswith(local) for url in shown.requested)
    finally:
        view.browser.close()


def test_a_growing_map_appears_while_it_grows(tmp_path: Path) -> None:
    from artemis_edge.view.live import LiveView, map_socket

    mesh, _ = square_room()
    colours = np.tile(np.array([[30, 160, 220]], np.uint8), (len(mesh.vertices), 1))
    walls = [
        Patch(
            np.arange(4, dtype=np.int64) + 4 * k, mesh.vertices[4 * k : 4 * k + 4], colours[:4],
            mesh.labels[:4], mesh.confidence[:4], mesh.faces[2 * k : 2 * k + 2].astype(np.int64),
        )
        for k in range(5)
    ]  # fmt: skip
    stop = threading.Event()
    path = tmp_path / "view.sock"

    def pipeline(live: Telling) -> None:
        publish = live.watching(SimpleNamespace(tell_everything=lambda: None))  # type: ignore[arg-type]
        for told in itertools.count():
            if stop.wait(0.1):
                return
            publish(delta_of({(told % 5, 0, 0): walls[told % 5]}))

    with telling(ViewConfig(socket=str(path))) as live:
        run = threading.Thread(target=pipeline, args=(live,), daemon=True)
        run.start()
        view = LiveView(MapReader(map_socket(path)), "127.0.0.1", 0)
        drawing = threading.Thread(target=view.run, daemon=True)
        drawing.start()
        try:
            with page(view.browser.url, tmp_path, WIDTH, HEIGHT) as shown:
                settled(shown, lambda s: ((s[..., 2] - s[..., 0]) > 60).mean() > 0.1, "the map")
                shown.until(lambda: "5 blocks" in shown.evaluate("document.body.innerText"), "the state")
        finally:
            view.close()
            drawing.join(20)
            stop.set()
            run.join(20)
    assert not drawing.is_alive()


def test_open_to_the_network_the_token_is_asked_for(room: Path) -> None:
    from artemis_edge.view.finished import FinishedView

    view = FinishedView(room, "0.0.0.0", 0)
    url = view.browser.url.replace("0.0.0.0", "127.0.0.1")
    try:
        with page(url.partition("?")[0], room, WIDTH, HEIGHT) as shown:
            shown.until(lambda: "token" in (shown.evaluate("document.body.innerText") or ""), "the refusal")
        (room / "second").mkdir()
        with page(url, room / "second", WIDTH, HEIGHT) as shown:
            settled(shown, lambda s: colourful(s) > 0.1, "the map")
    finally:
        view.browser.close()
