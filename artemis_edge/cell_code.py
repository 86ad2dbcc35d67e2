"""Cell codes: the 12 x 12 x 12 cells of a voxel and its 26 neighbours as one small integer.

A code packs three coordinates of 5 bits, biased by 8, so that a code can be moved to a neighbour's frame by one
addition without a borrow (the moved coordinates lie in 4..23). Own cells have coordinates 12..15.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from artemis_edge._jit import kernel
from artemis_edge.block_store import Store, lowest_bit
from artemis_edge.frames import I32, U32

CODES = 1 << 15  # the 16th bit of a stored code is the mesher's
OWN = 12  # first own coordinate


@kernel
def code_of(X: int, Y: int, Z: int) -> int:
    """Code of biased coordinates."""
    return (X << 10) | (Y << 5) | Z


@kernel
def neighbour_shift(k: int) -> int:
    """What to add to a code of neighbour ``k`` (0..26 as in ``neighbours27``) to express it in the own frame."""
    return ((k // 9 - 1) * 4 << 10) + (((k // 3) % 3 - 1) * 4 << 5) + (k % 3 - 1) * 4


@kernel
def code_voxel(code: int) -> int:
    """Which of the 27 voxels a code lies in."""
    return (((code >> 10) - 8) >> 2) * 9 + ((((code >> 5) & 31) - 8) >> 2) * 3 + (((code & 31) - 8) >> 2)


@kernel
def code_cell(code: int) -> int:
    """Cell 0..63 within its voxel."""
    return (((code >> 10) & 3) << 4) | (((code >> 5) & 3) << 2) | (code & 3)


@kernel
def code_in(k: int, c: int) -> int:
    """Code of cell ``c`` (0..63) of the voxel ``k`` of the 27."""
    return code_of(
        8 + (k // 9) * 4 + (c >> 4), 8 + ((k // 3) % 3) * 4 + ((c >> 2) & 3), 8 + (k % 3) * 4 + (c & 3)
    )


@kernel
def gather_cells(store: Store, neighbour: I32, margin: int, grid: I32, code: U32) -> int:
    """Cells with evidence of a voxel (first) and within ``margin`` (0..4) cells around it.

    Writes ``grid[code] = slot`` and lists the codes; returns how many.
    """
    n = gather_voxel(store, neighbour[13], 13, margin, grid, code, 0)
    for k in range(27):
        if k != 13 and neighbour[k] >= 0:
            n = gather_voxel(store, neighbour[k], k, margin, grid, code, n)
    return n


@kernel
def cells_within(store: Store, w: int, margin: int, k: int) -> int:
    """How many cells the part of ``gather_cells`` for one of the 27 voxels has."""
    n, mask = 0, store.voxel_mask[w] & _WITHIN[margin, k]
    while mask != 0:
        mask &= mask - np.uint64(1)
        n += 1
    return n


@kernel
def gather_voxel(store: Store, w: int, k: int, margin: int, grid: I32, code: U32, n: int) -> int:
    """The part of ``gather_cells`` for one of the 27 voxels."""
    mask = store.voxel_mask[w] & _WITHIN[margin, k]
    while mask != 0:
        c = lowest_bit(mask)
        mask &= mask - np.uint64(1)
        at = code_in(k, c)
        grid[at] = store.voxel_cell[w, c]
        code[n] = at
        n += 1
    return n


def _masks() -> NDArray[np.uint64]:
    """Cells of each of the 27 voxels that lie within a margin of the own one, uint64 (5 margins, 27)."""
    c = np.arange(64)
    cell = np.stack([c >> 4, (c >> 2) & 3, c & 3])
    out = np.zeros((5, 27), np.uint64)
    for margin in range(5):
        for k in range(27):
            at = cell + 8 + 4 * np.array([[k // 9], [(k // 3) % 3], [k % 3]])
            inside = ((at >= OWN - margin) & (at < OWN + 4 + margin)).all(axis=0)
            out[margin, k] = (inside.astype(np.uint64) << c.astype(np.uint64)).sum(dtype=np.uint64)
    return out


_WITHIN = _masks()


def _near_voxels() -> NDArray[np.uint64]:
    """Which of the 27 voxels but the own one touch each own cell, uint64 (64,), a bit for each voxel."""
    own = _WITHIN[1]
    cell = np.arange(64, dtype=np.uint64)
    out = np.zeros(64, np.uint64)
    for k in range(27):
        if k != 13:
            # the own cells in a neighbour's margin are those of the opposite neighbour in ours
            out |= ((own[26 - k] >> cell) & np.uint64(1)) << np.uint64(k)
    return out


NEAR_VOXELS = _near_voxels()
