"""Pages: nothing changes on the way to disk and back."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from artemis_edge import block_store as bs
from artemis_edge.frames import I64
from artemis_edge.key_set import KeySet
from artemis_edge.paging import (
    MOST_OUT,
    Page,
    PageFile,
    block_keys,
    pack,
    page_bytes,
    page_from_bytes,
    restore_block,
)
from tests import naive

# Holds what the sensor sees in the corridor and half as much again, not the corridor
SMALL_MB = 12


@pytest.fixture(autouse=True)
def _closed_files() -> Iterator[None]:
    with naive.closing_page_files():
        yield


def _scene(folder: Path, frames: int = 6) -> naive.SmallMapper:
    """A wall and a floor over several blocks, some below zero; evidence is left pending."""
    rng = np.random.default_rng(1)
    mapper = naive.SmallMapper(folder)
    for _ in range(frames):
        wall = naive.rectangle(rng, (3.3, -4, -1), (0, 8, 0), (0, 0, 2), 300, 0.01)
        floor = naive.rectangle(rng, (-1, -4, -1.05), (4.3, 0, 0), (0, 8, 0), 300, 0.01)
        mapper.add(np.concatenate((wall, floor)), (0, 0, 1))
    return mapper


def _pages(mapper: naive.SmallMapper) -> list[Page]:
    return list(mapper.pager.pages())


def _sorted_rows(triangles: I64) -> list[list[int]]:
    return sorted(triangles.tolist())


def test_bytes_give_the_page_back(tmp_path: Path) -> None:
    for page in _pages(_scene(tmp_path)):
        back = page_from_bytes(page_bytes(page))
        for field in dataclasses.fields(Page):
            a, b = getattr(page, field.name), getattr(back, field.name)
            assert a.dtype == b.dtype and a.shape == b.shape
            np.testing.assert_array_equal(a, b, err_msg=field.name)
        assert page_bytes(back) == page_bytes(page)


def test_empty_block_is_a_page_too(tmp_path: Path) -> None:
    store = bs.allocate(1.0)
    page = pack(store, np.array([bs.find_or_add_block(store, -3, 2, 7)], np.int32))
    back = page_from_bytes(page_bytes(page))
    assert back.block.tolist() == [[-3, 2, 7]]
    assert len(back.inner) == len(back.cell) == len(back.triangle) == len(back.vertex_ids()) == 0


def test_cut_off_bytes_are_refused_wherever_the_cut_is(tmp_path: Path) -> None:
    data = page_bytes(_pages(_scene(tmp_path, 1))[0])
    cuts = {0, 1, 31, 32, 33, len(data) // 2, len(data) - 2, len(data) - 1}
    for cut in cuts | set(np.linspace(0, len(data) - 1, 50, dtype=int).tolist()):
        with pytest.raises(ValueError):
            page_from_bytes(data[:cut])
    with pytest.raises(ValueError, match="not a page"):
        page_from_bytes(b"XXXX" + data[4:])


def test_names_of_vertices_are_their_cells(tmp_path: Path) -> None:
    mapper = _scene(tmp_path)
    mapper.finish()
    for page in _pages(mapper):
        ids = page.vertex_ids()
        cell = np.stack([(ids >> s) & 0x1FFFFF for s in (42, 21, 0)], -1) - (1 << 20)
        assert len(np.unique(ids)) == len(ids)
        assert ((cell >> 5) == page.block[0]).all()
        alive = page.alive()
        # a vertex lies in its cell, or as far outside as its plane took it
        off = page.vertex[alive, :3] / mapper.voxel_map.cell_m - cell[alive] - 0.5
        assert np.abs(off).max() < 1.5 and np.median(np.abs(off)) < 0.5
    known = set(np.concatenate([p.vertex_ids() for p in _pages(mapper)]).tolist())
    assert set(naive.all_triangles(mapper.pager).ravel().tolist()) <= known


def test_page_of_several_blocks_is_their_pages_in_order(tmp_path: Path) -> None:
    mapper = _scene(tmp_path)
    slots = mapper.pager.resident()
    whole, parts = (
        pack(mapper.store, slots),
        [pack(mapper.store, slots[k : k + 1]) for k in range(len(slots))],
    )
    for field in dataclasses.fields(Page):
        joined = np.concatenate([getattr(p, field.name) for p in parts])
        np.testing.assert_array_equal(getattr(whole, field.name), joined, err_msg=field.name)
    np.testing.assert_array_equal(whole.vertex_ids(), np.concatenate([p.vertex_ids() for p in parts]))
    np.testing.assert_array_equal(whole.triangle_ids(), np.concatenate([p.triangle_ids() for p in parts]))


def _evict(mapper: naive.SmallMapper, slot: int) -> int:
    """Send one block to disk as ``make_room`` does; its key."""
    key = int(block_keys(mapper.store.block[slot : slot + 1, :3])[0])
    mapper.pager.file.put(key, pack(mapper.store, np.array([slot], np.int32)))
    bs.remove_block(mapper.store, slot)
    return key


def test_blocks_that_went_and_came_back_give_the_same_map(tmp_path: Path) -> None:
    mapper = _scene(tmp_path)
    mapper.finish()
    before = [page_bytes(p) for p in _pages(mapper)]
    keys = [_evict(mapper, int(slot)) for slot in mapper.pager.resident()]
    assert (mapper.store.hash_key == bs.EMPTY_KEY).all()
    assert [page_bytes(p) for p in _pages(mapper)] == before  # read from disk
    for key in reversed(keys):
        mapper.pager._restore(key, 99)
    assert len(mapper.pager.file) == 0
    assert [page_bytes(p) for p in _pages(mapper)] == before


def test_block_seen_again_before_it_came_back_adds_up(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    points = naive.rectangle(rng, (3.3, -1, 0.1), (0, 2, 0), (0, 0, 2), 300, 0.01)
    whole, paged = naive.SmallMapper(tmp_path / "a"), naive.SmallMapper(tmp_path / "b")
    for mapper in (whole, paged):
        mapper.add(points, (0, 0, 1))
        mapper.mesher.flush(1)
    for slot in paged.pager.resident():
        _evict(paged, int(slot))
    for mapper in (whole, paged):
        mapper.stamp += 1
        mapper.voxel_map.insert(naive.frame_of(points[::2], (0, 0, 1)), 2)
    paged.pager.bring_back(paged.voxel_map.touched_blocks(), 2)
    assert paged.pager.paged_in > 0 and len(paged.pager.file) == 0
    for a, b in zip(_pages(whole), _pages(paged), strict=True):
        np.testing.assert_allclose(a.evidence, b.evidence, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(a.triangle_ids(), b.triangle_ids())
        # cells that came back count as fresh once more: the patch is made anew a little early
        np.testing.assert_array_equal(a.meta[:, [0, 2]], b.meta[:, [0, 2]])
        np.testing.assert_array_equal(a.state, b.state)


def test_newest_page_of_a_block_counts_and_the_file_goes_when_closed(tmp_path: Path) -> None:
    first, second = _pages(_scene(tmp_path, 1))[0], _pages(_scene(tmp_path, 3))[0]
    file = PageFile(tmp_path / "pages")
    assert len(file) == 0 and file.keys().tolist() == []
    file.put(5, first)
    file.put(-7, first)
    file.put(5, second)
    assert file.keys().tolist() == [-7, 5] and 5 in file and 6 not in file
    assert page_bytes(file.take(5)) == page_bytes(second)
    assert len(file) == 1
    assert (tmp_path / "pages" / "pages.bin").exists()
    file.close()
    assert not (tmp_path / "pages" / "pages.bin").exists()


@given(
    st.lists(
        st.tuples(st.booleans(), st.integers(-4, 4), st.integers(-4, 4), st.integers(-4, 4)), max_size=80
    ),
    st.integers(0, 3),
)
@settings(max_examples=40, deadline=None)
def test_blocks_on_disk_around_others_are_found(said: list[tuple[bool, int, int, int]], asked: int) -> None:
    known, there = KeySet(), set()
    for comes, x, y, z in said:
        key = bs.block_key(x, y, z)
        if comes:
            known.add(key)
            there.add((x, y, z))
        elif (x, y, z) in there:
            known.remove(key)
            there.remove((x, y, z))
        assert (key in known) == ((x, y, z) in there)
    block = np.arange(3 * asked, dtype=np.int32).reshape(asked, 3) - 3
    near = [p for p in there if any(max(abs(p[k] - b[k]) for k in range(3)) <= 1 for b in block)]
    assert len(known) == len(there)
    assert known.around(block).tolist() == sorted(bs.block_key(*p) for p in near)


def test_a_set_of_keys_grows() -> None:
    known = KeySet()
    keys = [bs.block_key(k, -k, k % 7) for k in range(3000)]
    for key in keys:
        known.add(key)
    for key in keys[::2]:
        known.remove(key)
    assert len(known) == 1500 and all((key in known) == bool(k % 2) for k, key in enumerate(keys))


def test_nothing_goes_while_there_is_room(tmp_path: Path) -> None:
    mapper = _scene(tmp_path)
    mapper.pager.make_room(10_000)
    assert mapper.pager.paged_out == 0 and mapper.pager.fill() < 0.85


def test_waiting_and_lately_seen_blocks_stay(tmp_path: Path) -> None:
    mapper = naive.SmallMapper(tmp_path, budget_bytes=1.0)
    for k in range(60):
        for points in naive.corridor([(k * 1.0, 0.0, 0.0)], 4000):
            mapper.add(points.scans[0].points + np.array([k * 1.0, 0, 0]), (k * 1.0, 0, 0))
    waiting = mapper.mesher.waiting
    assert mapper.pager.fill() > 0.85 and waiting > 0
    mapper.store.block[:, bs.CHANGED] = 0  # as if all had been told
    mapper.pager.make_room(mapper.stamp, busy_frames=20)
    assert mapper.pager.paged_out > 0
    assert mapper.pager.paged_out <= MOST_OUT or mapper.pager.fill() < 0.93, "no frame pays for many"
    assert mapper.mesher.waiting == waiting
    resident = mapper.store.block[mapper.pager.resident()]
    gone = [mapper.pager.file.get(k).block[0, 0] for k in mapper.pager.file.keys().tolist()]
    assert min(resident[:, 0]) >= 0 and max(gone) * mapper.voxel_map.block_m < 45.0


def test_long_corridor_in_little_memory_is_the_corridor_in_much(tmp_path: Path) -> None:
    places = naive.walk(70.0, 0.5)
    area = {}
    for budget_mb in (SMALL_MB, 60):
        pipeline = naive.small_pipeline(tmp_path / str(budget_mb), places, budget_mb)
        for frame in naive.corridor(places):
            pipeline.process(frame)
        pipeline.finish()
        triangles = naive.all_triangles(pipeline.pager)
        naive.assert_manifold(triangles)
        assert set(triangles.ravel().tolist()) <= naive.living_vertices(pipeline.pager).keys()
        assert (pipeline.pager.paged_out > 10 and pipeline.pager.paged_in > 5) == (budget_mb == SMALL_MB)
        assert "points_without_memory" not in pipeline.lost
        area[budget_mb] = naive.area(naive.raw_mesh(pipeline.pager))
    assert area[SMALL_MB] == pytest.approx(area[60], rel=0.05)


def test_a_pool_that_is_not_full_refuses_no_patch(tmp_path: Path) -> None:
    places = naive.walk(70.0, 0.5)
    pipeline = naive.small_pipeline(tmp_path, places, SMALL_MB)
    for frame in naive.corridor(places):
        pipeline.process(frame)
    assert pipeline.pager.paged_out > 0
    assert pipeline.lost == {}


def _carve_beside_blocks_on_disk(folder: Path, seed: int) -> None:
    mapper = _scene(folder)
    mapper.finish()
    slots = mapper.pager.resident()
    for slot in slots[::2]:
        _evict(mapper, int(slot))
    store, rng = mapper.store, np.random.default_rng(seed)
    for slot in mapper.pager.resident():
        for v in store.block_voxel[slot][store.block_voxel[slot] >= 0]:
            for s in store.voxel_cell[v][store.voxel_cell[v] >= 0]:
                if rng.random() < 0.1:  # as free space does
                    store.state[s] = bs.CARVED
                    store.evidence[s, :13] = 0.0
            store.voxel[v, bs.FRESH] += 64
            bs.enqueue(store, v, mapper.stamp)
    mapper.mesher.flush(mapper.stamp)
    naive.assert_manifold(naive.all_triangles(mapper.pager))


def test_meshing_beside_a_block_on_disk_stays_manifold(tmp_path: Path) -> None:
    for seed in range(8):
        _carve_beside_blocks_on_disk(tmp_path / str(seed), seed)


@pytest.mark.parametrize("attributes", [0, 4, 20])
def test_attributes_come_back_and_are_added_to_what_was_learned_since(attributes: int) -> None:
    store = bs.allocate(1.0, attributes)
    block = bs.find_or_add_block(store, 0, 0, 0)
    v = bs.add_voxel(store, block, 0, 0, 0, 0)
    s = bs.add_cell(store, v, 5)
    store.attribute[s] = np.arange(1, attributes + 1)
    store.voxel_class[v] = 2.0
    page = page_from_bytes(page_bytes(pack(store, np.array([block], np.int32))))
    bs.remove_block(store, block)
    again = bs.find_or_add_block(store, 0, 0, 0)
    w = bs.add_voxel(store, again, 0, 0, 0, 0)
    t = bs.add_cell(store, w, 5)
    assert not store.attribute[t].any() and not store.voxel_class[w].any(), "memory given back is all zeros"
    store.attribute[t] = 7.0
    store.voxel_class[w] = 1.0
    assert restore_block(store, again, 1, *page.arrays())
    colour, classes = store.attribute[t, : bs.LOG_CLASS], store.attribute[t, bs.LOG_CLASS :]
    assert (colour == 7.0).all(), "the newer colour stays"
    np.testing.assert_array_equal(classes, 7.0 + np.arange(bs.LOG_CLASS + 1, attributes + 1))
    assert (store.voxel_class[w] == 3.0).all()
