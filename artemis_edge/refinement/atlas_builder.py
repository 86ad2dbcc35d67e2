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
from artemis_edge.refinement.texel_pages import TexelPages, blocks_around
from artemis_edge.refinement.texels import AT, COARSEST, LEVEL, LEVELS, MEAN_SCALE, TexelStore, chart_near

PADDING = 4  # pixels: two mip levels
LARGEST_PAGE, SMALLEST_PAGE = 4096, 256
# Texels around a face that its own colour is copied to: interpolation and the level above need them
_WIDEN = 1.5
_BLOCKS_AT_ONCE = 64  # whose texels are brought into memory together


class Faces(NamedTuple):
    """Where faces lie: ``key`` int64 (m,) of the chart or -1 and its ``level``, ``corner`` int64 (m, 2) the chart's
    place b, c; ``uv`` float64 (m, 3, 2) corners in voxels from there, ``plane`` float64 (m, 4): the height a of the
    first corner and its slopes along b and c [voxels], and the direction.
    """

    key: I64
    level: I32
    corner: I64
    uv: F64
    plane: F64


class Boxes(NamedTuple):
    """Rectangles of the atlas, one a chart: ``first`` and ``last`` of its faces among ``face``; ``level``; ``start``
    (g, 2) and ``size`` (g, 2) in texels from the chart's corner, padding included; ``at`` (g, 3) page, column, row.
    """

    face: I64
    first: I64
    last: I64
    level: I32
    start: I64
    size: I64
    at: I64


def build_atlas(
    mesh: Mesh,
    texels: TexelStore,
    pages: TexelPages,
    voxel_m: float,
    most_texels: int,
    exposure: float = 1.0,
) -> Atlas:
    """Atlas of a mesh from the texture of its map; coarser where it would have more than ``most_texels``.

    Colours are multiplied by ``exposure``.

    Texels on disk are brought into memory part by part.
    """
    m = len(mesh.faces)
    faces = Faces(
        np.full(m, -1, np.int64),
        np.zeros(m, np.int32),
        np.empty((m, 2), np.int64),
        np.empty((m, 3, 2)),
        np.empty((m, 4)),
    )
    parts = _parts(mesh, voxel_m, len(pages) > 0)
    for rows, blocks in parts:
        pages.need(blocks)
        place_faces(texels, mesh.vertices, mesh.faces, rows, voxel_m, np.empty((3, 3)), faces)
    if not (faces.key >= 0).any():
        return empty_atlas(m)
    boxes, edge, count = _lay_out(faces, most_texels)
    atlas = Atlas(
        tuple(np.zeros((count, edge, edge, 3), np.uint8)),
        np.full(m, UNTEXTURED, np.int32),
        np.zeros((m, 3, 2), np.float32),
        PADDING,
    )
    place = np.full(m, -1, np.int64)
    place[boxes.face] = np.repeat(np.arange(len(boxes.first)), boxes.last - boxes.first)
    for rows, blocks in parts:
        pages.need(blocks)
        mine = np.unique(place[rows])
        _fill(texels, faces, boxes, mine[mine >= 0], atlas, exposure)
    return atlas


def _parts(mesh: Mesh, voxel_m: float, in_parts: bool) -> list[tuple[I64, set[tuple[int, int, int]]]]:
    """Faces by the blocks of their middles, and the blocks whose texels they may need: those and their neighbours."""
    if not in_parts:
        return [(np.arange(len(mesh.faces)), set())]
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    block = np.floor(middle / np.float32(8.0 * voxel_m)).astype(np.int64)
    names, which = np.unique(block, axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    ends = np.searchsorted(which.ravel()[order], np.arange(len(names) + 1))
    out = []
    for first in range(0, len(names), _BLOCKS_AT_ONCE):
        last = min(first + _BLOCKS_AT_ONCE, len(names))
        near = blocks_around([(x, y, z) for x, y, z in names[first:last].tolist()])
        out.append((order[ends[first] : ends[last]], near))
    return out


def _lay_out(faces: Faces, most_texels: int) -> tuple[Boxes, int, int]:
    """Rectangles of all charts, the edge of the pages and how many there are.

    In the order of the charts' places in space, which does not depend on how memory was handed out.
    """
    face = np.flatnonzero(faces.key >= 0)
    face = face[np.argsort(faces.key[face], kind="stable")]
    first = np.flatnonzero(np.diff(faces.key[face], prepend=-1))
    low = np.minimum.reduceat(faces.uv[face].min(axis=1), first, axis=0)
    high = np.maximum.reduceat(faces.uv[face].max(axis=1), first, axis=0)
    for finest in range(LEVELS - 1, -1, -1):
        level = np.minimum(faces.level[face[first]], finest)
        edge = (COARSEST << level)[:, None]
        start = np.floor(low * edge - 0.5).astype(np.int64) - PADDING
        size = np.ceil(high * edge - 0.5).astype(np.int64) + PADDING + 1 - start
        if size.prod(axis=1).sum() <= most_texels:
            break
    page_edge = _page_edge(size)
    order = np.lexsort((-size[:, 0], -size[:, 1]))
    place, at = np.empty((2, len(first), 3), np.int64)
    count = pack_shelves(size[order, 0], size[order, 1], page_edge, place)
    at[order] = place
    last = np.append(first[1:], len(face))
    return Boxes(face, first, last, level.astype(np.int32), start, size, at), page_edge, count


def _fill(texels: TexelStore, faces: Faces, boxes: Boxes, mine: I64, atlas: Atlas, exposure: float) -> None:
    """Draw the rectangles ``mine`` and set the corners of their faces."""
    if len(mine) == 0:
        return
    room = int(boxes.size[mine].prod(axis=1).max())
    known, queue = np.empty(room, np.uint8), np.empty((room, 2), np.int32)
    P, E = np.empty((2, 3, 3))
    for g in mine.tolist():
        picture = atlas.pages[boxes.at[g, 0]]
        fill_box(texels, faces, boxes, g, exposure, picture, atlas.page, atlas.uv, known, queue, P, E)


def _page_edge(size: I64) -> int:
    """Edge of the square pages: the smallest power of two that may hold everything, within limits."""
    area = float(size.prod(axis=1).sum()) / 0.85
    wanted = 1 << math.ceil(math.log2(max(math.sqrt(area), 1.0)))
    least = 1 << math.ceil(math.log2(float(size.max())))
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
    texels: TexelStore, vertices: F32, triangles: I32, rows: I64, voxel_m: float, P: F64, faces: Faces
) -> None:
    """The chart of each face's middle and the face's corners there, for the faces ``rows``; ``P`` is scratch."""
    for t in rows:
        direction, along_b, along_c = load_triangle(
            vertices, triangles[t, 0], triangles[t, 1], triangles[t, 2], voxel_m, texels, P
        )
        if direction < 0:
            continue
        a = (P[0, 2] + P[1, 2] + P[2, 2]) / 3.0
        b = math.floor((P[0, 0] + P[1, 0] + P[2, 0]) / 3.0)
        c = math.floor((P[0, 1] + P[1, 1] + P[2, 1]) / 3.0)
        chart = chart_near(texels, direction, b, c, a)
        if chart < 0:
            continue
        faces.key[t], faces.level[t] = texels.key[chart], texels.chart[chart, LEVEL]
        faces.corner[t, 0], faces.corner[t, 1] = b, c
        for m in range(3):
            faces.uv[t, m, 0], faces.uv[t, m, 1] = P[m, 0] - b, P[m, 1] - c
        row = faces.plane[t]
        row[0], row[1], row[2], row[3] = P[0, 2], along_b, along_c, direction


@kernel
def fill_box(
    texels: TexelStore,
    faces: Faces,
    boxes: Boxes,
    g: int,
    exposure: float,
    picture: U8,
    page: I32,
    uv: F32,
    known: U8,
    queue: I32,
    P: F64,
    E: F64,
) -> None:
    """Draw rectangle ``g`` into its page and set the corners of its faces; the rest is scratch."""
    left, top, width, height = boxes.start[g, 0], boxes.start[g, 1], boxes.size[g, 0], boxes.size[g, 1]
    column, row = boxes.at[g, 1], boxes.at[g, 2]
    part = picture[row : row + height, column : column + width]
    known[: width * height] = 0
    total = 0
    for k in range(boxes.first[g], boxes.last[g]):
        total += _copy_face(
            texels, faces, boxes.face[k], boxes.level[g], left, top, exposure, part, known, P, E
        )
    if total == 0:
        return
    _spread(part, known, queue)
    edge = COARSEST << boxes.level[g]
    for k in range(boxes.first[g], boxes.last[g]):
        t = boxes.face[k]
        page[t] = boxes.at[g, 0]
        for m in range(3):
            uv[t, m, 0] = column + faces.uv[t, m, 0] * edge - 0.5 - left
            uv[t, m, 1] = row + faces.uv[t, m, 1] * edge - 0.5 - top


@kernel
def _copy_face(
    texels: TexelStore,
    faces: Faces,
    t: int,
    level: int,
    left: int,
    top: int,
    exposure: float,
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
                chart = chart_near(texels, int(plane[3]), faces.corner[t, 0] + b, faces.corner[t, 1] + c, a)
            if chart < 0:
                continue
            row, column = j - top, i - left
            if known[row * width + column] == 0 and _copy_texel(
                texels, chart, level, i - b * edge, j - c * edge, exposure, picture[row, column]
            ):
                known[row * width + column] = 1
                total += 1
    return total


@kernel
def _copy_texel(texels: TexelStore, chart: int, level: int, i: int, j: int, exposure: float, out: U8) -> bool:
    """Colour of a texel at ``level`` of a chart that may be finer or coarser; False where no camera saw it."""
    own, at = texels.chart[chart, LEVEL], texels.chart[chart, AT]
    edge = COARSEST << own
    if own <= level:
        shift = level - own
        texel = texels.texel[at + (j >> shift) * edge + (i >> shift)]
        if texel[3] == 0:
            return False
        for k in range(3):
            out[k] = int(min(texel[k] * exposure / MEAN_SCALE + 0.5, 255.0))
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
    scale = exposure / (n * MEAN_SCALE)
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
