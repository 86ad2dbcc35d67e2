"""The units: systemd finds nothing to say about them, and the service is locked in well."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "systemd"
_MOST_EXPOSED = 22  # tenths

needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")


def _with_a_command_that_is_there(unit: Path, folder: Path) -> Path:
    text = re.sub(r"^(Exec\w+)=\S+", r"\1=/bin/true", unit.read_text(), flags=re.M)
    copy = folder / unit.name
    copy.write_text(text)
    return copy


@needs_systemd
@pytest.mark.parametrize("name", [unit.name for unit in FOLDER.glob("*.service")])
def test_systemd_has_nothing_to_say(name: str, tmp_path: Path) -> None:
    copy = _with_a_command_that_is_there(FOLDER / name, tmp_path)
    found = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", copy],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (found.returncode, found.stdout, found.stderr) == (0, "", "")


@needs_systemd
def test_the_service_is_locked_in(tmp_path: Path) -> None:
    copy = _with_a_command_that_is_there(FOLDER / "artemis-edge.service", tmp_path)
    words = [
        "systemd-analyze",
        "security",
        "--offline=true",
        f"--threshold={_MOST_EXPOSED}",
        "--no-pager",
        copy,
    ]
    found = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert found.returncode == 0, found.stdout[-300:]


def test_what_numba_and_the_sensors_need_stays_allowed() -> None:
    text = (FOLDER / "artemis-edge.service").read_text()
    for setting in ("MemoryDenyWriteExecute", "ProcSubset", "PrivateNetwork", "PrivateDevices"):
        assert not re.search(rf"^{setting}=", text, re.M)
    assert "AF_CAN" in text and "char-ttyUSB" in text


def test_the_makefile_installs_every_file() -> None:
    makefile = (FOLDER.parent / "Makefile").read_text()
    assert all(path.name in makefile for path in FOLDER.iterdir())
