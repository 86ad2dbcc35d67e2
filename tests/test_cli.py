"""The command line: grammar, exit codes, what goes to stdout and what to stderr."""

import errno
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from artemis_edge.cli import main
from artemis_edge.export.ply import bare_mesh, read_mesh, write_ply
from artemis_edge.session.writer import SessionWriter


@pytest.fixture
def square(tmp_path: Path) -> Path:
    corners = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], np.float32)
    write_ply(tmp_path / "mesh.ply", bare_mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32)))
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "required: COMMAND"),
        (["fly"], "invalid choice: 'fly'"),
        (["reprocess"], "required: INPUT, --out"),
        (["reprocess", "x", "--out", "y", "--frames", "7"], "'7' is not A:B"),
        (["reprocess", "x", "--out", "y", "--frames", "9:3"], "'9:3' is not A:B"),
        (["reprocess", "x", "--out", "y", "--holdout", "1"], "'1' is not a whole number of 2 or more"),
        (["reprocess", "x", "--out", "y", "--poses", "p", "--no-poses"], "not allowed with"),
        (["evaluate"], "required: KIND"),
        (["export", "m", "--format", "stl", "--out", "o"], "invalid choice: 'stl'"),
    ],
)
def test_usage_errors_are_one_line_with_help(
    arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert sentence in told.err
    assert "--help'" in told.err


def test_help_and_version_end_well(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    listed = capsys.readouterr().out
    for command in (
        "demo",
        "simulate",
        "reprocess",
        "evaluate",
        "bench",
        "render",
        "export",
        "check",
        "session",
    ):
        assert command in listed
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("artemis-edge ")


@pytest.mark.parametrize(
    ("error", "code", "sentence"),
    [
        (MemoryError(), 1, "not enough memory"),
        (OSError(errno.ENOSPC, "No space left on device", "/disk/x"), 1, "/disk/x: the disk is full"),
        (PermissionError(errno.EACCES, "Permission denied", "/x"), 1, "/x: Permission denied"),
        (KeyboardInterrupt(), 1, "interrupted"),
    ],
)
def test_failures_of_the_machine_are_one_sentence(
    error: BaseException,
    code: int,
    sentence: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("artemis_edge.session.catalog.catalog", fail)
    assert main(["session", "info", "x"]) == code
    told = capsys.readouterr()
    assert sentence in told.err
    assert told.err.count("\n") == 1
    assert told.out == ""


def _system_error(cause: BaseException | None) -> SystemError:
    error = SystemError("kernel returned a result with an exception set")
    error.__cause__ = cause
    return error


def test_an_interrupt_inside_a_kernel_is_an_interrupt(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    raised = _system_error(None)

    def fail(*_: object) -> None:
        raise raised

    monkeypatch.setattr("artemis_edge.session.catalog.catalog", fail)
    raised = _system_error(_system_error(KeyboardInterrupt()))
    assert main(["session", "info", "x"]) == 1
    assert "interrupted" in capsys.readouterr().err
    raised = _system_error(ValueError("a fault of ours"))
    with pytest.raises(SystemError):
        main(["session", "info", "x"])


def test_reader_that_leaves_ends_quietly(kitti: Path) -> None:
    command = [sys.executable, "-m", "artemis_edge.cli", "session", "info", str(kitti)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 1


def test_evaluate_mesh_prints_one_json_object(square: Path, capsys: pytest.CaptureFixture[str]) -> None:
    heatmap = square / "heat.png"
    arguments = ["evaluate", "mesh", str(square), "--reference", str(square / "mesh.ply"), "--json"]
    assert main([*arguments, "--threshold", "0.5", "--threshold", "1", "--heatmap", str(heatmap)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found["thresholds"]) == {"0.5", "1"}
    assert heatmap.read_bytes().startswith(b"\x89PNG")


def test_evaluate_trajectory_of_itself(kitti: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses = str(kitti.parents[1] / "poses.tum")
    assert main(["evaluate", "trajectory", poses, "--reference", poses, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ate_rmse_m"] < 1e-9
    assert main(["evaluate", "trajectory", poses, "--reference", poses]) == 0
    assert "10 poses paired" in capsys.readouterr().out


def test_export_writes_both_formats(square: Path) -> None:
    for form in ("ply", "glb"):
        out = square / f"copy.{form}"
        assert main(["export", str(square), "--format", form, "--out", str(out)]) == 0
        assert out.stat().st_size > 100
    assert np.array_equal(read_mesh(square / "copy.ply").faces, read_mesh(square / "mesh.ply").faces)


def test_render_draws_the_map(square: Path) -> None:
    picture, depth = square / "view.png", square / "depth.npy"
    pose = "1 1 -2 0 0 0 1"
    intrinsics = "40 30 20 20 19.5 14.5"
    arguments = ["render", str(square), "--pose", pose, "--intrinsics", intrinsics]
    assert main([*arguments, "--out", str(picture), "--depth", str(depth)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert np.load(depth)[15, 20] == pytest.approx(2.0)


def test_check_says_what_is_wrong_with_a_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ready"] is True
    bad = tmp_path / "bad.toml"
    bad.write_text("[voxel_map]\nvoxel_m = 900.0\n")
    assert main(["check", "--config", str(bad)]) == 1
    assert "fail  configuration" in capsys.readouterr().out


def test_session_info_counts_messages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = np.ones((5, 3), np.float32)
    with SessionWriter(tmp_path / "s.mcap") as out:
        for k in range(11):
            out.write_points(10**9 + k * 10**8, points)
            out.write_imu(10**9 + k * 10**8, np.zeros(3), np.array([0, 0, 9.81]))
    assert main(["session", "info", str(tmp_path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["frames"] == 11
    assert found["duration_s"] == pytest.approx(1.0)
    assert [topic["messages"] for topic in found["topics"]] == [11, 11]
    assert found["topics"][0]["hz"] == pytest.approx(10.0)
    assert main(["session", "info", str(tmp_path)]) == 0
    assert "11 LiDAR frames, without poses" in capsys.readouterr().out


def test_session_info_of_a_recording_without_lidar(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with SessionWriter(tmp_path / "s.mcap") as out:
        out.write_imu(10**9, np.zeros(3), np.array([0, 0, 9.81]))
    assert main(["session", "info", str(tmp_path / "s.mcap")]) == 0
    assert "cannot be mapped:" in capsys.readouterr().out


def test_session_info_of_a_data_set(kitti: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["session", "info", str(kitti)]) == 0
    told = capsys.readouterr().out
    assert "0.9 s" in told
    assert "10 LiDAR frames" in told


@pytest.mark.parametrize(
    ("words", "instead"),
    [(["tui"], "'artemis-edge view'"), (["demo", "--tui", "--out", "made"], "leave --tui out")],
)
def test_without_a_terminal_it_is_said_what_else_there_is(
    words: list[str],
    instead: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "needs a terminal" in said and instead in said and ("--tui" in said) == ("--tui" in words)
    assert not list(tmp_path.iterdir())


def test_a_world_that_is_not_there_leaves_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", "atlantis", "--out", str(tmp_path / "a" / "b")]) == 2
    assert "atlantis" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_simulate_writes_a_session(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "walk"
    arguments = ["simulate", "corridor", "--seconds", "0.3", "--out", str(out), "--set", "density=0.05"]
    quick = ["--set", "camera=off", "--set", "reach_m=30", "--set", "reference=off"]
    assert main([*arguments, *quick]) == 0
    assert "3 frames" in capsys.readouterr().out
    assert (out / "truth" / "trajectory.tum").is_file()
    assert main([*arguments, "--set", "speed"]) == 2
    assert "write it as key=value" in capsys.readouterr().err


def test_warm_up_says_where_the_kernels_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from artemis_edge._jit import cache_dir
    from artemis_edge.session import stream_mapping

    asked = []

    def warm_up(config: object, folder: Path, questions: bool) -> float:
        asked.append((folder.parent.is_dir(), questions))
        return 2.6

    monkeypatch.setattr(stream_mapping, "warm_up", warm_up)
    assert main(["warm-up"]) == 0
    assert asked == [(True, True)]
    assert capsys.readouterr().out == f"ready after 3 s; kept in {cache_dir()}\n"


def test_run_refuses_a_session_that_is_there_before_it_waits_for_devices(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk" / "session_000.mcap").write_bytes(b"something")
    rig = tmp_path / "rig.toml"
    rig.write_text("[[lidar]]\navia = {}\n")
    for taken in (tmp_path / "walk", rig):
        assert main(["run", "--config", str(rig), "--session", str(taken)]) == 2
        assert "is there already" in capsys.readouterr().err
