"""The project as a package and as a repository: what is shipped, what must not be, and what is documented."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from artemis_edge import config
from artemis_edge.documentation import settings_table

ROOT = Path(__file__).parents[1]


def tracked() -> list[Path]:
    """Files of the repository, or every file where git is not there."""
    try:
        listed = subprocess.run(
            ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    return [ROOT / name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()]


def texts() -> dict[str, str]:
    found = {}
    for path in tracked():
        content = path.read_bytes()
        if b"\0" not in content:
            found[path.relative_to(ROOT).as_posix()] = content.decode("utf-8")
    return found


def test_wheel_holds_both_packages(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as content:
        names = set(content.namelist())
    for name in ("artemis_edge/cli.py", "artemis_edge/py.typed", "artemis_drivers/virtual/street.py"):
        assert name in names
    assert {f"artemis_edge/profiles/{name}.toml" for name in config.profiles()} <= names
    assert not [name for name in names if name.startswith(("tests/", "docs/"))]


def test_no_addresses_of_registries_and_no_paths_of_a_machine() -> None:
    hosts = ["pypi" + ".org", "files.python" + "hosted.org", "ana" + "conda.org", "crates" + ".io"]
    paths = ["/wo" + "rk/", "/ro" + "ot/", "/ho" + "me/"]
    forbidden = re.compile("|".join(re.escape(text) for text in [*hosts, *paths]))
    hits = {name: match.group() for name, text in texts().items() if (match := forbidden.search(text))}
    assert hits == {}


def test_nothing_large_is_in_the_repository() -> None:
    assert [path.name for path in tracked() if path.stat().st_size > 1_500_000] == []


def test_constraints_are_names_and_versions_only() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    assert all(re.fullmatch(r"[a-z0-9-]+==[0-9][0-9a-z.]*", line) for line in lines)
    names = [line.split("==")[0] for line in lines]
    assert names == sorted(names)


def test_constraints_cover_what_is_required() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pinned = {line.split("==")[0] for line in (ROOT / "constraints.txt").read_text().splitlines()}
    required = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    names = {Requirement(text).name.lower().replace("_", "-") for text in required}
    assert names - pinned == {"artemis-edge"}


def test_matrices_are_multiplied_by_one_thread_unless_the_user_says_otherwise() -> None:
    told = "import os, artemis_edge; print(os.environ['OPENBLAS_NUM_THREADS'])"
    for given, wanted in (({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")):
        rest = {key: value for key, value in os.environ.items() if key != "OPENBLAS_NUM_THREADS"}
        said = subprocess.run(
            [sys.executable, "-c", told], env=rest | given, capture_output=True, text=True, check=True
        )
        assert said.stdout.strip() == wanted


def test_the_command_is_installed() -> None:
    (script,) = metadata.entry_points(group="console_scripts", name="artemis-edge")
    assert script.value == "artemis_edge.cli:main"


@pytest.mark.parametrize("name", config.profiles())
def test_profiles_are_valid(name: str) -> None:
    assert config.load(profile=name) != config.Config()


def test_every_setting_is_documented_once() -> None:
    """The table of docs/tuning.md is generated: python -m artemis_edge.documentation docs/tuning.md."""
    assert settings_table() in (ROOT / "docs" / "tuning.md").read_text()


def test_links_of_the_documentation_lead_somewhere() -> None:
    for name, text in texts().items():
        if not name.endswith(".md"):
            continue
        for target in re.findall(r"\]\(([^)#:]+)\)", text):
            assert ((ROOT / name).parent / target).exists(), f"{name}: {target}"


def test_readme_names_only_commands_that_exist() -> None:
    listed = subprocess.run(
        [sys.executable, "-m", "artemis_edge.cli", "--help"], capture_output=True, text=True, check=True
    ).stdout
    for command in re.findall(r"artemis-edge ([a-z]+)", (ROOT / "README.md").read_text()):
        assert re.search(rf"^ +{command}\b", listed, re.MULTILINE), command
