"""Point samples of a mesh, evenly by area, and thinning of clouds to one point a voxel."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import F32, F64, I32, I64

# Two-dimensional low-discrepancy sequence of the plastic number (Roberts 2018): fills a triangle more evenly
# than random numbers and is the same on every machine.
_PLASTIC = 1.32471795724474602596
_STEP_U, _STEP_V = 1.0 / _PLASTIC, 1.0 / _PLASTIC**2
_SAMPLES_AT_ONCE = 1 << 22
# Some minutes of sampling: 100,000 m2 at a tau of 3.2 cm. More is a triangle gone astray or a tau too fine.
MOST_SAMPLES = 1_000_000_000
_CELL_BITS = 21


def triangle_areas(vertices: F32, faces: I32) -> F64:
    """Areas float64 (m,) in m2."""
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    areas: F64 = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return areas


def samples(vertices: F32, faces: I32, per_m2: float) -> Iterator[F32]:
    """Points on the surface, ``per_m2`` a square metre, in chunks float32 (n, 3) in order of triangles.

    Systematic by area: sample k lies where the running area reaches k + 1/2 shares, so every patch gets its
    share to within one sample. Raises InputError for more than ``MOST_SAMPLES``.
    """
    ends = np.cumsum(triangle_areas(vertices, faces))
    total = float(ends[-1]) if len(ends) else 0.0
    if total * per_m2 > MOST_SAMPLES:
        raise InputError(
            f"{total:.4g} m2 of mesh need {total * per_m2:.2g} samples, more than {MOST_SAMPLES:.0e}; remove "
            "triangles that are far too large, cut the mesh to the reference or give a larger --threshold"
        )
    count = int(np.ceil(total * per_m2))
    for start in range(0, count, _SAMPLES_AT_ONCE):
        k = np.arange(start, min(start + _SAMPLES_AT_ONCE, count))
        triangle = np.searchsorted(ends, (k + 0.5) * (total / count), side="right")
        yield _points_in(vertices, faces[np.minimum(triangle, len(faces) - 1)], k)


def _points_in(vertices: F32, faces: I32, k: I64) -> F32:
    u, v = np.modf(k * _STEP_U)[0], np.modf(k * _STEP_V)[0]
    folded = u + v > 1.0  # the square's other half onto the triangle
    u, v = (np.where(folded, 1.0 - w, w).astype(np.float32)[:, None] for w in (u, v))
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    points: F32 = a + u * (b - a) + v * (c - a)
    return points


def thin(chunks: Iterator[F32], voxel: float) -> F64:
    """Mean point of every occupied voxel of edge ``voxel`` (m), float64 (n, 3), in order of the voxels.

    The grid is anchored at the origin. Raises InputError for coordinates too far apart to be one scene.
    """
    merged = _Sums(np.empty(0, np.int64), np.empty((0, 4)))
    pending = [merged]
    for chunk in chunks:
        ones = np.ones((len(chunk), 1), np.float32)
        pending.append(_sum_by_cell(_cells(chunk, voxel), np.concatenate([chunk, ones], axis=1)))
        # Merging whenever as much waits as is merged keeps both time and memory in proportion to the result.
        if sum(len(p.cell) for p in pending[1:]) > max(len(merged.cell), _SAMPLES_AT_ONCE):
            merged = _merge(pending)
            pending = [merged]
    total = _merge(pending).sums
    mean: F64 = total[:, :3] / total[:, 3:]
    return mean


class _Sums(NamedTuple):
    """Sums of x, y, z and the number of points, float64 (n, 4), of voxels ``cell`` int64 (n,), ascending."""

    cell: I64
    sums: F64


def _sum_by_cell(cell: I64, rows: F32 | F64) -> _Sums:
    unique, inverse = np.unique(cell, return_inverse=True)
    return _Sums(unique, np.stack([np.bincount(inverse, rows[:, k], len(unique)) for k in range(4)], axis=1))


def _merge(parts: list[_Sums]) -> _Sums:
    if len(parts) == 1:
        return parts[0]
    return _sum_by_cell(np.concatenate([p.cell for p in parts]), np.concatenate([p.sums for p in parts]))


def _cells(points: F32, voxel: float) -> I64:
    half = 1 << (_CELL_BITS - 1)
    place = np.floor(points.astype(np.float64) / voxel)
    if len(place) and (place.min() < -half or place.max() >= half):
        raise InputError(
            f"coordinates lie more than {voxel * half / 1000:.3g} km from the origin, too far for voxels of "
            f"{voxel:g} m; shift both clouds alike first or give a larger --threshold"
        )
    cell = place.astype(np.int64) + half
    packed: I64 = (cell[:, 0] << (2 * _CELL_BITS)) | (cell[:, 1] << _CELL_BITS) | cell[:, 2]
    return packed
