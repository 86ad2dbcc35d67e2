"""Where something nearer covers part of a patch: its contour moves with what is nearer, not with the patch's plane.

A patch beside a shelf takes the edge of the shelf for a pattern of the wall behind; such patches agree with each
other and pull the pose along for as long as the shelf is passed. FAST-LIVO2 (Zheng et al., T-RO 2024) leaves out points
whose depth is not continuous with that of their neighbours in the image, for the same reason.
"""

from __future__ import annotations

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.frames import F64, Bool
from artemis_edge.odometry.visual_patch import NEAREST_M

_CELL = 8  # pixels of a cell of the depth grid
_REACH = 2  # cells: half of a patch on the coarsest level, 16 pixels
_FARTHEST = (_REACH + 1) * _CELL  # pixels from a patch's centre to what lies in those cells
_STEP_M = 0.1  # nearer than the patch by more is something else: three deviations of a point and a plane


@njit
def nearest_depth(points: F64, K: F64, width: int, height: int) -> F64:
    """Depth (rows, columns) of the nearest point (n, 3) of the camera's frame in each cell; inf where there is none.

    ``K`` is fx fy cx cy; as a pinhole, for a lens moves a point by less than a cell.
    """
    out = np.full((-(-height // _CELL), -(-width // _CELL)), np.inf)
    for n in range(len(points)):
        z = points[n, 2]
        if not z > NEAREST_M:
            continue
        u, v = K[0] * points[n, 0] / z + K[2], K[1] * points[n, 1] / z + K[3]
        if 0.0 <= u < width and 0.0 <= v < height:
            row, column = int(v) // _CELL, int(u) // _CELL
            out[row, column] = min(out[row, column], z)
    return out


@njit
def _least_depth(centre: F64, normal: F64, K: F64) -> float:
    """The least depth of a plane over the pixels of all cells that are looked at about a patch's centre."""
    offset = normal[0] * centre[0] + normal[1] * centre[1] + normal[2] * centre[2]
    x, y, least = centre[0] / centre[2], centre[1] / centre[2], centre[2]
    for i in range(-1, 2, 2):
        for j in range(-1, 2, 2):
            across = _FARTHEST * i / K[0] + x
            down = _FARTHEST * j / K[1] + y
            ray = normal[0] * across + normal[1] * down + normal[2]
            depth = offset / ray if ray != 0.0 else np.inf
            if 0.0 < depth < least:
                least = depth
    return float(least)


@njit
def partly_covered(centres: F64, normals: F64, nearest: F64, K: F64) -> Bool:
    """Which patches (n,), by centre and normal (n, 3) in the camera's frame, have something nearer beside them.

    ``nearest`` as of :func:`nearest_depth`. Where a floor meets a wall the floor's patches stay: what of the plane
    itself is about a patch may be as near.
    """
    out = np.zeros(len(centres), np.bool_)
    rows, columns = nearest.shape
    for n in range(len(centres)):
        z = centres[n, 2]
        if not z > NEAREST_M:
            continue
        limit = _least_depth(centres[n], normals[n], K) - _STEP_M
        row = int((K[1] * centres[n, 1] / z + K[3]) // _CELL)
        column = int((K[0] * centres[n, 0] / z + K[2]) // _CELL)
        for r in range(max(row - _REACH, 0), min(row + _REACH + 1, rows)):
            for c in range(max(column - _REACH, 0), min(column + _REACH + 1, columns)):
                out[n] = out[n] or nearest[r, c] < limit
    return out
