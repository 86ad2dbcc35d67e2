"""Where the virtual devices of ``replay --wire`` may appear."""

from __future__ import annotations

from pathlib import Path

import pytest

from artemis_edge.errors import InputError
from artemis_edge.session.wire_replay import Played, WireRig


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
