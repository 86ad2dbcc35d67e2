"""Four recordings on two Dask workers of which one is killed, against the same command without a cluster."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import small_session

pytestmark = pytest.mark.skipif(
    "ARTEMIS_CLUSTER" not in os.environ, reason="takes minutes: make cluster-test"
)

_NAMES = ("a", "b", "c", "d")
_PATIENCE_S = 60.0 * float(os.environ.get("ARTEMIS_PATIENCE", "1"))


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler on the loopback address and two workers without a nanny: what is killed stays dead."""
    pytest.importorskip("distributed")
    file = tmp_path / "scheduler.json"
    scheduler = _start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0",
                       "--scheduler-file", str(file), folder=tmp_path)  # fmt: skip
    _wait(lambda: file.exists() and bool(file.read_text().strip()))
    address = json.loads(file.read_text())["address"]
    workers = [
        _start(
            "dask_worker",
            address,
            "--no-nanny",
            "--no-dashboard",
            "--nthreads",
            "1",
            "--name",
            name,
            folder=tmp_path,
        )
        for name in ("first", "second")
    ]
    yield address, workers
    for process in (*workers, scheduler):
        process.kill()
        process.wait()


def _start(module: str, *words: str, folder: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", f"distributed.cli.{module}", *words]
    with (folder / f"{module}-{time.monotonic_ns()}.log").open("wb") as log:
        return subprocess.Popen(command, cwd=folder, stdout=log, stderr=subprocess.STDOUT)


def _wait(condition) -> None:  # type: ignore[no-untyped-def]
    end = time.monotonic() + _PATIENCE_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


def _reprocess(sessions: list[Path], out: Path, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "artemis_edge.cli", "reprocess", *map(str, sessions), "--out", str(out)]
    return subprocess.Popen([*command, *more], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def _contents(folder: Path) -> dict[str, bytes]:
    """All results but the reports, which tell the times of the run."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in files
        if not path.name.startswith("report.")
    }


def test_the_same_bytes_although_a_worker_is_killed(
    dask: tuple[str, list[subprocess.Popen[bytes]]], tmp_path: Path
) -> None:
    address, workers = dask
    sessions = [
        small_session.write(tmp_path / "in" / name, frames=20 + 5 * k, points=3000)
        for k, name in enumerate(_NAMES)
    ]
    alone = _reprocess(sessions, tmp_path / "alone", "--jobs", "1")
    _, told = alone.communicate(timeout=20 * _PATIENCE_S)
    assert alone.returncode == 0, told
    many = _reprocess(sessions, tmp_path / "cluster", "--cluster", address)
    _wait(lambda: len(list((tmp_path / "cluster").glob("*/.scratch-*"))) == 2)
    os.kill(workers[0].pid, signal.SIGKILL)
    _, told = many.communicate(timeout=20 * _PATIENCE_S)
    assert many.returncode == 0, told
    assert "its worker is gone; done again by" in told
    for name in _NAMES:
        expected, found = (_contents(tmp_path / kind / name) for kind in ("alone", "cluster"))
        assert found == expected and len(found) > 6, name
