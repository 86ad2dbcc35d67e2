"""Section III-C, eqs 12 and 13: every vertex' class probabilities, refined by every image that sees it.

    lambda_c += W log P_mask(o | c)                                                                     (12, 13)

W is the reliability of eq. 9, the very one that weights the colours. P_mask(o | c) is the share of class c in the
scores that the mask gives the vertex' pixel, kept away from 0 by ``FLOOR``: no single image may rule a class out.
A class that the image was not asked for would have shown as background, so it gets background's share: that tells
it from the classes asked for, and not from background. The softmax of lambda are the refined probabilities.
"""

from __future__ import annotations

import math

import numpy as np

from artemis_edge import block_store as bs
from artemis_edge._jit import kernel
from artemis_edge.block_store import BLOCK, CHANGED, CLASSES, FRESH, LOG_CLASS, WEIGHT, Store
from artemis_edge.class_rows import best_class, is_blank
from artemis_edge.frames import F32, I32, U8
from artemis_edge.sight import Seen
from artemis_edge.voxel_fusion import start_from

# What a mask says of a pixel is wrong this often whatever its score: outlines are off by pixels, classes mistaken
FLOOR = 0.05
# An image less reliable than this is not passed on (the paper: only highly reliable observations are)
LEAST_RELIABILITY = 0.05
# A class this far below the best (natural logarithm) is ruled out; deeper would only take longer to unlearn
DEEPEST = -30.0


@kernel
def refine(
    store: Store, seen: Seen, n: int, sampled: F32, slots: I32, reliability: F32, stamp: int, share: F32
) -> int:
    """Eqs 12 and 13 for the vertices of ``seen``; returns how many were updated.

    ``sampled`` float32 (n, layers) scores, ``slots`` int32 (CLASSES,) the layer of each slot or -1, ``reliability``
    float32 (n,) W; ``share`` float32 (CLASSES,) is scratch. A vertex that nobody has looked at starts from its
    voxel's distribution. Blocks in which a vertex changed its class are marked as changed at ``stamp``.
    """
    updated = 0
    layers = sampled.shape[1]
    for i in range(n):
        w = reliability[i]
        if w < LEAST_RELIABILITY:
            continue
        weighted_log(sampled[i], layers, w, share)
        attribute = store.attribute[seen.slot[i]]
        if is_blank(attribute) and store.voxel_class[seen.voxel[i], WEIGHT] > 0.0:
            start_from(attribute, store.voxel_class[seen.voxel[i]])
        before = best_class(attribute)
        add_log_likelihood(attribute, share, slots)
        if best_class(attribute) != before:
            voxel = store.voxel[seen.voxel[i]]
            store.block[voxel[BLOCK], CHANGED] = stamp
            voxel[FRESH] += (
                1  # triangles keep objects apart, so a vertex of another class is as good as a new one
            )
            bs.enqueue(store, seen.voxel[i], stamp)
        updated += 1
    return updated


@kernel
def refine_rows(
    attribute: F32, seen: Seen, n: int, sampled: F32, slots: I32, reliability: F32, share: F32
) -> None:
    """As :func:`refine` for the vertices of a finished mesh: ``attribute`` has a row for each."""
    layers = sampled.shape[1]
    for i in range(n):
        if reliability[i] >= LEAST_RELIABILITY:
            weighted_log(sampled[i], layers, reliability[i], share)
            add_log_likelihood(attribute[seen.slot[i]], share, slots)


@kernel
def weighted_log(sampled: F32, layers: int, w: float, out: F32) -> None:
    """W log P_mask(o | c) of eq. 13 for each layer."""
    total = np.float32(FLOOR * layers)
    for k in range(layers):
        total += sampled[k]
    inverse = np.float32(1.0) / total
    for k in range(layers):
        out[k] = np.float32(w * math.log((sampled[k] + np.float32(FLOOR)) * inverse))


@kernel
def add_log_likelihood(attribute: F32, log_likelihood: F32, slots: I32) -> None:
    """Eq. 12 for one vertex; the best class is moved to 0, which the softmax does not notice."""
    most = np.float32(-np.inf)
    for c in range(CLASSES):
        attribute[LOG_CLASS + c] += log_likelihood[max(slots[c], 0)]
        most = max(most, attribute[LOG_CLASS + c])
    for c in range(CLASSES):
        attribute[LOG_CLASS + c] = max(attribute[LOG_CLASS + c] - most, np.float32(DEEPEST))


@kernel
def probabilities(lam: F32, active: U8, out: F32) -> int:
    """Softmax of ``lam`` (CLASSES,) over the ``active`` classes into ``out``; returns the most probable class.

    Of equals the lowest number wins, so a vertex that no mask told apart is background.
    """
    best, most = 0, np.float32(-np.inf)
    for c in range(CLASSES):
        if active[c] and lam[c] > most:
            best, most = c, lam[c]
    total = np.float32(0.0)
    for c in range(CLASSES):
        out[c] = np.float32(math.exp(lam[c] - most)) if active[c] else np.float32(0.0)
        total += out[c]
    for c in range(CLASSES):
        out[c] /= total
    return best


@kernel
def labels_of(lam: F32, active: U8, label: U8, probability: F32, out: F32) -> None:
    """Label and its probability for each row of ``lam`` float32 (n, CLASSES); 0 and 0 where nobody has looked.

    ``out`` float32 (CLASSES,) is scratch.
    """
    for i in range(lam.shape[0]):
        blank = True
        for c in range(CLASSES):
            blank = blank and lam[i, c] == 0.0
        label[i] = 0 if blank else probabilities(lam[i], active, out)
        probability[i] = 0.0 if blank else out[label[i]]
