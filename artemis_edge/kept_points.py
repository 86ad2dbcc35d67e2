"""``map/points.bin``: the input points in world coordinates with time, intensity and colour, in bounded number.

A header of 32 bytes (magic, number of rows, ``stamp_ns`` of time zero, stride) and rows of ``ROW``,
little-endian. Every ``stride``-th finite point of the input is there, in the order measured. Colours come when they
are first asked for; then the magic is another.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from artemis_edge.errors import InputError
from artemis_edge.export.atomic import replacing
from artemis_edge.export.mesh import finite_rows
from artemis_edge.frames import F32, F64

FILE = "points.bin"
#: ``tick`` is the time in units of 10 us, ``intensity`` 65535 for 1.0, ``seen`` how many images gave the colour
#: (255: or more; 0: none, the colour means nothing).
ROW = np.dtype(
    [
        ("position", "<f4", 3),
        ("tick", "<u4"),
        ("intensity", "<u2"),
        ("colour", "u1", 3),
        ("seen", "u1"),
    ]
)
TICKS_PER_S = 100_000
FULL_INTENSITY = 65535
_PLAIN, _COLOURED = b"ARTPTS1\n", b"ARTPTS2\n"
_HEADER = struct.Struct("<8sqqq")
_ROWS_AT_ONCE = 1 << 18

Rows = NDArray[np.void]


class PointSpool:
    """Takes points as they come; beyond ``most`` rows every second one goes, and later ones are taken sparser.

    What remains is every ``stride``-th point of all, whatever the number of frames. Memory is that of a chunk.
    """

    def __init__(self, path: Path, most: int) -> None:
        self.rows = 0
        self.stride = 1
        self._path, self._most = path, most
        self._offered = 0
        self._zero_ns: int | None = None

    def add(self, points: F32, stamp_ns: int, time_s: F32 | F64, intensity: F32 | None) -> None:
        """Points float32 (n, 3) of the world, measured ``time_s`` (n,) after ``stamp_ns``; 0..1 (n,) or None."""
        good = finite_rows(points)
        if self._most == 0 or not good.any():
            return
        zero_ns = self._zero(stamp_ns, float(np.min(time_s[good])))
        kept = np.flatnonzero(good)[-self._offered % self.stride :: self.stride]
        self._offered += int(good.sum())
        rows = np.zeros(len(kept), ROW)
        rows["position"] = points[kept]
        seconds = (stamp_ns - zero_ns) * 1e-9 + time_s[kept].astype(np.float64)
        rows["tick"] = np.rint(seconds * TICKS_PER_S).clip(0, np.iinfo(np.uint32).max)
        if intensity is not None:
            full = np.nan_to_num(intensity[kept]).clip(0.0, 1.0)
            rows["intensity"] = np.rint(full * np.float32(FULL_INTENSITY))
        with self._path.open("ab") as file:
            file.write(rows.tobytes())
        self.rows += len(rows)
        while self.rows > self._most:
            self._halve()

    def take_over(self, kept: KeptPoints) -> None:
        """Begin with the points of a map made before, at their own times as far as those fit into the file."""
        if self._most == 0:
            return
        with self._path.open("ab") as file:
            for rows in kept.chunks():
                file.write(rows.tobytes())
        self.rows, self.stride, self._zero_ns = kept.rows, max(kept.stride, 1), kept.zero_ns
        self._offered = self.rows * self.stride
        while self.rows > self._most:
            self._halve()

    def _zero(self, stamp_ns: int, earliest_s: float) -> int:
        if self._zero_ns is None:
            self._zero_ns = stamp_ns + int(np.floor(min(earliest_s, 0.0) * 1e9))
        return self._zero_ns

    def _halve(self) -> None:
        """Every second row goes. In place: what is written lies behind what is still to be read."""
        written, read = 0, 0
        with self._path.open("r+b") as file:
            while read < self.rows:
                file.seek(read * ROW.itemsize)
                rows = _read_rows(file, min(_ROWS_AT_ONCE, self.rows - read))
                file.seek(written * ROW.itemsize)
                file.write(rows[::2].tobytes())  # chunks are even: each begins with a row that stays
                read, written = read + len(rows), written + len(rows[::2])
            file.truncate(written * ROW.itemsize)
        self.rows, self.stride = written, self.stride * 2

    def after_copy(self) -> None:
        """In a copy of the process that takes over: what the other appended is not known here."""
        if self._path.exists():
            with self._path.open("r+b") as file:
                file.truncate(min(self.rows * ROW.itemsize, self._path.stat().st_size))
            self.rows = self._path.stat().st_size // ROW.itemsize

    def save(self, folder: Path) -> int:
        """Write ``points.bin`` into a map's folder, without colours; returns its size in bytes (0: no points)."""
        if self.rows == 0:
            return 0
        target = folder / FILE
        with target.open("wb") as out, self._path.open("rb") as spool:
            out.write(_HEADER.pack(_PLAIN, self.rows, self._zero_ns or 0, self.stride))
            while part := spool.read(_ROWS_AT_ONCE * ROW.itemsize):
                out.write(part)
        return target.stat().st_size


@dataclass(frozen=True, slots=True)
class KeptPoints:
    """The points file of a map. ``zero_ns`` is the session time of tick 0; ``coloured``: colours were looked for."""

    path: Path
    rows: int
    zero_ns: int
    stride: int
    coloured: bool

    def chunks(self) -> Iterator[Rows]:
        """All rows, some at a time."""
        with self.path.open("rb") as file:
            file.seek(_HEADER.size)
            for start in range(0, self.rows, _ROWS_AT_ONCE):
                yield _read_rows(file, min(_ROWS_AT_ONCE, self.rows - start))

    def with_colours(self, rows: Iterator[Rows]) -> KeptPoints:
        """The file replaced by one of all ``rows``, in order, with their colours; all or nothing.

        Raises RunError where it cannot be written.
        """
        with replacing(self.path) as file:
            file.write(_HEADER.pack(_COLOURED, self.rows, self.zero_ns, self.stride))
            for some in rows:
                file.write(some.tobytes())
        return replace(self, coloured=True)


def open_points(folder: Path) -> KeptPoints | None:
    """The points of a map's folder ``map/``, None where it has none; InputError if the file is damaged."""
    path = folder / FILE
    if not path.is_file():
        return None
    with path.open("rb") as file:
        head = file.read(_HEADER.size)
    size = path.stat().st_size
    if len(head) == _HEADER.size:
        magic, rows, zero_ns, stride = _HEADER.unpack(head)
        if magic in (_PLAIN, _COLOURED) and rows >= 0 and size == _HEADER.size + rows * ROW.itemsize:
            return KeptPoints(path, rows, zero_ns, stride, magic == _COLOURED)
    raise InputError(f"{path} is damaged or of another version; make the map again")


def _read_rows(file: BinaryIO, count: int) -> Rows:
    content: Any = file.read(count * ROW.itemsize)
    return np.frombuffer(content, ROW).copy()
