"""Section III-B, eq. 1: masks are fused into the voxels by confidence-weighted averaging.

An image's observation of a voxel is the mean over the voxel's vertices that it sees of

    omega_mask = sigma_mask * cos(theta_view) * exp(-d_depth / sigma_d)                                    (1)

for each class that was asked for, sigma_mask being the network's score of that class at the vertex' pixel. The
voxel sums omega by class; its distribution is the sums' share of their total, and the total over the classes asked
for is W_sem of eq. 7.
"""

from __future__ import annotations

import math

import numpy as np

from artemis_edge._jit import kernel
from artemis_edge.block_store import CLASSES, LOG_CLASS, WEIGHT, Store
from artemis_edge.frames import F32, I32, U8
from artemis_edge.segmentation.backend import FULL_SCORE, DenseScores
from artemis_edge.sight import Seen

# Beyond so many sigma_d an observation weighs less than 2 % and is left out: it is of what stands in front
MOST_SIGMAS = 4.0
# Observations of every class that a voxel's distribution begins with when a vertex inherits it (Dirichlet prior)
DOUBT = 0.5


def grid_of(scores: DenseScores) -> F32:
    """The score map's grid as an array: scale x, scale y, offset x, offset y."""
    g = scores.grid
    return np.array([g.scale_x, g.scale_y, g.offset_x, g.offset_y], np.float32)


@kernel
def sample_scores(seen: Seen, n: int, score: U8, grid: F32, out: F32) -> None:
    """Scores 0..1 at the vertices' pixels, bilinear: ``out`` float32 (n, layers) from ``score`` (h, w, layers)."""
    height, width, layers = score.shape
    full = np.float32(1.0 / FULL_SCORE)
    for i in range(n):
        x = min(max(seen.u[i] * grid[0] + grid[2], np.float32(0.0)), np.float32(width - 1))
        y = min(max(seen.v[i] * grid[1] + grid[3], np.float32(0.0)), np.float32(height - 1))
        x0, y0 = int(x), int(y)
        x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
        fx, fy = x - np.float32(x0), y - np.float32(y0)
        a, b = (np.float32(1.0) - fx) * (np.float32(1.0) - fy) * full, fx * (np.float32(1.0) - fy) * full
        c, d = (np.float32(1.0) - fx) * fy * full, fx * fy * full
        for k in range(layers):
            out[i, k] = (
                a * score[y0, x0, k] + b * score[y0, x1, k] + c * score[y1, x0, k] + d * score[y1, x1, k]
            )


@kernel
def fuse(store: Store, seen: Seen, n: int, sampled: F32, slots: I32, sigma_d: float, total: F32) -> int:
    """Add one image to the voxels of the vertices it sees; returns how many voxels it told something of.

    ``sampled`` float32 (n, layers) as of :func:`sample_scores`, ``slots`` int32 (CLASSES,) the layer of each slot,
    -1 where it was not asked for: such a class would show as background, and gets background's sum. ``total``
    float32 (CLASSES,) is scratch.
    """
    told = i = 0
    while i < n:
        voxel, first = seen.voxel[i], i
        total[:] = 0.0
        looks = 0
        while i < n and seen.voxel[i] == voxel:
            d = seen.depth_error[i] / sigma_d
            if d < MOST_SIGMAS:
                geometry = seen.cosine[i] * np.float32(math.exp(-d))
                for k in range(sampled.shape[1]):
                    total[k] += geometry * sampled[i, k]
                looks += 1
            i += 1
        if looks > 0:
            _add(store.voxel_class[voxel], total, slots, sampled.shape[1], 1.0 / (i - first))
            told += 1
    return told


@kernel
def _add(row: F32, total: F32, slots: I32, layers: int, share: float) -> None:
    k = np.float32(share)
    for c in range(CLASSES):
        row[c] += k * total[max(slots[c], 0)]
    for layer in range(layers):
        row[WEIGHT] += k * total[layer]


@kernel
def distribution(row: F32, active: U8, out: F32) -> bool:
    """P_sem of a voxel over the ``active`` classes, uint8 (CLASSES,); False (uniform) when nothing was seen."""
    total = np.float32(0.0)
    for c in range(CLASSES):
        if active[c]:
            total += row[c]
    for c in range(CLASSES):
        out[c] = row[c] / total if active[c] and total > 0.0 else np.float32(0.0)
    return bool(total > 0.0)


@kernel
def start_from(attribute: F32, row: F32) -> None:
    """Log-probabilities of a voxel's sums, floored so that no class starts impossible.

    ``DOUBT`` makes a voxel that few masks have told of say little: the mask of this moment is among them and will be
    counted for the vertex itself, too.
    """
    floor = np.float32(0.02) * row[WEIGHT] + np.float32(DOUBT)
    most = np.float32(0.0)
    for c in range(CLASSES):
        most = max(most, row[c])
    for c in range(CLASSES):
        attribute[LOG_CLASS + c] = np.float32(math.log((row[c] + floor) / (most + floor)))
