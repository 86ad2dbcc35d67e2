"""``artemis-edge tui`` in a real terminal (tmux), attached to a service that a test plays; more sizes with ``make``.

The demo from its start to its report, which takes minutes, is in tests/soak/test_demo_terminal.py.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from artemis_edge.errors import InputError
from artemis_edge.service.control import ControlSocket, viewers_path
from artemis_edge.service.map_feed import MapFeed
from artemis_edge.status import MapStatus, QueryStatus, Status, Stream
from tests.fake_remote import court
from tests.terminal import HAS_TMUX, Terminal

pytestmark = pytest.mark.skipif(not HAS_TMUX, reason="needs tmux")

HIGHLIGHT = (255, 80, 0)


class Played:
    """A service: its mesh grows with every question, it stops, and then there is a report."""

    def __init__(self, path: Path) -> None:
        self.told: list[str] = []
        self.now = Status(
            state="recording", frames=12, streams=[Stream("lidar_0", 10, 10, state="running")],
            map=MapStatus(vertices=1000),
        )  # fmt: skip
        self._report = path.parent / "report.html"
        self._control = ControlSocket(path, 0o600, self._answer)
        self._feed = MapFeed(viewers_path(path), 0o600)
        self._parts = court()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _answer(self, what: str, request: dict[str, Any]) -> dict[str, Any]:
        if what == "status":
            return dict(msgspec.to_builtins(self.now))
        self.told.append(what)
        if what == "ask":
            query = QueryStatus(request["text"], "matched", colour=HIGHLIGHT, labels=[1])
            self.now = replace(self.now, queries=[query])
            return {}
        if what == "mark":
            return {"number": 1}
        if what != "stop":
            raise InputError(f"no request '{what}'")
        self._report.write_text("<html/>")
        self.now = replace(self.now, state="done", report=str(self._report))
        return {"phase": "saving"}

    def _serve(self) -> None:
        while not self._over.is_set():
            self._control.turn(dict, 0.02)
            if self._feed.turn():
                for part in self._parts:
                    self._feed.add(part)

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self._control.close()
        self._feed.close()


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Played]:
    played = Played(tmp_path / "s")
    yield played
    played.close()


_WIDER = pytest.mark.skipif("ARTEMIS_TERMINAL" not in os.environ, reason="asked for by make terminal-test")


@pytest.mark.parametrize("size", [(80, 24), pytest.param((160, 48), marks=_WIDER)])
def test_a_newcomer_asks_stops_and_finds_the_report(
    service: Played, tmp_path: Path, size: tuple[int, int]
) -> None:
    over_ssh = {"SSH_CONNECTION": "10.0.0.2 50000 10.0.0.1 22"}
    with Terminal(["tui", "--socket", str(tmp_path / "s")], size, tmp_path, over_ssh) as terminal:
        shown = terminal.sees("RECORDING.*frame 12")
        assert 0.8 * size[0] < max(map(len, shown.splitlines())) <= size[0]
        terminal.sees("▀")
        assert HIGHLIGHT not in terminal.colours()
        terminal.press("/")
        terminal.write("bench")
        terminal.press("Enter")
        terminal.sees("bench +1 .*matched")
        bright = [c for c in terminal.colours() if c[0] > 150 and c[2] < 60]
        assert len(bright) > 1, "the swatch, and vertices in a mixture of it and their own colour"
        terminal.press("m")
        terminal.sees("marked, number 1")
        terminal.press("s")
        terminal.sees("DONE")
        terminal.press("o")
        assert str(tmp_path / "report.html") in terminal.sees("Esc closes").replace("\n", "")
        terminal.press("Enter")
        terminal.sees("q leave")
        terminal.press("q")
        assert terminal.ends() == 0
    assert service.told == ["ask", "mark", "stop"]
