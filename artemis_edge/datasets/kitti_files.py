"""The files of a KITTI folder: scans by number, times by row, images by the number in their name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from artemis_edge.datasets.common import add_counts, natural_order, read_lines, seconds_to_ns
from artemis_edge.datasets.kitti_calibration import Camera, image_files
from artemis_edge.errors import InputError
from artemis_edge.frames import F32, I64

# x, y, z, reflectance as float32
_POINT_BYTES = 16
# Frames of an odometry sequence without times.txt
_NOMINAL_INTERVAL_NS = 100_000_000


def read_bin(path: Path) -> F32:
    """Points (n, 4): x, y, z in m and reflectance. Bytes after the last whole point are left out."""
    try:
        values = np.fromfile(path, np.float32)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    return values[: len(values) // 4 * 4].reshape(-1, 4)


class ScanFiles:
    """The ``.bin`` files of a folder with their numbers.

    Empty files are left out, files that are cut off kept, both counted. Raises InputError if not one point is
    there.
    """

    def __init__(self, folder: Path) -> None:
        self.lost: dict[str, int] = {}
        self.warnings: list[str] = []
        every = sorted(folder.glob("*.bin"), key=natural_order)
        if not every:
            raise InputError(f"{folder} holds no .bin scans; give the folder of a KITTI drive or sequence")
        sizes = [file.stat().st_size for file in every]
        empty = [file for file, size in zip(every, sizes, strict=True) if size < _POINT_BYTES]
        cut = [file for file, size in zip(every, sizes, strict=True) if size % _POINT_BYTES]
        self._report("empty_file", "empty and left out", empty)
        self._report(
            "truncated_file", "cut off and used up to its last whole point", sorted({*cut} - {*empty})
        )
        self._position = [k for k, size in enumerate(sizes) if size >= _POINT_BYTES]
        self._total = len(every)
        self.paths = [every[k] for k in self._position]
        if not self.paths:
            raise InputError(f"every scan in {folder} is empty; copy the data set again")
        named = all(path.stem.isdecimal() for path in self.paths)
        self.numbers = [int(path.stem) for path in self.paths] if named else list(self._position)

    def _report(self, reason: str, sentence: str, files: list[Path]) -> None:
        if files:
            others = f" (and {len(files) - 1} more)" if len(files) > 1 else ""
            add_counts(self.lost, {reason: len(files)})
            self.warnings.append(f"scan {files[0]}{others} is {sentence}")

    def rows(self, count: int, file: Path) -> I64:
        """The row of each scan in a file of ``count`` rows.

        By the number in the scan's name, or by position if there is one row per scan; else InputError.
        """
        if max(self.numbers) < count:
            return np.array(self.numbers, np.int64)
        if count != self._total:
            raise InputError(f"{file} has {count} rows for {self._total} scans; it must hold one per scan")
        return np.array(self._position, np.int64)

    def stamps(self, times: I64, file: Path) -> I64:
        """The time of each scan; InputError unless they ascend."""
        chosen: I64 = times[self.rows(len(times), file)]
        if (np.diff(chosen) <= 0).any():
            raise InputError(f"the times in {file} do not ascend; copy the data set again")
        return chosen


def read_times(file: Path, scans: ScanFiles) -> I64:
    """``times.txt``: seconds, one a line, as nanoseconds; 10 Hz and a warning where the file is missing."""
    if not file.is_file():
        scans.warnings.append(f"{file} is missing; the scans are taken to be 0.1 s apart")
        return np.arange(max(scans.numbers) + 1, dtype=np.int64) * _NOMINAL_INTERVAL_NS
    return np.array([seconds_to_ns(line.strip(), str(file)) for line in read_lines(file)], np.int64)


def read_datetimes(file: Path) -> I64:
    """``timestamps.txt``: lines ``2011-09-26 13:00:00.103650000`` as nanoseconds since 1970."""
    try:
        times = np.array([line.strip() for line in read_lines(file)], "datetime64[ns]")
    except ValueError:
        times = np.array(["NaT"], "datetime64[ns]")
    if len(times) == 0 or np.isnat(times).any():
        raise InputError(f"{file} must hold one time like 2011-09-26 13:00:00.103650000 a line")
    stamps: I64 = times.astype(np.int64)
    return stamps


@dataclass(frozen=True, slots=True)
class Picture:
    """An image file of a frame; the stamp is session time."""

    camera: Camera
    path: Path
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class ImageFolder:
    """Images of a camera, and their times by number; None: taken with the scan of the same number."""

    camera: Camera
    folder: Path
    times: I64 | None = None

    def stamp_ns(self, number: int, scan_ns: int) -> int:
        """Time of the image with this number."""
        if self.times is None or number >= len(self.times):
            return scan_ns
        return int(self.times[number])


def pair_images(folders: list[ImageFolder], scans: ScanFiles, stamp_ns: I64) -> list[list[Picture]]:
    """Images of each frame, paired by the number in the name: a camera may lack images in between."""
    frame_of = {number: frame for frame, number in enumerate(scans.numbers)}
    pictures: list[list[Picture]] = [[] for _ in scans.numbers]
    alone = 0
    for item in folders:
        for path in image_files(item.folder):
            number = int(path.stem) if path.stem.isdecimal() else -1
            frame = frame_of.get(number)
            if frame is None:
                alone += 1
                continue
            stamp = item.stamp_ns(number, int(stamp_ns[frame]))
            pictures[frame].append(Picture(item.camera, path, stamp))
    if alone:
        add_counts(scans.lost, {"images_without_scan": alone})
        scans.warnings.append(f"{alone} images have no scan of the same number and are left out")
    return pictures
