"""The compiler works in another process, once for a kind of input."""

from pathlib import Path

import pytest

from artemis_edge import compile_ahead
from artemis_edge.datasets import open_input
from artemis_edge.runtime import Request
from tests.test_runtime import poses_of


class Child:
    """A process that only says how it ended."""

    started = 0
    exitcode = 0

    def __init__(self, **_: object) -> None: ...

    def start(self) -> None:
        type(self).started += 1

    def join(self) -> None: ...


@pytest.fixture
def child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> type[Child]:
    class Fresh(Child):
        pass

    class Context:
        Process = Fresh

    monkeypatch.setattr(compile_ahead, "cache_dir", lambda: tmp_path / "cache")
    monkeypatch.setattr(compile_ahead.multiprocessing, "get_context", lambda _: Context)
    return Fresh


def test_a_kind_of_input_is_compiled_for_once(child: type[Child], kitti: Path, tmp_path: Path) -> None:
    source = open_input(kitti)
    given, own = (Request(kitti, tmp_path / "out", poses=p) for p in (poses_of(kitti), None))
    for request, count in ((given, 1), (given, 1), (own, 3), (own, 3)):
        compile_ahead.compile_ahead(request, source, range(10))
        assert child.started == count


def test_what_failed_is_tried_again(child: type[Child], kitti: Path, tmp_path: Path) -> None:
    child.exitcode = 1
    for count in (2, 4):  # the odometry and the map
        compile_ahead.compile_ahead(Request(kitti, tmp_path / "out"), open_input(kitti), range(10))
        assert child.started == count


@pytest.mark.parametrize("part", [compile_ahead.MAP, compile_ahead.ODOMETRY])
@pytest.mark.parametrize("own", [False, True])
def test_the_child_leaves_its_cache_only(
    kitti: Path, tmp_path: Path, part: str, own: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses = None if own else poses_of(kitti)
    monkeypatch.setattr(compile_ahead.os, "nice", lambda _: 0)
    compile_ahead._compile(Request(kitti, tmp_path / "out", poses=poses, stop=1), part)
    assert not (tmp_path / "out").exists()


def test_the_child_leaves_faults_to_the_run(tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        compile_ahead._compile(Request(tmp_path / "nothing", tmp_path / "out"), compile_ahead.MAP)
