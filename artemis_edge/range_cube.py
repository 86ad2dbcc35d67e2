"""What a scan saw in every direction: a cube of six range images.

A pixel holds the nearest range of itself and its eight neighbours, so that an edge seen a pixel aside protects
the surface behind it. Tiles of pixels hold the farthest range around them, so that a voxel behind all that was
seen is known by one look.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from artemis_edge._jit import kernel
from artemis_edge.frames import F32, F64, I32, DeskewedScan

PIXELS = 256  # a face; 0.45 degrees a pixel in its middle, the line spacing of common LiDARs
FAR = np.float32(1.0e6)
TILE = 16  # pixels along its edge
TILES = PIXELS // TILE
SPREAD = 0.06  # sine of the half angle under which what is looked up by tiles may appear: a voxel beyond 6 m
CHUNK = 256  # points that stay in the processor's first cache


class Rays(NamedTuple):
    """Columns of rays from the cube's centre."""

    way: F32  # (3, n) [m]
    range_m: F32
    pixel: I32  # face, row and column of ``pixel`` as a place in the flat cube; -1 for the centre and NaN


def new_rays(n: int) -> Rays:
    """Memory for ``n`` rays."""
    return Rays(np.empty((3, n), np.float32), np.empty(n, np.float32), np.empty(n, np.int32))


class RangeCube:
    """Nearest range seen in every direction from one scan's origin; memory is reused.

    ``range_m`` float32 (6, PIXELS, PIXELS), ``farthest_m`` float32 (6, TILES, TILES) its largest value in and
    around each tile, 0 where nothing was seen.
    """

    def __init__(self) -> None:
        self._raw = np.empty((6, PIXELS, PIXELS), np.float32)
        self.range_m = np.empty_like(self._raw)
        self.farthest_m = np.empty((6, TILES, TILES), np.float32)
        self._window = np.ones((3, 3), np.uint8)
        self._tile = np.empty(6 * TILES * TILES, np.float32)
        self._around = tiles_around()
        self._rays = new_rays(CHUNK)

    def look(self, scan: DeskewedScan) -> None:
        """Fill the cube from a scan, in the axes of the lidar frame around the scan's origin."""
        self._raw.fill(FAR)
        fill_cube(scan.points, scan.origin, self._raw.reshape(-1), self._rays)
        for face in range(6):
            cv2.erode(self._raw[face], self._window, dst=self.range_m[face])
        farthest_of_tiles(self.range_m, self._tile)
        farthest_around(self._tile, self._around, self.farthest_m.reshape(-1))


@kernel
def pixel(x: float, y: float, z: float) -> tuple[int, int, int]:
    """Face, row and column of a direction; face -1 for the origin itself."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, major, a, b = (0 if x > 0.0 else 1), ax, y, z
    elif ay >= az:
        face, major, a, b = (2 if y > 0.0 else 3), ay, x, z
    else:
        face, major, a, b = (4 if z > 0.0 else 5), az, x, y
    if not major > 0.0:
        return -1, 0, 0
    scale = 0.5 * PIXELS / major
    row = min(int(b * scale + 0.5 * PIXELS), PIXELS - 1)
    column = min(int(a * scale + 0.5 * PIXELS), PIXELS - 1)
    return face, row, column


@kernel
def look_up(w: Rays, n: int) -> None:
    """Ranges and pixels of the first ``n`` rays.

    Without branches, so that the compiler makes vector instructions of it; in float32, so that a ray between two
    pixels may get either.
    """
    half, most, none = np.float32(0.5 * PIXELS), np.float32(PIXELS - 1), np.float32(0.0)
    x, y, z, range_m, place = w.way[0, :n], w.way[1, :n], w.way[2, :n], w.range_m, w.pixel
    for i in range(n):
        ax, ay, az = abs(x[i]), abs(y[i]), abs(z[i])
        on_x = (ax >= ay) & (ax >= az)
        on_y = (not on_x) & (ay >= az)
        major = x[i] if on_x else (y[i] if on_y else z[i])
        face = (0 if on_x else (2 if on_y else 4)) + (0 if major > none else 1)
        scale = half / abs(major)
        row = (y[i] if not (on_x | on_y) else z[i]) * scale + half
        column = (y[i] if on_x else x[i]) * scale + half
        row = row if row > none else none
        column = column if column > none else none
        at = np.int32(row if row < most else most) * PIXELS + np.int32(column if column < most else most)
        r = np.float32(math.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i]))
        range_m[i] = r
        place[i] = np.int32(face * (PIXELS * PIXELS) + at if (r > none) & (r < FAR) else -1)


@kernel
def fill_cube(points: F32, origin: F64, cube: F32, w: Rays) -> None:
    """Smallest range of the points (n, 3) in each pixel of the flat ``cube``."""
    ox, oy, oz = np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2])
    for start in range(0, points.shape[0], CHUNK):
        part = points[start : start + CHUNK]
        n = part.shape[0]
        for i in range(n):
            w.way[0, i], w.way[1, i], w.way[2, i] = part[i, 0] - ox, part[i, 1] - oy, part[i, 2] - oz
        look_up(w, n)
        for i in range(n):
            at = w.pixel[i]
            if at >= 0 and w.range_m[i] < cube[at]:
                cube[at] = w.range_m[i]


def tiles_around() -> I32:
    """Tiles that directions within ``SPREAD`` of each tile can lie in, (6 * TILES^2, k), filled up with its own."""
    edge = np.linspace(-1.0, 1.0, TILES + 1)
    b, a = np.meshgrid(edge, edge, indexing="ij")
    faces = []
    for face in range(6):
        axis, sign = face // 2, 1.0 - 2.0 * (face % 2)
        faces.append(np.insert(np.stack((a, b), axis=-1), axis, sign, axis=-1))
    corner = np.stack(faces)
    corner /= np.linalg.norm(corner, axis=-1, keepdims=True)
    own = np.stack((corner[:, :-1, :-1], corner[:, :-1, 1:], corner[:, 1:, :-1], corner[:, 1:, 1:]))
    own = own.reshape(4, -1, 3)
    centre = own.mean(axis=0)
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    radius = np.arccos(np.einsum("kti,ti->kt", own, centre).min(axis=0))
    apart = np.arccos(np.clip(centre @ centre.T, -1.0, 1.0))
    near = apart <= radius[:, None] + radius[None] + math.asin(SPREAD)
    order = np.argsort(~near, axis=1, kind="stable")[:, : near.sum(axis=1).max()].astype(np.int32)
    return np.where(
        np.take_along_axis(near, order, axis=1), order, np.arange(len(near), dtype=np.int32)[:, None]
    )


@kernel
def farthest_of_tiles(range_m: F32, tile: F32) -> None:
    """Largest range in each tile of a cube, 0 where nothing was seen."""
    tile[:] = 0.0
    for face in range(6):
        for row in range(PIXELS):
            first = (face * TILES + row // TILE) * TILES
            for t in range(TILES):
                most = tile[first + t]
                for column in range(t * TILE, (t + 1) * TILE):
                    seen = range_m[face, row, column]
                    most = max(most, seen if seen < FAR else np.float32(0.0))
                tile[first + t] = most


@kernel
def farthest_around(tile: F32, around: I32, out: F32) -> None:
    """Largest value of each tile's surroundings."""
    for i in range(around.shape[0]):
        most = tile[i]
        for j in around[i]:
            most = max(most, tile[j])
        out[i] = most
