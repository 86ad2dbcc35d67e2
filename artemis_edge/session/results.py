"""The output directory of a run: every file complete under its name, or the one that was there before."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from artemis_edge.errors import InputError, RunError
from artemis_edge.export.atomic import disk_sentence, write_bytes

_T = TypeVar("_T")
# What a run writes first, and what it would replace.
_OURS = b"[voxel_map]"
_NAMES = (
    "config.toml", "map", "mesh.ply", "mesh.glb", "trajectory.tum", "objects.json", "report.json", "report.html",
)  # fmt: skip
_SCRATCH, _HOLD = ".scratch-", ".held"


class Results:
    """Writes results one by one: where one cannot be written, the others still are.

    ``kept`` are the names written, ``fault`` the first sentence why something was not (None: all well).
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.kept: list[str] = []
        self.fault: str | None = None

    def attempt(self, name: str, write: Callable[[Path], _T]) -> _T | None:
        """``write`` the result ``name``; None when that failed, which is remembered."""
        try:
            value = write(self.folder / name)
        except RunError as error:
            self._failed(str(error))
        except OSError as error:
            self._failed(disk_sentence(self.folder / name, error))
        else:
            self.kept.append(name)
            return value
        return None

    def text(self, name: str, content: str) -> None:
        """A text file."""
        self.attempt(name, lambda path: write_bytes(path, content.encode()))

    def json(self, name: str, content: Any) -> None:
        """A JSON file."""
        self.text(name, json.dumps(content, indent=2, ensure_ascii=False) + "\n")

    def directory(self, name: str, write: Callable[[Path], _T]) -> _T | None:
        """A folder that ``write`` fills; it takes the place of an older one only when complete."""
        return self.attempt(name, lambda path: _replace_folder(path, write))

    def _failed(self, sentence: str) -> None:
        self.fault = self.fault or sentence


def prepare(folder: Path) -> list[Path]:
    """Create ``folder`` (and those above it) for results if it is not there; returns the folders that were made.

    Raises InputError if it cannot be one.
    """
    made = [above for above in (folder, *folder.parents) if not above.exists()]
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file; --out needs a folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror}; choose another --out") from None
    return made


def remove_empty(folders: Iterable[Path]) -> None:
    """Those of ``folders`` that hold nothing, the innermost first."""
    for folder in sorted(folders, key=lambda path: len(path.parts), reverse=True):
        with suppress(OSError):
            folder.rmdir()


@contextmanager
def preparing(folder: Path) -> Iterator[None]:
    """As ``prepare``; where an error leaves nothing in it, what was made is gone again."""
    made = prepare(folder)
    try:
        yield
    except BaseException:
        remove_empty(made)
        raise


def refuse_foreign(folder: Path) -> None:
    """InputError where ``folder`` holds files by the names of results that no run made: they would be replaced."""
    config = folder / "config.toml"
    if config.is_file() and _OURS in config.read_bytes():
        return
    there = [name for name in _NAMES if (folder / name).exists()]
    if there:
        raise InputError(
            f"{folder} holds {there[0]}, which is not of a run and would be replaced; choose another --out"
        )


@contextmanager
def scratch(folder: Path) -> Iterator[Path]:
    """A hidden folder inside ``folder``, on the same disk, gone afterwards; those of runs that were killed go, too."""
    clear_left(folder)
    with (
        tempfile.TemporaryDirectory(prefix=_SCRATCH, dir=folder, ignore_cleanup_errors=True) as name,
        (Path(name) / _HOLD).open("w") as hold,
    ):
        with suppress(OSError):  # a disk that knows no locks
            fcntl.flock(hold, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield Path(name)


def clear_left(folder: Path) -> None:
    """Remove the scratch folders of processes that are no more."""
    for left in folder.glob(f"{_SCRATCH}*"):
        if not _held(left / _HOLD):
            shutil.rmtree(left, ignore_errors=True)


def _held(hold: Path) -> bool:
    """Whether a process that lives has its scratch folder locked."""
    try:
        with hold.open() as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


def _replace_folder(path: Path, write: Callable[[Path], _T]) -> _T:
    part, old = (path.with_name(f".{path.name}.{os.getpid()}.{kind}") for kind in ("part", "old"))
    try:
        part.mkdir()
        value = write(part)
        if path.exists():
            path.replace(old)
        part.replace(path)
        return value
    finally:
        for leftover in (part, old):
            shutil.rmtree(leftover, ignore_errors=True)
