"""What of the map an image shows: blocks in the frustum, their vertices and triangles, the reference depth map."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from artemis_edge import block_store as bs
from artemis_edge._jit import kernel
from artemis_edge.block_store import (
    ALIVE,
    AT_MESH,
    BX,
    IX,
    IY,
    IZ,
    PATCH_AT,
    PATCH_LEN,
    POSITION,
    QUEUED,
    Store,
)
from artemis_edge.cell_code import code_cell, code_voxel
from artemis_edge.frames import F32, I32
from artemis_edge.paging import EAR_MASK
from artemis_edge.refinement.camera import Camera, sees_sphere, to_camera, to_pixel

NEAR_M = 0.2
_GROWTH = 2  # of lists that are full
# Half the diagonal of a cube in edges
_HALF_DIAGONAL = 0.8661
_VOXELS = 512  # of a block


class Visible(NamedTuple):
    """Lists of one image. Vertices and triangles have room for more than ``length`` says."""

    voxel: I32  # (512,) slots of the block at hand
    slot: I32  # (n,) cell slots of living vertices
    point: F32  # (n, 3) in the camera's coordinates [m]
    pixel: F32  # (n, 3) u, v and nearness 1 / z; NaN where not in front of the camera
    place: I32  # (cells,) row of a cell slot; counts only where ``slot`` of that row names it back
    triangle: I32  # (m, 3) rows of vertices
    owner: I32  # (m,) voxel slot
    neighbour: I32  # (27,)
    length: I32  # (2,) vertices, triangles
    block: I32  # (blocks,) slots, and
    away: F32  # (blocks,) how far they are from the camera [m]


def new_visible(store: Store, vertices: int = 65_536, triangles: int = 131_072) -> Visible:
    """Fresh scratch with room for so much in one view."""
    return Visible(
        voxel=np.empty(_VOXELS, np.int32),
        slot=np.empty(vertices, np.int32),
        point=np.empty((vertices, 3), np.float32),
        pixel=np.empty((vertices, 3), np.float32),
        place=np.zeros(len(store.state), np.int32),
        triangle=np.empty((triangles, 3), np.int32),
        owner=np.empty(triangles, np.int32),
        neighbour=np.empty(27, np.int32),
        length=np.zeros(2, np.int32),
        block=np.empty(len(store.block), np.int32),
        away=np.empty(len(store.block), np.float32),
    )


class Scope(NamedTuple):
    """How far and how finely one looks: ``step`` image pixels are one of the depth map.

    Left out is what lies so far behind that the nearness of what is in front of it is more than ``behind`` times its
    own, and the blocks that are farther away than those that have ``most`` triangles.
    """

    voxel_m: float
    far_m: float
    step: int
    behind: float
    most: int


def list_visible(store: Store, camera: Camera, scope: Scope, w: Visible) -> tuple[Visible, Depth]:
    """Vertices and triangles in view, but for what is hidden clearly, and the reference depth map d_ref of eq. 11.

    Returns ``w``, or larger scratch if it had to grow. From the nearest block to the farthest, so that what hides is
    known before what is hidden. Corners are put where the lens puts them and edges are drawn straight: between
    vertices 0.1 m apart a lens bends an edge by much less than a pixel of this map.
    """
    n = list_blocks(store, camera, scope, w)
    blocks = w.block[:n][np.argsort(w.away[:n], kind="stable")]
    while True:
        nearness = np.zeros((-(-camera.height // scope.step), -(-camera.width // scope.step)), np.float32)
        if see_blocks(store, camera, scope, blocks, w, nearness):
            break
        room = _GROWTH * len(w.slot)
        point, pixel = np.empty((2, room, 3), np.float32)
        triangles = _GROWTH * len(w.triangle)
        w = w._replace(
            slot=np.empty(room, np.int32),
            point=point,
            pixel=pixel,
            triangle=np.empty((triangles, 3), np.int32),
            owner=np.empty(triangles, np.int32),
        )
    front = cv2.dilate(nearness, np.ones((3, 3), np.uint8)).astype(np.float32, copy=False)
    return w, Depth(nearness, front, scope.step)


@kernel
def list_blocks(store: Store, camera: Camera, scope: Scope, w: Visible) -> int:
    """Blocks in view and how far away they are, in the order of the hash; returns how many."""
    n, block_m = 0, scope.voxel_m * bs.VOXELS_PER_BLOCK
    radius = _HALF_DIAGONAL * block_m + scope.voxel_m
    for at in range(store.hash_key.shape[0]):
        if store.hash_key[at] == bs.EMPTY_KEY:
            continue
        row = store.block[store.hash_slot[at]]
        x, y, z = (row[BX] + 0.5) * block_m, (row[BX + 1] + 0.5) * block_m, (row[BX + 2] + 0.5) * block_m
        if sees_sphere(camera, x, y, z, radius, NEAR_M, scope.far_m):
            a, b, c = to_camera(camera, x, y, z)
            w.block[n], w.away[n] = store.hash_slot[at], math.sqrt(a * a + b * b + c * c)
            n += 1
    return n


@kernel
def see_blocks(store: Store, camera: Camera, scope: Scope, blocks: I32, w: Visible, nearness: F32) -> bool:
    """List what ``blocks`` show, and draw their nearness; False when a list is full."""
    w.length[:] = 0
    block_m = scope.voxel_m * bs.VOXELS_PER_BLOCK
    radius = _HALF_DIAGONAL * block_m + scope.voxel_m
    for block in blocks:
        row = store.block[block]
        x, y, z = (row[BX] + 0.5) * block_m, (row[BX + 1] + 0.5) * block_m, (row[BX + 2] + 0.5) * block_m
        if w.length[1] >= scope.most:
            break
        if is_hidden(camera, scope, x, y, z, radius, nearness):
            continue
        voxels = list_voxels(store, camera, scope, block, nearness, w.voxel)
        for i in range(voxels):
            if not list_vertices(store, camera, w.voxel[i], w):
                return False
        for i in range(voxels):
            first = w.length[1]
            if not list_triangles(store, camera, w.voxel[i], w):
                return False
            draw_nearness(w.pixel, w.triangle[first : w.length[1]], 1.0 / scope.step, nearness)
    return True


@kernel
def is_hidden(
    camera: Camera, scope: Scope, x: float, y: float, z: float, radius: float, nearness: F32
) -> bool:
    """Whether all that a sphere of the world can cover in the depth map is clearly behind what is drawn there."""
    a, b, c = to_camera(camera, x, y, z)
    if c - radius < NEAR_M:
        return False
    u, v = to_pixel(camera, a / c, b / c)
    least = scope.behind / (c - radius)
    scale = 1.0 / scope.step
    # a / c changes by no more than radius / (c - radius) (1 + |a / c|) over the sphere
    reach = camera.stretch * radius / (c - radius) * scale
    wide, high = reach * camera.fx * (1.0 + abs(a / c)) + 1.0, reach * camera.fy * (1.0 + abs(b / c)) + 1.0
    u, v = (u + 0.5) * scale, (v + 0.5) * scale
    rows, columns = nearness.shape
    if not (0.0 <= u < columns and 0.0 <= v < rows) or nearness[int(v), int(u)] <= least:
        return False
    for row in range(max(int(v - high), 0), min(int(v + high) + 1, rows)):
        for column in range(max(int(u - wide), 0), min(int(u + wide) + 1, columns)):
            if nearness[row, column] <= least:
                return False
    return True


@kernel
def list_voxels(store: Store, camera: Camera, scope: Scope, block: int, nearness: F32, out: I32) -> int:
    """Slots of the voxels of a block that are in view and not hidden; returns how many."""
    n, voxel_m = 0, scope.voxel_m
    # a voxel's triangles reach into its neighbours, and theirs use its vertices
    radius = (_HALF_DIAGONAL + 1.0) * voxel_m
    for inner in range(_VOXELS):
        v = store.block_voxel[block, inner]
        if v < 0 or store.voxel_mask[v] == 0:
            continue
        own = store.voxel[v]
        x, y, z = (own[IX] + 0.5) * voxel_m, (own[IY] + 0.5) * voxel_m, (own[IZ] + 0.5) * voxel_m
        if sees_sphere(camera, x, y, z, radius, NEAR_M, scope.far_m) and not is_hidden(
            camera, scope, x, y, z, radius, nearness
        ):
            out[n] = v
            n += 1
    return n


@kernel
def unmeshed(store: Store, camera: Camera, voxel_m: float, far_m: float) -> float:
    """Share of the voxels in view that wait for their first patch; 1 where no voxel is in view."""
    total = waiting = 0
    block_m = voxel_m * bs.VOXELS_PER_BLOCK
    for at in range(store.hash_key.shape[0]):
        if store.hash_key[at] == bs.EMPTY_KEY:
            continue
        block = store.hash_slot[at]
        row = store.block[block]
        x, y, z = (row[BX] + 0.5) * block_m, (row[BX + 1] + 0.5) * block_m, (row[BX + 2] + 0.5) * block_m
        if not sees_sphere(camera, x, y, z, 0.0, NEAR_M, far_m):
            continue
        for inner in range(512):
            v = store.block_voxel[block, inner]
            if v >= 0 and store.voxel_mask[v] != 0:
                total += 1
                waiting += store.voxel[v, AT_MESH] == 0 and store.voxel[v, QUEUED] != 0
    return float(waiting / total) if total > 0 else 1.0


@kernel
def row_of(w: Visible, s: int) -> int:
    """Row of a vertex, -1 where it is not listed."""
    row = w.place[s]
    return int(row) if row < w.length[0] and w.slot[row] == s else -1


@kernel
def add_vertex(store: Store, camera: Camera, s: int, w: Visible) -> int:
    """List a vertex that is not listed, projected; returns its row, -1 when the list is full."""
    n = int(w.length[0])
    if n == w.slot.shape[0]:
        return -1
    p = store.vertex[s]
    x, y, z = to_camera(camera, p[POSITION], p[POSITION + 1], p[POSITION + 2])
    w.slot[n] = s
    w.place[s] = n
    w.point[n, 0], w.point[n, 1], w.point[n, 2] = x, y, z
    if z > NEAR_M:
        near = 1.0 / z
        w.pixel[n, 0], w.pixel[n, 1] = to_pixel(camera, x * near, y * near)
        w.pixel[n, 2] = near
    else:
        w.pixel[n, 0] = w.pixel[n, 1] = w.pixel[n, 2] = math.nan
    w.length[0] = n + 1
    return n


@kernel
def list_vertices(store: Store, camera: Camera, v: int, w: Visible) -> bool:
    """List the living vertices of a voxel; False when the list is full."""
    mask = store.voxel_mask[v]
    while mask != 0:
        s = store.voxel_cell[v, bs.lowest_bit(mask)]
        mask &= mask - np.uint64(1)
        if store.state[s] == ALIVE and row_of(w, s) < 0 and add_vertex(store, camera, s, w) < 0:
            return False
    return True


@kernel
def _living(store: Store, w: Visible, code: int) -> int:
    """Cell slot of the vertex that a triangle's code names, -1 where it does not live."""
    u = w.neighbour[code_voxel(code)]
    if u < 0:
        return -1
    s = store.voxel_cell[u, code_cell(code)]
    return int(s) if s >= 0 and store.state[s] == ALIVE else -1


@kernel
def list_triangles(store: Store, camera: Camera, v: int, w: Visible) -> bool:
    """List the triangles of a voxel all of whose vertices lie in front of the camera; False when a list is full."""
    length = store.voxel[v, PATCH_LEN]
    if length == 0:
        return True
    m = int(w.length[1])
    if m + length > w.triangle.shape[0]:
        return False
    bs.neighbours27(store, v, w.neighbour)
    at = store.voxel[v, PATCH_AT]
    for t in range(at, at + length):
        i = _living(store, w, np.int64(store.triangle[t, 0]) & EAR_MASK)
        j = _living(store, w, np.int64(store.triangle[t, 1]))
        k = _living(store, w, np.int64(store.triangle[t, 2]))
        if i < 0 or j < 0 or k < 0:
            continue
        a, b, c = row_of(w, i), row_of(w, j), row_of(w, k)
        if a < 0 or b < 0 or c < 0:  # of a block that comes later
            a = add_vertex(store, camera, i, w) if a < 0 else a
            b = add_vertex(store, camera, j, w) if b < 0 else b
            c = add_vertex(store, camera, k, w) if c < 0 else c
            if a < 0 or b < 0 or c < 0:
                return False
        if math.isnan(w.pixel[a, 0] + w.pixel[b, 0] + w.pixel[c, 0]):
            continue
        w.triangle[m, 0], w.triangle[m, 1], w.triangle[m, 2] = a, b, c
        w.owner[m] = v
        m += 1
    w.length[1] = m
    return True


@kernel
def facing(a: F32, b: F32, c: F32) -> float:
    """Cosine between a triangle's normal and the direction to the camera, of corners in camera coordinates.

    Negative seen from behind; 0 without area.
    """
    ux, uy, uz = np.float64(b[0]) - a[0], np.float64(b[1]) - a[1], np.float64(b[2]) - a[2]
    vx, vy, vz = np.float64(c[0]) - a[0], np.float64(c[1]) - a[1], np.float64(c[2]) - a[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    mx, my, mz = (
        np.float64(a[0]) + b[0] + c[0],
        np.float64(a[1]) + b[1] + c[1],
        np.float64(a[2]) + b[2] + c[2],
    )
    length2 = (nx * nx + ny * ny + nz * nz) * (mx * mx + my * my + mz * mz)
    if length2 <= 0.0:
        return 0.0
    return float(-(nx * mx + ny * my + nz * mz) / math.sqrt(length2))


class Depth(NamedTuple):
    """The reference depth map at 1 / ``step`` of the image's resolution, in the image's own (distorted) geometry.

    ``nearness`` float32 (h, w) is 1 / z [1/m], 0 where nothing; ``front`` the nearest within one pixel around.
    A pixel's centre (i, j) lies at ``step`` (i, j) + (step - 1) / 2 of the image.
    """

    nearness: F32
    front: F32
    step: int


@kernel
def draw_nearness(pixel: F32, triangle: I32, scale: float, nearness: F32) -> None:
    """Draw triangles (m, 3) of image points (n, 3) u, v, 1 / z into a z-buffer of 1 / z, which is linear there."""
    height, width = nearness.shape
    shift = 0.5 * (scale - 1.0)
    for k in range(triangle.shape[0]):
        a, b, c = pixel[triangle[k, 0]], pixel[triangle[k, 1]], pixel[triangle[k, 2]]
        au, av = a[0] * scale + shift, a[1] * scale + shift
        bu, bv = b[0] * scale + shift, b[1] * scale + shift
        cu, cv = c[0] * scale + shift, c[1] * scale + shift
        first_u = max(math.ceil(min(au, bu, cu)), 0)
        last_u = min(math.floor(max(au, bu, cu)), width - 1)
        first_v = max(math.ceil(min(av, bv, cv)), 0)
        last_v = min(math.floor(max(av, bv, cv)), height - 1)
        if first_u > last_u or first_v > last_v:
            continue
        area = (bu - au) * (cv - av) - (cu - au) * (bv - av)
        if area == 0.0:
            continue
        # barycentric weights of b and c, and nearness, as linear functions of the pixel
        k_area = 1.0 / area
        b_u, b_v = (cv - av) * k_area, -(cu - au) * k_area
        c_u, c_v = -(bv - av) * k_area, (bu - au) * k_area
        da, db, dc = np.float64(a[2]), np.float64(b[2]) - a[2], np.float64(c[2]) - a[2]
        du = first_u - au
        for row in range(first_v, last_v + 1):
            dv = row - av
            wb, wc = b_u * du + b_v * dv, c_u * du + c_v * dv
            for column in range(first_u, last_u + 1):
                if wb >= 0.0 and wc >= 0.0 and wb + wc <= 1.0:
                    near = np.float32(da + wb * db + wc * dc)
                    nearness[row, column] = max(nearness[row, column], near)
                wb, wc = wb + b_u, wc + c_u
