"""Kernels that look textures up: where on which atlas page a pixel's sight line falls, and what is there."""

from __future__ import annotations

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.frames import F32, I32, U8
from artemis_edge.raster import corner_weights

UNTEXTURED = -1  # as of export.atlas; kernels take constants of their own file


@njit
def find_texels(
    points: F32,
    faces: I32,
    triangle: I32,
    lines: F32,
    orthographic: bool,
    face_page: I32,
    face_uv: F32,
    page: I32,
    uv: F32,
) -> None:
    """Atlas page int32 (h, w) and place on it in pixels float32 (h, w, 2) of what every pixel shows.

    ``triangle`` and ``lines`` as for ``raster.interpolate``; ``face_page`` int32 (m,) and ``face_uv`` float32
    (m, 3, 2) those of the faces. Pixels without a triangle and those of an untextured one become ``UNTEXTURED``.
    """
    height, width = triangle.shape
    for v in range(height):
        for u in range(width):
            t = triangle[v, u]
            page[v, u] = UNTEXTURED
            if t < 0 or face_page[t] < 0:
                continue
            i, j, m = faces[t, 0], faces[t, 1], faces[t, 2]
            x, y = lines[v, u, 0], lines[v, u, 1]
            wa, wb, wc = corner_weights(points[i], points[j], points[m], x, y, orthographic)
            page[v, u] = face_page[t]
            for k in range(2):
                uv[v, u, k] = wa * face_uv[t, 0, k] + wb * face_uv[t, 1, k] + wc * face_uv[t, 2, k]


@njit
def sample_page(image: U8, number: int, page: I32, uv: F32, out: F32) -> None:
    """Colour of atlas page ``number``, uint8 (rows, columns, 3), into ``out`` float32 (h, w, >= 3) where
    ``page`` names it; between texel centres bilinear, beyond the border the border's.
    """
    rows, columns, _ = image.shape
    for v in range(page.shape[0]):
        for u in range(page.shape[1]):
            if page[v, u] != number:
                continue
            x = min(max(uv[v, u, 0], np.float32(0.0)), np.float32(columns - 1))
            y = min(max(uv[v, u, 1], np.float32(0.0)), np.float32(rows - 1))
            left, top = int(x), int(y)
            right, bottom = min(left + 1, columns - 1), min(top + 1, rows - 1)
            a, b = x - np.float32(left), y - np.float32(top)
            for k in range(3):
                upper = image[top, left, k] * (1.0 - a) + image[top, right, k] * a
                lower = image[bottom, left, k] * (1.0 - a) + image[bottom, right, k] * a
                out[v, u, k] = upper * (1.0 - b) + lower * b
