"""The input points coloured by the mean of the images that see them: what a map without a mesh would look like.

An image sees a point that is not behind another by more than the tolerance, both drawn as splats.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.evaluate.photos import Photo, count_photos, read_photos
from artemis_edge.frames import F32, F64, I64, U8, Bool, CameraModel
from artemis_edge.kept_images import INDEX
from artemis_edge.kept_points import KeptPoints, Rows, open_points
from artemis_edge.progress import Report, say, silent
from artemis_edge.splats import NOTHING, Lens, blank, lens_of, place, splat
from artemis_edge.trajectory import inverse

# A point this share of its depth, and this far, behind what is seen is still the same surface: noise and slant.
_TOLERANCE, _TOLERANCE_M = 0.01, 0.1
_MOST_SEEN = 255


@njit
def _seen_at(x: float, y: float, z: float, T_cam_world: F64, lens: Lens, nearest: F32) -> tuple[float, float]:
    """Pixel u, v of a world point that the camera sees before depths ``nearest`` (h, w); NaN where it does not."""
    height, width = nearest.shape
    u, v, depth = place(x, y, z, T_cam_world, lens)
    if -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5:
        limit = nearest[int(np.floor(v + 0.5)), int(np.floor(u + 0.5))]
        if depth <= limit * (1.0 + _TOLERANCE) + _TOLERANCE_M:
            return u, v
    return np.nan, np.nan


@njit
def add_colours(
    points: F32, T_cam_world: F64, lens: Lens, nearest: F32, image: U8, sums: F32, seen: I64
) -> None:
    """Add the image's colour at every point it sees to ``sums`` float32 (n, 3), and 1 to ``seen`` (n,)."""
    for i in range(len(points)):
        u, v = _seen_at(points[i, 0], points[i, 1], points[i, 2], T_cam_world, lens, nearest)
        if np.isnan(u):
            continue
        column, row = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
        for k in range(3):
            sums[i, k] += image[row, column, k]
        seen[i] += 1


@njit
def sees(points: F32, T_cam_world: F64, lens: Lens, nearest: F32) -> F64:
    """Pixels float64 (n, 2) of points that the camera sees before depths ``nearest`` (h, w); NaN for the others."""
    out = np.empty((len(points), 2))
    for i in range(len(points)):
        out[i] = _seen_at(points[i, 0], points[i, 1], points[i, 2], T_cam_world, lens, nearest)
    return out


def coloured_points(folder: Path, report: Report = silent) -> KeptPoints | None:
    """The points of a map's folder, coloured with the images kept there the first time that they are asked for.

    None where it keeps no points; without images no point has a colour. InputError if the file is damaged, RunError
    where the folder cannot be written.
    """
    kept = open_points(folder)
    index = folder / INDEX
    if kept is None or kept.coloured or not index.is_file():
        return kept
    points = np.concatenate([rows["position"] for rows in kept.chunks()])
    sums, seen = np.zeros((len(points), 3), np.float32), np.zeros(len(points), np.int64)
    total = count_photos(index)
    for done, photo in enumerate(kept_photographs(index)):
        _add_photo(points, photo, sums, seen)
        report(done + 1, total, photo.file)
    return kept.with_colours(_coloured(kept.chunks(), sums, seen))


def kept_photographs(index: Path) -> Iterator[Photo]:
    """Those of a map's folder that can be read; what is said of the others ends up with whoever asked for them."""
    return read_photos(index, lambda what: say(f"{what}; it goes on without it"))


def _add_photo(points: F32, photo: Photo, sums: F32, seen: I64) -> None:
    T_cam_world, lens = inverse(photo.T_world_cam), lens_of(photo.camera)
    nearest, number = blank(photo.camera)
    splat(points, T_cam_world, lens, 0, nearest, number)
    add_colours(points, T_cam_world, lens, nearest, photo.image, sums, seen)


def _coloured(chunks: Iterator[Rows], sums: F32, seen: I64) -> Iterator[Rows]:
    start = 0
    for rows in chunks:
        part = slice(start, start + len(rows))
        count = seen[part]
        mean = sums[part] / np.maximum(count, 1).astype(np.float32)[:, None]
        rows["colour"] = np.rint(mean)
        rows["seen"] = np.minimum(count, _MOST_SEEN)
        start = part.stop
        yield rows


@dataclass(frozen=True, slots=True)
class SplatCloud:
    """Coloured points to be drawn; those that no image saw are left out."""

    kept: KeptPoints

    def draw(self, camera: CameraModel, T_world_cam: F64) -> tuple[F32, Bool]:
        """Colours float32 (h, w, 3) 0..255 and which pixels show a point."""
        T_cam_world, lens = inverse(T_world_cam), lens_of(camera)
        nearest, number = blank(camera)
        colours, first = np.zeros((*nearest.shape, 3), np.float32), 0
        for rows in self.kept.chunks():
            rows = rows[rows["seen"] > 0]
            position = np.ascontiguousarray(rows["position"])
            splat(position, T_cam_world, lens, first, nearest, number)
            new = number >= first
            colours[new] = rows["colour"][number[new] - first]
            first += len(rows)
        return colours, number != NOTHING


def open_splats(folder: Path, report: Report = silent) -> SplatCloud | None:
    """The coloured points of a map's folder; None where it keeps none or no image saw any."""
    kept = coloured_points(folder, report)
    if kept is None or not any((rows["seen"] > 0).any() for rows in kept.chunks()):
        return None
    return SplatCloud(kept)
