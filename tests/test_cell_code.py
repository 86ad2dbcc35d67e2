"""Cell codes against the coordinates they stand for."""

import itertools

import numpy as np
import pytest

from artemis_edge import block_store as bs
from artemis_edge import cell_code as cc

NEIGHBOURS = list(itertools.product((-1, 0, 1), repeat=3))  # in the order of neighbours27


def _coordinates(code: int) -> tuple[int, int, int]:
    return code >> 10, (code >> 5) & 31, code & 31


def test_codes_are_unique_and_can_be_read_back() -> None:
    codes = {cc.code_of(*c): c for c in itertools.product(range(4, 24), repeat=3)}
    assert len(codes) == 20**3 and max(codes) < cc.CODES
    assert all(_coordinates(code) == c for code, c in codes.items())


def test_voxel_and_cell_of_every_code() -> None:
    for c in itertools.product(range(8, 20), repeat=3):
        code = cc.code_of(*c)
        voxel = [(x - cc.OWN) // 4 for x in c]
        cell = [x % 4 for x in c]
        assert NEIGHBOURS[cc.code_voxel(code)] == tuple(voxel)
        assert cc.code_cell(code) == cell[0] * 16 + cell[1] * 4 + cell[2]


@pytest.mark.parametrize("k", range(27))
def test_shift_expresses_a_neighbours_code_in_the_own_frame(k: int) -> None:
    d = NEIGHBOURS[k]
    for c in itertools.product((8, 11, 12, 15, 16, 19), repeat=3):
        moved = tuple(x + 4 * s for x, s in zip(c, d, strict=True))
        assert cc.code_of(*c) + cc.neighbour_shift(k) == cc.code_of(*moved)


@pytest.mark.parametrize("margin", [0, 1, 2, 4])
def test_gathered_cells_against_a_dictionary(margin: int) -> None:
    rng = np.random.default_rng(margin)
    store = bs.allocate(1.0)
    slots: dict[tuple[int, int, int], int] = {}
    for cell in {tuple(rng.integers(-8, 12, 3).tolist()) for _ in range(1500)}:
        x, y, z = (c >> 2 for c in cell)
        block = bs.find_or_add_block(store, x >> 3, y >> 3, z >> 3)
        inner = bs.inner_index(x, y, z)
        v = int(store.block_voxel[block, inner])
        v = v if v >= 0 else bs.add_voxel(store, block, inner, x, y, z)
        a, b, c = (q & 3 for q in cell)
        slots[cell] = bs.add_cell(store, v, a * 16 + b * 4 + c)  # type: ignore[index]
    own = int(store.block_voxel[bs.find_block(store, 0, 0, 0), 0])
    neighbour, grid, code = np.empty(27, np.int32), np.full(cc.CODES, -1, np.int32), np.empty(1728, np.uint32)
    bs.neighbours27(store, own, neighbour)
    n = cc.gather_cells(store, neighbour, margin, grid, code)

    near = {c: s for c, s in slots.items() if all(-margin <= x < 4 + margin for x in c)}
    expected = {cc.code_of(*(x + cc.OWN for x in c)): s for c, s in near.items()}
    assert {int(q): int(grid[q]) for q in code[:n]} == expected
    assert n == len(expected) and (grid >= 0).sum() == n
    inside = [all(cc.OWN <= x < cc.OWN + 4 for x in _coordinates(int(q))) for q in code[:n]]
    assert inside == sorted(inside, reverse=True), "own cells come first"
