"""Hash of blocks, pools and patches against dictionaries."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from artemis_edge import block_store as bs
from artemis_edge.block_store import Store

SMALLEST = 1.0  # bytes: the smallest memory there is


def _resident(store: Store) -> dict[tuple[int, int, int], int]:
    slots = store.hash_slot[store.hash_key != bs.EMPTY_KEY]
    return {tuple(store.block[s, :3].tolist()): int(s) for s in slots}


def _assert_same(store: Store, twin: dict[tuple[int, int, int], int]) -> None:
    assert _resident(store) == twin
    assert len(set(twin.values())) == len(twin)
    for block, slot in twin.items():
        assert bs.find_block(store, *block) == slot


@pytest.mark.parametrize("reach", [3, 1_000_000])
def test_blocks_against_a_dictionary(reach: int) -> None:
    rng = np.random.default_rng(reach)
    store = bs.allocate(SMALLEST)
    twin: dict[tuple[int, int, int], int] = {}
    for step in range(6000):
        block = tuple(rng.integers(-reach, reach, 3).tolist())
        action = rng.integers(3)
        if action == 0 and twin:
            block = list(twin)[rng.integers(len(twin))]
            bs.remove_block(store, twin.pop(block))
            assert bs.find_block(store, *block) == -1
        elif action == 1:
            assert bs.find_block(store, *block) == twin.get(block, -1)  # type: ignore[call-overload]
        else:
            slot = bs.find_or_add_block(store, *block)
            assert slot == twin.setdefault(block, slot)  # type: ignore[call-overload]
        if step % 500 == 0:
            _assert_same(store, twin)
    _assert_same(store, twin)


def _colliding_keys(mask: int, n: int) -> list[int]:
    """Keys that all want one of the last three places, so that runs wrap around the table's end."""
    return [key for key in range(2000) if bs.home_slot(key, mask) >= mask - 2][:n]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.booleans(), st.integers(0, 11)), max_size=60))
def test_removal_keeps_runs_of_colliding_keys_reachable(steps: list[tuple[bool, int]]) -> None:
    mask = 31
    keys = _colliding_keys(mask, 12)
    assert len(keys) == 12
    hash_key, hash_slot = np.full(mask + 1, bs.EMPTY_KEY, np.int64), np.zeros(mask + 1, np.int32)
    twin: dict[int, int] = {}
    for insert, which in steps:
        key = keys[which]
        at = bs.find_slot(hash_key, key)
        if insert:
            hash_key[at], hash_slot[at] = key, which
            twin[key] = which
        elif key in twin:
            del twin[key]
            bs.remove_key(hash_key, hash_slot, at)
        found = {
            k: int(hash_slot[bs.find_slot(hash_key, k)])
            for k in keys
            if hash_key[bs.find_slot(hash_key, k)] == k
        }
        assert found == twin
        assert (hash_key != bs.EMPTY_KEY).sum() == len(twin)


def test_key_is_unique_and_ordered_by_coordinates() -> None:
    corners = [-1_048_576, -1, 0, 1, 1_048_575]
    keys = [bs.block_key(x, y, z) for x in corners for y in corners for z in corners]
    assert keys == sorted(set(keys))
    assert bs.EMPTY_KEY not in keys


def _add_voxels(store: Store, coordinates: set[tuple[int, int, int]]) -> dict[tuple[int, int, int], int]:
    out = {}
    for x, y, z in sorted(coordinates):
        block = bs.find_or_add_block(store, x >> 3, y >> 3, z >> 3)
        out[x, y, z] = bs.add_voxel(store, block, bs.inner_index(x, y, z), x, y, z)
    return out


@pytest.mark.parametrize("centre", [(0, 0, 0), (-8, 7, 800), (-1, -1, -1)])
def test_neighbours_across_block_borders_against_a_dictionary(centre: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(7)
    store = bs.allocate(SMALLEST)
    picked = {tuple((rng.integers(-9, 10, 3) + centre).tolist()) for _ in range(2500)}
    voxels = _add_voxels(store, picked)  # type: ignore[arg-type]
    out = np.empty(27, np.int32)
    for (x, y, z), v in voxels.items():
        bs.neighbours27(store, v, out)
        around = [(x + i, y + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]
        assert out.tolist() == [voxels.get(a, -1) for a in around]
        assert out[13] == v


def test_inner_index_names_each_voxel_of_a_block_once() -> None:
    places = {bs.inner_index(x, y, z) for x in range(-8, 0) for y in range(8, 16) for z in range(8)}
    assert places == set(range(512))


def test_lowest_bit_against_strings() -> None:
    rng = np.random.default_rng(10)
    masks = [1 << k for k in range(64)] + [
        2**64 - 1,
        3 << 62,
        *map(int, rng.integers(1, 2**63, 300, np.uint64)),
    ]
    for mask in masks:
        assert bs.lowest_bit(np.uint64(mask)) == f"{mask:b}"[::-1].index("1")


def _patch(n: int, mark: int) -> np.ndarray:
    return np.full((n, 3), mark % 65536, np.uint16)


def test_live_patches_never_overlap_and_keep_their_triangles() -> None:
    rng = np.random.default_rng(8)
    store = bs.allocate(SMALLEST)
    voxels = list(_add_voxels(store, {(x, y, 0) for x in range(10) for y in range(10)}).values())
    twin: dict[int, tuple[int, int]] = {}
    for step in range(5000):
        v = voxels[rng.integers(len(voxels))]
        if rng.random() < 0.2:
            bs.release_patch(store, v)
            twin.pop(v, None)
        else:
            n = int(rng.choice([0, 1, 7, 8, 9, 60, 200, 512]))
            assert bs.set_patch(store, v, _patch(n, step), n)
            twin[v] = (n, step)
        if step % 100 == 0:
            used = np.zeros(len(store.triangle), np.int32)
            for u in voxels:
                at, room = store.voxel[u, bs.PATCH_AT], store.voxel[u, bs.PATCH_ROOM]
                used[at : at + room] += 1
                n, mark = twin.get(u, (0, 0))
                assert store.voxel[u, bs.PATCH_LEN] == n <= room or u not in twin
                assert (store.triangle[at : at + n] == mark % 65536).all()
            assert used.max() <= 1
    assert store.counter[bs.N_TRIANGLES] <= len(store.triangle)


def test_full_triangle_pool_refuses_and_keeps_the_old_patch() -> None:
    store = bs.allocate(SMALLEST)
    voxels = list(
        _add_voxels(store, {(x, y, z) for x in range(8) for y in range(8) for z in range(8)}).values()
    )
    results = [bs.set_patch(store, v, _patch(512, v), 512) for v in voxels]
    assert results.count(True) == len(store.triangle) // 512
    last = voxels[results.index(False) - 1]
    assert not bs.set_patch(store, last, _patch(1000, 1), 1000)
    at = store.voxel[last, bs.PATCH_AT]
    assert store.voxel[last, bs.PATCH_LEN] == 512
    assert (store.triangle[at : at + 512] == last).all()
    bs.release_patch(store, voxels[0])
    assert bs.set_patch(store, voxels[-1], _patch(400, 3), 400)  # the released room is used again


def test_full_pools_say_so_and_what_is_there_stays() -> None:
    store = bs.allocate(SMALLEST)
    rows = len(store.block)
    assert [bs.find_or_add_block(store, i, 0, 0) for i in range(rows)] == list(range(rows))
    assert bs.find_or_add_block(store, rows, 0, 0) == -1
    assert bs.find_block(store, rows, 0, 0) == -1
    assert bs.find_or_add_block(store, 3, 0, 0) == 3
    bs.remove_block(store, 3)
    assert bs.find_or_add_block(store, rows, 0, 0) == 3

    v = -1
    for k in range(len(store.voxel)):
        v = bs.add_voxel(store, k // 512, k % 512, 0, 0, 0)
        assert v == k
    assert bs.add_voxel(store, 100, 5, 0, 0, 0) == -1
    assert store.block_voxel[100, 5] == -1

    for k in range(len(store.evidence)):
        assert bs.add_cell(store, k // 64, k % 64) == k
    assert bs.add_cell(store, v, 1) == -1
    assert store.voxel_cell[v, 1] == -1 and store.voxel_mask[v] == 0


def test_removed_block_gives_voxels_cells_and_patches_back_empty() -> None:
    store = bs.allocate(SMALLEST)
    for turn in range(30):
        block = bs.find_or_add_block(store, turn, -turn, 0)
        for inner in range(300):
            v = bs.add_voxel(store, block, inner, 0, 0, 0)
            assert v >= 0 and (store.voxel_cell[v] == -1).all() and store.voxel[v, bs.PATCH_LEN] == 0
            for c in (0, 63):
                s = bs.add_cell(store, v, c)
                assert not store.evidence[s].any() and store.state[s] == bs.EVIDENCE_ONLY
                store.evidence[s] = 1.0
                store.state[s] = bs.ALIVE
            assert int(store.voxel_mask[v]) == 1 | 1 << 63
            assert bs.set_patch(store, v, _patch(20, 1), 20)
        bs.remove_block(store, block)
    c = store.counter
    assert (c[bs.N_VOXELS], c[bs.N_CELLS]) == (c[bs.FREE_VOXELS], c[bs.FREE_CELLS]) == (300, 600)
    assert c[bs.N_TRIANGLES] == 300 * 32


def test_queue_holds_each_voxel_once_in_order_around_its_end() -> None:
    store = bs.allocate(SMALLEST)
    rng = np.random.default_rng(9)
    store.counter[bs.QUEUE_AT] = len(store.queue) - 5
    _add_voxels(store, {(x, y, 0) for x in range(10) for y in range(10)})
    twin: list[int] = []
    for stamp in range(1, 2000):
        v = int(rng.integers(100))
        if rng.random() < 0.5:
            bs.enqueue(store, v, stamp)
            if v not in twin:
                twin.append(v)
                assert store.voxel[v, bs.QUEUED] == stamp
        elif twin:
            assert bs.dequeue(store) == twin[0]
            store.voxel[twin.pop(0), bs.QUEUED] = 0
        assert store.counter[bs.QUEUE_LEN] == len(twin)


def test_memory_is_about_the_budget() -> None:
    for budget in (50e6, 200e6):
        size = sum(a.nbytes for a in bs.allocate(budget))
        assert size < 1.2 * budget, f"{size / 1e6:.0f} MB of {budget / 1e6:.0f}"
