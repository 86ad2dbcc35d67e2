"""Progress on stderr: a bar on a terminal, otherwise a plain line now and then. Never on stdout."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

_LINE_EVERY_S = 10.0
_BAR_EVERY_S = 0.1


class Report(Protocol):
    """Called with the number done so far, the number in all and a short note; cheap, for every frame."""

    def __call__(self, done: int, total: int, note: str = "") -> None:
        """Say how far the work is."""
        ...


def silent(done: int, total: int, note: str = "") -> None:
    """Report to nobody."""


def say(sentence: str) -> None:
    """One plain line on stderr; where nobody reads it any more (``| tee``, stopped), the work goes on."""
    try:
        print(sentence, file=sys.stderr, flush=True)
    except BrokenPipeError:  # nor may Python try to flush it at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


@contextmanager
def progress(label: str, plain: bool = False) -> Iterator[Report]:
    """A Report for one piece of work: a bar where stderr is a terminal and not ``plain``, else lines."""
    if plain or not sys.stderr.isatty():
        yield _lines(label)
        return
    with _bar(label) as report:
        yield report


def now_and_then(report: Report, every_s: float, last_s: float = -math.inf) -> Report:
    """``report`` called at most every ``every_s`` from ``last_s`` (monotonic) on, and whenever all is done."""

    def seldom(done: int, total: int, note: str = "") -> None:
        nonlocal last_s
        now = time.monotonic()
        if now - last_s >= every_s or done == total:
            last_s = now
            report(done, total, note)

    return seldom


def _lines(label: str) -> Report:
    def line(done: int, total: int, note: str = "") -> None:
        say(f"{label}: {done} of {total}{', ' if note else ''}{note}")

    return now_and_then(line, _LINE_EVERY_S, time.monotonic())


@contextmanager
def _bar(label: str) -> Iterator[Report]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=32),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("[dim]{task.fields[note]}"),
    )
    # No refresh of its own: a thread that draws would be counted in the CPU time of the frames.
    with Progress(*columns, console=Console(stderr=True), auto_refresh=False) as bar:
        task = bar.add_task(label, total=None, note="")

        def draw(done: int, total: int, note: str = "") -> None:
            bar.update(task, completed=done, total=total, note=note, refresh=True)

        yield now_and_then(draw, _BAR_EVERY_S)
