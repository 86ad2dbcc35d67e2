"""Whether the triangles of a reconstruction are wound as the surfaces are that the sensors observed.

Three judges, because each is unfair where the others are not. *Nearest*: the normal of the nearest observed point.
Beside edges and on things thinner than the noise, that is often a point of another side. *Mean*: the mean of the
observed normals within NEAR_M, the surface at the scale of a mesh's triangle; where the mean is shorter than
LEAST_MEAN, surfaces of opposite sides are in reach and it judges nothing. *Facing*: whether the triangle shows its
front to a place from which a beam saw the nearest observed point; this asks for no normal at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.frames import F32, F64, I64, Bool

NEAR_M = 0.10
LEAST_MEAN = 0.3
_BITS = 21
_HALF = 1 << (_BITS - 1)


class Near(NamedTuple):
    """Per place (n,): ``nearest`` int64 observed point within NEAR_M, -1 for none; ``mean`` float64 (n, 3) mean
    of the normals within NEAR_M, 0 for none.
    """

    nearest: I64
    mean: F64


@dataclass(frozen=True, slots=True)
class Verdict:
    """Of one judge, per triangle: whether it is ``judged``, and whether it ``agrees``."""

    judged: Bool
    agrees: Bool


def near(places: F64, points: F32, normals: F32) -> Near:
    """Observed ``points`` and ``normals`` float32 (m, 3) around ``places`` float64 (n, 3)."""
    cell = _cells(points)
    order = np.argsort(cell, kind="stable")
    found = Near(np.full(len(places), -1, np.int64), np.zeros((len(places), 3)))
    _gather(places, cell[order], order, points[order], normals[order], found.nearest, found.mean)
    return found


def verdicts(normal: F64, found: Near, normals: F32, views: F32 | None) -> dict[str, Verdict]:
    """The judges' verdicts on triangles of unit ``normal`` float64 (n, 3) (0 where they have no area)."""
    judged = (found.nearest >= 0) & (np.abs(normal).sum(axis=1) > 0)
    at = np.maximum(found.nearest, 0)
    length = np.linalg.norm(found.mean, axis=1)
    out = {
        "nearest": _verdict(judged, normal, normals[at] if len(normals) else found.mean),
        "mean": _verdict(judged & (length >= LEAST_MEAN), normal, found.mean),
    }
    if views is not None:
        out["facing"] = _verdict(judged, normal, views[at] if len(views) else found.mean)
    return out


def _verdict(judged: Bool, normal: F64, direction: F32 | F64) -> Verdict:
    return Verdict(judged, judged & ((normal * direction).sum(axis=1) > 0))


def _cells(points: F32) -> I64:
    """Cell of edge NEAR_M as one number, ascending along x."""
    cell = np.clip(np.floor(points.astype(np.float64) / NEAR_M), -_HALF, _HALF - 1).astype(np.int64) + _HALF
    return np.asarray((cell[:, 2] << (2 * _BITS)) | (cell[:, 1] << _BITS) | cell[:, 0], np.int64)


@njit
def _gather(places: F64, cell: I64, order: I64, points: F32, normals: F32, nearest: I64, mean: F64) -> None:
    """``cell``, ``points`` and ``normals`` are sorted by cell; ``order`` gives the points' own numbers."""
    for i in range(len(places)):
        x, y, z = places[i]
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
            continue
        cx = int(np.floor(x / NEAR_M)) + _HALF
        cy = int(np.floor(y / NEAR_M)) + _HALF
        cz = int(np.floor(z / NEAR_M)) + _HALF
        best, count = NEAR_M * NEAR_M, 0
        for kz in range(cz - 1, cz + 2):
            for ky in range(cy - 1, cy + 2):
                row = (kz << (2 * _BITS)) | (ky << _BITS)
                first = np.searchsorted(cell, row | (cx - 1))
                last = np.searchsorted(cell, row | (cx + 1), side="right")
                for k in range(first, last):
                    d2 = (points[k, 0] - x) ** 2 + (points[k, 1] - y) ** 2 + (points[k, 2] - z) ** 2
                    if d2 > NEAR_M * NEAR_M:
                        continue
                    count += 1
                    for a in range(3):
                        mean[i, a] += normals[k, a]
                    if d2 < best or nearest[i] < 0:
                        best, nearest[i] = d2, order[k]
        if count > 0:
            for a in range(3):
                mean[i, a] /= count
