"""Points drawn as small squares through a lens, with a z-buffer: what a coloured point cloud looks like.

Of two splats on a pixel the nearer stays, of two equally near the one drawn first. Pixels as in ``raster.py``:
a centre has integer coordinates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.frames import F32, F64, I64, CameraModel
from artemis_edge.lens import distort, fold_radius

#: A splat covers this many pixels each way: those whose centres are nearest to the point's place.
SPLAT_PX = 2
NOTHING = -1
_NEAR_M = 0.05


class Lens(NamedTuple):
    """A camera as kernels take it; nothing beyond radius ``fold`` of the normalised image is seen."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: F64
    fold: float


def lens_of(camera: CameraModel) -> Lens:
    """The camera for the kernels below."""
    distortion = np.array(camera.distortion, np.float64)
    return Lens(camera.fx, camera.fy, camera.cx, camera.cy, distortion, fold_radius(distortion))


@njit
def place(x: float, y: float, z: float, T: F64, lens: Lens) -> tuple[float, float, float]:
    """Pixel u, v and depth (m) of a world point; NaN where the camera cannot see it."""
    depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    if not depth >= _NEAR_M:
        return np.nan, np.nan, np.nan
    a = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / depth
    b = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / depth
    if not a * a + b * b < lens.fold * lens.fold:
        return np.nan, np.nan, np.nan
    a, b = distort(a, b, lens.distortion)
    return lens.fx * a + lens.cx, lens.fy * b + lens.cy, depth


@njit
def splat(points: F32, T_cam_world: F64, lens: Lens, first: int, nearest: F32, number: I64) -> None:
    """Draw points float32 (n, 3) of the world, numbered from ``first``.

    ``nearest`` float32 (h, w) starts as infinity and takes depths (m), ``number`` int64 (h, w) as ``NOTHING``.
    """
    height, width = nearest.shape
    for i in range(len(points)):
        u, v, z = place(points[i, 0], points[i, 1], points[i, 2], T_cam_world, lens)
        if not (-1.0 <= u < width and -1.0 <= v < height):
            continue
        depth = np.float32(z)
        left, top = int(np.floor(u)), int(np.floor(v))
        for row in range(max(top, 0), min(top + SPLAT_PX, height)):
            for column in range(max(left, 0), min(left + SPLAT_PX, width)):
                if depth < nearest[row, column]:
                    nearest[row, column] = depth
                    number[row, column] = first + i


def blank(camera: CameraModel) -> tuple[F32, I64]:
    """Fresh buffers for :func:`splat`."""
    shape = camera.height, camera.width
    return np.full(shape, np.inf, np.float32), np.full(shape, NOTHING, np.int64)
