"""Several recordings in one call: processes side by side, a cluster whose workers are threads here, and errors.

A cluster of processes of which one is killed is in tests/soak/test_cluster.py.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import threading
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from artemis_edge import batch, batch_child, cluster, orphans
from artemis_edge.batch_child import Child, Done, Task
from artemis_edge.cli import main
from artemis_edge.config import load
from artemis_edge.errors import InputError, RunError
from artemis_edge.runtime import Request
from tests.waiting import until

REPORT = {"frames": 3}


def _requests(folder: Path, count: int = 4) -> list[Request]:
    found = []
    for k in range(count):
        (folder / f"walk{k}").mkdir(parents=True)
        found.append(Request(folder / f"walk{k}", folder / "out" / f"walk{k}"))
    return found


class FakeChild:
    """Does in a moment what a process does in minutes; walk1 is no recording, walk2 waits to be stopped."""

    def __init__(self, task: Task) -> None:
        self.task, self.progress = task, (1, 4, "")
        self.result: Done | None = None
        name = Path(task.input).name
        if name == "walk1":
            self.result = Done(error="walk1 is no recording", code=2)
        elif name != "waits":
            self.result = Done({**REPORT, "input": task.input}, ("an image is damaged",))

    def stop(self) -> None:
        self.result = Done(error="interrupted after 1 of 4 frames", code=1)

    def kill(self) -> None:
        self.stop()


def test_a_request_survives_as_text(tmp_path: Path) -> None:
    config = load(sets=["voxel_map.voxel_m=0.3", "exclusion.boxes=[[0,0,0,1,1,1]]"])
    whole = Request(
        tmp_path / "a", tmp_path / "b", config, tmp_path / "p.tum", True, 3, 9, 4, ("red car", "tree"), "net",
        tmp_path / "map",
    )  # fmt: skip
    bare = Request(tmp_path / "a", tmp_path / "b")
    same = [f.name for f in fields(Request) if getattr(whole, f.name) == getattr(bare, f.name)]
    assert same == ["input", "out"], "every field is tried"
    for request in (whole, Request(tmp_path / "a", tmp_path / "b")):
        task = Task.of(request)
        assert task.request() == request


@pytest.mark.parametrize("jobs", [2, 4])
def test_side_by_side_all_are_done_and_errors_are_told(
    jobs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(batch, "Child", FakeChild)
    requests = _requests(tmp_path)
    with pytest.raises(RunError, match="1 of 4 inputs failed"):
        batch.run_all(requests, True, jobs)
    told = capsys.readouterr().err
    assert "walk1 is no recording" in told and told.count("an image is damaged") == 3
    good = [requests[k] for k in (0, 2, 3)]
    assert [m.report["input"] for m in batch.run_all(good, True, jobs)] == [str(r.input) for r in good]


def test_an_interrupt_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C reaches the children of a terminal by itself; the second one ends them."""
    monkeypatch.setattr(batch, "Child", FakeChild)
    (tmp_path / "waits").mkdir()
    requests = [Request(tmp_path / "waits", tmp_path / "o"), *_requests(tmp_path, 2)]
    looks = iter(range(100))

    def sleep(_: float) -> None:
        if next(looks) in (2, 4):
            raise KeyboardInterrupt

    monkeypatch.setattr(batch.time, "sleep", sleep)
    done = batch._side_by_side(requests, True, 1)
    assert done[0].error.startswith("interrupted after") and done[2].error == "interrupted before it began"


def test_as_many_as_cores_and_memory_allow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    requests = _requests(tmp_path)
    monkeypatch.setattr(batch.health, "processors", lambda: 8)
    for free_mb, expected in ((100.0, 1), (4500.0, 2), (90_000.0, 4)):
        monkeypatch.setattr(batch.health, "available_memory_mb", lambda free_mb=free_mb: free_mb)
        assert batch.fitting(requests) == expected
    assert batch.overall([1.0, 0.5, 0.0, 0.0]) == (150, 400, "1 of 4 done")


def test_a_process_tells_its_error(tmp_path: Path) -> None:
    child = Child(Task.of(Request(tmp_path / "nothing", tmp_path / "out")))
    assert until(lambda: child.result is not None, 60.0)
    assert child.result is not None and child.result.code == 2
    assert "there is no" in str(child.result.fault()) and isinstance(child.result.fault(), InputError)


def test_a_process_that_is_killed_is_told(tmp_path: Path) -> None:
    child = Child(Task.of(Request(tmp_path / "nothing", tmp_path / "out")))
    child.kill()
    assert until(lambda: child.result is not None, 20.0)
    assert child.result is not None and "ended by signal 9" in child.result.error


def test_a_process_whose_parent_died_while_it_began_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[int] = []
    monkeypatch.setattr(orphans.os, "kill", lambda pid, number: sent.append(number))
    monkeypatch.setattr(orphans.ctypes, "CDLL", lambda _: SimpleNamespace(prctl=lambda *_: 0))
    orphans.end_with_the_parent(9, os.getppid())
    assert sent == []
    orphans.end_with_the_parent(9, os.getppid() + 1)
    assert sent == [9]


def test_what_a_killed_run_left_is_cleared(tmp_path: Path) -> None:
    (tmp_path / ".scratch-abc").mkdir()
    (tmp_path / ".map.123.part").mkdir()
    (tmp_path / ".mesh.ply.123.part").write_text("half")
    (tmp_path / "mesh.ply").write_text("whole")
    batch_child._clear(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mesh.ply"]


# --- a cluster


@pytest.fixture(scope="module")
def dask() -> Iterator[Any]:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=":0", protocol="tcp"
    ) as made:
        yield made


def test_a_cluster_does_the_same(
    dask: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cluster, "Child", FakeChild)
    monkeypatch.setattr(cluster, "_LOOK_S", 0.02)
    requests = _requests(tmp_path)
    done = cluster.on_cluster(dask.scheduler_address, requests, True)
    assert [bool(d.error) for d in done] == [False, True, False, False]
    assert done[3].report["input"] == str(requests[3].input) and done[1].code == 2
    told = capsys.readouterr().err
    assert "400 of 400, 4 of 4 done" in told and "walk1: walk1 is no recording" in told
    assert "done again" not in told
    assert [request.out.is_dir() for request in requests] == [True, False, True, True]


def test_an_interrupt_reaches_the_workers(
    dask: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cluster, "Child", FakeChild)
    monkeypatch.setattr(cluster, "_LOOK_S", 0.02)
    monkeypatch.setattr(cluster, "_TOLD_S", 0.05)
    (tmp_path / "waits").mkdir()
    main_thread = threading.main_thread()
    asked = []

    class Interrupted(cluster.Batch):
        def look(self) -> None:
            super().look()
            if self.shares[0] > 0.0 and not asked and threading.current_thread() is main_thread:
                asked.append(True)
                raise KeyboardInterrupt

    monkeypatch.setattr(cluster, "Batch", Interrupted)
    (done,) = cluster.on_cluster(dask.scheduler_address, [Request(tmp_path / "waits", tmp_path / "o")], True)
    assert "done again" not in capsys.readouterr().err, "although it told of its progress"
    assert done.error == "interrupted after 1 of 4 frames"


def test_what_is_wrong_with_a_cluster(dask: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    requests = _requests(tmp_path, 1)
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.3)
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1; start one"):
        cluster.on_cluster("tcp://127.0.0.1:1", requests, True)
    with pytest.raises(InputError, match="no Dask scheduler answers at nowhere"):
        cluster.on_cluster("nowhere", requests, True)
    monkeypatch.setattr(cluster, "_CONNECT_S", 10.0)
    with pytest.raises(InputError, match=r"does not see .*missing; give paths"):
        cluster.on_cluster(dask.scheduler_address, [Request(tmp_path / "missing", tmp_path / "o")], True)
    for name in ("poses", "go_on"):
        here = Request(requests[0].input, tmp_path / "o" / "deep", **{name: tmp_path / "absent"})
        with pytest.raises(InputError, match=r"does not see .*absent; give paths"):
            cluster.on_cluster(dask.scheduler_address, [here], True)
    assert not (tmp_path / "o").exists(), "nothing is left of what was prepared"
    monkeypatch.setattr(cluster, "_look", lambda paths: ("0.0.1", []))
    with pytest.raises(InputError, match=r"has artemis-edge 0\.0\.1, this is"):
        cluster.on_cluster(dask.scheduler_address, requests, True)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match="needs the extra 'cluster'"):
        cluster.on_cluster(dask.scheduler_address, requests, True)


def test_nothing_of_dask_is_needed_until_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    importlib.reload(cluster)
    assert main(["reprocess", "--help"]) == 0


def test_the_command_takes_jobs_and_cluster(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        cluster, "on_cluster", lambda address, requests, plain: [Done(REPORT)] * len(requests)
    )
    words = ["reprocess", "a", "b", "--out", str(tmp_path), "--cluster", "tcp://x:1", "--json"]
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["runs"] == {
        str(tmp_path / "a"): REPORT, str(tmp_path / "b"): REPORT,
    }  # fmt: skip
    assert main([*words[:5], "--jobs", "0"]) == 2
    assert "whole number of 1 or more" in capsys.readouterr().err
