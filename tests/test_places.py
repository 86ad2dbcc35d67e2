"""Where files are written: told before the work, never over something else, and results never over foreign files."""

import json
import os
from pathlib import Path

import pytest

from artemis_edge.cli import main
from artemis_edge.errors import InputError
from artemis_edge.export.atomic import write_bytes
from artemis_edge.export.places import check_file, check_folder, check_new_folder
from artemis_edge.json_file import read_json
from artemis_edge.session.results import refuse_foreign, scratch


def _told(option: str, path: Path, *read: Path | None) -> str:
    with pytest.raises(InputError) as caught:
        check_file(option, path, (".png",), read)
    return str(caught.value)


def test_a_picture_replaces_pictures_only(tmp_path: Path) -> None:
    picture, mesh = tmp_path / "a.png", tmp_path / "mesh.ply"
    for file in (picture, mesh):
        file.write_bytes(b"x")
    check_file("--out", picture, (".png",))
    check_file("--out", tmp_path / "new.of.any.name", (".png",))
    check_file("--out", Path(os.devnull), (".png",))
    assert "is no .png file" in _told("--heatmap", mesh)
    assert "is a folder; --out needs" in _told("--out", tmp_path)
    assert "there is no folder" in _told("--out", tmp_path / "none" / "a.png")
    assert "there is no folder" in _told("--out", mesh / "a.png")
    assert "a part of what is read" in _told("--out", picture, None, tmp_path / "." / "a.png")
    assert "a part of what is read" in _told("--out", picture, tmp_path)


def test_folders_are_new_or_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"x")
    check_folder("--meshes", tmp_path / "new" / "er")
    check_new_folder("--out", tmp_path / "new")
    with pytest.raises(InputError, match="file is a file"):
        check_folder("--meshes", tmp_path / "file" / "deeper")
    with pytest.raises(InputError, match="there already"):
        check_new_folder("--out", tmp_path)
    with pytest.raises(InputError, match="a part of what is read"):
        check_new_folder("--out", tmp_path / "new", (tmp_path,))


def test_a_pipe_stays_a_pipe(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_bytes(pipe, b"picture")
    assert os.read(reader, 100) == b"picture"
    os.close(reader)
    assert pipe.is_fifo()


@pytest.mark.parametrize("name", ["map", "mesh.ply", "config.toml"])
def test_files_that_no_run_made_are_not_replaced(tmp_path: Path, name: str) -> None:
    refuse_foreign(tmp_path / "none")
    refuse_foreign(tmp_path)
    if name == "map":
        (tmp_path / name).mkdir()
    else:
        (tmp_path / name).write_text("[tool]\n")
    with pytest.raises(InputError, match=f"holds {name}"):
        refuse_foreign(tmp_path)
    (tmp_path / "config.toml").write_text("[voxel_map]\n")
    refuse_foreign(tmp_path)


def test_scratch_of_a_killed_run_is_cleared_away(tmp_path: Path) -> None:
    left = tmp_path / ".scratch-left"
    left.mkdir()
    (left / ".held").write_text("")
    (tmp_path / ".scratch-older").mkdir()
    with scratch(tmp_path) as first, scratch(tmp_path) as second:
        assert sorted(tmp_path.iterdir()) == sorted((first, second))
    assert list(tmp_path.iterdir()) == []


def test_json_that_is_none_is_a_value_error(tmp_path: Path) -> None:
    for content in (b"", b"\xff", b"[" * 100_000):
        (tmp_path / "a.json").write_bytes(content)
        with pytest.raises(ValueError):
            read_json(tmp_path / "a.json")


def test_json_is_one_object_in_failure_too(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["ask", "nowhere", "car"], ["evaluate", "mesh"], ["reprocess", "nowhere", "--out", "x"]):
        assert main([*words, "--json"]) == 2
        told = capsys.readouterr()
        found = json.loads(told.out)
        assert found["exit_code"] == 2
        assert found["error"] == told.err.strip().partition(": ")[2]


@pytest.mark.parametrize("port", ["-1", "0", "65536", "80a"])
def test_a_port_that_is_none_is_told_before_the_map_is_read(
    port: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", "nowhere", f"--port={port}"]) == 2
    assert f"'{port}' is no port" in capsys.readouterr().err
