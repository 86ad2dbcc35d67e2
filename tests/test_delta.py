"""What the deltas tell, put together, is the map."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from artemis_edge import block_store as bs
from artemis_edge import delta as deltas
from artemis_edge.block_store import ALIVE, CARVED, CHANGED, COUNT, N_CELLS
from artemis_edge.delta import AGAIN_AFTER, MOST_BLOCKS, Outbox, confidence
from artemis_edge.frames import F32, MeshDelta
from artemis_edge.pipeline import Pipeline
from tests import naive


@pytest.fixture(autouse=True)
def _closed_files() -> Iterator[None]:
    with naive.closing_page_files():
        yield


class Viewer:
    """Keeps the newest of every block."""

    def __init__(self) -> None:
        self.vertices: dict[tuple[int, ...], dict[int, F32]] = {}
        self.triangles: dict[tuple[int, ...], list[tuple[int, ...]]] = {}

    def apply(self, d: MeshDelta) -> None:
        for k, block in enumerate(map(tuple, d.block.tolist())):
            rows = slice(d.vertex_start[k], d.vertex_start[k + 1])
            self.vertices[block] = dict(zip(d.vertex_id[rows].tolist(), d.position[rows], strict=True))
            self.triangles[block] = list(
                map(tuple, d.triangles[d.triangle_start[k] : d.triangle_start[k + 1]].tolist())
            )

    def assert_shows(self, pipeline: Pipeline, missing_allowed: int = 0) -> None:
        shown = sorted(t for block in self.triangles.values() for t in block)
        there = sorted(map(tuple, naive.all_triangles(pipeline.pager).tolist()))
        assert len(set(shown) ^ set(there)) <= missing_allowed
        living = naive.living_vertices(pipeline.pager)
        told = {name: p for block in self.vertices.values() for name, p in block.items()}
        assert told.keys() == living.keys()
        for name, position in living.items():
            np.testing.assert_array_equal(told[name], position)


def _assert_shape(d: MeshDelta) -> None:
    n, blocks = len(d.vertex_id), len(d.block)
    assert d.position.shape == d.normal.shape == d.colour.shape == (n, 3)
    assert len(d.label) == len(d.confidence) == n
    assert len(d.vertex_start) == len(d.triangle_start) == blocks + 1
    assert d.vertex_start[0] == d.triangle_start[0] == 0
    assert d.vertex_start[-1] == n and d.triangle_start[-1] == len(d.triangles)
    assert (np.diff(d.vertex_start) >= 0).all() and (np.diff(d.triangle_start) >= 0).all()
    assert (d.confidence >= 0).all() and (d.confidence <= 1).all()
    dtypes = (d.block.dtype, d.vertex_id.dtype, d.triangles.dtype, d.position.dtype, d.colour.dtype)
    assert dtypes == (np.int32, np.int64, np.int64, np.float32, np.uint8)


def _run(pipeline: Pipeline, places: list[tuple[float, float, float]]) -> Viewer:
    viewer = Viewer()
    for frame in naive.corridor(places, 1000):
        d = pipeline.process(frame)
        assert d.index == frame.index
        _assert_shape(d)
        viewer.apply(d)
    viewer.apply(pipeline.finish())
    return viewer


def test_all_deltas_together_are_the_map(tmp_path: Path) -> None:
    places = naive.walk(12.0, 0.5)
    pipeline = naive.small_pipeline(tmp_path, places, 60)
    # a few ears that neighbours displaced may still be shown: see the next test
    _run(pipeline, places).assert_shows(pipeline, missing_allowed=40)
    assert len(pipeline.outbox.everything(0).block) == 0


def test_all_deltas_together_are_exactly_the_map(tmp_path: Path) -> None:
    places = naive.walk(40.0, 0.5)
    pipeline = naive.small_pipeline(tmp_path, places, 60)
    _run(pipeline, places).assert_shows(pipeline)


def test_blocks_on_disk_were_told_before_they_went(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    places = naive.walk(70.0, 0.5)[:140]
    pipeline = naive.small_pipeline(tmp_path, places)
    monkeypatch.setattr(deltas, "MOST_BLOCKS", 1)  # as if a scan changed more blocks than are told at once
    viewer = _run(pipeline, places)
    assert pipeline.pager.paged_out > 0
    viewer.assert_shows(pipeline, missing_allowed=100)


def _scattered(folder: Path) -> naive.SmallMapper:
    """Points everywhere, in many blocks, and a floor; every fifth cell carved."""
    mapper, rng = naive.SmallMapper(folder), np.random.default_rng(1)
    mapper.add(rng.uniform(-12, 12, (20000, 3)), (0, 0, 0))
    mapper.add(naive.rectangle(rng, (-6, -6, -2), (12, 0, 0), (0, 12, 0), 500, 0.01), (0, 0, 0))
    mapper.finish()
    mapper.store.state[: mapper.store.counter[N_CELLS] : 5] = CARVED
    return mapper


def _told(d: MeshDelta) -> list[tuple[int, ...]]:
    _assert_shape(d)
    return list(map(tuple, d.block.tolist()))


def test_no_more_blocks_than_a_viewer_takes_and_none_forgotten(tmp_path: Path) -> None:
    mapper = _scattered(tmp_path)
    slots, block = mapper.pager.resident(), mapper.store.block
    assert len(slots) > 3 * MOST_BLOCKS
    outbox, order = Outbox(mapper.store), np.random.default_rng(2).permutation(slots)
    block[:, CHANGED] = 0
    told, expected = [], []
    for turn in range(len(slots)):  # two more than can be told, then silence
        news = order[turn * (MOST_BLOCKS + 2) : (turn + 1) * (MOST_BLOCKS + 2)]
        block[news, CHANGED] = turn + 1
        expected += [tuple(block[s, :3].tolist()) for s in np.sort(news)]
        blocks = _told(outbox.changed(turn))
        assert len(blocks) <= MOST_BLOCKS
        told += blocks
        if not blocks:
            break
    assert told == expected, "those that wait longest first"


def test_a_block_that_goes_on_changing_is_told_now_and_then(tmp_path: Path) -> None:
    mapper = _scattered(tmp_path)
    block = mapper.store.block
    block[:, CHANGED] = 0
    outbox, turns = Outbox(mapper.store), []
    for turn in range(4 * AGAIN_AFTER):
        block[3, CHANGED] = turn + 1
        if _told(outbox.changed(turn)):
            turns.append(turn)
    assert turns == [0, AGAIN_AFTER, 2 * AGAIN_AFTER, 3 * AGAIN_AFTER]
    assert _told(outbox.everything(99)) == [tuple(block[3, :3].tolist())], (
        "what changed last is told at the end"
    )
    assert _told(outbox.everything(99)) == []


def test_a_delta_against_loops_over_every_place(tmp_path: Path) -> None:
    mapper = _scattered(tmp_path)
    store, slots = mapper.store, mapper.pager.resident()[1::3]
    empty = bs.find_or_add_block(store, 500, -500, 7)
    slots = np.concatenate((slots[:4], [empty], slots[4:])).astype(np.int32)
    d = deltas.to_delta(7, store, slots, deltas.new_listing(store))
    _assert_shape(d)
    assert d.index == 7 and d.block.tolist() == store.block[slots, :3].tolist()
    vertices, triangles = 0, 0
    for k, slot in enumerate(slots):
        assert (d.vertex_start[k], d.triangle_start[k]) == (vertices, triangles)
        for v in store.block_voxel[slot][store.block_voxel[slot] >= 0]:
            corner = store.voxel[v, :3].astype(np.int64) * 4
            for c in range(64):
                s = store.voxel_cell[v, c]
                if s >= 0 and store.state[s] == ALIVE:
                    cell = np.add(corner, (c >> 4, (c >> 2) & 3, c & 3))
                    assert d.vertex_id[vertices] == bs.block_key(*cell.tolist())
                    np.testing.assert_array_equal(d.position[vertices], store.vertex[s, :3])
                    np.testing.assert_array_equal(d.normal[vertices], store.vertex[s, 3:6])
                    sure = 1.0 - np.exp(-store.evidence[s, COUNT] / 4.0)
                    assert d.confidence[vertices] == pytest.approx(sure, abs=1e-6)
                    vertices += 1
            at = store.voxel[v, bs.PATCH_AT]
            for codes in store.triangle[at : at + store.voxel[v, bs.PATCH_LEN]].astype(np.int64) & 0x7FFF:
                cells = [np.add(corner - 12, (q >> 10, (q >> 5) & 31, q & 31)) for q in codes]
                assert d.triangles[triangles].tolist() == [bs.block_key(*q.tolist()) for q in cells]
                triangles += 1
    assert (len(d.vertex_id), len(d.triangles)) == (vertices, triangles)
    assert vertices > 500 and triangles > 50


def test_delta_of_an_empty_map(tmp_path: Path) -> None:
    mapper = naive.SmallMapper(tmp_path)
    d = Outbox(mapper.store).changed(3)
    _assert_shape(d)
    assert d.index == 3 and len(d.block) == 0


def test_confidence_grows_with_hits() -> None:
    evidence = np.zeros((4, 16), np.float32)
    evidence[:, COUNT] = (0, 1, 16, 1000)
    np.testing.assert_allclose(confidence(evidence), [0, 0.2212, 0.9817, 1.0], atol=1e-4)
