"""Where the virtual devices of ``replay --wire`` may appear."""

from __future__ import annotations

import time
import tomllib
from itertools import pairwise
from pathlib import Path

import pytest

from artemis_edge.errors import InputError
from artemis_edge.session.wire_replay import Played, WireRig, _write_rig, read
from tests import small_session


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


@pytest.mark.parametrize("camera", [True, False])
def test_the_lidar_never_stops_in_the_middle_of_a_packet(tmp_path: Path, camera: bool) -> None:
    """From standing still to the walk: stamps go on without a gap, wherever the walk begins."""
    walk = read(small_session.write(tmp_path / "walk", frames=2, points=500, camera=camera))
    rig = WireRig(walk, tmp_path / "rig")
    rig.board.firmware.boot_ns = time.monotonic_ns() - 1_234_567
    stream = rig._shots()
    shots = [next(stream)]
    rig.begin(0.1)
    shots += stream
    assert rig.start_ns is not None and shots[-2].start_ns == rig.start_ns
    for before, after in pairwise(shots):
        assert after.start_ns == before.start_ns + len(before.xyz) * 1_000_000_000 // 240_000
    assert all(len(part.xyz) % 96 == 0 for part in shots) and rig.over.is_set()
