"""Checkpoints of a process: when it dies, its copy goes on from there."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from artemis_edge.service.checkpoint import Checkpoints
from tests.waiting import until

# Counts to ten, a line each; a checkpoint after each even number; dies in the ways it is told.
_COUNTER = """
import json, os, signal, sys, time
from artemis_edge.service.checkpoint import Checkpoints

out, deaths = open(sys.argv[1], "a"), json.loads(sys.argv[2])
checkpoints, number = Checkpoints(lambda: print("resumed", file=out, flush=True)), 0

def guard(resumed):
    while resumed:
        resumed = checkpoints.guard_again()

guard(checkpoints.take())
while number < 10:
    if number in checkpoints.fatal:
        out.write(f"skip {number}\\n")
        number += 1
        continue
    checkpoints.working_on(number)
    kind = deaths.get(str(number))
    if kind == "always" or (kind == "once" and checkpoints.deaths == 0):
        out.flush()
        os.kill(os.getpid(), signal.SIGKILL)
    out.write(f"{number}\\n")
    out.flush()
    number += 1
    if number % 2 == 0:
        guard(checkpoints.take())
checkpoints.close()
out.write("end\\n")
out.flush()
"""


def _count(tmp_path: Path, deaths: dict[str, str]) -> list[str]:
    log = tmp_path / "log"
    subprocess.run([sys.executable, "-c", _COUNTER, str(log), json.dumps(deaths)], check=False, timeout=60)
    assert until(lambda: log.exists() and log.read_text().endswith("end\n"), 20.0), log.read_text()
    return log.read_text().split("\n")[:-1]


def test_without_a_death_the_copies_do_nothing(tmp_path: Path) -> None:
    assert _count(tmp_path, {}) == [*map(str, range(10)), "end"]


def test_a_copy_goes_on_from_the_last_checkpoint(tmp_path: Path) -> None:
    lines = _count(tmp_path, {"5": "once"})
    assert lines == ["0", "1", "2", "3", "4", "resumed", "4", "5", "6", "7", "8", "9", "end"]


def test_what_kills_it_twice_is_left_out(tmp_path: Path) -> None:
    lines = _count(tmp_path, {"7": "always"})
    assert lines[-4:] == ["skip 7", "8", "9", "end"]
    assert lines.count("resumed") == 2


def test_closing_ends_the_copy() -> None:
    checkpoints = Checkpoints()
    assert checkpoints.take() is False
    copy = checkpoints._copy
    assert Path(f"/proc/{copy}").exists() and checkpoints.fork_ms > 0
    checkpoints.take()
    assert until(lambda: not Path(f"/proc/{copy}").exists())
    copy = checkpoints._copy
    checkpoints.close()
    assert not Path(f"/proc/{copy}").exists()
