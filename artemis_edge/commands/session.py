"""``artemis-edge session``: look into recordings, judge, repair and cut them."""

from __future__ import annotations

import argparse
import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from artemis_edge.commands.common import DONE, FELL_SHORT, command, json_option, print_json
from artemis_edge.errors import InputError, RunError

_SECOND_NS = 1_000_000_000


def add(commands: Any) -> None:
    """Declare the actions."""
    group = commands.add_parser("session", help="look into recordings, judge, repair and cut them")
    kinds = group.add_subparsers(title="actions", metavar="ACTION", required=True)
    listing = command(kinds, "list", run_list, "recordings in a folder")
    listing.add_argument(
        "folder", type=Path, nargs="?", default=Path(), metavar="FOLDER", help="default: here"
    )
    json_option(listing)
    info = command(kinds, "info", run_info, "topics, counts and duration of a recording")
    info.add_argument("session", type=Path, metavar="SESSION", help="a session, a bag or a data set")
    json_option(info)
    verify = command(kinds, "verify", run_verify, "read every byte of a recording and say what is damaged")
    verify.add_argument("session", type=Path, metavar="SESSION", help="a session (folder or .mcap)")
    json_option(verify)
    recover = command(kinds, "recover", run_recover, "a complete copy of a recording that was cut off")
    recover.add_argument(
        "session", type=Path, metavar="SESSION", help="a session (folder or .mcap); only read"
    )
    recover.add_argument("--out", type=Path, metavar="PATH", help="default: SESSION_recovered beside it")
    json_option(recover)
    trim = command(kinds, "trim", run_trim, "a copy of a part of a recording")
    trim.add_argument("session", type=Path, metavar="SESSION", help="a session (folder or .mcap); only read")
    trim.add_argument(
        "--from", type=float, default=0.0, dest="start", metavar="SECONDS", help="since its beginning"
    )
    trim.add_argument(
        "--to", type=float, default=math.inf, dest="stop", metavar="SECONDS", help="default: its end"
    )
    trim.add_argument(
        "--out", type=Path, required=True, metavar="PATH", help="as SESSION: a folder or a .mcap"
    )
    json_option(trim)


def run_list(given: argparse.Namespace) -> int:
    """``artemis-edge session list``."""
    from artemis_edge.session import catalog
    from artemis_edge.session.verify import sessions_in

    cards = [catalog.card(path) for path in sessions_in(given.folder)]
    if given.json:
        print_json({"sessions": cards})
        return DONE
    for card in cards:
        print(f"{card['name']:<28} {card['recorded']}  {card['problem'] or _in_short(card)}")
    if not cards:
        print(f"no recordings in {given.folder}")
    return DONE


def _in_short(card: dict[str, Any]) -> str:
    damage = ", ".join(f"{count} {reason}" for reason, count in sorted(card["lost"].items()))
    told = f"  damaged ({damage}): session recover makes a copy" if damage else ""
    return f"{card['duration_s']:8.1f} s  {card['bytes'] / 1e6:9.1f} MB{told}"


def run_info(given: argparse.Namespace) -> int:
    """``artemis-edge session info``."""
    from artemis_edge.session import catalog

    found = catalog.catalog(given.session)
    if given.json:
        print_json(found.to_json())
    else:
        print(catalog.to_text(found))
    return DONE


def run_verify(given: argparse.Namespace) -> int:
    """``artemis-edge session verify``."""
    from artemis_edge.session.verify import verify

    verdicts = verify(given.session)
    good = not any(verdict.problems for verdict in verdicts)
    if given.json:
        print_json({"good": good, "files": [verdict.to_json() for verdict in verdicts]})
        return DONE if good else FELL_SHORT
    for verdict in verdicts:
        print(
            f"{verdict.path}: {verdict.messages} messages in {verdict.chunks} chunks, {verdict.bytes / 1e6:.1f} MB"
        )
        for problem in verdict.problems:
            print(f"  {problem}")
    print("complete, nothing is damaged" if good else "see above")
    return DONE if good else FELL_SHORT


def run_recover(given: argparse.Namespace) -> int:
    """``artemis-edge session recover``."""
    from artemis_edge.session.recover import SUFFIX, faults, recover
    from artemis_edge.session.verify import verify

    source = _existing(given.session)
    out = given.out or source.with_name(f"{source.stem}{SUFFIX}{source.suffix}")
    whole = set[Path]()
    if source.is_file():
        reports = [recover(source, out)]
    else:
        whole = {verdict.path for verdict in verify(source) if not verdict.problems}
        with _new_folder(out):
            for file in sorted(whole):
                _link(file, out / file.name)
            others = [file for file in sorted(source.glob("*.mcap")) if file not in whole]
            reports = [recover(file, out / file.name) for file in others]
    if not whole and not any(report.messages for report in reports):
        _take_back(reports, out)
        raise RunError(f"no message of {source} is whole; there is nothing to recover")
    if given.json:
        print_json({"out": str(out), "files": [_copied(report) for report in reports]})
        return DONE
    for report in reports:
        of = f" of the {report.recorded}" if report.recorded > report.messages else ""
        print(f"{report.messages}{of} messages of {report.source} are in {report.copy}")
        for problem in faults(report):
            print(f"  {problem}")
    print(f"{out}: can be read to its end")
    return DONE


def _take_back(reports: list[Any], out: Path) -> None:
    for report in reports:
        report.copy.unlink()
    if out.is_dir():
        out.rmdir()


def run_trim(given: argparse.Namespace) -> int:
    """``artemis-edge session trim``."""
    from artemis_edge.session.recover import faults, trim
    from artemis_edge.session.verify import verify

    source = _existing(given.session)
    if not 0.0 <= given.start < given.stop:
        raise InputError(f"--from {given.start:g} --to {given.stop:g}: give 0 <= from < to, in seconds")
    verdicts = verify(source)
    first = min((verdict.first_ns for verdict in verdicts if verdict.messages), default=0)
    start = first + _nanoseconds(given.start)
    stop = first + _nanoseconds(given.stop)
    if start > max(verdict.last_ns for verdict in verdicts):
        raise InputError(f"--from {given.start:g}: {source} is shorter than that")
    if source.is_file():
        reports = [trim(source, given.out, start, stop)]
    else:
        kept = [verdict for verdict in verdicts if verdict.last_ns >= start and verdict.first_ns < stop]
        with _new_folder(given.out):
            reports = [trim(verdict.path, given.out / verdict.path.name, start, stop) for verdict in kept]
    problems = [problem for report in reports for problem in faults(report)]
    if given.json:
        print_json({"out": str(given.out), "files": [_copied(report) for report in reports]})
    else:
        print(f"{given.out}: {sum(report.messages for report in reports)} messages")
        for problem in problems:
            print(f"  missing: {problem}")
    return FELL_SHORT if problems else DONE


def _nanoseconds(seconds: float) -> int:
    """Seconds of any size, infinite ones too, as an integer beyond which no recording goes."""
    return round(min(seconds * _SECOND_NS, float(1 << 62)))


def _copied(report: Any) -> dict[str, Any]:
    return {
        "source": str(report.source),
        "copy": str(report.copy),
        "was_complete": report.finished,
        "messages": report.messages,
        "recorded": report.recorded,
        "chunks": report.chunks,
        "attachments": report.attachments,
        "torn_bytes": report.torn_bytes,
        "damaged": report.damaged,
        "lost": report.lost,
    }


def _existing(path: Path) -> Path:
    if not path.exists():
        raise InputError(f"there is no {path}; give a session, a folder or a .mcap file")
    return path


@contextmanager
def _new_folder(path: Path) -> Iterator[None]:
    """Made, and gone again where an error leaves nothing in it."""
    from artemis_edge.session.results import preparing

    if path.exists():
        raise InputError(f"{path} is there already; remove it or give another --out")
    with preparing(path):
        yield


def _link(source: Path, copy: Path) -> None:
    """The same file under another name where the disk can do that, else a copy."""
    try:
        os.link(source, copy)
    except OSError:
        shutil.copy2(source, copy)
