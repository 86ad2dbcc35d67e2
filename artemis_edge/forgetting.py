"""Classes that nobody asks for any more: what the map knew of them is taken back, so that their slots can be used anew.

A class that is not asked for shows as background in a mask (voxel_fusion.py, refinement/semantics.py). So what was of
a forgotten class becomes background, and its slot knows what background knows, like all slots that are not in use.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from artemis_edge import block_store as bs
from artemis_edge._jit import kernel
from artemis_edge.block_store import BLOCK, CHANGED, CLASSES, FRESH, LOG_CLASS, Store
from artemis_edge.class_rows import best_class
from artemis_edge.frames import F32, I32, U8
from artemis_edge.paging import Page


@dataclass(frozen=True, slots=True)
class Forgotten:
    """Slots that lost their class, ``gone``, and those in use afterwards, ``active``: uint8 (CLASSES,) each."""

    gone: U8
    active: U8

    def __call__(self, page: Page) -> Page:
        """A page that was on disk meanwhile."""
        known = replace(page, voxel_class=page.voxel_class.copy(), attribute=page.attribute.copy())
        forget_rows(known.voxel_class, known.attribute, self.gone, self.active)
        return known


@kernel
def forget_sums(row: F32, gone: U8, active: U8) -> None:
    """The class sums of a voxel (eq. 1): those of the forgotten classes are background's."""
    for c in range(1, CLASSES):
        if gone[c]:
            row[0] += row[c]
    for c in range(1, CLASSES):
        if gone[c] or not active[c]:
            row[c] = row[0]


@kernel
def forget_logs(attribute: F32, gone: U8, active: U8) -> None:
    """The log-probabilities of a vertex (eq. 12): background is as probable as the likeliest forgotten class."""
    most = attribute[LOG_CLASS]
    for c in range(1, CLASSES):
        if gone[c]:
            most = max(most, attribute[LOG_CLASS + c])
    attribute[LOG_CLASS] = most
    for c in range(1, CLASSES):
        if gone[c] or not active[c]:
            attribute[LOG_CLASS + c] = most


@kernel
def forget_rows(voxel_class: F32, attribute: F32, gone: U8, active: U8) -> None:
    """All voxels (v, CLASSES + 1) and vertices (c, LOG_CLASS + CLASSES) of a page."""
    for i in range(voxel_class.shape[0]):
        forget_sums(voxel_class[i], gone, active)
    for i in range(attribute.shape[0]):
        forget_logs(attribute[i], gone, active)


@kernel
def forget_blocks(store: Store, blocks: I32, gone: U8, active: U8, stamp: int) -> int:
    """All voxels of resident ``blocks`` (slots); returns how many vertices have another class now.

    Their voxels are meshed anew: triangles keep objects apart.
    """
    changed = 0
    for block in blocks:
        for inner in range(512):
            v = store.block_voxel[block, inner]
            if v < 0:
                continue
            forget_sums(store.voxel_class[v], gone, active)
            mask = store.voxel_mask[v]
            here = 0
            while mask != 0:
                c = bs.lowest_bit(mask)
                mask &= mask - np.uint64(1)
                row = store.attribute[store.voxel_cell[v, c]]
                before = best_class(row)
                forget_logs(row, gone, active)
                here += best_class(row) != before
            if here > 0:
                store.block[store.voxel[v, BLOCK], CHANGED] = stamp
                store.voxel[v, FRESH] += here
                bs.enqueue(store, v, stamp)
                changed += here
    return changed
