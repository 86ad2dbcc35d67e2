"""Where a command is to write a file: told before any work is done, and never over something else."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from artemis_edge.errors import InputError


def check_file(option: str, path: Path, kinds: Sequence[str], read: Sequence[Path | None] = ()) -> None:
    """InputError where ``path``, given with ``option``, cannot become a file or would cost another one.

    A file that is there already is replaced only where its name ends in one of ``kinds`` (".png"). Nothing is written
    over the files ``read``, nor into the folders among them.
    """
    if path.is_dir():
        raise InputError(f"{path} is a folder; {option} needs the name of a file")
    folder = path.parent
    if not folder.is_dir():
        raise InputError(f"{option} {path}: there is no folder {folder}; make it or choose another place")
    if not os.access(folder, os.W_OK):
        raise InputError(f"{option} {path}: the folder {folder} cannot be written to; choose another place")
    if path.is_file() and path.suffix.lower() not in kinds:
        raise InputError(
            f"{path} is there already and is no {' or '.join(kinds)} file; choose another {option}"
        )
    if _within(path, read):
        raise InputError(f"{path} is a part of what is read; choose another {option}")


def check_folder(option: str, path: Path) -> None:
    """InputError where ``path``, given with ``option``, cannot become a folder to write to."""
    above = next(place for place in (path, *path.absolute().parents) if place.exists())
    if not above.is_dir():
        raise InputError(f"{option} {path}: {above} is a file; choose another place")
    if not os.access(above, os.W_OK):
        raise InputError(f"{option} {path}: the folder {above} cannot be written to; choose another place")


def check_new_folder(option: str, path: Path, read: Sequence[Path | None] = ()) -> None:
    """As ``check_folder``; besides, the folder must be new or empty and outside the folders ``read``."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{path} is there already; give {option} a folder that is new or empty")
    if _within(path, read):
        raise InputError(f"{path} is a part of what is read; choose another {option}")
    check_folder(option, path)


def _within(path: Path, read: Sequence[Path | None]) -> bool:
    place = path.resolve()
    return any(
        place == taken or taken in place.parents for taken in (r.resolve() for r in read if r is not None)
    )
