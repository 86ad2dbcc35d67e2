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
# Angle of a cell of the depth map that splats are drawn on (8 pixels of 1280): at 11 m it is a vertex' own spacing
CELL_RAD = 1.0 / 112.0
# Columns of the depth map: depth of the nearest vertex [m], inverse depth of its plane at the cell's centre [1/m] and
# how that changes from pixel to pixel, to the right and down
DEPTH, INVERSE, RIGHT, DOWN = range(4)
# A plane is followed until its depth has changed by this factor; beyond it the cell shows something else, too
_FARTHEST = 2.0
# Surfaces seen at a smaller cosine show a pixel of something else, and their planes have no depth to be followed
LEAST_COSINE = 0.05
# Depth errors of so many sigma_geom weigh nothing (below 4e-6): spares the exponential
_NO_WEIGHT = 5.0
_IN_THE_WAY_M = 1e-3
_NOT_MEASURED = np.empty((0, 4), np.float32)
_SPLAT = 0.75  # radius of a splat in point spacings: neighbouring splats overlap and leave no hole


class Sight(NamedTuple):
    """One image's view of the world.

    ``T_cam_world`` float64 (3, 4); ``lens`` float64 (12,): fx fy cx cy k1 k2 p1 p2 k3 width height and the squared
    radius within which the lens model holds; ``tangent`` float64 (4,): x / z and y / z, least and most, that the
    image can show; ``depth`` float32 (h, w, 4) the reference depth: the surface nearest to the camera as a plane, with
    columns DEPTH (inf where nothing is known), INVERSE, RIGHT and DOWN; one cell for every :func:`cell_px` pixels.
    ``measured`` float32 (n, 4) are the points that beams met around the image's time (measured.py).
    """

    T_cam_world: F64
    lens: F64
    tangent: F64
    depth: F32
    measured: F32


class Seen(NamedTuple):
    """Vertices in view, voxel by voxel; arrays as long as the map's pool of cells, of which ``n`` rows are valid."""

    slot: I32  # of the cell
    voxel: I32
    u: F32  # pixel
    v: F32
    z: F32  # depth [m]
    right: F32  # change of the inverse depth along the vertex' plane, per pixel [1/m]
    down: F32
    cosine: F32  # between the line of sight and the normal, 0 when seen from behind
    depth_error: F32  # |depth - reference depth| [m], 0 where no reference is known
    reliability: F32  # W of eq. 9 from the depth alone, 0 where the surface is seen from behind


class Visibility(NamedTuple):
    """When a vertex in view is what its pixel shows."""

    sigma_geom: float  # of eq. 9: relative depth error
    least_reliability: float  # W below it is as good as 0
    most_error_m: float  # depth error up to which eq. 1 takes it in


def new_seen(cells: int) -> Seen:
    """Memory for as many vertices as the map can hold; only what is used is ever touched."""
    return Seen(
        np.empty(cells, np.int32),
        np.empty(cells, np.int32),
        *(np.empty(cells, np.float32) for _ in range(8)),
    )


def new_sight(camera: CameraModel, T_world_cam: F64) -> Sight:
    """The view of ``camera`` from a pose, with an empty depth map."""
    lens = np.array(
        [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion, camera.width, camera.height, 0.0]
    )
    lens[11] = min(fold_radius(lens[4:9]) ** 2, 1e6)
    u, v = np.array([0.0, camera.width - 1]), np.array([0.0, camera.height - 1])
    tangent = np.array([*(u - camera.cx) / camera.fx, *(v - camera.cy) / camera.fy]) * _FRUSTUM_MARGIN
    return Sight(
        np.ascontiguousarray(inverse(T_world_cam)[:3]), lens, tangent, empty_depth(lens), _NOT_MEASURED.copy()
    )


def cell_px(lens: F64) -> float:
    """Pixels that a cell of the depth map of a ``Sight.lens`` is wide."""
    return float(max(round(float(lens[0]) * CELL_RAD), 1))


def empty_depth(lens: F64) -> F32:
    """A depth map for a ``Sight.lens`` in which nothing is known."""
    size = cell_px(lens)
    depth = np.zeros((math.ceil(lens[10] / size), math.ceil(lens[9] / size), 4), np.float32)
    depth[:, :, DEPTH] = np.inf
    return depth


def without_depth(sight: Sight) -> Sight:
    """The view alone: some hundred bytes, of which thousands can be kept."""
    return sight._replace(depth=np.empty((0, 0, 4), np.float32), measured=_NOT_MEASURED.copy())


def filled(then: F32, now: F32) -> F32:
    """The depth map of an image's time, and where nothing was known ``then`` (it may be empty), what is known ``now``.

    Where the map knew nothing when the image was taken, what stood in the way is what it knows now.
    """
    if then.size == 0:
        return now
    return np.where(then[:, :, DEPTH, None] < np.inf, then, now)


def hiding_the_unknown(depth: F32) -> F32:
    """The depth map with something right before the camera wherever nothing is known: what is there tells nothing."""
    unknown = depth[:, :, DEPTH] == np.inf
    out = depth.copy()
    out[unknown] = _IN_THE_WAY_M, 1.0 / _IN_THE_WAY_M, 0.0, 0.0
    return out


def look(
    store: Store, sight: Sight, blocks: I32, block_m: float, reach_m: float, rules: Visibility, seen: Seen
) -> int:
    """Living vertices of ``blocks`` (slots) within ``reach_m`` that ``sight`` shows into ``seen``; how many.

    Those that its reference depth hides are left out, as by :func:`keep_visible`. Where it has none all remain, and
    ``depth_error`` and ``reliability`` are left for :func:`keep_visible`.
    """
    planes = np.empty((6, 4))
    view_planes(sight, reach_m, planes)
    return int(list_seen(store, sight, planes, blocks, block_m, reach_m, cell_px(sight.lens), rules, seen))


@kernel
def list_seen(
    store: Store,
    sight: Sight,
    planes: F64,
    blocks: I32,
    block_m: float,
    reach_m: float,
    size_px: float,
    rules: Visibility,
    seen: Seen,
) -> int:
    """Kernel of :func:`look`; ``planes`` as of :func:`view_planes`."""
    T, lens, depth = sight.T_cam_world, sight.lens, sight.depth
    n = 0
    for block in blocks:
        if not _touches_view(store.block[block], planes, block_m):
            continue
        for inner in range(512):
            voxel = store.block_voxel[block, inner]
            if voxel < 0 or not _touches_view(store.voxel[voxel], planes, block_m / 8.0):
                continue
            mask = store.voxel_mask[voxel]
            while mask != 0:
                c = bs.lowest_bit(mask)
                mask &= mask - np.uint64(1)
                s = store.voxel_cell[voxel, c]
                if store.state[s] != ALIVE or not project(store.vertex[s], T, lens, reach_m, seen, n):
                    continue
                if depth.size > 0 and not _is_visible(seen, n, size_px, depth, rules):
                    continue
                seen.slot[n] = s
                seen.voxel[n] = voxel
                n += 1
    return n


@kernel
def see_rows(vertex: F32, T: F64, lens: F64, reach_m: float, seen: Seen) -> int:
    """The vertices ``vertex`` float32 (n, 6), position and normal, that a view shows; ``slot`` is the row."""
    n = 0
    for row in range(vertex.shape[0]):
        if project(vertex[row], T, lens, reach_m, seen, n):
            seen.slot[n] = row
            n += 1
    return n


@kernel
def view_planes(sight: Sight, reach_m: float, out: F64) -> None:
    """The six planes that bound the view, into ``out`` float64 (6, 4): unit normals that point in, and offsets [m]."""
    T, tangent = sight.T_cam_world, sight.tangent
    for c in range(4):
        out[0, c], out[1, c] = T[2, c], -T[2, c]
        for k in range(2):
            low, high = tangent[2 * k], tangent[2 * k + 1]
            out[2 + 2 * k, c] = (T[k, c] - low * T[2, c]) / math.sqrt(1.0 + low * low)
            out[3 + 2 * k, c] = (high * T[2, c] - T[k, c]) / math.sqrt(1.0 + high * high)
    out[1, 3] += reach_m


@kernel
def _touches_view(index: I32, planes: F64, edge_m: float) -> bool:
    """Whether the sphere around a cube (a block, a voxel) of that ``index`` (3,) and edge reaches into the view."""
    cx, cy, cz = (index[0] + 0.5) * edge_m, (index[1] + 0.5) * edge_m, (index[2] + 0.5) * edge_m
    least = -0.8661 * edge_m
    for k in range(6):
        p = planes[k]
        if p[0] * cx + p[1] * cy + p[2] * cz + p[3] < least:
            return False
    return True


@kernel
def project(p: F32, T: F64, lens: F64, reach_m: float, seen: Seen, n: int) -> bool:
    """Pixel, depth and cosine of a vertex into row ``n``; False when the image does not show it."""
    px, py, pz = np.float64(p[POSITION]), np.float64(p[POSITION + 1]), np.float64(p[POSITION + 2])
    z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
    if z < NEAR_M or z > reach_m:
        return False
    cx = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
    cy = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
    nearness = 1.0 / z
    x, y = cx * nearness, cy * nearness
    u, v, shown = pixel_of(x, y, lens)
    if not shown:
        return False
    gx, gy, gz = np.float64(p[NORMAL]), np.float64(p[NORMAL + 1]), np.float64(p[NORMAL + 2])
    nx = T[0, 0] * gx + T[0, 1] * gy + T[0, 2] * gz
    ny = T[1, 0] * gx + T[1, 1] * gy + T[1, 2] * gz
    nz = T[2, 0] * gx + T[2, 1] * gy + T[2, 2] * gz
    facing = -(nx * x + ny * y + nz)
    cosine = facing / math.sqrt(x * x + y * y + 1.0)
    seen.u[n], seen.v[n], seen.z[n] = u, v, z
    seen.cosine[n] = max(cosine, 0.0)
    # the inverse depth of a plane is linear in the image: n . ray / n . p
    steep = cosine < LEAST_COSINE
    slope = 0.0 if steep else -nearness / facing
    seen.right[n] = slope * nx / lens[0]
    seen.down[n] = slope * ny / lens[1]
    return True


@kernel
def pixel_of(x: float, y: float, lens: F64) -> tuple[float, float, bool]:
    """Pixel of the sight line (x / z, y / z) through a ``Sight.lens``, and whether the image shows it."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    u = lens[0] * (x * radial + 2.0 * lens[6] * x * y + lens[7] * (r2 + 2.0 * x * x)) + lens[2]
    v = lens[1] * (y * radial + lens[6] * (r2 + 2.0 * y * y) + 2.0 * lens[7] * x * y) + lens[3]
    inside = u > -0.5 and v > -0.5 and u < lens[9] - 0.5 and v < lens[10] - 0.5
    return u, v, inside and r2 <= lens[11]


@kernel
def splat_depth(seen: Seen, n: int, focal: float, spacing_m: float, size_px: float, depth: F32) -> None:
    """Reference depth of the vertices in view: each covers a square of its own spacing; the nearest stays."""
    height, width, _ = depth.shape
    for i in range(n):
        z = seen.z[i]
        half = _SPLAT * spacing_m * focal / z
        left = max(int((seen.u[i] - half) / size_px + 0.5), 0)
        right = min(int((seen.u[i] + half) / size_px + 0.5), width - 1)
        top = max(int((seen.v[i] - half) / size_px + 0.5), 0)
        bottom = min(int((seen.v[i] + half) / size_px + 0.5), height - 1)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                cell = depth[row, column]
                if z < cell[DEPTH]:
                    du, dv = column * size_px - seen.u[i], row * size_px - seen.v[i]
                    cell[DEPTH] = z
                    cell[INVERSE] = 1.0 / z + seen.right[i] * du + seen.down[i] * dv
                    cell[RIGHT], cell[DOWN] = seen.right[i], seen.down[i]


@kernel
def keep_visible(seen: Seen, n: int, size_px: float, depth: F32, rules: Visibility) -> int:
    """Compare the vertices in view with the reference depth at their very pixels; only those remain that are what
    the image shows there, for eq. 1 or for eq. 9. Returns how many; ``depth_error`` and ``reliability`` are set."""
    kept = 0
    for i in range(n):
        if not _is_visible(seen, i, size_px, depth, rules):
            continue
        seen.slot[kept], seen.voxel[kept] = seen.slot[i], seen.voxel[i]
        seen.u[kept], seen.v[kept], seen.z[kept] = seen.u[i], seen.v[i], seen.z[i]
        seen.cosine[kept] = seen.cosine[i]
        seen.depth_error[kept], seen.reliability[kept] = seen.depth_error[i], seen.reliability[i]
        kept += 1
    return kept


@kernel
def _is_visible(seen: Seen, i: int, size_px: float, depth: F32, rules: Visibility) -> bool:
    """Whether row ``i`` is what its pixel shows, by its depth error and reliability, which are set."""
    error = _depth_error(seen, i, size_px, depth)
    weight = 0.0
    if seen.cosine[i] > LEAST_COSINE:
        relative = error / (max(seen.z[i] - error, NEAR_M) * rules.sigma_geom)
        weight = math.exp(-0.5 * relative * relative) if relative < _NO_WEIGHT else 0.0
    seen.depth_error[i], seen.reliability[i] = error, weight
    return error < rules.most_error_m or weight >= rules.least_reliability


@kernel
def _depth_error(seen: Seen, i: int, size_px: float, depth: F32) -> float:
    """|depth - reference depth| of row ``i``, 0 where no reference is known."""
    return float(abs(depth_ahead(seen, i, size_px, depth)))


@kernel
def depth_ahead(seen: Seen, i: int, size_px: float, depth: F32) -> float:
    """How far the reference depth map is before row ``i`` at its very pixel [m]; 0 where no reference is known."""
    row = min(max(int(seen.v[i] / size_px + 0.5), 0), depth.shape[0] - 1)
    column = min(max(int(seen.u[i] / size_px + 0.5), 0), depth.shape[1] - 1)
    cell = depth[row, column]
    if not cell[DEPTH] < np.inf:
        return 0.0
    du, dv = seen.u[i] - column * size_px, seen.v[i] - row * size_px
    inverse = cell[INVERSE] + cell[RIGHT] * du + cell[DOWN] * dv
    reference = min(max(1.0 / max(inverse, 1e-6), cell[DEPTH] / _FARTHEST), cell[DEPTH] * _FARTHEST)
    return float(seen.z[i] - reference)
