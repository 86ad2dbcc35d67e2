"""The pages beside the live one: what is ready, what was recorded, how it is used."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from rich.text import Text
from textual import on, work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.screen import Screen
from textual.widgets import DataTable, Footer, Markdown, Static

from artemis_edge.check_finding import Finding

_STYLE = {"ok": "green", "warn": "yellow", "fail": "bold red"}

HELP = """\
## Walking
Watch the picture: what is grey was not seen by a camera, what is dark is far. Turn slower when you are told to.

| key | does |
|---|---|
| `r` `s` `m` | start, stop, mark this moment |
| `/` | ask for something: *bench*, *red car*, *person next to the bench*; up and down go through older questions |
| Enter on a question | look at its next object; Esc back to you |
| Delete on a question | forget it |
| `v` `+` `-` | from behind or above, nearer, farther |
| `1` `2` `3` `?` | live, checks before the walk, recordings, this page |
| `o` | the report, when the map is saved |
| `q` | leave; the recording goes on (a demo ends) |

Ctrl+P opens the palette of all commands. Keys can be changed in the file `keys.toml`; docs/operator.md tells how.
"""


class ChecksPage(Screen[None]):
    """The pre-flight page: what `artemis-edge check` says."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("c", "again", "check again", id="again")]
    CSS = "#summary { height: 2; padding: 0 1; } DataTable { height: 1fr; }"

    def compose(self) -> ComposeResult:
        """A sentence and a table."""
        yield Static("looking ...", id="summary")
        yield DataTable(id="findings", cursor_type="row")
        yield Footer()

    def on_mount(self) -> None:
        """Look."""
        table = self.query_one(DataTable)
        for title in ("", "what", "how it is"):
            table.add_column(title)
        self.look()

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
        table = self.query_one(DataTable)
        table.clear()
        for f in sorted(findings, key=lambda f: ("fail", "warn", "ok").index(f.status)):
            table.add_row(Text(f.status, style=_STYLE[f.status]), Text(f.name), Text(f.detail), height=None)
        bad = sum(f.status == "fail" for f in findings)
        doubtful = sum(f.status == "warn" for f in findings)
        sentence = (
            Text(f"{bad} to mend before you walk", style="bold red")
            if bad
            else Text(f"ready, {doubtful} to look at" if doubtful else "ready", style="bold green")
        )
        self.query_one("#summary", Static).update(sentence)


class SessionsPage(Screen[None]):
    """Recordings as cards: when, how long, how much."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("c", "again", "look again", id="again")]
    CSS = "#card { height: 8; padding: 0 1; border-top: solid grey; } DataTable { height: 1fr; }"

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self._found: list[tuple[Path, float]] = []

    def compose(self) -> ComposeResult:
        """A list and the card of the chosen one."""
        yield DataTable(id="recordings", cursor_type="row")
        yield Static("", id="card")
        yield Footer()

    def on_mount(self) -> None:
        """Look."""
        table = self.query_one(DataTable)
        for title in ("recorded", "MB", "where"):
            table.add_column(title)
        self.action_again()

    def action_again(self) -> None:
        """Look again."""
        import time

        table = self.query_one(DataTable)
        table.clear()
        self._found = recordings(self._folder)
        for path, when in self._found:
            size = sum(f.stat().st_size for f in _files(path)) / 1e6
            table.add_row(
                time.strftime("%Y-%m-%d %H:%M", time.localtime(when)), f"{size:.0f}", str(path), key=str(path)
            )
        if not self._found:
            self.query_one("#card", Static).update(f"no recordings in {self._folder.resolve()}")

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
            text = catalog.to_text(catalog.catalog(path))
        except UserError as error:
            text = str(error)
        self.app.call_from_thread(self.query_one("#card", Static).update, Text(text))


def recordings(folder: Path) -> list[tuple[Path, float]]:
    """Sessions in a folder and one level below it, the newest first: path and time of change."""
    found = [p for pattern in ("*.mcap", "*/*.mcap") for p in folder.glob(pattern) if p.is_file()]
    places = {p.parent if p.parent.resolve() != folder.resolve() else p for p in found}
    return sorted(
        ((p, max(f.stat().st_mtime for f in _files(p))) for p in places), key=lambda x: (-x[1], x[0])
    )


def _files(path: Path) -> list[Path]:
    return sorted(path.glob("*.mcap")) if path.is_dir() else [path]


class HelpPage(Screen[None]):
    """What the keys do."""

    def compose(self) -> ComposeResult:
        """One page of text."""
        with VerticalScroll():
            yield Markdown(HELP)
        yield Footer()
