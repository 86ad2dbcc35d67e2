"""Free space: what a later scan looks through is not surface any more.

A scan becomes a cube of six range images holding the nearest range of each pixel and its eight neighbours, so
that an edge seen a pixel aside protects the surface behind it. A vertex well in front of that range was looked
through; one at that range is confirmed. Both are counted, and the vertex is carved when looks through it
outweigh the confirmations: a car that drove on, a mixed point between two surfaces.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from artemis_edge import block_store as bs
from artemis_edge._jit import kernel
from artemis_edge.block_store import (
    ALIVE,
    CARVED,
    CARVED_CELLS,
    CONFIRMED,
    COUNT,
    FRESH,
    HITS,
    IX,
    IY,
    IZ,
    SUM,
    THROUGH,
    Store,
)
from artemis_edge.config import VoxelMapConfig
from artemis_edge.frames import F32, F64, DeskewedScan, TrackedFrame
from artemis_edge.voxel_map import AT_ONCE, VoxelMap, is_seen_through

PIXELS = 256  # a face; 0.45 degrees a pixel in its middle, the line spacing of common LiDARs
FAR = np.float32(1.0e6)
EVERY = 2  # frames between two judgements; each takes every second block


class RangeCube:
    """Nearest range seen in every direction from one scan's origin; memory is reused."""

    def __init__(self) -> None:
        self._raw = np.empty((6, PIXELS, PIXELS), np.float32)
        self.range_m = np.empty_like(self._raw)
        self._window = np.ones((3, 3), np.uint8)

    def look(self, scan: DeskewedScan) -> None:
        """Fill the cube from a scan, in the axes of the lidar frame around the scan's origin."""
        self._raw.fill(FAR)
        fill_cube(scan.points, scan.origin, self._raw)
        for face in range(6):
            cv2.erode(self._raw[face], self._window, dst=self.range_m[face])


class FreeSpace:
    """Judges the vertices around the sensor by what each scan looked through."""

    def __init__(self, config: VoxelMapConfig, voxel_map: VoxelMap) -> None:
        self._config = config
        self._map = voxel_map
        self._cube = RangeCube()

    def carve(self, frame: TrackedFrame, stamp: int) -> int:
        """Count looks through and confirmations of a frame; returns how many vertices were carved."""
        gone = 0
        if self._config.free_space and stamp % EVERY == 0:
            for scan in frame.scans:
                self._cube.look(scan)
                gone += carve(
                    self._map.store,
                    self._cube.range_m,
                    frame.T_world_lidar,
                    scan.origin,
                    self._map.block_m,
                    self._config.free_space_range_m,
                    self._config.voxel_m,
                    self._config.free_space_slope,
                    stamp,
                )
        return gone


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
def fill_cube(points: F32, origin: F64, cube: F32) -> None:
    """Smallest range of the points (n, 3) in each pixel of ``cube`` (6, PIXELS, PIXELS)."""
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        face, row, column = pixel(x, y, z)
        if face >= 0:
            r = np.float32(math.sqrt(x * x + y * y + z * z))
            if r < cube[face, row, column]:
                cube[face, row, column] = r


@kernel
def carve(
    store: Store,
    cube: F32,
    T_world_lidar: F64,
    origin: F64,
    block_m: float,
    reach_m: float,
    margin_m: float,
    slope: float,
    stamp: int,
) -> int:
    """Judge the cells of the blocks around the sensor, every second block at a time.

    A cell whose points lie at range r was looked through when the range seen there exceeds r + margin + slope r;
    the margin is a voxel, the slope the error of a range image's pixel at grazing surfaces. Returns how many
    cells lost their evidence.
    """
    R, t = T_world_lidar[:3, :3], T_world_lidar[:3, 3]
    ox = R[0, 0] * origin[0] + R[0, 1] * origin[1] + R[0, 2] * origin[2] + t[0]
    oy = R[1, 0] * origin[0] + R[1, 1] * origin[1] + R[1, 2] * origin[2] + t[1]
    oz = R[2, 0] * origin[0] + R[2, 1] * origin[1] + R[2, 2] * origin[2] + t[2]
    gone = 0
    for bx in range(math.floor((ox - reach_m) / block_m), math.floor((ox + reach_m) / block_m) + 1):
        for by in range(math.floor((oy - reach_m) / block_m), math.floor((oy + reach_m) / block_m) + 1):
            for bz in range(math.floor((oz - reach_m) / block_m), math.floor((oz + reach_m) / block_m) + 1):
                if (bx + by + bz + stamp // EVERY) & 1:
                    continue
                key = bs.block_key(bx, by, bz)
                at = bs.find_slot(store.hash_key, key)
                if store.hash_key[at] == key:
                    gone += _carve_block(
                        store,
                        store.hash_slot[at],
                        cube,
                        R,
                        ox,
                        oy,
                        oz,
                        block_m / 32.0,
                        margin_m,
                        slope,
                        stamp,
                    )
    store.counter[CARVED_CELLS] += gone
    return gone


@kernel
def _carve_block(
    store: Store,
    block: int,
    cube: F32,
    R: F64,
    ox: float,
    oy: float,
    oz: float,
    cell_m: float,
    margin_m: float,
    slope: float,
    stamp: int,
) -> int:
    gone = 0
    for inner in range(512):
        v = store.block_voxel[block, inner]
        if v < 0:
            continue
        gone_here = 0
        for c in range(64):
            s = store.voxel_cell[v, c]
            if s < 0 or store.evidence[s, COUNT] == 0.0:
                continue
            e = store.evidence[s]
            # the mean of the cell's points: a vertex may not have been made of them yet
            k = 1.0 / e[COUNT]
            dx = (4 * store.voxel[v, IX] + (c >> 4) + 0.5) * cell_m + k * e[SUM] - ox
            dy = (4 * store.voxel[v, IY] + ((c >> 2) & 3) + 0.5) * cell_m + k * e[SUM + 1] - oy
            dz = (4 * store.voxel[v, IZ] + (c & 3) + 0.5) * cell_m + k * e[SUM + 2] - oz
            face, row, column = pixel(
                R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz,
                R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz,
                R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz,
            )
            if face < 0:
                continue
            seen = cube[face, row, column]
            if seen >= FAR:
                continue
            r = math.sqrt(dx * dx + dy * dy + dz * dz)
            if seen > r + margin_m + slope * r:
                e[THROUGH] += 1.0
                if is_seen_through(e):
                    gone_here += store.state[s] == ALIVE
                    store.state[s] = CARVED
                    e[HITS] = 0.0
                    for k in range(COUNT, THROUGH):
                        e[k] = 0.0
                    gone += 1
            elif seen > r - margin_m:
                e[CONFIRMED] += 1.0
        if gone_here > 0:
            _remesh_around(store, v, stamp)
    return gone


@kernel
def _remesh_around(store: Store, v: int, stamp: int) -> None:
    """A vertex of ``v`` went: every patch that may use it is made anew."""
    x, y, z = store.voxel[v, 0], store.voxel[v, 1], store.voxel[v, 2]
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                block = bs.find_block(store, (x + dx) >> 3, (y + dy) >> 3, (z + dz) >> 3)
                if block >= 0:
                    u = store.block_voxel[block, bs.inner_index(x + dx, y + dy, z + dz)]
                    if u >= 0:
                        store.voxel[u, FRESH] += AT_ONCE
                        bs.enqueue(store, u, stamp)
