"""Where the virtual devices of ``replay --wire`` may appear."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from artemis_edge.errors import InputError
from artemis_edge.session.wire_replay import Played, WireRig, _write_rig


def test_a_file_is_no_folder_for_devices(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("kept")
    with pytest.raises(InputError, match="choose another folder with --rig"), WireRig(Played(), file):
        pass
    assert file.read_text() == "kept"


@pytest.mark.parametrize("name", ["can", "imu"])
def test_files_of_others_are_not_replaced_by_devices(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("kept")
    with pytest.raises(InputError, match="is no virtual device"), WireRig(Played(), tmp_path):
        pass
    assert (tmp_path / name).read_text() == "kept" and [item.name for item in tmp_path.iterdir()] == [name]


def test_a_rig_file_of_somebody_else_is_not_replaced(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text("# mine\nimu_over_lidar = true\n")
    with pytest.raises(InputError, match="choose another folder with --rig"), WireRig(Played(), tmp_path):
        pass
    assert file.read_text() == "# mine\nimu_over_lidar = true\n"


def test_its_own_rig_file_is_replaced_until_it_is_changed(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    _write_rig(file, b"a = 1\n")
    assert tomllib.loads(file.read_text()) == {"a": 1}
    _write_rig(file, b"a = 2\n")
    assert tomllib.loads(file.read_text()) == {"a": 2}
    file.write_text(file.read_text() + "b = 3\n")
    with pytest.raises(InputError, match="was changed since"):
        _write_rig(file, b"a = 4\n")
    assert tomllib.loads(file.read_text()) == {"a": 2, "b": 3}
