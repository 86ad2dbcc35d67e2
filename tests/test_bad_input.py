"""Bad input at the command itself: one sentence, the right exit code, no traceback, partial results kept."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from artemis_edge.cli import main
from artemis_edge.session.writer import SessionWriter

pytestmark = pytest.mark.usefixtures("fake_pipeline")


def refused(capsys: pytest.CaptureFixture[str], code: int, *arguments: object) -> str:
    """The one sentence that a command ends with."""
    assert main([str(a) for a in arguments]) == code
    told = capsys.readouterr()
    assert told.out == ""
    sentences = [line for line in told.err.splitlines() if line.startswith("artemis-edge: ")]
    assert len(sentences) == 1, told.err
    assert "Traceback" not in told.err
    return sentences[0]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    rng = np.random.default_rng(2)
    with SessionWriter(tmp_path / "walk.mcap") as out:
        for k in range(20):
            points = rng.uniform(-5, 5, (20_000, 3)).astype(np.float32)
            points[:, 2] = -1.5
            out.write_points(10**9 + k * 10**8, points)
    return tmp_path / "walk.mcap"


@pytest.mark.parametrize("kind", ["missing", "empty folder", "some folder", "text file", "empty file"])
def test_what_is_no_data_set(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = tmp_path / "input"
    if "folder" in kind:
        place.mkdir()
    if kind == "some folder":
        (place / "notes.txt").write_text("hello")
    if "file" in kind:
        place.write_text("hello" if kind == "text file" else "")
    sentence = refused(capsys, 2, "reprocess", place, "--out", tmp_path / "out")
    assert str(place) in sentence
    assert not (tmp_path / "out").exists()


def test_truncated_scan(kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = kitti / "velodyne" / "000004.bin"
    os.truncate(scan, scan.stat().st_size // 2 + 3)
    (kitti / "velodyne" / "000006.bin").write_bytes(b"")
    assert main(["reprocess", str(kitti), "--out", str(tmp_path / "out"), "--json"]) == 0
    told = capsys.readouterr()
    report = json.loads(told.out)
    assert report["frames"] == 9
    assert report["frames_dropped"] == 1
    assert report["lost"]["truncated_file"] == 1
    assert "000004.bin is cut off" in told.err


def test_truncated_recording(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.truncate(recording, recording.stat().st_size * 6 // 10)
    assert main(["reprocess", str(recording), "--out", str(tmp_path / "out"), "--json"]) == 0
    told = capsys.readouterr()
    assert 5 <= json.loads(told.out)["frames"] < 20
    assert "note: " in told.err


@pytest.mark.parametrize("size", [8, 30, 100])
def test_recording_cut_off_in_its_header(
    size: int, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.truncate(recording, size)
    sentence = refused(capsys, 2, "reprocess", recording, "--out", tmp_path / "out")
    assert "is cut off or damaged" in sentence


def test_points_that_are_not_finite(kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = kitti / "velodyne" / "000003.bin"
    values = np.fromfile(scan, np.float32).reshape(-1, 4)
    values[:700, 0], values[700:800, 2] = np.nan, np.inf
    values.tofile(scan)
    assert main(["reprocess", str(kitti), "--out", str(tmp_path / "out"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["lost"]["nan_points"] == 800


def test_nothing_but_nan(kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for scan in (kitti / "velodyne").iterdir():
        np.full((50, 4), np.nan, np.float32).tofile(scan)
    assert main(["reprocess", str(kitti), "--out", str(tmp_path / "out"), "--json"]) in (0, 2)
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        ([(100.0 + 0.1 * k) for k in range(5)], "cover none of the 10 frames"),
        ([0.1 * k for k in range(5)], "do not cover 5 of the 10 frames"),
        ([], "holds no poses"),
    ],
)
def test_poses_that_do_not_cover_the_frames(
    rows: list[float], sentence: str, kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = tmp_path / "few.tum"
    poses.write_text("".join(f"{t} 0 0 0 0 0 0 1\n" for t in rows))
    assert sentence in refused(capsys, 2, "reprocess", kitti, "--poses", poses, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_poses_in_national_coordinates(
    kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = tmp_path / "utm.tum"
    poses.write_text("".join(f"{0.1 * k:.6f} 450000 {5e6 + 0.5 * k} 0 0 0 0 1\n" for k in range(10)))
    sentence = refused(capsys, 2, "reprocess", kitti, "--out", tmp_path / "out", "--poses", poses)
    assert "subtract one offset" in sentence
    assert not (tmp_path / "out").exists()


def test_poses_that_are_not_there(kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("reprocess", kitti, "--poses", tmp_path / "no.tum", "--out", tmp_path / "out")
    assert "cannot read the poses" in refused(capsys, 2, *arguments)


@pytest.mark.parametrize(
    ("option", "value", "sentence"),
    [
        ("--set", "voxel_map.voxel_m", "section.field=value"),
        ("--set", "voxel_map.voxel_m=99", "docs/tuning.md"),
        ("--set", "voxel_map.no_such=1", "no_such"),
        ("--set", "nothing.voxel_m=1", "nothing"),
        ("--profile", "submarine", "no profile named 'submarine'"),
    ],
)
def test_bad_settings(
    option: str, value: str, sentence: str, kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sentence in refused(capsys, 2, "reprocess", kitti, "--out", tmp_path / "out", option, value)


def test_file_without_permission(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plain_open = Path.open

    def refuse(path: Path, *arguments: Any, **options: Any) -> Any:
        if path == recording:  # nothing is unreadable for root: permissions cannot be taken for real
            raise PermissionError(13, "Permission denied", str(path))
        return plain_open(path, *arguments, **options)

    monkeypatch.setattr(Path, "open", refuse)
    assert "Permission denied" in refused(capsys, 2, "reprocess", recording, "--out", tmp_path / "out")


def test_output_that_cannot_be(kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert "is a file" in refused(capsys, 2, "reprocess", kitti, "--out", tmp_path / "file")
    assert "cannot write to" in refused(capsys, 2, "reprocess", kitti, "--out", tmp_path / "file" / "b")


def test_full_disk_keeps_what_fits(
    kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The disk is full when the larger results are written: small ones are there, large ones not at all."""

    def refuse(descriptor: int) -> None:
        if os.fstat(descriptor).st_size > 2000:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", refuse)
    sentence = refused(capsys, 1, "reprocess", kitti, "--out", tmp_path / "out")
    assert "No space left on device; free space" in sentence
    assert "kept in" in sentence
    kept = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"trajectory.tum", "config.toml"} <= kept
    assert "mesh.glb" not in kept
    assert not [name for name in kept if name.startswith(".")]


_LIMITED = """
import resource, sys
from artemis_edge.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
sys.exit(main(sys.argv[1:]))
"""


def test_recording_to_a_disk_that_fills(tmp_path: Path) -> None:
    """The system itself refuses to write on."""
    command = [
        sys.executable,
        "-c",
        _LIMITED,
        "simulate",
        "corridor",
        "--seconds",
        "0.3",
        "--set",
        "camera=off",
    ]
    command += ["--set", "reach_m=30", "--out", str(tmp_path / "walk")]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 1, ended.stderr
    assert "Traceback" not in ended.stderr
    assert ended.stderr.splitlines()[-1].startswith("artemis-edge: ")


@pytest.mark.parametrize(
    "arguments",
    [
        ("evaluate", "mesh", "{}/no.ply", "--reference", "{}/no.ply"),
        ("evaluate", "mesh", "{}/text", "--reference", "{}/text"),
        ("evaluate", "trajectory", "{}/text", "--reference", "{}/text"),
        ("export", "{}/text", "--format", "glb", "--out", "{}/out.glb"),
        ("export", "{}", "--format", "glb", "--out", "{}"),
        ("render", "{}/text", "--pose", "1 2", "--intrinsics", "4 4 2 2 1 1", "--out", "{}/x.png"),
        ("session", "info", "{}/text"),
        ("simulate", "moon", "--out", "{}/moon"),
        ("simulate", "street", "--seconds", "0", "--out", "{}/street"),
        ("demo", "--world", "moon", "--out", "{}/demo"),
        ("bench", "{}/text"),
    ],
)
def test_every_command_refuses_in_one_sentence(
    arguments: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "text").write_text("this is not what you think")
    refused(capsys, 2, *(argument.format(tmp_path) for argument in arguments))


def test_mesh_reports_nothing_lost_for_good_input(
    kitti: Path, tmp_path: Path, fake_pipeline: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    """The other side of all the above: good input is not complained about."""
    assert main(["reprocess", str(kitti), "--out", str(tmp_path / "out"), "--json"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["lost"] == {}
    assert "note:" not in told.err
