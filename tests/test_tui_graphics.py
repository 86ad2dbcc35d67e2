"""The picture in pixels: what a terminal answers decides, and sixels come out where it can show them."""

from __future__ import annotations

import base64
import contextlib
import fcntl
import io
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from textual.pilot import Pilot

from artemis_edge.tui import graphics
from artemis_edge.tui.app import ArtemisTui
from artemis_edge.tui.picture import SKY, Kind, MapCopy, _stamp, draw
from artemis_edge.tui.widgets import MeshPicture
from tests.fake_remote import Fake, court, run

widgets = pytest.importorskip("textual_image.widget")

_ASKS = """
from artemis_edge.tui.graphics import find_graphics
found = find_graphics()
print("[", found and (found.image.__module__, found.image.__name__, *found.cell), "]")
"""
_RUNS = """
from pathlib import Path
from artemis_edge.tui.app import ArtemisTui
from artemis_edge.tui.graphics import find_graphics
from tests.fake_remote import Fake
ArtemisTui(Fake(), Path("."), graphics=find_graphics()).run()
"""
_SIXEL, _PLAIN, _KITTY = b"\x1b[?62;4c", b"\x1b[?62c", b"\x1b_Gi=1;OK\x1b\\"
_PATIENCE_S = 60.0


class _Terminal:
    """Runs Python code in a pseudo terminal of 80 x 24 characters of 9 x 18 pixels that answers as it is told."""

    def __init__(self, code: str, answers: dict[bytes, bytes], **environment: str) -> None:
        self.shown, self._answers = b"", answers
        self._master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 720, 432))
        plain = {k: v for k, v in os.environ.items() if not k.startswith("SSH_") and k != graphics.VARIABLE}
        given = {**plain, "TERM": "xterm-256color", "COLORTERM": "truecolor", **environment}
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            env=given,
            cwd=Path(__file__).parents[1],
            start_new_session=True,
        )
        os.close(slave)

    def sees(self, pattern: bytes) -> re.Match[bytes]:
        """What matches, once it is there."""
        end, answered = time.monotonic() + _PATIENCE_S, 0
        while (found := re.search(pattern, self.shown, re.DOTALL)) is None:
            assert time.monotonic() < end, self.shown[-2000:]
            if select.select([self._master], [], [], 0.1)[0]:
                self.shown += os.read(self._master, 1 << 16)
            for question, answer in self._answers.items():
                at = self.shown.find(question, answered)
                if at >= 0:
                    answered = at + len(question)
                    os.write(self._master, answer)
        return found

    def end(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        os.close(self._master)


@pytest.mark.parametrize(
    ("answers", "environment", "found"),
    [
        ({b"\x1b[c": _SIXEL}, {}, b"'textual_image.widget.sixel', 'Image', 9, 18"),
        ({b"\x1b[c": _PLAIN, b"\x1b_G": _KITTY}, {}, b"'textual_image.widget', 'TGPImage', 9, 18"),
        ({}, {}, b"None"),
        ({b"\x1b[c": _SIXEL}, {"SSH_CONNECTION": "1 2 3 4"}, b"None"),
    ],
)
def test_the_terminals_answer_decides(
    answers: dict[bytes, bytes], environment: dict[str, str], found: bytes
) -> None:
    terminal = _Terminal(_ASKS, answers, **environment)
    try:
        assert found in terminal.sees(rb"\[ .* \]")[0]
        assert (b"\x1b[c" in terminal.shown) == (not environment), "over SSH it is not asked"
    finally:
        terminal.end()


def test_it_may_be_turned_off_or_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(graphics.VARIABLE, "off")
    monkeypatch.setitem(sys.modules, "textual_image", None)
    assert graphics.find_graphics() is None
    monkeypatch.setenv(graphics.VARIABLE, "on")
    assert graphics.find_graphics() is None, "the extra is not installed"


def test_sixels_come_out() -> None:
    terminal = _Terminal(_RUNS, {b"\x1b[c": _SIXEL})
    try:
        found = terminal.sees(rb'\x1bP[0-9;]*q"1;1;(\d+);(\d+)(#.*?)\x1b\\')
        width, height = int(found[1]), int(found[2])
        assert width % 9 == 0 and 200 < width < 720 and height % 18 == 0 and 90 < height < 432
        assert len(set(re.findall(rb"#\d+;2;\d+;\d+;\d+", found[3]))) > 4, "the mesh has colours"
        assert b"from behind" in terminal.shown, "with the caption above it"
    finally:
        terminal.end()


def test_kitty_is_sent_a_file() -> None:
    terminal = _Terminal(_RUNS, {b"\x1b[c": _PLAIN, b"\x1b_G": _KITTY})
    try:
        terminal.sees(rb"\x1b_Gi=\d+,m=0,f=100,q=2;.*?\x1b\\")
        number = terminal.sees(rb"\x1b_Gi=(\d+),m=.,f=100")[1]
        parts = re.findall(rb"\x1b_Gi=%s,m=.,f=100,q=2;(.*?)\x1b" % number, terminal.shown)
        picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(b"".join(parts)))))
        assert picture.shape[0] % 18 == 0 and picture.shape[1] % 9 == 0
        assert len(np.unique(picture.reshape(-1, picture.shape[2]), axis=0)) > 4, "the mesh has colours"
    finally:
        terminal.end()


@pytest.mark.parametrize(("kind", "span_m"), [("above", 5.0), ("behind", 20.0)])
def test_vertices_fill_what_lies_between_them(kind: Kind, span_m: float) -> None:
    copy = MapCopy()
    for part in court():
        copy.apply(part)
    holey, whole = (
        draw(copy, 144, 108, (0.0, 0.0, 0.0), 0.0, kind, span_m, spacing_m=spacing_m)
        for spacing_m in (0.0, 0.1)
    )
    floor = np.s_[70:] if kind == "behind" else np.s_[:]
    assert (holey[floor] == SKY).all(axis=2).mean() > 0.05
    assert not (whole[floor] == SKY).all(axis=2).any()


def test_what_is_stamped_last_is_on_top() -> None:
    rng = np.random.default_rng(2)
    u, v = rng.integers(-1, 13, (2, 60)).astype(float)
    colour = rng.integers(0, 255, (60, 3)).astype(np.uint8)
    image, expected = np.zeros((2, 9, 12, 3), np.uint8)
    _stamp(image, u, v, 3, colour)
    for x, y, c in zip(u.astype(int).tolist(), v.astype(int).tolist(), colour, strict=True):
        expected[max(y - 1, 0) : max(y + 2, 0), max(x - 1, 0) : max(x + 2, 0)] = c
    np.testing.assert_array_equal(image, expected)
    _stamp(image, u[:0], v[:0], 2, colour[:0])
    np.testing.assert_array_equal(image, expected)


def test_the_picture_fills_what_the_caption_leaves() -> None:
    found = graphics.Graphics(widgets.SixelImage, (9, 18))
    app = ArtemisTui(Fake(), Path(), graphics=found)

    async def script(pilot: Pilot[None]) -> None:
        await pilot.pause(1.2)
        picture = app.screen.query_one(MeshPicture)
        assert isinstance(picture, graphics.PixelPicture)
        columns, rows = picture.size
        assert picture.pixels == (3 * columns, 6 * (rows - 1))
        child = picture.query_one(widgets.SixelImage)
        assert (
            child.display
            and child.size == (columns, rows - 1)
            and child.image.size == (9 * columns, 18 * (rows - 1))
        )
        assert "from behind" in picture.render_line(0).text
        picture.message = "no map yet"
        picture.show(np.zeros((6, 6, 3), np.uint8))
        assert not child.display
        assert any("no map yet" in picture.render_line(y).text for y in range(rows))

    run(app, script)
