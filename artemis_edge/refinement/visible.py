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
# Triangles larger than this many pixels of the depth map are drawn by clipped boxes all the same; a box this far
# outside the picture belongs to a triangle that the lens model tears apart
_ROOM = 1.2  # of the lists, when they must grow
# Half the diagonal of a cube in edges
_HALF_DIAGONAL = 0.8661


class Visible(NamedTuple):
    """Lists of one image. Vertices and triangles have room for more than ``length`` says."""

    voxel: I32  # (v,) slots
    slot: I32  # (n,) cell slots of living vertices
    point: F32  # (n, 3) in the camera's coordinates [m]
    pixel: F32  # (n, 3) u, v and nearness 1 / z; NaN where not in front of the camera
    place: I32  # (cells,) row of a cell slot; counts only where ``slot`` of that row names it back
    triangle: I32  # (m, 3) rows of vertices
    owner: I32  # (m,) voxel slot
    neighbour: I32  # (27,)
    length: I32  # (3,) voxels, vertices, triangles


def new_visible(store: Store, voxels: int = 1024, vertices: int = 8192, triangles: int = 16384) -> Visible:
    """Fresh scratch with room for so much in one view."""
    return Visible(
        voxel=np.empty(voxels, np.int32),
        slot=np.empty(vertices, np.int32),
        point=np.empty((vertices, 3), np.float32),
        pixel=np.empty((vertices, 3), np.float32),
        place=np.zeros(len(store.state), np.int32),
        triangle=np.empty((triangles, 3), np.int32),
        owner=np.empty(triangles, np.int32),
        neighbour=np.empty(27, np.int32),
        length=np.zeros(3, np.int32),
    )


def list_visible(store: Store, camera: Camera, voxel_m: float, far_m: float, w: Visible) -> Visible:
    """Voxels, vertices and triangles in the frustum; returns ``w``, or larger scratch if it had to grow."""
    n = list_voxels(store, camera, voxel_m, far_m, w.voxel)
    if n > len(w.voxel):
        w = w._replace(voxel=np.empty(int(n * _ROOM), np.int32))
        list_voxels(store, camera, voxel_m, far_m, w.voxel)
    vertices, triangles = count_contents(store, w.voxel[:n])
    if vertices > len(w.slot):
        room = int(vertices * _ROOM)
        point, pixel = np.empty((2, room, 3), np.float32)
        w = w._replace(slot=np.empty(room, np.int32), point=point, pixel=pixel)
    if triangles > len(w.triangle):
        room = int(triangles * _ROOM)
        w = w._replace(triangle=np.empty((room, 3), np.int32), owner=np.empty(room, np.int32))
    w.length[0] = n
    w.length[1] = list_vertices(store, camera, n, w)
    w.length[2] = list_triangles(store, n, w)
    return w


@kernel
def list_voxels(store: Store, camera: Camera, voxel_m: float, far_m: float, out: I32) -> int:
    """Slots of the voxels in view, as many as fit into ``out``; returns how many there are."""
    n = 0
    block_m = voxel_m * bs.VOXELS_PER_BLOCK
    for at in range(store.hash_key.shape[0]):
        if store.hash_key[at] == bs.EMPTY_KEY:
            continue
        block = store.hash_slot[at]
        row = store.block[block]
        x, y, z = (row[BX] + 0.5) * block_m, (row[BX + 1] + 0.5) * block_m, (row[BX + 2] + 0.5) * block_m
        if not sees_sphere(camera, x, y, z, _HALF_DIAGONAL * block_m + voxel_m, NEAR_M, far_m):
            continue
        for inner in range(512):
            v = store.block_voxel[block, inner]
            if v < 0 or store.voxel_mask[v] == 0:
                continue
            own = store.voxel[v]
            x, y, z = (own[IX] + 0.5) * voxel_m, (own[IY] + 0.5) * voxel_m, (own[IZ] + 0.5) * voxel_m
            # a voxel's triangles reach into its neighbours, and theirs use its vertices
            if sees_sphere(camera, x, y, z, (_HALF_DIAGONAL + 1.0) * voxel_m, NEAR_M, far_m):
                if n < out.shape[0]:
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
def count_contents(store: Store, voxels: I32) -> tuple[int, int]:
    """Most vertices and triangles that voxels can have."""
    vertices = triangles = 0
    for v in voxels:
        mask = store.voxel_mask[v]
        while mask != 0:
            mask &= mask - np.uint64(1)
            vertices += 1
        triangles += store.voxel[v, PATCH_LEN]
    return vertices, triangles


@kernel
def list_vertices(store: Store, camera: Camera, voxels: int, w: Visible) -> int:
    """Living vertices of the listed voxels, projected."""
    n = 0
    for i in range(voxels):
        v = w.voxel[i]
        mask = store.voxel_mask[v]
        while mask != 0:
            s = store.voxel_cell[v, bs.lowest_bit(mask)]
            mask &= mask - np.uint64(1)
            if store.state[s] != ALIVE:
                continue
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
            n += 1
    return n


@kernel
def _row_of(store: Store, w: Visible, code: int, vertices: int) -> int:
    """Row of the vertex that a triangle's code names, -1 where it is not listed."""
    u = w.neighbour[code_voxel(code)]
    if u < 0:
        return -1
    s = store.voxel_cell[u, code_cell(code)]
    if s < 0:
        return -1
    row = w.place[s]
    return row if row < vertices and w.slot[row] == s else -1


@kernel
def list_triangles(store: Store, voxels: int, w: Visible) -> int:
    """Triangles of the listed voxels all of whose vertices lie in front of the camera."""
    m, vertices = 0, w.length[1]
    for i in range(voxels):
        v = w.voxel[i]
        length = store.voxel[v, PATCH_LEN]
        if length == 0:
            continue
        bs.neighbours27(store, v, w.neighbour)
        at = store.voxel[v, PATCH_AT]
        for t in range(at, at + length):
            a = _row_of(store, w, np.int64(store.triangle[t, 0]) & EAR_MASK, vertices)
            b = _row_of(store, w, np.int64(store.triangle[t, 1]), vertices)
            c = _row_of(store, w, np.int64(store.triangle[t, 2]), vertices)
            if a < 0 or b < 0 or c < 0 or math.isnan(w.pixel[a, 0] + w.pixel[b, 0] + w.pixel[c, 0]):
                continue
            w.triangle[m, 0], w.triangle[m, 1], w.triangle[m, 2] = a, b, c
            w.owner[m] = v
            m += 1
    return m


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


def depth_map(visible: Visible, camera: Camera, step: int) -> Depth:
    """Reference depth d_ref of eq. 11: the nearest surface of the current mesh.

    Corners are put where the lens puts them and edges are drawn straight: between vertices 0.1 m apart a lens
    bends an edge by much less than a pixel of this map.
    """
    nearness = np.zeros((-(-camera.height // step), -(-camera.width // step)), np.float32)
    draw_nearness(visible.pixel, visible.triangle[: visible.length[2]], 1.0 / step, nearness)
    return Depth(
        nearness, cv2.dilate(nearness, np.ones((3, 3), np.uint8)).astype(np.float32, copy=False), step
    )


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
        for row in range(first_v, last_v + 1):
            for column in range(first_u, last_u + 1):
                du, dv = column - au, row - av
                wb, wc = b_u * du + b_v * dv, c_u * du + c_v * dv
                if wb >= 0.0 and wc >= 0.0 and wb + wc <= 1.0:
                    near = np.float32(da + wb * db + wc * dc)
                    nearness[row, column] = max(nearness[row, column], near)
