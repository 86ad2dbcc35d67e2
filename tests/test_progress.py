"""What is said while work goes on, and that the work does not depend on a listener."""

import subprocess
import sys

import pytest

from artemis_edge.progress import now_and_then, progress

_WORK = "from artemis_edge.progress import say\nfor k in range(3): say(f'{k}')\nprint('done')"


def test_work_goes_on_when_nobody_reads_what_is_said() -> None:
    work = subprocess.Popen(
        [sys.executable, "-c", _WORK], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert work.stderr is not None and work.stdout is not None
    work.stderr.close()
    assert work.stdout.read() == "done\n"
    work.stdout.close()
    assert work.wait() == 0


def test_lines_come_at_the_end_at_least(capsys: pytest.CaptureFixture[str]) -> None:
    with progress("mapping", plain=True) as report:
        report(1, 2)
        report(2, 2, "almost")
    told = capsys.readouterr()
    assert (told.out, told.err) == ("", "mapping: 2 of 2, almost\n")


def test_now_and_then_means_once_a_while_and_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    now, said = [100.0], list[int]()
    monkeypatch.setattr("artemis_edge.progress.time.monotonic", lambda: now[0])
    report = now_and_then(lambda done, total, note="": said.append(done), 5.0)
    late = now_and_then(lambda done, total, note="": said.append(-done), 5.0, now[0])
    for done in range(1, 13):
        report(done, 12)
        late(done, 12)
        now[0] += 1.0
    assert said == [1, 6, -6, 11, -11, 12, -12]
