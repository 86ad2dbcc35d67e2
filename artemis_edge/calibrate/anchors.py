"""Surface patches worth comparing: LiDAR points on planes where a photograph has contrast."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import KDTree

from artemis_edge.frames import F64, U8, Bool

_CELL_PX, _SMALLEST_CELL_PX = 16, 4  # one patch of each square of so many pixels, halved with every level
_BORDER_PX = 4
_LEAST_GRADIENT = 6.0  # grey levels a pixel
_NEIGHBOURS = 12
_FLAT = 0.1  # smallest / middle eigenvalue of a patch's neighbourhood
_LARGEST_M = 0.4  # radius of the neighbourhood, and that as a share of the distance
_LARGEST_SHARE = 0.04
_GRAZING = 0.2  # least cosine between surface normal and line of sight
_NEAREST_M, _FARTHEST_M = 0.8, 40.0


def gradient(grey: U8) -> F64:
    """Gradient magnitude (h, w), grey levels a pixel."""
    gx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    gy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    return np.asarray(cv2.magnitude(gx, gy), np.float64)


def select(grey: U8, K: F64, T_cam_world: F64, points: F64, tree: KDTree, level: int) -> F64:
    """Patches (n, 9) as ``photometric.compare`` takes them: a pixel of this view apart.

    ``points`` (m, 3) in world are the candidates, ``tree`` all points around them; the photograph is halved
    ``level`` times.
    """
    candidates = _best_of_cells(grey, K, T_cam_world, points, max(_CELL_PX >> level, _SMALLEST_CELL_PX))
    if len(candidates) == 0:
        return np.empty((0, 9))
    centre, normal, flat = _planes(candidates, tree, T_cam_world)
    line = centre - _place(T_cam_world)
    depth = line @ T_cam_world[2, :3]
    cosine = np.abs(np.einsum("ij,ij->i", line, normal)) / np.linalg.norm(line, axis=1)
    keep = flat & (cosine > _GRAZING)
    centre, normal, depth = centre[keep], normal[keep], depth[keep]
    across = np.cross(T_cam_world[1, :3], normal)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    down = np.cross(normal, across)
    step = (depth / K[0])[:, None]
    return np.ascontiguousarray(np.hstack([centre, across * step, down * step]))


def _best_of_cells(grey: U8, K: F64, T_cam_world: F64, points: F64, cell_px: int) -> F64:
    """The point of highest gradient of each cell."""
    seen = points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    ahead = (seen[:, 2] > _NEAREST_M) & (seen[:, 2] < _FARTHEST_M)
    points, seen = points[ahead], seen[ahead]
    u = np.rint(K[0] * seen[:, 0] / seen[:, 2] + K[2]).astype(np.int64)
    v = np.rint(K[1] * seen[:, 1] / seen[:, 2] + K[3]).astype(np.int64)
    h, w = grey.shape
    inside = (u >= _BORDER_PX) & (u < w - _BORDER_PX) & (v >= _BORDER_PX) & (v < h - _BORDER_PX)
    points, u, v = points[inside], u[inside], v[inside]
    strength = gradient(grey)[v, u]
    cell = (v // cell_px) * w + u // cell_px
    order = np.lexsort((-strength, cell))
    first = order[np.flatnonzero(np.r_[True, np.diff(cell[order]) > 0])] if len(order) else order
    best: F64 = points[first[strength[first] > _LEAST_GRADIENT]]
    return best


def on_planes(points: F64, tree: KDTree, T_cam_world: F64) -> Bool:
    """Which points (n, 3) lie on a plane of their neighbours: neither leaves nor mixed returns."""
    return _planes(points, tree, T_cam_world)[2] if len(points) else np.zeros(0, np.bool_)


def _planes(points: F64, tree: KDTree, T_cam_world: F64) -> tuple[F64, F64, Bool]:
    """Points moved onto the planes of their neighbours, normals, and whether there is a plane."""
    distance, index = tree.query(points, _NEIGHBOURS)
    near = np.asarray(tree.data)[np.minimum(index, tree.n - 1)]
    mean = near.mean(axis=1)
    spread = near - mean[:, None]
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread) / _NEIGHBOURS)
    normal = vectors[:, :, 0]
    off = np.einsum("ij,ij->i", points - mean, normal)
    reach = np.linalg.norm(points - _place(T_cam_world), axis=1)
    small = distance[:, -1] < np.minimum(_LARGEST_M, _LARGEST_SHARE * reach + 0.1)
    flat = small & (values[:, 0] < _FLAT * values[:, 1])
    return points - off[:, None] * normal, normal, flat


def _place(T_cam_world: F64) -> F64:
    place: F64 = -T_cam_world[:3, :3].T @ T_cam_world[:3, 3]
    return place
