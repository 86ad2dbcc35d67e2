"""What beams met around an image's time: the points of the scans that the image shows, for the classes of vertices.

A vertex is a mean over seconds, and whether an image shows it is judged by a depth map of the map, in which a
railing is as wide as its vertices are apart. A beam needs no such judgement: the camera stands beside the LiDAR, so
what a beam met while the image was taken the image shows, unless something nearer covers it from a few centimetres
aside. That is judged among the points themselves, within the width by which outlines of masks are unsure.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from artemis_edge import block_store as bs
from artemis_edge._jit import kernel
from artemis_edge.block_store import ALIVE, NORMAL, POSITION, Store
from artemis_edge.class_rows import best_class, is_blank
from artemis_edge.frames import F32, F64, I32, I64, U8, TrackedFrame
from artemis_edge.insertion import NOWHERE
from artemis_edge.segmentation.backend import FULL_SCORE
from artemis_edge.sight import (
    CELL_RAD,
    LEAST_COSINE,
    NEAR_M,
    Seen,
    Sight,
    cell_px,
    depth_ahead,
    pixel_of,
    project,
)

# Columns of measured points: place in world [m], and the depth of the nearest point around its pixel [m]
X, FRONT = 0, 3
COLUMNS = 4
# What is nearer within so many cells of SHARE of a cell of the depth map (10 pixels of 1280) may cover a point.
# Figures of less and of more: docs/semantics.md
REACH_CELLS, SHARE = 2, 0.5
# A surface's own points are that much nearer than its plane at most: roughness, and noise of range
ROUGH_SHARE, ROUGH_M = 0.04, 0.1
# What stands so far before a point may be hollow, and the beam have passed a pane [m]
HOLLOW_M = 0.7
# Of the points in a cube of THIN_M, about a vertex' cell, so many are looked at: more cost more and tell little else
THIN_M, ENOUGH = 0.1, 2
# Cubes that points are sorted by, and in how many buckets
NEAR_BY_M, _BUCKETS = 0.4, 1 << 12
_TABLE = 1 << 16  # places of the table that thins points out; cubes that share one take it from each other


class Scope(NamedTuple):
    """How far one looks, how large the map's cells are, and pixels: within which a nearer point may cover another, and
    of a cell of the depth map."""

    reach_m: float
    cell_m: float
    around_px: float
    depth_px: float


def scope_of(lens: F64, reach_m: float, cell_m: float) -> Scope:
    """For a ``Sight.lens``."""
    return Scope(reach_m, cell_m, _cell_px(lens) * (REACH_CELLS + 0.5), cell_px(lens))


class LatestScans:
    """The scans of the latest frame, and what of them an image shows."""

    def __init__(self) -> None:
        self._frame: TrackedFrame | None = None

    def take(self, frame: TrackedFrame) -> None:
        """A frame that has been tracked; the one before is forgotten."""
        self._frame = frame

    def in_view(self, sight: Sight, reach_m: float) -> F32:
        """Points float32 (n, COLUMNS) that ``sight`` shows within ``reach_m``, sorted by place."""
        frame = self._frame
        scans = () if frame is None else tuple((scan.points, frame.T_world_lidar) for scan in frame.scans)
        room = sum(len(points) for points, _ in scans)
        rows, cell = np.empty((room, COLUMNS), np.float32), np.empty(room, np.int32)
        size = _cell_px(sight.lens)
        height, width = math.ceil(sight.lens[10] / size), math.ceil(sight.lens[9] / size)
        nearness = np.zeros((height, width), np.float32)
        thin, taken = np.zeros(_TABLE, np.int64), np.zeros(_TABLE, np.uint8)
        n = 0
        for points, T_world_lidar in scans:
            n = list_points(points, T_world_lidar, sight, reach_m, size, nearness, thin, taken, rows, cell, n)
        reach = 2 * REACH_CELLS + 1
        front = cv2.dilate(nearness, np.ones((reach, reach), np.uint8))
        rows[:n, FRONT] = 1.0 / front.reshape(-1)[cell[:n]]
        return in_blocks(rows[:n])


def in_blocks(rows: F32) -> F32:
    """The rows, those of one block of the map's kind together: looked up so, they cost a third."""
    count = np.zeros(_BUCKETS + 1, np.int64)
    out, bucket = np.empty_like(rows), np.empty(len(rows), np.int32)
    sort_by_place(rows, bucket, count, out)
    return out


@kernel
def sort_by_place(rows: F32, bucket: I32, count: I64, out: F32) -> None:
    """Counting sort of ``rows`` (n, COLUMNS) by the cube of NEAR_BY_M that they are in, into ``out``; stable."""
    mask = count.shape[0] - 2
    for i in range(rows.shape[0]):
        key = bs.block_key(
            math.floor(rows[i, X] / NEAR_BY_M),
            math.floor(rows[i, X + 1] / NEAR_BY_M),
            math.floor(rows[i, X + 2] / NEAR_BY_M),
        )
        bucket[i] = _spread(key, mask)
        count[bucket[i] + 1] += 1
    for k in range(1, count.shape[0]):
        count[k] += count[k - 1]
    for i in range(rows.shape[0]):
        at = count[bucket[i]]
        count[bucket[i]] += 1
        for c in range(COLUMNS):
            out[at, c] = rows[i, c]


@kernel
def _spread(key: int, mask: int) -> int:
    """A place 0..``mask`` for a key: of the product's bits the high ones, which all bits of the key reach."""
    product = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return int(np.int64(product >> np.uint64(40)) & mask)


def _cell_px(lens: F64) -> float:
    return float(max(round(float(lens[0]) * CELL_RAD * SHARE), 1))


@kernel
def list_points(
    points: F32,
    T: F64,
    sight: Sight,
    reach_m: float,
    size_px: float,
    nearness: F32,
    thin: I64,
    taken: U8,
    rows: F32,
    cell: I32,
    n: int,
) -> int:
    """Points (k, 3) of a scan in view into ``rows``, their cells of ``nearness`` (h, w) into ``cell``, from ``n`` on.

    ``T`` is T_world_lidar; ``thin`` int64 and ``taken`` uint8 say how many rows cubes have. Returns all rows.
    """
    C, lens = sight.T_cam_world, sight.lens
    for i in range(points.shape[0]):
        a, b, c = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        depth = C[2, 0] * x + C[2, 1] * y + C[2, 2] * z + C[2, 3]
        if not (depth >= NEAR_M and depth <= reach_m):
            continue
        right = (C[0, 0] * x + C[0, 1] * y + C[0, 2] * z + C[0, 3]) / depth
        down = (C[1, 0] * x + C[1, 1] * y + C[1, 2] * z + C[1, 3]) / depth
        u, v, shown = pixel_of(right, down, lens)
        if not shown:
            continue
        row = min(max(int(v / size_px), 0), nearness.shape[0] - 1)
        column = min(max(int(u / size_px), 0), nearness.shape[1] - 1)
        nearness[row, column] = max(nearness[row, column], np.float32(1.0 / depth))
        # 0, with which the table begins, is the key of a cube 100 km away
        key = bs.block_key(math.floor(x / THIN_M), math.floor(y / THIN_M), math.floor(z / THIN_M))
        place = _spread(key, thin.shape[0] - 1)
        if thin[place] != key:
            thin[place], taken[place] = key, 0
        if taken[place] == ENOUGH:
            continue
        taken[place] += 1
        rows[n, X], rows[n, X + 1], rows[n, X + 2] = x, y, z
        cell[n] = row * nearness.shape[1] + column
        n += 1
    return n


class Shown(NamedTuple):
    """What a mask shows: ``score`` uint8 (h, w, layers), its ``grid`` (voxel_fusion.grid_of), each layer's ``slot``."""

    score: U8
    grid: F32
    slot: I32


class Scratch(NamedTuple):
    """``row`` int32 (cells,): of the vertex in a cell, where ``Seen.slot`` names the cell back; ``vertex`` (6,)."""

    row: I32
    vertex: F32


@kernel
def see_measured(
    store: Store, rows: F32, sight: Sight, scope: Scope, shown: Shown, w: Scratch, seen: Seen, mean: F32
) -> int:
    """The vertices in whose cells the measured points ``rows`` (n, COLUMNS) lie, and what the points' pixels show.

    A point counts where no nearer one may cover it, and where it is not behind a pane: what the map has far before it
    is then of the very class that the pixel shows. ``seen`` gets a row for each vertex, W of eq. 9 being 1, because a
    beam has just met it, and ``mean`` float32 (cells, layers) the scores 0..1, the mean over its points. Returns how
    many.
    """
    n, layers = 0, shown.score.shape[2]
    last_x, last_y, last_z, voxel = NOWHERE, 0, 0, -1
    for i in range(rows.shape[0]):
        if n == seen.slot.shape[0]:
            break
        cx = math.floor(rows[i, X] / scope.cell_m)
        cy = math.floor(rows[i, X + 1] / scope.cell_m)
        cz = math.floor(rows[i, X + 2] / scope.cell_m)
        if cx >> 2 != last_x or cy >> 2 != last_y or cz >> 2 != last_z:
            last_x, last_y, last_z = cx >> 2, cy >> 2, cz >> 2
            voxel = voxel_at(store, last_x, last_y, last_z)
        slot = vertex_of(store.voxel_cell, store.state, voxel, cx, cy, cz)
        if slot < 0:
            continue
        if not _is_shown(store.vertex[slot], rows[i], sight, scope, w.vertex, seen, n):
            continue
        line, column = _score_cell(shown, seen.u[n], seen.v[n])
        ahead = depth_ahead(seen, n, scope.depth_px, sight.depth)
        if ahead >= HOLLOW_M:
            before = _class_before(store, rows[i], sight, 1.0 - ahead / seen.z[n], scope.cell_m)
            if before < 0 or before == shown.slot[_best_layer(shown.score, line, column)]:
                continue
        k = w.row[slot]
        if not (0 <= k < n and seen.slot[k] == slot):
            k = w.row[slot] = n
            seen.slot[k], seen.voxel[k] = slot, voxel
            seen.depth_error[k], seen.reliability[k] = 0.0, 0.0
            mean[k] = 0.0
            n += 1
        seen.reliability[k] += 1.0
        for layer in range(layers):
            mean[k, layer] += shown.score[line, column, layer]
    for k in range(n):
        share = np.float32(1.0 / FULL_SCORE) / seen.reliability[k]
        seen.reliability[k] = 1.0
        for layer in range(layers):
            mean[k, layer] *= share
    return n


@kernel
def _is_shown(vertex: F32, row: F32, sight: Sight, scope: Scope, p: F32, seen: Seen, n: int) -> bool:
    """Whether no nearer point may cover a measured one; its pixel and the vertex' plane there into row ``n``."""
    for k in range(3):
        p[POSITION + k], p[NORMAL + k] = row[X + k], vertex[NORMAL + k]
    if not project(p, sight.T_cam_world, sight.lens, scope.reach_m, seen, n) or seen.cosine[n] < LEAST_COSINE:
        return False
    # the nearest that the surface itself comes within the window
    steepest = abs(seen.right[n]) + abs(seen.down[n])
    nearest = 1.0 / (1.0 / seen.z[n] + steepest * scope.around_px)
    return bool(row[FRONT] >= nearest * (1.0 - ROUGH_SHARE) - ROUGH_M)


@kernel
def _score_cell(shown: Shown, u: float, v: float) -> tuple[int, int]:
    """Line and column of the scores' cell that a pixel is in; the mean over points does what interpolation would."""
    line = int(v * shown.grid[1] + shown.grid[3] + 0.5)
    column = int(u * shown.grid[0] + shown.grid[2] + 0.5)
    return (
        min(max(line, 0), shown.score.shape[0] - 1),
        min(max(column, 0), shown.score.shape[1] - 1),
    )


@kernel
def _best_layer(score: U8, line: int, column: int) -> int:
    best = 0
    for layer in range(1, score.shape[2]):
        if score[line, column, layer] > score[line, column, best]:
            best = layer
    return best


@kernel
def _class_before(store: Store, row: F32, sight: Sight, share: float, r: float) -> int:
    """The class of the map's surface at ``share`` of the way to a measured point, -1 where there is none.

    ``r`` is the edge of a cell [m]. It takes the whole store, which costs as much as the rest: not for every point.
    """
    T = sight.T_cam_world
    x, y, z = np.float64(row[X]), np.float64(row[X + 1]), np.float64(row[X + 2])
    eye_x = -(T[0, 0] * T[0, 3] + T[1, 0] * T[1, 3] + T[2, 0] * T[2, 3])
    eye_y = -(T[0, 1] * T[0, 3] + T[1, 1] * T[1, 3] + T[2, 1] * T[2, 3])
    eye_z = -(T[0, 2] * T[0, 3] + T[1, 2] * T[1, 3] + T[2, 2] * T[2, 3])
    x, y, z = eye_x + share * (x - eye_x), eye_y + share * (y - eye_y), eye_z + share * (z - eye_z)
    _, slot = vertex_at(store, x, y, z, r)
    for k in range(1, 8):
        if slot >= 0 and not is_blank(store.attribute[slot]):
            return int(best_class(store.attribute[slot]))
        # then the cells beside it
        step = r if k % 2 else -r
        dx, dy, dz = step * (k < 3), step * (k == 3 or k == 4), step * (k > 4)
        _, slot = vertex_at(store, x + dx, y + dy, z + dz, r)
    return -1


@kernel
def vertex_at(store: Store, x: float, y: float, z: float, cell_m: float) -> tuple[int, int]:
    """Voxel and slot of the living vertex of the cell that a place is in; -1 for the slot where there is none."""
    cx, cy, cz = math.floor(x / cell_m), math.floor(y / cell_m), math.floor(z / cell_m)
    voxel = voxel_at(store, cx >> 2, cy >> 2, cz >> 2)
    return voxel, vertex_of(store.voxel_cell, store.state, voxel, cx, cy, cz)


@kernel
def voxel_at(store: Store, x: int, y: int, z: int) -> int:
    """Slot of the voxel of that index, -1 where there is none."""
    block = bs.find_block(store, x >> 3, y >> 3, z >> 3)
    return int(store.block_voxel[block, bs.inner_index(x, y, z)]) if block >= 0 else -1


@kernel
def vertex_of(voxel_cell: I32, state: U8, voxel: int, cx: int, cy: int, cz: int) -> int:
    """Slot of the living vertex of a voxel's cell of that index, -1 where there is none."""
    if voxel < 0:
        return -1
    slot = voxel_cell[voxel, ((cx & 3) << 4) | ((cy & 3) << 2) | (cz & 3)]
    return int(slot) if slot >= 0 and state[slot] == ALIVE else -1
