"""A newcomer's first minutes in a real terminal: ``demo --tui`` from its start to its report (make terminal-test)."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest

from tests.terminal import HAS_TMUX, Terminal

pytestmark = [
    pytest.mark.skipif("ARTEMIS_TERMINAL" not in os.environ, reason="takes minutes: make terminal-test"),
    pytest.mark.skipif(not HAS_TMUX, reason="needs tmux"),
]
_MINUTES = 60.0 * float(os.environ.get("ARTEMIS_PATIENCE", "1"))


def _vertices(shown: str) -> int:
    found = re.search(r"([\d,]+) vertices", shown)
    return int(found[1].replace(",", "")) if found else 0


def _blocks(shown: str) -> int:
    return shown.count("▀")


@pytest.mark.parametrize("size", [(80, 24), (160, 48)])
def test_a_newcomers_demo(size: tuple[int, int], tmp_path: Path) -> None:
    words = ["demo", "--tui", "--world", "street", "--seconds", "4", "--out", str(tmp_path / "out")]
    with Terminal(words, size, tmp_path, {"SSH_TTY": "/dev/pts/9"}) as terminal:
        terminal.sees("CHECKING", 1 * _MINUTES)
        first = terminal.sees(r"REPLAYING.*frame [1-9]", 15 * _MINUTES)
        later = terminal.sees(r"REPLAYING.*frame (2\d|3\d)|SAVING", 10 * _MINUTES)
        assert _vertices(later) > 1.2 * _vertices(first) > 0, "the mesh grows"
        assert _blocks(later) > 20, "and is seen"
        terminal.press("/")
        terminal.write("tree")
        terminal.press("Enter")
        shown = terminal.sees(r"tree +[1-9]\d* .*matched", 10 * _MINUTES)
        assert len(shown.splitlines()) <= size[1]
        swatch = max(terminal.colours(), key=lambda c: max(c) - min(c))
        assert max(swatch) - min(swatch) > 100, "a colour that nothing else has"
        terminal.press("s")
        terminal.sees("SAVING|DONE", 5 * _MINUTES)
        terminal.sees("DONE", 10 * _MINUTES)
        terminal.press("o")
        assert str(tmp_path / "out" / "report.html") in terminal.sees("Esc closes").replace("\n", "")
        terminal.press("Enter")
        terminal.sees("q leave")
        terminal.press("q")
        assert terminal.ends(60.0) == 0
        assert "report: " in terminal.text()
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["frames"] > 20 and (tmp_path / "out" / "report.html").stat().st_size > 10_000
