"""Every page of the terminal as a picture (SVG), compared with the one that was looked at and kept in tests/screens.

After a change that is meant: ARTEMIS_SCREENS=write pytest tests/test_tui_screens.py, and look at what git shows.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace
from textual.pilot import Pilot
from textual.widgets import DataTable, Input

from artemis_edge import check
from artemis_edge.check_finding import Finding
from artemis_edge.status import QueryStatus, Status
from artemis_edge.tui.app import ArtemisTui
from artemis_edge.tui.widgets import MeshPicture
from tests import small_session
from tests.fake_remote import FULL, Fake, court, live, run, settled

KEPT = Path(__file__).parent / "screens"
SMALL, LARGE = (80, 24), (160, 48)
_WHEN = 1_750_000_000

Script = Callable[[Pilot[None]], Awaitable[None]]


WALK = replace(
    FULL,
    dropped=0,
    frame_ms=[20.0, 25.0, 31.0, 60.0, 80.0, 130.0, 70.0, 40.0] * 4,
    queries=[
        QueryStatus("bench", "matched", 1, 0.91, (255, 80, 0), places=[(5.6, 3.0, -1.0)], labels=[1]),
        QueryStatus("unicorn", "unsupported", note="no model knows it", colour=(0, 255, 0)),
    ],
)


class _Remote(Fake):
    def __init__(self, status: Status) -> None:
        super().__init__(status)
        self.news = court()


def _normalised(svg: str) -> str:
    """Without what says nothing about the page: fonts from elsewhere, numbers that name a drawing, ends of lines."""
    svg = re.sub(r' (shape-rendering|clip-path)="[^"]*"', "", svg)
    svg = re.sub(r"<defs>.*?</defs>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"@font-face \{.*?\}", "", svg, flags=re.DOTALL)
    svg = re.sub(r"terminal-\d+", "terminal", svg)
    return re.sub(r"\s*\n\s*", "\n", svg).strip() + "\n"


def _compare(app: ArtemisTui, name: str) -> None:
    svg = _normalised(app.export_screenshot(simplify=True))
    kept = KEPT / f"{name}.svg"
    if os.environ.get("ARTEMIS_SCREENS") == "write":
        kept.parent.mkdir(exist_ok=True)
        kept.write_text(svg)
    assert kept.is_file(), f"look at the page and keep it: ARTEMIS_SCREENS=write pytest {Path(__file__).name}"
    assert svg == kept.read_text(), f"{name} looks otherwise than in {kept}"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder to be in, at a place on Earth without daylight saving."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TZ", "UTC")
    time.tzset()
    yield Path()
    monkeypatch.undo()
    time.tzset()


def _shown(
    name: str, folder: Path, status: Status, size: tuple[int, int], script: Script, colour: bool = True
) -> None:
    app = ArtemisTui(_Remote(status), folder, colour)

    async def all_of_it(pilot: Pilot[None]) -> None:
        await settled(pilot, lambda: app.status == status and len(live(app)._copy) > 0)
        await script(pilot)
        await pilot.pause()
        if app.screen is live(app):
            live(app).redraw()
            await pilot.pause()
        _compare(app, name)

    run(app, all_of_it, size)


async def _nothing(pilot: Pilot[None]) -> None:
    await pilot.pause()


@pytest.mark.parametrize(
    ("name", "size", "colour"),
    [("live-small", SMALL, True), ("live-large", LARGE, True), ("live-plain", SMALL, False)],
)
def test_live_page(name: str, size: tuple[int, int], colour: bool, folder: Path) -> None:
    _shown(name, folder, WALK, size, _nothing, colour)


def test_live_page_from_above_with_a_question_being_written(folder: Path) -> None:
    async def script(pilot: Pilot[None]) -> None:
        await pilot.press("v", "minus", "slash", *"red ca")
        line = live(pilot.app).query_one(Input)  # type: ignore[arg-type]
        line.cursor_blink = False
        await settled(pilot, lambda: line._suggestion == "red car")

    _shown("live-asking", folder, WALK, SMALL, script)


@pytest.mark.parametrize(
    ("name", "status"),
    [
        ("live-waiting", Status(state="checking", message="getting ready; the first time takes a minute or two")),
        ("live-fault", Status(state="fault", message="no service listens at a.sock; start it with: artemis-edge run")),
    ],
)  # fmt: skip
def test_live_page_before_there_is_a_map(name: str, status: Status, folder: Path) -> None:
    app = ArtemisTui(Fake(status), folder)
    app._remote.news = []  # type: ignore[attr-defined]

    async def script(pilot: Pilot[None]) -> None:
        await settled(pilot, lambda: app.status == status)
        live(app).redraw()
        await pilot.pause()
        assert live(app).query_one(MeshPicture).size.height > 6
        _compare(app, name)

    run(app, script, SMALL)


def test_checks_page(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = [
        Finding("python", "ok", "3.11.9"),
        Finding("disk", "warn", "1.4 GB free in sessions: minutes, not hours; free space or choose another disk"),
        Finding("lidar_0", "fail", "no broadcast at 192.168.1.5 for 3 s; see its cable, power and the network of eth1"),
    ]  # fmt: skip
    monkeypatch.setattr(check, "check", lambda: found)

    async def script(pilot: Pilot[None]) -> None:
        await pilot.press("2")
        await settled(pilot, lambda: pilot.app.screen.query_one(DataTable).row_count == 3)

    _shown("checks", folder, WALK, SMALL, script)


def test_recordings_page(folder: Path) -> None:
    for k, name in enumerate(("morning", "noon")):
        small_session.write(folder / name, frames=3, points=400)
        os.utime(folder / name / "session.mcap", (_WHEN + 3600 * k, _WHEN + 3600 * k))

    async def script(pilot: Pilot[None]) -> None:
        await pilot.press("3")
        await settled(pilot, lambda: "Hz" in str(pilot.app.screen.query_one("#card").render()))

    _shown("recordings", folder, WALK, SMALL, script)


def test_help_page(folder: Path) -> None:
    async def script(pilot: Pilot[None]) -> None:
        await pilot.press("question_mark")
        await pilot.pause(0.2)

    _shown("help", folder, WALK, SMALL, script)


def test_palette_names_all_commands(folder: Path) -> None:
    async def script(pilot: Pilot[None]) -> None:
        await pilot.press("ctrl+p")
        await pilot.pause(0.5)
        for word in ("Keys", "Quit"):
            assert word in pilot.app.export_screenshot()
        await pilot.press("escape")
        await pilot.pause(0.2)

    _shown("live-small", folder, WALK, SMALL, script)
