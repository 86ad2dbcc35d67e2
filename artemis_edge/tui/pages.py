"""The pages beside the live one: what is ready, what was recorded, how it is used."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from rich.console import Group
from rich.table import Table
from rich.text import Text
from textual import on, work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.screen import ModalScreen, Screen
from textual.widgets import DataTable, Footer, Static
from textual.widgets.data_table import ColumnKey

from artemis_edge.check_finding import Finding
from artemis_edge.config import profiles
from artemis_edge.tui.jobs import Job

if TYPE_CHECKING:
    from artemis_edge.session.catalog import Catalog

_NAME_WIDTH = 14
_JOB_EVERY_S = 0.5
_STYLE = {"ok": "green", "warn": "yellow", "fail": "bold red"}

HELP = (
    ("r  s  m", "start, stop, mark this moment"),
    ("/", "ask: bench, red car, person next to the bench; up and down: older questions"),
    ("Enter", "on a question: look at its next object; Esc: back to you"),
    ("Delete", "on a question: forget it"),
    ("v  +  -", "from behind or above, nearer, farther"),
    ("1 2 3 ?", "live, checks before the walk, recordings, this page"),
    ("p  y  f", "on a recording: map it, replay it, with which profile; x stops that"),
    ("o", "the report, when a map is saved"),
    ("Ctrl+P", "all commands"),
    ("q", "leave; the recording goes on (a demo ends)"),
)
_WALKING = (
    "Watch the picture: what is grey was not seen by a camera, what is dark is far. Turn slower when you are told "
    "to. A bar of the frame times that is red took longer than the 100 ms a frame has."
)
_KEYS = "Keys can be changed in keys.toml; docs/operator.md tells how."


class ChecksPage(Screen[None]):
    """The pre-flight page: what `artemis-edge check` says."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("c", "again", "check again", id="again")]
    CSS = "#summary { height: 2; padding: 0 1; } DataTable { height: 1fr; overflow-x: hidden; }"

    def __init__(self) -> None:
        super().__init__()
        self._found: list[Finding] = []

    def compose(self) -> ComposeResult:
        """A sentence and a table."""
        yield Static("looking ...", id="summary")
        yield DataTable(id="findings", cursor_type="row")
        yield Footer(show_command_palette=False, compact=True)

    def on_mount(self) -> None:
        """Look."""
        table = self.query_one(DataTable)
        for title, width in (("", 4), ("what", _NAME_WIDTH), ("how it is", 40)):
            table.add_column(title, width=width, key=title)
        self.look()

    def on_resize(self) -> None:
        """Sentences are wrapped where the terminal ends."""
        table = self.query_one(DataTable)
        if table.columns:
            table.columns[ColumnKey("how it is")].width = max(self.size.width - _NAME_WIDTH - 4 - 8, 20)
            self.show(self._found)

    def action_again(self) -> None:
        """Look again."""
        self.query_one("#summary", Static).update("looking ...")
        self.look()

    @work(thread=True, exclusive=True)
    def look(self) -> None:
        """In a thread: disks are measured."""
        from artemis_edge.check import check

        findings = check()
        self.app.call_from_thread(self.show, findings)

    def show(self, findings: list[Finding]) -> None:
        """Fill the page."""
        self._found = findings
        table = self.query_one(DataTable)
        table.clear()
        for f in sorted(findings, key=lambda f: ("fail", "warn", "ok").index(f.status)):
            table.add_row(Text(f.status, style=_STYLE[f.status]), Text(f.name), Text(f.detail), height=None)
        if not findings:
            return
        bad = sum(f.status == "fail" for f in findings)
        doubtful = sum(f.status == "warn" for f in findings)
        sentence = (
            Text(f"{bad} to mend before you walk", style="bold red")
            if bad
            else Text(f"ready, {doubtful} to look at" if doubtful else "ready", style="bold green")
        )
        self.query_one("#summary", Static).update(sentence)


class SessionsPage(Screen[None]):
    """Recordings as cards: when, how long, how much; to be mapped again or replayed."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("p", "work('reprocess')", "process", id="process"),
        Binding("y", "work('replay')", "replay", id="replay"),
        Binding("f", "profile", "profile", id="profile"),
        Binding("x", "stop", "stop it", id="stop_work", show=False),
        Binding("c", "again", "look again", id="again", show=False),
    ]
    CSS = """
    #card { height: 8; padding: 0 1; border-top: solid grey; } DataTable { height: 1fr; overflow-x: hidden; }
    #job { height: 1; padding: 0 1; }
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self._found: list[tuple[Path, float]] = []
        self._profiles = ["", *profiles()]
        self.job: Job | None = None

    def compose(self) -> ComposeResult:
        """A list, the card of the chosen one, and the work on it."""
        yield DataTable(id="recordings", cursor_type="row")
        yield Static("", id="card")
        yield Static("", id="job")
        yield Footer(show_command_palette=False, compact=True)

    def on_mount(self) -> None:
        """Look."""
        table = self.query_one(DataTable)
        for title in ("recorded", "MB", "where"):
            table.add_column(title)
        self.action_again()
        self.set_interval(_JOB_EVERY_S, self.show_job)
        self.show_job()

    def on_unmount(self) -> None:
        """The terminal is left: what is at work saves what it has."""
        if self.job is not None:
            self.job.close()

    def action_again(self) -> None:
        """Look again."""
        table = self.query_one(DataTable)
        table.clear()
        self._found = recordings(self._folder)
        for path, when in self._found:
            size = sum(f.stat().st_size for f in _files(path)) / 1e6
            recorded = time.strftime("%Y-%m-%d %H:%M", time.localtime(when))
            table.add_row(recorded, f"{size:.0f}" if size >= 10 else f"{size:.1f}", str(path), key=str(path))
        if not self._found:
            self.query_one("#card", Static).update(f"no recordings in {self._folder.resolve()}")

    def action_profile(self) -> None:
        """The next profile for ``process``."""
        self._profiles.append(self._profiles.pop(0))
        self.show_job()

    def action_work(self, what: str) -> None:
        """Map the chosen recording: ``reprocess``, or ``replay`` as it was mapped live."""
        table = self.query_one(DataTable)
        if not self._found or (self.job is not None and not self.job.over):
            self.notify("one at a time: x stops the present one" if self._found else "there is no recording")
            return
        path = self._found[min(table.cursor_row, len(self._found) - 1)][0]
        out = (path if path.is_dir() else path.parent) / what
        words = [what, str(path), "--out", str(out)]
        if what == "reprocess" and self._profiles[0]:
            words += ["--profile", self._profiles[0]]
        self.job = Job(f"{what} {path.name}", words, out)
        self.show_job()

    def action_stop(self) -> None:
        """Stop it; what is mapped is saved."""
        if self.job is not None:
            self.job.stop()

    def show_job(self) -> None:
        """How the work does, or what could be done."""
        idle = f"p maps it with profile {self._profiles[0] or 'default'}, f changes that, y replays it"
        self.query_one("#job", Static).update(Text(self.job.sentence if self.job is not None else idle))

    @on(DataTable.RowHighlighted, "#recordings")
    def chosen(self, event: DataTable.RowHighlighted) -> None:
        """Show its card."""
        if event.row_key.value is not None:
            self.read_card(Path(event.row_key.value))

    @work(thread=True, exclusive=True)
    def read_card(self, path: Path) -> None:
        """In a thread: the index of a long recording takes a moment."""
        from artemis_edge.errors import UserError
        from artemis_edge.session import catalog

        try:
            text = card(path, catalog.catalog(path))
        except UserError as error:
            text = str(error)
        self.app.call_from_thread(self.query_one("#card", Static).update, Text(text))


def card(path: Path, found: Catalog) -> str:
    """What a recording is, in at most seven lines."""
    rates = [
        f"{t.name.strip('/').split('/')[0]} {t.rate_hz():.0f} Hz" for t in found.topics if t.rate_hz() >= 1
    ]
    lines = [
        f"{found.duration_s:.1f} s, {found.bytes / 1e6:.1f} MB, {found.frames} LiDAR frames"
        + (", with poses" if found.has_poses else ""),
        ", ".join(dict.fromkeys(rates)),
    ]
    lines += [f"lost: {count} {reason.replace('_', ' ')}" for reason, count in sorted(found.lost.items())]
    lines += found.warnings
    if found.problem is not None:
        lines.append(f"cannot be mapped: {found.problem}")
    return "\n".join(line for line in [*lines[:5], *_maps(path)] if line)


def _maps(path: Path) -> list[str]:
    """The maps that were made of it."""
    reports = sorted(path.glob("*/report.json")) if path.is_dir() else []
    return [f"maps: {', '.join(report.parent.name for report in reports)}"] if reports else []


def recordings(folder: Path) -> list[tuple[Path, float]]:
    """Sessions in a folder and one level below it, the newest first: path and time of change."""
    found = [p for pattern in ("*.mcap", "*/*.mcap") for p in folder.glob(pattern) if p.is_file()]
    places = {p.parent if p.parent.resolve() != folder.resolve() else p for p in found}
    return sorted(
        ((p, max(f.stat().st_mtime for f in _files(p))) for p in places), key=lambda x: (-x[1], x[0])
    )


def _files(path: Path) -> list[Path]:
    return sorted(path.glob("*.mcap")) if path.is_dir() else [path]


class ReportPlace(ModalScreen[None]):
    """Where the report lies, for a terminal that has no browser beside it: the path on lines of its own."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,enter,o,q", "dismiss", "close", id="close")]
    CSS = """
    ReportPlace { align: center bottom; } #place { width: 100%; height: auto; padding: 1 0; background: $panel; }
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path

    def compose(self) -> ComposeResult:
        """No frame and nothing beside it, so that it can be marked and copied."""
        words = (
            "It needs nothing else: open it in a browser here, or copy it to your computer. The path is in your "
            "clipboard, if your terminal allows that. Esc closes this."
        )
        yield Static(Text.assemble(("report\n", "bold"), str(self._path), "\n\n", words), id="place")


class HelpPage(Screen[None]):
    """What the keys do, on one page of 80 x 24."""

    CSS = "#help { padding: 1 2; }"

    def compose(self) -> ComposeResult:
        """Text and a table."""
        table = Table.grid(padding=(0, 2))
        for key, does in HELP:
            table.add_row(Text(key, style="bold"), does)
        with VerticalScroll():
            yield Static(Group(_WALKING, "", table, "", _KEYS), id="help")
        yield Footer(show_command_palette=False, compact=True)
