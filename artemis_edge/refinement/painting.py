"""Texels of the triangles an image shows: where they lie, what the image says of them, the Bayesian update."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_edge._jit import kernel
from artemis_edge.frames import F32, F64
from artemis_edge.refinement.camera import Camera, to_pixel
from artemis_edge.refinement.reliability import (
    CLIPPED,
    Photo,
    Trust,
    exposure_weight,
    front_at,
    geometric,
    photometric,
    reach_of,
    sample,
    shade_at,
    takes_no_part,
)
from artemis_edge.refinement.texels import (
    AT,
    COARSEST,
    INFORMATION_SCALE,
    LEVEL,
    LEVELS,
    LOOKS,
    MEAN_SCALE,
    STAMP,
    TexelStore,
    add_chart,
    chart_near,
    place_key,
    refine_chart,
)
from artemis_edge.refinement.visible import NEAR_M, Visible, facing

# Triangles are widened by so many texels: none falls between two of them, and hardly any is painted twice
WIDEN = 0.02
_CLEARLY = 0.8  # cosine from which a direction is preferred to one that has a chart but serves only just
_BARELY = 0.6


class Brush(NamedTuple):
    """How texels are laid out."""

    voxel_m: float
    texel_px: float  # edge of a texel in pixels of the best image that saw it
    finest: int  # level
    plane: F64  # (3, 3) scratch: corners of the triangle in chart axes b, c, a [voxels]
    edge: F64  # (3, 3) scratch: a i + b j + c >= 0 inside


def new_brush(voxel_m: float, texel_px: float, finest_m: float) -> Brush:
    """Brush whose texels are never finer than ``finest_m``."""
    finest = int(np.clip(np.floor(np.log2(voxel_m / COARSEST / finest_m) + 1e-6), 0, LEVELS - 1))
    return Brush(voxel_m, texel_px, finest, np.empty((3, 3)), np.empty((3, 3)))


@kernel
def choose_direction(
    texels: TexelStore, nx: float, ny: float, nz: float, x: float, y: float, z: float
) -> int:
    """Direction of the chart that a triangle's texels belong to; normal of length 1, middle in voxels.

    The direction it faces most, unless another that serves it has a chart there already: between two directions
    the noise of the normal would decide anew with each mesh, and texture would be lost.
    """
    best, most = 0, 0.0
    kept, kept_most = -1, _BARELY
    for axis in range(3):
        n = nx if axis == 0 else (ny if axis == 1 else nz)
        direction = axis if n >= 0.0 else axis + 3
        n = abs(n)
        if n > most:
            best, most = direction, n
        if n > kept_most:
            a = x if axis == 0 else (y if axis == 1 else z)
            b = y if axis == 0 else (z if axis == 1 else x)
            c = z if axis == 0 else (x if axis == 1 else y)
            if chart_near(texels, direction, math.floor(b), math.floor(c), a) >= 0:
                kept, kept_most = direction, n
    if kept >= 0 and (most < _CLEARLY or kept == best):
        return kept
    return best


@kernel
def wanted_level(footprint_m: float, brush: Brush) -> int:
    """Coarsest level whose texels are at most ``texel_px`` pixels of a view with this footprint."""
    edge_m = brush.voxel_m / COARSEST
    level = 0
    while level < brush.finest and edge_m > brush.texel_px * footprint_m:
        edge_m *= 0.5
        level += 1
    return level


@kernel
def paint(
    texels: TexelStore,
    visible: Visible,
    vertex: F32,
    photo: Photo,
    trust: Trust,
    brush: Brush,
    stamp: int,
    share: int,
    enough: float,
) -> int:
    """Update the texels of the listed triangles with what ``photo`` shows; returns how many were updated.

    ``share`` of ``PARTS`` parts of the voxels take part, others in other frames. Texels that hold at least ``enough``
    times the information (as stored) that a look like this one tells at best are left as they are; where a closer
    look has been taken, so are all that anything is known of.
    """
    updated = 0
    for t in range(visible.length[1]):
        if takes_no_part(visible.owner[t], share, stamp):
            continue
        if not _is_in_view(visible, t, photo.camera):
            continue
        i, j, k = visible.triangle[t, 0], visible.triangle[t, 1], visible.triangle[t, 2]
        cosine = facing(visible.point[i], visible.point[j], visible.point[k])
        if cosine < trust.least_cosine:
            continue
        updated += _paint_triangle(texels, visible, t, cosine, vertex, photo, trust, brush, stamp, enough)
    return updated


@kernel
def _is_in_view(visible: Visible, t: int, camera: Camera) -> bool:
    a, b, c = (
        visible.pixel[visible.triangle[t, 0]],
        visible.pixel[visible.triangle[t, 1]],
        visible.pixel[visible.triangle[t, 2]],
    )
    return bool(
        max(a[0], b[0], c[0]) > 0.0
        and min(a[0], b[0], c[0]) < camera.width - 1.0
        and max(a[1], b[1], c[1]) > 0.0
        and min(a[1], b[1], c[1]) < camera.height - 1.0
    )


@kernel
def load_triangle(
    vertex: F32, i: int, j: int, k: int, voxel_m: float, texels: TexelStore, plane: F64
) -> tuple[int, float, float]:
    """Corners in chart coordinates into ``plane``; returns direction and the slopes da/db, da/dc; -1: no area."""
    p, q, r = vertex[i], vertex[j], vertex[k]
    inverse = 1.0 / voxel_m
    ux, uy, uz = np.float64(q[0]) - p[0], np.float64(q[1]) - p[1], np.float64(q[2]) - p[2]
    vx, vy, vz = np.float64(r[0]) - p[0], np.float64(r[1]) - p[1], np.float64(r[2]) - p[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    if length < 1e-12:
        return -1, 0.0, 0.0
    third = inverse / 3.0
    direction = choose_direction(
        texels,
        nx / length,
        ny / length,
        nz / length,
        (np.float64(p[0]) + q[0] + r[0]) * third,
        (np.float64(p[1]) + q[1] + r[1]) * third,
        (np.float64(p[2]) + q[2] + r[2]) * third,
    )
    a = direction % 3
    b, c = (a + 1) % 3, (a + 2) % 3
    for m in range(3):
        corner = p if m == 0 else (q if m == 1 else r)
        plane[m, 0], plane[m, 1], plane[m, 2] = corner[b] * inverse, corner[c] * inverse, corner[a] * inverse
    na = nx if a == 0 else (ny if a == 1 else nz)
    nb = ny if a == 0 else (nz if a == 1 else nx)
    nc = nz if a == 0 else (nx if a == 1 else ny)
    return direction, -nb / na, -nc / na


# In line: a call hands on some 300 numbers that the tuples of arrays consist of, which a texel's work is not worth
@kernel(inline="always")
def _paint_triangle(
    texels: TexelStore,
    visible: Visible,
    t: int,
    cosine: float,
    vertex: F32,
    photo: Photo,
    trust: Trust,
    brush: Brush,
    stamp: int,
    enough: float,
) -> int:
    i, j, k = visible.triangle[t, 0], visible.triangle[t, 1], visible.triangle[t, 2]
    P = brush.plane
    direction, along_b, along_c = load_triangle(
        vertex, visible.slot[i], visible.slot[j], visible.slot[k], brush.voxel_m, texels, P
    )
    if direction < 0:
        return 0
    depth_m = (np.float64(visible.point[i, 2]) + visible.point[j, 2] + visible.point[k, 2]) / 3.0
    footprint_m = depth_m / (photo.camera.fx * math.sqrt(cosine))
    level = wanted_level(footprint_m, brush)
    low_b, high_b = min(P[0, 0], P[1, 0], P[2, 0]), max(P[0, 0], P[1, 0], P[2, 0])
    low_c, high_c = min(P[0, 1], P[1, 1], P[2, 1]), max(P[0, 1], P[1, 1], P[2, 1])
    low_a, high_a = min(P[0, 2], P[1, 2], P[2, 2]), max(P[0, 2], P[1, 2], P[2, 2])
    middle_b, middle_c = (P[0, 0] + P[1, 0] + P[2, 0]) / 3.0, (P[0, 1] + P[1, 1] + P[2, 1]) / 3.0
    updated = 0
    for b in range(math.floor(low_b), math.floor(high_b) + 1):
        for c in range(math.floor(low_c), math.floor(high_c) + 1):
            at_b, at_c = min(max(middle_b, b), b + 1.0), min(max(middle_c, c), c + 1.0)
            a = P[0, 2] + along_b * (at_b - P[0, 0]) + along_c * (at_c - P[0, 1])
            a = min(max(a, low_a), high_a)
            chart = _chart_for(texels, direction, b, c, a, level, stamp)
            if chart >= 0:
                updated += _paint_chart(
                    texels,
                    chart,
                    cosine,
                    b,
                    c,
                    direction,
                    along_b,
                    along_c,
                    photo,
                    trust,
                    brush,
                    _looks_wanted(enough, level, texels.chart[chart, LEVEL]),
                )
    return updated


@kernel
def _looks_wanted(enough: float, level: int, finest: int) -> float:
    """Looks after which a view that wants ``level`` leaves texels of level ``finest`` alone; 0: if any is there."""
    return enough if level + 1 >= finest or enough == math.inf else 0.0


@kernel
def _chart_for(texels: TexelStore, direction: int, b: int, c: int, a: float, level: int, stamp: int) -> int:
    """The chart of a piece of surface, made or refined to ``level`` where needed; -1 without memory."""
    chart = chart_near(texels, direction, b, c, a)
    if chart < 0:
        chart = add_chart(texels, place_key(direction, b, c, math.floor(a)), level)
        if chart < 0:
            return -1
    row = texels.chart[chart]
    if level > row[LEVEL]:
        refine_chart(texels, chart, level)
    if row[STAMP] != stamp:
        row[STAMP] = stamp
        row[LOOKS] += 1
    return int(chart)


@kernel
def set_edges(P: F64, b: int, c: int, edge: int, E: F64, widen: float) -> None:
    """Edge functions of a triangle in the texels of chart (b, c): E[m] . (i, j, 1) >= 0 inside, widened."""
    area = (P[1, 0] - P[0, 0]) * (P[2, 1] - P[0, 1]) - (P[2, 0] - P[0, 0]) * (P[1, 1] - P[0, 1])
    side = 1.0 if area > 0.0 else -1.0
    for m in range(3):
        n = (m + 1) % 3
        # a texel's centre (i, j) lies at ((i + 0.5) / edge + b, (j + 0.5) / edge + c)
        ax, ay = (P[m, 0] - b) * edge - 0.5, (P[m, 1] - c) * edge - 0.5
        bx, by = (P[n, 0] - b) * edge - 0.5, (P[n, 1] - c) * edge - 0.5
        dx, dy = (bx - ax) * side, (by - ay) * side
        length = math.sqrt(dx * dx + dy * dy)
        E[m, 0], E[m, 1] = -dy, dx
        E[m, 2] = dy * ax - dx * ay + widen * length


@kernel
def row_span(E: F64, j: float, first: int, last: int) -> tuple[int, int]:
    """First and last i with all edge functions >= 0 in row ``j``, within ``first`` .. ``last``."""
    for m in range(3):
        rest = E[m, 1] * j + E[m, 2]
        if E[m, 0] > 1e-12:
            first = max(first, math.ceil(-rest / E[m, 0]))
        elif E[m, 0] < -1e-12:
            last = min(last, math.floor(-rest / E[m, 0]))
        elif rest < 0.0:
            return 1, 0
    return first, last


@kernel(inline="always")
def _paint_chart(
    texels: TexelStore,
    chart: int,
    cosine: float,
    b: int,
    c: int,
    direction: int,
    along_b: float,
    along_c: float,
    photo: Photo,
    trust: Trust,
    brush: Brush,
    enough: float,
) -> int:
    """The texels of one triangle (``brush.plane``) in one chart."""
    P, E, camera, V = brush.plane, brush.edge, photo.camera, brush.voxel_m
    edge = COARSEST << texels.chart[chart, LEVEL]
    at = texels.chart[chart, AT]
    texel_m = V / edge
    set_edges(P, b, c, edge, E, WIDEN)
    # camera coordinates are linear in (i, j)
    axis = direction % 3
    ub, uc, ua = (axis + 1) % 3, (axis + 2) % 3, axis
    R = camera.R
    i_x = (R[0, ub] + along_b * R[0, ua]) * texel_m
    i_y = (R[1, ub] + along_b * R[1, ua]) * texel_m
    i_z = (R[2, ub] + along_b * R[2, ua]) * texel_m
    j_x = (R[0, uc] + along_c * R[0, ua]) * texel_m
    j_y = (R[1, uc] + along_c * R[1, ua]) * texel_m
    j_z = (R[2, uc] + along_c * R[2, ua]) * texel_m
    first_b, first_c = b + 0.5 / edge, c + 0.5 / edge
    first_a = P[0, 2] + along_b * (first_b - P[0, 0]) + along_c * (first_c - P[0, 1])
    o_b, o_c, o_a = first_b * V, first_c * V, first_a * V
    o_x = R[0, ub] * o_b + R[0, uc] * o_c + R[0, ua] * o_a + camera.t[0]
    o_y = R[1, ub] * o_b + R[1, uc] * o_c + R[1, ua] * o_a + camera.t[1]
    o_z = R[2, ub] * o_b + R[2, uc] * o_c + R[2, ua] * o_a + camera.t[2]
    # the plane's normal in the camera, and its distance
    nx, ny, nz = i_y * j_z - i_z * j_y, i_z * j_x - i_x * j_z, i_x * j_y - i_y * j_x
    slope = reach_of(camera, photo.depth, nx, ny, nx * o_x + ny * o_y + nz * o_z)
    low_c = min(P[0, 1], P[1, 1], P[2, 1]) - c
    high_c = max(P[0, 1], P[1, 1], P[2, 1]) - c
    low_b = min(P[0, 0], P[1, 0], P[2, 0]) - b
    high_b = max(P[0, 0], P[1, 0], P[2, 0]) - b
    first_j = max(0, math.ceil(low_c * edge - 0.5 - WIDEN))
    last_j = min(edge - 1, math.floor(high_c * edge - 0.5 + WIDEN))
    first_i = max(0, math.ceil(low_b * edge - 0.5 - WIDEN))
    last_i = min(edge - 1, math.floor(high_b * edge - 0.5 + WIDEN))
    # a view tells about a texel what its pixels resolve of it
    size = texel_m * camera.fx * cosine
    middle = 0.5 * (edge - 1)
    best = min(size / max(o_z + middle * (i_z + j_z), NEAR_M), 1.0)
    known = max(enough * best * best, 1.0)
    updated = 0
    for j in range(first_j, last_j + 1):
        first, last = row_span(E, j, first_i, last_i)
        for i in range(first, last + 1):
            z = o_z + i * i_z + j * j_z
            texel = texels.texel[at + j * edge + i]
            if z < NEAR_M or texel[3] >= known:
                continue
            near = 1.0 / z
            u, v = to_pixel(camera, (o_x + i * i_x + j * j_x) * near, (o_y + i * i_y + j * j_y) * near)
            if not (0.0 <= u < camera.width - 1.0 and 0.0 <= v < camera.height - 1.0):
                continue
            g = geometric(front_at(photo.depth, u, v), near, slope, trust.sigma_geom)
            if g < trust.least:
                continue
            quality = min(size * near, 1.0)
            _update(texel, photo, u, v, g, quality * quality, trust)
            updated += 1
    return updated


@kernel(inline="always")
def _update(
    texel: NDArray[np.uint16], photo: Photo, u: float, v: float, g: float, quality: float, trust: Trust
) -> None:
    """Bayesian update of one texel's colour by the pixel at u, v, modulated by W."""
    r, k, b = sample(photo.image, u, v)
    clipped = max(r, k, b) >= CLIPPED
    quality *= photo.sharpness * exposure_weight(r, k, b)
    f = shade_at(photo, u, v)
    r, k, b = r * f * photo.gain[0], k * f * photo.gain[1], b * f * photo.gain[2]
    scale = 1.0 / MEAN_SCALE
    mr, mk, mb = texel[0] * scale, texel[1] * scale, texel[2] * scale
    information = texel[3] / INFORMATION_SCALE
    dr, dk, db = r - mr, k - mk, b - mb
    if clipped and information > 0.0:  # at least that bright: no contradiction to what is brighter
        dr, dk, db = max(dr, 0.0), max(dk, 0.0), max(db, 0.0)
    p = photometric(dr * dr + dk * dk + db * db, information, trust)
    w = g * p
    if w >= trust.least and quality > 0.0:
        w *= quality
        gain = w / (information + w)
        texel[0] = _level(mr + gain * dr)
        texel[1] = _level(mk + gain * dk)
        texel[2] = _level(mb + gain * db)
        information += w
    information *= 1.0 - trust.forget * (1.0 - p) * g * quality
    texel[3] = max(int(min(information, trust.most) * INFORMATION_SCALE + 0.5), 1)


@kernel
def _level(value: float) -> int:
    return int(min(max(value * MEAN_SCALE + 0.5, 0.0), 65535.0))
