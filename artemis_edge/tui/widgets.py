"""The parts of the live page. Each shows one part of a Status and keeps nothing else."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from rich.color import Color
from rich.segment import Segment
from rich.style import Style
from rich.text import Text
from textual.coordinate import Coordinate
from textual.geometry import Region
from textual.strip import Strip
from textual.widget import Widget
from textual.widgets import DataTable, Static
from textual.widgets.data_table import ColumnKey

from artemis_edge.frames import U8
from artemis_edge.status import QueryStatus, Status, Stream
from artemis_edge.tui.picture import luminance_text

BUDGET_MS = 100.0  # a frame of a LiDAR at 10 Hz
_BARS = "▁▂▃▄▅▆▇█"
_HALF = "▀"
_WIDE = 45  # characters of a table that has room for reasons
_STYLES = 1 << 14  # pairs of colours remembered: a picture has some hundred, the next one much the same
_LOW_MINUTES, _LEAST_MINUTES = 15.0, 5.0


class MeshPicture(Widget):
    """A picture in half blocks: every character is two pixels, one above the other."""

    DEFAULT_CSS = "MeshPicture { height: 1fr; min-height: 6; background: #0c0e14; }"
    spacing_m = 0.0  # of vertices, where a pixel is finer than that

    def __init__(self, colour: bool = True, id: str | None = None) -> None:
        super().__init__(id=id)
        self._colour = colour
        self._lines: list[Strip] = []
        self._shown: U8 = np.empty((0, 0, 3), np.uint8)
        self._said: tuple[str, str] = ("", "")
        self.caption = ""
        self.message = ""

    @property
    def pixels(self) -> tuple[int, int]:
        """Width and height that fill the widget."""
        return max(self.size.width, 1), max(self.size.height, 1) * 2

    def show(self, image: U8) -> None:
        """Take over a picture uint8 (h, w, 3), h is even; only lines that have changed are drawn again."""
        shown, said = self._shown, (self.caption, self.message)
        changed = np.ones(len(image) // 2, np.bool_)
        if shown.shape == image.shape and said == self._said:
            changed = (image != shown).reshape(len(changed), -1).any(axis=1)
        self._shown, self._said = image, said
        rows = np.flatnonzero(changed).tolist()
        if len(rows) == len(changed):
            self._lines = self._drawn(image, rows)
            self.refresh()
            return
        for row, line in zip(rows, self._drawn(image, rows), strict=True):
            self._lines[row] = line
            self.refresh(Region(0, row, self.size.width, 1))

    def _drawn(self, image: U8, rows: Sequence[int]) -> list[Strip]:
        """Lines of characters, each of two rows of pixels."""
        if self._colour:
            return [_strip(image[2 * r], image[2 * r + 1]) for r in rows]
        pairs = image[: len(image) // 2 * 2].reshape(-1, 2, *image.shape[1:])[rows]
        text = luminance_text(pairs.reshape(-1, *image.shape[1:]))
        return [Strip([Segment(line)]) for line in text]

    def render_line(self, y: int) -> Strip:
        """One line of characters."""
        if y == 0 and self.caption:
            return Strip([Segment(f" {self.caption} ", Style(bold=True, reverse=True))]).adjust_cell_length(
                self.size.width
            )
        if self.message and (told := self._told(y)):
            style = Style(color="white", bold=True)
            return Strip([Segment(told.center(self.size.width), style)]).adjust_cell_length(self.size.width)
        line = self._lines[y] if y < len(self._lines) else Strip.blank(self.size.width)
        return line.adjust_cell_length(self.size.width)

    def _told(self, y: int) -> str:
        """The line of the message at ``y``: it stands in the middle."""
        lines = textwrap.wrap(self.message, max(self.size.width - 4, 10))
        row = y - (self.size.height - len(lines)) // 2
        return lines[row] if 0 <= row < len(lines) else ""


def _strip(top: U8, bottom: U8) -> Strip:
    """Runs of equal colours become one segment: a line is some tens of them, not hundreds."""
    pair = np.concatenate((top, bottom), axis=1).astype(np.int64)
    ends = np.flatnonzero(np.concatenate(((pair[1:] != pair[:-1]).any(axis=1), [True]))) + 1
    lengths = np.diff(ends, prepend=0).tolist()
    segments = [
        Segment((" " if colours[:3] == colours[3:] else _HALF) * length, _style(tuple(colours)))
        for colours, length in zip(pair[ends - 1].tolist(), lengths, strict=True)
    ]
    return Strip(segments, len(pair))


@lru_cache(_STYLES)
def _style(colours: tuple[int, ...]) -> Style:
    """Of a half block: red, green, blue above and below. A style that is met again knows its escape codes."""
    return Style.from_color(Color.from_rgb(*colours[:3]), Color.from_rgb(*colours[3:]))


class Sentence(Static):
    """Text that is drawn again only where it says something else: to lay out and draw a page takes milliseconds."""

    fixed_size = True
    _latest = Text("")

    def tell(self, text: Text) -> None:
        """Show ``text``; with ``fixed_size`` the page stays laid out as it is."""
        if not _same(text, self._latest):
            self._latest = text
            self.update(text, layout=not self.fixed_size)


class Rows(DataTable[Text]):
    """A table of which only those cells are drawn again that have changed."""

    _filled: Sequence[tuple[str, list[Text]]] = ()

    def fill(self, rows: Sequence[tuple[str, list[Text]]]) -> None:
        """Show rows: a key and the cells of each."""
        before, self._filled = self._filled, rows
        if [key for key, _ in before] != [key for key, _ in rows]:
            self.clear()
            for key, cells in rows:
                self.add_row(*cells, key=key)
            return
        for r, ((_, old), (_, new)) in enumerate(zip(before, rows, strict=True)):
            for c, (was, cell) in enumerate(zip(old, new, strict=True)):
                if not _same(was, cell):
                    self.update_cell_at(Coordinate(r, c), cell)


def _same(a: Text, b: Text) -> bool:
    """Rich does not compare the style of the whole."""
    return a == b and a.style == b.style


class FrameTimes(Sentence):
    """A sparkline of the latest frames' times against the 100 ms line."""

    def show(self, status: Status) -> None:
        """Redraw for a status."""
        self.tell(frame_times(status.frame_ms, max(self.size.width - 22, 10)))


def frame_times(times: list[float], width: int) -> Text:
    """Bars scaled so that a full one is the budget; red above it."""
    latest = times[-width:]
    text = Text()
    for ms in latest:
        level = min(int(ms / BUDGET_MS * (len(_BARS) - 1)), len(_BARS) - 1)
        text.append(
            _BARS[level], style="red" if ms > BUDGET_MS else "yellow" if ms > 0.7 * BUDGET_MS else "green"
        )
    if not latest:
        return Text("no frame yet", style="dim")
    middle, worst = float(np.median(latest)), max(latest)
    text.append(f" {middle:.0f} ms, at most {worst:.0f}", style="bold red" if worst > BUDGET_MS else "")
    return text


class Streams(Rows):
    """One row a sensor: rate, losses, state; what is wrong is told below (``Advice``)."""

    DEFAULT_CSS = "Streams { overflow-x: hidden; }"

    def on_mount(self) -> None:
        """Columns: 35 characters, what is left of 80 beside the picture."""
        self.cursor_type = "none"
        self.show_cursor = False
        self.zebra_stripes = False
        self.cell_padding = 0
        for title, width in (("sensor", 10), ("Hz", 11), ("lost", 6), ("state", 8)):
            self.add_column(title, key=title, width=width)

    def show(self, status: Status) -> None:
        """Redraw for a status."""
        self.fill([(s.name, _stream_cells(s)) for s in status.streams])


def _stream_cells(s: Stream) -> list[Text]:
    slow = s.expected_hz > 0.0 and s.hz < 0.8 * s.expected_hz
    bad = s.state in ("failed", "silent")
    style = "bold red" if bad else "yellow" if slow or s.lost else "green"
    return [
        Text(s.name),
        Text(f"{short(s.hz)}/{short(s.expected_hz)}" if s.expected_hz else short(s.hz), style=style),
        Text(short(s.lost), style="yellow" if s.lost else "dim"),
        Text(s.state, style=style),
    ]


def short(number: float) -> str:
    """At most five characters: 240000 as 240k."""
    for unit, value in (("", number), ("k", number / 1e3), ("M", number / 1e6)):
        if value < 9999.5 or unit == "M":
            return f"{value:.0f}{unit}"
    raise AssertionError("the last unit takes everything")


class Queries(Rows):
    """The live questions: colour, count, best score; Enter goes to the next of its objects."""

    DEFAULT_CSS = "Queries { overflow-x: hidden; }"
    _FIXED = (("", 2), ("query", 13), ("n", 3), ("best", 5))  # what is left is for the status

    def __init__(self, id: str | None = None) -> None:
        super().__init__(id=id, cursor_type="row", cell_padding=0, cursor_foreground_priority="renderable")

    def on_mount(self) -> None:
        """Columns."""
        for title, width in self._FIXED:
            self.add_column(title, key=title or "colour", width=width)
        self.add_column("status", key="status", width=12)

    def on_resize(self) -> None:
        """The query and the status share what a wider terminal gives."""
        more = max(self.size.width - sum(width for _, width in self._FIXED) - 12, 0)
        for key, width in (("query", 13 + more // 3), ("status", 12 + more - more // 3)):
            self.columns[ColumnKey(key)].width = width
        self.refresh(layout=True)

    def show(self, queries: list[QueryStatus]) -> None:
        """Redraw, the cursor stays where it is."""
        row = self.cursor_row
        self.fill([(q.text, self._cells(q)) for q in queries])
        if queries and self.cursor_row != (kept := min(row, len(queries) - 1)):
            self.move_cursor(row=kept)

    def _cells(self, q: QueryStatus) -> list[Text]:
        found = q.count > 0
        return [
            Text("██", style=f"rgb({q.colour[0]},{q.colour[1]},{q.colour[2]})"),
            Text(f" {q.text}"),
            Text(str(q.count), style="bold" if found else "dim"),
            Text(f"{q.score:.2f}" if q.score > 0.0 else "-"),
            Text(
                f"{q.status}: {q.note}" if q.note and self.size.width > _WIDE else q.status,
                style="green" if found else "dim",
            ),
        ]


class Gauges(Sentence):
    """State, time, map, disk and battery in two lines."""

    def show(self, status: Status) -> None:
        """Redraw for a status."""
        self.tell(gauges(status))


def gauges(status: Status) -> Text:
    """Two lines that fit 78 columns."""
    styles = {"recording": "bold white on red", "fault": "bold white on red", "saving": "black on yellow"}
    text = Text()
    text.append(f" {status.state.upper()} ", style=styles.get(status.state, "reverse"))
    minutes, seconds = divmod(int(status.seconds), 60)
    text.append(f" {minutes:02d}:{seconds:02d}  ")
    frames = f"{status.frames}/{status.frames_total}" if status.frames_total else str(status.frames)
    text.append(f"frame {frames}  ")
    text.append(f"{status.dropped} dropped  ", style="bold red" if status.dropped else "dim")
    area = f"  {status.map.area_m2:,.0f} m2" if status.map.area_m2 else ""
    text.append(f"{status.map.vertices:,} vertices{area}\n")
    text.append_text(_left("disk", status.disk_minutes))
    text.append_text(_left("battery", status.battery_minutes))
    if status.state != "replaying":  # a recording's clocks were locked when it was made, or not
        text.append_text(_synchronised(status))
    if status.map.resident_mb:
        text.append(f"{status.map.resident_mb:.0f} MB  ")
    if status.segmentation_hz:
        text.append(f"masks {status.segmentation_hz:.1f} Hz  ")
    if status.temperature_c is not None:
        text.append(f"{status.temperature_c:.0f} C  ")
    if status.overload:
        text.append("reduced: " + ", ".join(status.overload), style="yellow")
    return text


def _synchronised(status: Status) -> Text:
    sync = status.sync
    if sync.state == "none":
        return Text("clocks not locked  ", style="dim")
    style = "green" if sync.state == "locked" else "yellow"
    return Text(f"clocks {sync.state} {sync.offset_ms:+.2f} ms  ", style=style)


def _left(name: str, minutes: float | None) -> Text:
    if minutes is None:
        return Text(f"{name} not known  ", style="dim")
    style = "bold red" if minutes < _LEAST_MINUTES else "yellow" if minutes < _LOW_MINUTES else "green"
    return Text(f"{name} {minutes:.0f} min  ", style=style)


class Advice(Sentence):
    """What the operator should know or do now, the gravest first."""

    fixed_size = False

    def show(self, status: Status) -> None:
        """Redraw for a status."""
        self.tell(advice(status))


def advice(status: Status) -> Text:
    """One line each; empty when all is well."""
    text = Text()
    if status.state == "fault":
        text.append(f"{status.message}\n", style="bold red")
    if status.degenerate:
        text.append("few walls in view: the position is held by IMU and camera\n", style="bold yellow")
    for sentence in status.coaching:
        text.append(f"{sentence}\n", style="bold yellow")
    for stream in status.streams:
        if stream.message and stream.state in ("failed", "silent"):
            text.append(f"{stream.name}: {stream.message}\n", style="red")
    for query in status.queries:
        if query.note:
            text.append(f"{query.text}: {query.note}\n", style="dim")
    lost = ", ".join(f"{n} {reason.replace('_', ' ')}" for reason, n in status.losses.items() if n)
    if lost:
        text.append(f"lost so far: {lost}\n", style="yellow")
    if status.state not in ("fault",) and status.message:
        text.append(status.message, style="dim")
    return text
