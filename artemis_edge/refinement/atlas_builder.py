"""From the texels of the map to the atlas of its finished mesh.

Faces of one chart lie together in one rectangle of the atlas, in the chart's own grid, so that texels are copied and
not resampled; where a face reaches over the chart's border the neighbour's texels go on. What no camera saw within a
rectangle takes the colour of the nearest that one did.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from artemis_edge._jit import kernel
from artemis_edge.export.atlas import UNTEXTURED, Atlas, empty_atlas
from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import F32, F64, I32, I64, U8
from artemis_edge.refinement.painting import load_triangle, row_span, set_edges
from artemis_edge.refinement.texels import AT, COARSEST, LEVEL, LEVELS, MEAN_SCALE, TexelStore, chart_near

PADDING = 4  # pixels: two mip levels
LARGEST_PAGE, SMALLEST_PAGE = 4096, 256
# Texels around a face that its own colour is copied to: interpolation and the level above need them
_WIDEN = 1.5
_FULL_SHELF = 0.97


class Faces(NamedTuple):
    """Where faces lie: ``chart`` int32 (m,) or -1, ``uv`` float64 (m, 3, 2) corners in voxels from the chart's corner,
    ``plane`` float64 (m, 4): place a of the first corner and slopes of it along the chart's axes; direction.
    """

    chart: I32
    uv: F64
    plane: F64


def build_atlas(mesh: Mesh, texels: TexelStore, voxel_m: float, most_texels: int) -> Atlas:
    """Atlas of a mesh from the texture of its map; coarser where it would have more than ``most_texels``."""
    m = len(mesh.faces)
    faces = Faces(np.full(m, -1, np.int32), np.empty((m, 3, 2)), np.empty((m, 4)))
    corners = np.empty((m, 2), np.int64)
    place_faces(texels, mesh.vertices, mesh.faces, voxel_m, np.empty((3, 3)), faces, corners)
    used = np.flatnonzero(faces.chart >= 0)
    if len(used) == 0:
        return empty_atlas(m)
    # by the chart's place in space, which does not depend on how memory was handed out
    key = texels.key[faces.chart[used]]
    used = used[np.argsort(key, kind="stable")]
    chart, first = np.unique(texels.key[faces.chart[used]], return_index=True)
    owner = faces.chart[used[first]]
    del chart
    group = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(used))))
    level, box = _boxes(texels, faces, used, first, group, owner, most_texels)
    return _draw(texels, faces, corners, used, first, level, box, m)


def _boxes(
    texels: TexelStore, faces: Faces, used: I64, first: I64, group: I64, owner: I32, most_texels: int
) -> tuple[I32, I64]:
    """Level of each rectangle and its texels (g, 4): first column and row, width and height, padding included."""
    low = np.minimum.reduceat(faces.uv[used].min(axis=1), first, axis=0)
    high = np.maximum.reduceat(faces.uv[used].max(axis=1), first, axis=0)
    del group
    for finest in range(LEVELS - 1, -1, -1):
        level = np.minimum(texels.chart[owner, LEVEL], finest)
        edge = (COARSEST << level)[:, None]
        start = np.floor(low * edge - 0.5).astype(np.int64) - PADDING
        stop = np.ceil(high * edge - 0.5).astype(np.int64) + PADDING + 1
        size = stop - start
        if size.prod(axis=1).sum() <= most_texels:
            break
    return level.astype(np.int32), np.concatenate((start, size), axis=1)


def _draw(
    texels: TexelStore,
    faces: Faces,
    corners: I64,
    used: I64,
    first: I64,
    level: I32,
    box: I64,
    m: int,
) -> Atlas:
    edge = _page_edge(box)
    order = np.lexsort((np.arange(len(box)), -box[:, 2], -box[:, 3]))
    place = np.empty((len(box), 3), np.int64)
    count = pack_shelves(box[order, 2], box[order, 3], edge, place)
    at = np.empty_like(place)
    at[order] = place
    pages = np.zeros((count, edge, edge, 3), np.uint8)
    last = np.append(first[1:], len(used))
    scratch = np.empty((int((box[:, 2] * box[:, 3]).max()), 2), np.int32)
    known = np.empty(int((box[:, 2] * box[:, 3]).max()), np.uint8)
    page = np.full(m, UNTEXTURED, np.int32)
    uv = np.zeros((m, 3, 2), np.float32)
    fill_boxes(
        texels,
        faces,
        corners,
        used,
        first,
        last,
        level,
        box,
        at,
        pages,
        page,
        uv,
        known,
        scratch,
        np.empty((3, 3)),
        np.empty((3, 3)),
    )
    return Atlas(tuple(pages), page, uv, PADDING)


def _page_edge(box: I64) -> int:
    """Edge of the square pages: the smallest power of two that may hold everything, within limits."""
    area = float((box[:, 2] * box[:, 3]).sum()) / 0.85
    wanted = 1 << math.ceil(math.log2(max(math.sqrt(area), 1.0)))
    least = 1 << math.ceil(math.log2(float(box[:, 2:].max())))
    return max(min(wanted, LARGEST_PAGE), least, SMALLEST_PAGE)


@kernel
def pack_shelves(width: I64, height: I64, edge: int, place: I64) -> int:
    """Pack rectangles, which come by falling height, row by row into square pages; returns how many pages.

    ``place`` (g, 3) receives page, column and row.
    """
    page = x = y = shelf = 0
    for k in range(width.shape[0]):
        if x + width[k] > edge:
            x, y, shelf = 0, y + shelf, 0
        if y + height[k] > edge:
            page, x, y, shelf = page + 1, 0, 0, 0
        if x == 0:
            shelf = height[k]
        place[k, 0], place[k, 1], place[k, 2] = page, x, y
        x += width[k]
    return page + 1


@kernel
def place_faces(
    texels: TexelStore, vertices: F32, triangles: I32, voxel_m: float, P: F64, faces: Faces, corners: I64
) -> None:
    """The chart of each face's middle, and its corners there. ``corners`` (m, 2): the chart's place b, c."""
    for t in range(triangles.shape[0]):
        direction, along_b, along_c = load_triangle(
            vertices, triangles[t, 0], triangles[t, 1], triangles[t, 2], voxel_m, texels, P
        )
        if direction < 0:
            continue
        middle_b, middle_c = (P[0, 0] + P[1, 0] + P[2, 0]) / 3.0, (P[0, 1] + P[1, 1] + P[2, 1]) / 3.0
        a = (P[0, 2] + P[1, 2] + P[2, 2]) / 3.0
        b, c = math.floor(middle_b), math.floor(middle_c)
        faces.chart[t] = chart_near(texels, direction, b, c, a)
        corners[t, 0], corners[t, 1] = b, c
        for m in range(3):
            faces.uv[t, m, 0], faces.uv[t, m, 1] = P[m, 0] - b, P[m, 1] - c
        row = faces.plane[t]
        row[0], row[1], row[2], row[3] = P[0, 2], along_b, along_c, direction


@kernel
def fill_boxes(
    texels: TexelStore,
    faces: Faces,
    corners: I64,
    used: I64,
    first: I64,
    last: I64,
    level: I32,
    box: I64,
    at: I64,
    pages: U8,
    page: I32,
    uv: F32,
    known: U8,
    scratch: I32,
    P: F64,
    E: F64,
) -> None:
    """Draw every rectangle and set the corners of its faces."""
    for g in range(first.shape[0]):
        left, top, width, height = box[g, 0], box[g, 1], box[g, 2], box[g, 3]
        picture = pages[at[g, 0], at[g, 2] : at[g, 2] + height, at[g, 1] : at[g, 1] + width]
        for i in range(width * height):
            known[i] = 0
        total = 0
        for k in range(first[g], last[g]):
            total += _copy_face(texels, faces, used[k], corners, level[g], left, top, picture, known, P, E)
        if total == 0:
            continue
        _spread(picture, known, scratch)
        edge = COARSEST << level[g]
        for k in range(first[g], last[g]):
            t = used[k]
            page[t] = at[g, 0]
            for m in range(3):
                uv[t, m, 0] = at[g, 1] + faces.uv[t, m, 0] * edge - 0.5 - left
                uv[t, m, 1] = at[g, 2] + faces.uv[t, m, 1] * edge - 0.5 - top


@kernel
def _copy_face(
    texels: TexelStore,
    faces: Faces,
    t: int,
    corners: I64,
    level: int,
    left: int,
    top: int,
    picture: U8,
    known: U8,
    P: F64,
    E: F64,
) -> int:
    """Copy the texels under one face that a camera has seen; returns how many."""
    edge = COARSEST << level
    for m in range(3):
        P[m, 0], P[m, 1] = faces.uv[t, m, 0], faces.uv[t, m, 1]
    set_edges(P, 0, 0, edge, E, _WIDEN)
    plane = faces.plane[t]
    low_a = high_a = plane[0]
    for m in range(1, 3):
        a = plane[0] + plane[1] * (P[m, 0] - P[0, 0]) + plane[2] * (P[m, 1] - P[0, 1])
        low_a, high_a = min(low_a, a), max(high_a, a)
    middle_b, middle_c = (P[0, 0] + P[1, 0] + P[2, 0]) / 3.0, (P[0, 1] + P[1, 1] + P[2, 1]) / 3.0
    height, width = picture.shape[0], picture.shape[1]
    first_j = max(math.ceil(min(P[0, 1], P[1, 1], P[2, 1]) * edge - 0.5 - _WIDEN), top)
    last_j = min(math.floor(max(P[0, 1], P[1, 1], P[2, 1]) * edge - 0.5 + _WIDEN), top + height - 1)
    first_i = max(math.ceil(min(P[0, 0], P[1, 0], P[2, 0]) * edge - 0.5 - _WIDEN), left)
    last_i = min(math.floor(max(P[0, 0], P[1, 0], P[2, 0]) * edge - 0.5 + _WIDEN), left + width - 1)
    total, at_b, at_c, chart = 0, 1 << 30, 1 << 30, -1
    for j in range(first_j, last_j + 1):
        begin, end = row_span(E, j, first_i, last_i)
        for i in range(begin, end + 1):
            b, c = i // edge, j // edge
            if b != at_b or c != at_c:
                at_b, at_c = b, c
                near_b, near_c = min(max(middle_b, b), b + 1.0), min(max(middle_c, c), c + 1.0)
                a = plane[0] + plane[1] * (near_b - P[0, 0]) + plane[2] * (near_c - P[0, 1])
                a = min(max(a, low_a), high_a)
                chart = chart_near(texels, int(plane[3]), corners[t, 0] + b, corners[t, 1] + c, a)
            if chart < 0:
                continue
            row, column = j - top, i - left
            if known[row * width + column] == 0 and _copy_texel(
                texels, chart, level, i - b * edge, j - c * edge, picture[row, column]
            ):
                known[row * width + column] = 1
                total += 1
    return total


@kernel
def _copy_texel(texels: TexelStore, chart: int, level: int, i: int, j: int, out: U8) -> bool:
    """Colour of a texel at ``level`` of a chart that may be finer or coarser; False where no camera saw it."""
    own, at = texels.chart[chart, LEVEL], texels.chart[chart, AT]
    edge = COARSEST << own
    if own <= level:
        shift = level - own
        texel = texels.texel[at + (j >> shift) * edge + (i >> shift)]
        if texel[3] == 0:
            return False
        for k in range(3):
            out[k] = int(min(texel[k] / MEAN_SCALE + 0.5, 255.0))
        return True
    shift = own - level
    red = green = blue = 0.0
    n = 0
    for y in range(j << shift, (j + 1) << shift):
        for x in range(i << shift, (i + 1) << shift):
            texel = texels.texel[at + y * edge + x]
            if texel[3] > 0:
                red, green, blue = red + texel[0], green + texel[1], blue + texel[2]
                n += 1
    if n == 0:
        return False
    scale = 1.0 / (n * MEAN_SCALE)
    out[0] = int(min(red * scale + 0.5, 255.0))
    out[1] = int(min(green * scale + 0.5, 255.0))
    out[2] = int(min(blue * scale + 0.5, 255.0))
    return True


@kernel
def _spread(picture: U8, known: U8, queue: I32) -> None:
    """Give unknown pixels the colour of the nearest known one, ring by ring; ``queue`` (n, 2) is scratch."""
    height, width = picture.shape[0], picture.shape[1]
    n = 0
    for row in range(height):
        for column in range(width):
            if known[row * width + column]:
                queue[n, 0], queue[n, 1] = row, column
                n += 1
    done = 0
    while done < n:
        row, column = queue[done, 0], queue[done, 1]
        done += 1
        for step in range(4):
            y = row + (1 if step == 0 else (-1 if step == 1 else 0))
            x = column + (1 if step == 2 else (-1 if step == 3 else 0))
            if 0 <= y < height and 0 <= x < width and known[y * width + x] == 0:
                known[y * width + x] = 1
                for k in range(3):
                    picture[y, x, k] = picture[row, column, k]
                queue[n, 0], queue[n, 1] = y, x
                n += 1
