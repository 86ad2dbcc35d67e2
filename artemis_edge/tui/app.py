"""The terminal application: pages, keys and the thread that talks to the other side."""

from __future__ import annotations

import concurrent.futures
import contextlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

from msgspec.structs import replace
from textual import on, work
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.css.query import NoMatches
from textual.reactive import reactive
from textual.screen import Screen
from textual.suggester import SuggestFromList
from textual.widgets import DataTable, Footer, Header, Input, Static

from artemis_edge.status import Status
from artemis_edge.tui.graphics import Graphics, PixelPicture
from artemis_edge.tui.history import History
from artemis_edge.tui.pages import ChecksPage, HelpPage, ReportPlace, SessionsPage
from artemis_edge.tui.picture import Finder, Kind, MapCopy, draw
from artemis_edge.tui.remote import Remote, RemoteError
from artemis_edge.tui.widgets import Advice, FrameTimes, Gauges, MeshPicture, Queries, Streams

STATUS_EVERY_S = 0.25
PICTURE_EVERY_S = 0.5  # two pictures a second are enough to walk by, and cost the other side nothing
_WORDS = (
    "backpack", "bench", "bicycle", "building", "car", "chair", "cyclist", "door", "ground", "person",
    "person next to the bench", "red car", "tallest tree", "tree", "truck",
)  # fmt: skip
_WHITE = (255, 255, 255)
_NEAREST_M, _FARTHEST_M = 10.0, 320.0


def can_open() -> bool:
    """Whether this terminal is on a desktop: over SSH, or without a display, nobody would see what opens."""
    if any(os.environ.get(name) for name in ("SSH_CONNECTION", "SSH_TTY")):
        return False
    return sys.platform == "darwin" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


class LivePage(Screen[None]):
    """The page one walks with."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("r", "command('start')", "start", id="start"),
        Binding("s", "command('stop')", "stop", id="stop"),
        Binding("m", "command('mark')", "mark", id="mark"),
        # priority: what is written right after it must find the line ready
        Binding("slash", "ask", "ask", id="ask", key_display="/", priority=True),
        Binding("v", "view", "view", id="view"),
        Binding("plus,equals_sign", "zoom(0.7)", "nearer", show=False, id="nearer"),
        Binding("minus", "zoom(1.4)", "farther", show=False, id="farther"),
        Binding("delete,backspace", "forget", "forget", show=False, id="forget"),
        Binding("escape", "leave", "", show=False, id="leave"),
    ]
    CSS = """
    #left { width: 3fr; } #right { width: 2fr; min-width: 36; padding: 0 0 0 1; }
    Gauges { height: 2; } FrameTimes { height: 1; } Advice { height: auto; max-height: 6; }
    Streams { height: auto; max-height: 8; } Queries { height: 1fr; min-height: 4; }
    Input { height: 1; border: none; padding: 0; } #prompt { height: 1; }
    """

    view: reactive[Kind] = reactive("behind")
    span_m: reactive[float] = reactive(40.0)

    def __init__(
        self, copy: MapCopy, colour: bool, history: History, graphics: Graphics | None = None
    ) -> None:
        super().__init__()
        self._copy, self._colour, self._history, self._graphics = copy, colour, history, graphics
        self._find = Finder(copy)
        self._status = Status()
        self._drawn: object = None  # what the picture was drawn of
        self._look_at: tuple[float, float, float] | None = None
        self._place = 0

    def compose(self) -> ComposeResult:
        """Left the picture, right numbers and questions."""
        yield Gauges()
        with Horizontal():
            with Vertical(id="left"):
                if self._graphics is None:
                    yield MeshPicture(self._colour, id="picture")
                else:
                    yield PixelPicture(self._graphics, id="picture")
                yield FrameTimes()
            with Vertical(id="right"):
                yield Streams(id="streams")
                yield Queries(id="queries")
                yield Advice()
        yield Input(
            placeholder="ask for something: bench, red car ...   (/ to write, Enter to ask, Esc to leave)",
            suggester=SuggestFromList([*self._history.lines, *_WORDS], case_sensitive=False),
            compact=True,
            id="ask",
        )
        yield Footer(show_command_palette=False, compact=True)

    def on_mount(self) -> None:
        """The picture is drawn on a timer of its own."""
        self.set_focus(self.query_one(Queries))
        self.set_interval(PICTURE_EVERY_S, self.redraw)

    def show(self, status: Status) -> None:
        """Take over a new status."""
        queries = [self._find(q) for q in status.queries]
        if status.state in ("done", "idle"):  # nobody is looking any more
            queries = [replace(q, status="not found") if q.status == "searching" else q for q in queries]
        known = status.map if status.map.vertices else replace(status.map, vertices=len(self._copy))
        status = replace(status, queries=queries, map=known)
        self._status = status
        self.query_one(Gauges).show(status)
        self.query_one(FrameTimes).show(status)
        self.query_one(Streams).show(status)
        self.query_one(Queries).show(status.queries)
        self.query_one(Advice).show(status)

    def redraw(self) -> None:
        """Draw the map as it is now, where anything of it has changed."""
        picture = self.query_one(MeshPicture)
        if not self.is_current or picture.size.width == 0:
            return
        width, height = picture.pixels
        status = self._status
        at = self._look_at or status.position
        # without colour what is asked for is bright, all else steps back
        queries = status.queries if self._colour else [replace(q, colour=_WHITE) for q in status.queries]
        picture.message = "" if len(self._copy) else status.message or "no map yet"
        picture.caption = f"{'from above' if self.view == 'above' else 'from behind'}, {self.span_m:.0f} m"
        seen = [(q.labels, q.boxes, q.colour) for q in queries]
        known = (self._copy.version, picture.pixels, picture.message, picture.caption, at, status.yaw, seen)
        if known == self._drawn:
            return
        self._drawn = known
        spacing_m = picture.spacing_m
        picture.show(
            draw(self._copy, width, height, at, status.yaw, self.view, self.span_m, queries, spacing_m)
        )

    def action_view(self) -> None:
        """Behind, above, behind ..."""
        self.view = "above" if self.view == "behind" else "behind"
        self.redraw()

    def action_zoom(self, factor: float) -> None:
        """Show less or more of the world."""
        self.span_m = min(max(self.span_m * factor, _NEAREST_M), _FARTHEST_M)
        self.redraw()

    def action_ask(self) -> None:
        """To the query line."""
        self.set_focus(self.query_one(Input))

    def action_leave(self) -> None:
        """Away from the query line, or from an object back to oneself."""
        self._look_at = None
        self.set_focus(self.query_one(Queries))
        self.redraw()

    def action_command(self, name: str) -> None:
        """Tell the other side."""
        self._call(lambda remote: remote.command(name))

    def action_forget(self) -> None:
        """Remove the question under the cursor."""
        table = self.query_one(Queries)
        if self._status.queries and table.has_focus:
            text = self._status.queries[min(table.cursor_row, len(self._status.queries) - 1)].text
            self._call(lambda remote: remote.forget(text))

    @on(Input.Submitted, "#ask")
    def asked(self, event: Input.Submitted) -> None:
        """A question was written."""
        text = event.value.strip()
        event.input.clear()
        if text:
            self._history.add(text)
            self._call(lambda remote: remote.ask(text))
        self.set_focus(self.query_one(Queries))

    @on(DataTable.RowSelected, "#queries")
    def jump(self, event: DataTable.RowSelected) -> None:
        """Look at the next object of a question."""
        row = event.cursor_row
        if row >= len(self._status.queries) or not self._status.queries[row].places:
            self.notify("nothing found for it yet")
            return
        places = self._status.queries[row].places
        self._look_at = places[self._place % len(places)]
        self._place += 1
        self.redraw()

    def on_key(self, event) -> None:  # type: ignore[no-untyped-def]
        """Up and down in the query line go through what was asked before."""
        line = self.query_one(Input)
        if line.has_focus and event.key in ("up", "down"):
            line.value = self._history.step(-1 if event.key == "up" else 1)
            line.cursor_position = len(line.value)
            event.stop()

    def _call(self, what: Callable[[Remote], str]) -> None:
        app = self.app
        assert isinstance(app, ArtemisTui)
        app.call(what)


class ArtemisTui(App[None]):
    """Attach to ``remote`` and show it until the operator leaves; never in the way of the other side."""

    TITLE = "Artemis Edge"
    ENABLE_COMMAND_PALETTE = True
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("1", "page('live')", "live", id="live"),
        Binding("2", "page('checks')", "checks", id="checks"),
        Binding("3", "page('sessions')", "sessions", id="sessions"),
        Binding("question_mark,f1", "page('help')", "help", id="help", key_display="?"),
        Binding("o", "report", "report", id="report"),
        Binding("q", "quit", "leave", id="quit"),
    ]

    def __init__(
        self, remote: Remote, sessions: Path, colour: bool = True, keymap: dict[str, str] | None = None,
        history: History | None = None, graphics: Graphics | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        self._graphics = graphics
        self._remote = remote
        self._sessions = sessions
        self._copy = MapCopy()
        self._colour = colour
        self._history = history or History(None)
        self.status = Status()
        self._lost = ""
        if keymap:
            self.set_keymap(keymap)
        self.sub_title = remote.name

    def compose(self) -> ComposeResult:
        """Only what is on every page."""
        yield Header()
        yield Static()

    def on_mount(self) -> None:
        """Pages, and the first look at the other side."""
        self.install_screen(LivePage(self._copy, self._colour, self._history, self._graphics), "live")
        self.install_screen(ChecksPage(), "checks")
        self.install_screen(SessionsPage(self._sessions), "sessions")
        self.install_screen(HelpPage(), "help")
        self.push_screen("live")
        self.set_interval(STATUS_EVERY_S, self.poll)

    def action_page(self, name: str) -> None:
        """Show another page."""
        self.switch_screen(name)
        self.refresh_bindings()

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """The page one is on needs no key, so that the others have room."""
        if action != "page" or not parameters or not self.is_screen_installed("live"):
            return True
        return self.screen is not self.get_screen(str(parameters[0]))

    def action_report(self) -> None:
        """Open the report of the last run, where there is one."""
        report = self._report()
        if not report:
            self.notify("there is no report yet: it is written when the map is saved")
            return
        path = Path(report).resolve()
        if can_open():
            self.open_url(path.as_uri())
            self.notify(f"report: {path}")
        else:  # a browser that opens in this terminal would take it from us
            self.copy_to_clipboard(str(path))
            self.push_screen(ReportPlace(path))

    def _report(self) -> str:
        """Of what was mapped on the page of recordings, else of the last run."""
        page = self.screen
        job = page.job if isinstance(page, SessionsPage) else None
        return (job.report if job is not None else "") or self.status.report

    @work(thread=True, exclusive=True, group="poll")
    def poll(self) -> None:
        """Ask for news in a thread: a slow answer never freezes the keys."""
        try:
            status = self._remote.status()
            deltas = self._remote.deltas()
        except RemoteError as error:
            self._show(self._lose, str(error))
            return
        for delta in deltas:
            self._copy.apply(delta)
        self._show(self._take, status)

    @work(thread=True, group="command")
    def call(self, what: Callable[[Remote], str]) -> None:
        """Tell the other side something and show its answer."""
        try:
            answer = what(self._remote)
        except RemoteError as error:
            self._show(self.notify, str(error), severity="error")
            return
        if answer:
            self._show(self.notify, answer)

    def _show(self, what: Callable[..., object], *arguments: object, **words: object) -> None:
        """Call it in the application's thread; a page that is gone meanwhile needs no news."""
        with contextlib.suppress(RuntimeError, NoMatches, concurrent.futures.CancelledError):
            self.call_from_thread(what, *arguments, **words)

    def _take(self, status: Status) -> None:
        if not self.is_screen_installed("live"):
            return  # the application is ending
        self._lost = ""
        if status.report and not self.status.report:
            self.notify("the map is saved; press o for the report")
        self.status = status
        live = self.get_screen("live")
        assert isinstance(live, LivePage)
        if live.is_mounted:
            live.show(status)

    def _lose(self, sentence: str) -> None:
        if sentence != self._lost:
            self.notify(sentence, severity="error", timeout=10)
        self._lost = sentence
        self._take(Status(state="fault", message=sentence))
        self._lost = sentence
