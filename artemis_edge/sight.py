"""Which vertices of the map an image sees: the list that voxel fusion and semantic refinement share.

Blocks outside the view frustum are passed over whole. What remains is projected through the lens; a vertex behind
what the reference depth map shows there by more than the map's error is occluded. Masks come late, so all of it
is done with the pose and the depth map of the mask's own image.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from artemis_edge import block_store as bs
from artemis_edge._jit import kernel
from artemis_edge.block_store import ALIVE, NORMAL, POSITION, Store
from artemis_edge.frames import F32, F64, I32, CameraModel
from artemis_edge.lens import fold_radius
from artemis_edge.trajectory import inverse

NEAR_M = 0.3  # nearer surfaces fill the image and are blurred
_FRUSTUM_MARGIN = 1.1  # of the largest line of sight: distortion moves the corners outwards
# Cells of the depth map that splats are drawn on: one pixel in eight keeps an edge within a vertex' own spacing
DEPTH_SHARE = 8
_SPLAT = 0.75  # radius of a splat in point spacings: neighbouring splats overlap and leave no hole


class Sight(NamedTuple):
    """One image's view of the world.

    ``T_cam_world`` float64 (3, 4); ``lens`` float64 (12,): fx fy cx cy k1 k2 p1 p2 k3 width height and the squared
    radius within which the lens model holds; ``tangent`` float64 (4,): x / z and y / z, least and most, that the
    image can show; ``depth`` float32 (h, w) reference depth along z [m], inf where nothing is known, one cell for
    every ``DEPTH_SHARE`` pixels.
    """

    T_cam_world: F64
    lens: F64
    tangent: F64
    depth: F32


class Seen(NamedTuple):
    """Vertices in view, voxel by voxel; arrays as long as the map's pool of cells, of which ``n`` rows are valid."""

    slot: I32  # of the cell
    voxel: I32
    u: F32  # pixel
    v: F32
    z: F32  # depth [m]
    cosine: F32  # between the line of sight and the normal, 0 when seen from behind
    depth_error: F32  # |depth - reference depth| [m], 0 where no reference is known


def new_seen(cells: int) -> Seen:
    """Memory for as many vertices as the map can hold; only what is used is ever touched."""
    return Seen(
        np.empty(cells, np.int32),
        np.empty(cells, np.int32),
        *(np.empty(cells, np.float32) for _ in range(5)),
    )


def new_sight(camera: CameraModel, T_world_cam: F64) -> Sight:
    """The view of ``camera`` from a pose, with an empty depth map."""
    lens = np.array(
        [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion, camera.width, camera.height, 0.0]
    )
    lens[11] = min(fold_radius(lens[4:9]) ** 2, 1e6)
    u, v = np.array([0.0, camera.width - 1]), np.array([0.0, camera.height - 1])
    tangent = np.array([*(u - camera.cx) / camera.fx, *(v - camera.cy) / camera.fy]) * _FRUSTUM_MARGIN
    return Sight(np.ascontiguousarray(inverse(T_world_cam)[:3]), lens, tangent, empty_depth(lens))


def empty_depth(lens: F64) -> F32:
    """A depth map for a ``Sight.lens`` in which nothing is known."""
    width, height = int(lens[9]), int(lens[10])
    return np.full((-(-height // DEPTH_SHARE), -(-width // DEPTH_SHARE)), np.inf, np.float32)


def without_depth(sight: Sight) -> Sight:
    """The view alone: some hundred bytes, of which thousands can be kept."""
    return sight._replace(depth=np.empty((0, 0), np.float32))


def look(store: Store, sight: Sight, blocks: I32, block_m: float, reach_m: float, seen: Seen) -> int:
    """Living vertices of ``blocks`` (slots) within ``reach_m`` that ``sight`` shows into ``seen``; how many.

    ``depth_error`` is left for :func:`compare_depth`.
    """
    return int(list_seen(store, sight, blocks, block_m, reach_m, seen))


@kernel
def list_seen(store: Store, sight: Sight, blocks: I32, block_m: float, reach_m: float, seen: Seen) -> int:
    """Kernel of :func:`look`."""
    T, lens = sight.T_cam_world, sight.lens
    n = 0
    for block in blocks:
        if not _touches_frustum(store, block, sight, block_m, reach_m):
            continue
        for inner in range(512):
            voxel = store.block_voxel[block, inner]
            if voxel < 0:
                continue
            mask = store.voxel_mask[voxel]
            while mask != 0:
                c = bs.lowest_bit(mask)
                mask &= mask - np.uint64(1)
                s = store.voxel_cell[voxel, c]
                if store.state[s] == ALIVE and _project(store.vertex[s], T, lens, reach_m, seen, n):
                    seen.slot[n] = s
                    seen.voxel[n] = voxel
                    n += 1
    return n


@kernel
def see_rows(vertex: F32, T: F64, lens: F64, reach_m: float, seen: Seen) -> int:
    """The vertices ``vertex`` float32 (n, 6), position and normal, that a view shows; ``slot`` is the row."""
    n = 0
    for row in range(vertex.shape[0]):
        if _project(vertex[row], T, lens, reach_m, seen, n):
            seen.slot[n] = row
            n += 1
    return n


@kernel
def _touches_frustum(store: Store, block: int, sight: Sight, block_m: float, reach_m: float) -> bool:
    """Whether the sphere around a block reaches into the view."""
    T, tangent = sight.T_cam_world, sight.tangent
    cx, cy, cz = (
        (store.block[block, 0] + 0.5) * block_m,
        (store.block[block, 1] + 0.5) * block_m,
        (store.block[block, 2] + 0.5) * block_m,
    )
    radius = 0.8661 * block_m
    x = T[0, 0] * cx + T[0, 1] * cy + T[0, 2] * cz + T[0, 3]
    y = T[1, 0] * cx + T[1, 1] * cy + T[1, 2] * cz + T[1, 3]
    z = T[2, 0] * cx + T[2, 1] * cy + T[2, 2] * cz + T[2, 3]
    if z < -radius or z > reach_m + radius:
        return False
    for k in range(2):
        along = x if k == 0 else y
        low, high = tangent[2 * k], tangent[2 * k + 1]
        if along - low * z < -radius * math.sqrt(1.0 + low * low):
            return False
        if along - high * z > radius * math.sqrt(1.0 + high * high):
            return False
    return True


@kernel
def _project(p: F32, T: F64, lens: F64, reach_m: float, seen: Seen, n: int) -> bool:
    """Pixel, depth and cosine of a vertex into row ``n``; False when the image does not show it."""
    px, py, pz = np.float64(p[POSITION]), np.float64(p[POSITION + 1]), np.float64(p[POSITION + 2])
    z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
    if z < NEAR_M or z > reach_m:
        return False
    cx = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
    cy = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
    x, y = cx / z, cy / z
    r2 = x * x + y * y
    if r2 > lens[11]:
        return False
    radial = 1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    u = lens[0] * (x * radial + 2.0 * lens[6] * x * y + lens[7] * (r2 + 2.0 * x * x)) + lens[2]
    v = lens[1] * (y * radial + lens[6] * (r2 + 2.0 * y * y) + 2.0 * lens[7] * x * y) + lens[3]
    if not (u > -0.5 and v > -0.5 and u < lens[9] - 0.5 and v < lens[10] - 0.5):
        return False
    nx, ny, nz = np.float64(p[NORMAL]), np.float64(p[NORMAL + 1]), np.float64(p[NORMAL + 2])
    facing = -(
        (T[0, 0] * nx + T[0, 1] * ny + T[0, 2] * nz) * cx
        + (T[1, 0] * nx + T[1, 1] * ny + T[1, 2] * nz) * cy
        + (T[2, 0] * nx + T[2, 1] * ny + T[2, 2] * nz) * z
    )
    seen.u[n], seen.v[n], seen.z[n] = u, v, z
    seen.cosine[n] = max(facing / (z * math.sqrt(r2 + 1.0)), 0.0)
    return True


@kernel
def splat_depth(seen: Seen, n: int, focal: float, spacing_m: float, depth: F32) -> None:
    """Reference depth of the vertices in view: each covers a square of its own spacing; the nearest stays."""
    height, width = depth.shape
    for i in range(n):
        z = seen.z[i]
        half = _SPLAT * spacing_m * focal / z
        left = max(int((seen.u[i] - half) / DEPTH_SHARE + 0.5), 0)
        right = min(int((seen.u[i] + half) / DEPTH_SHARE + 0.5), width - 1)
        top = max(int((seen.v[i] - half) / DEPTH_SHARE + 0.5), 0)
        bottom = min(int((seen.v[i] + half) / DEPTH_SHARE + 0.5), height - 1)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                if z < depth[row, column]:
                    depth[row, column] = z


@kernel
def compare_depth(seen: Seen, n: int, depth: F32) -> None:
    """``depth_error`` of the vertices in view against the reference depth at their pixels."""
    height, width = depth.shape
    for i in range(n):
        row = min(max(int(seen.v[i] / DEPTH_SHARE + 0.5), 0), height - 1)
        column = min(max(int(seen.u[i] / DEPTH_SHARE + 0.5), 0), width - 1)
        reference = depth[row, column]
        seen.depth_error[i] = abs(seen.z[i] - reference) if reference < np.inf else np.float32(0.0)
