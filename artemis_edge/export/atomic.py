"""Files that are either complete or not there: written beside their place, then renamed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from artemis_edge.errors import RunError


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Binary file to write to, which takes the place of ``path`` only when the block ends without an error.

    A device or pipe (``/dev/null``) is written to as it is. Raises RunError naming the cause (full disk, no
    permission); an older file of that name is then untouched.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        with _told(path), path.open("wb") as file:
            yield file
        return
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with _told(path):
            with part.open("wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RunError(disk_sentence(path, error)) from None


def disk_sentence(place: Path, error: OSError) -> str:
    """Why something could not be written, and what to do."""
    return f"cannot write {place}: {error.strerror or error}; free space or choose another place"


def write_bytes(path: Path, content: bytes) -> None:
    """Write a whole file at once; raises RunError as :func:`replacing` does."""
    with replacing(path) as file:
        file.write(content)
