"""What the deltas tell, put together, is the map."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from artemis_edge import delta as deltas
from artemis_edge.block_store import CHANGED, COUNT
from artemis_edge.delta import Outbox, confidence
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


def test_blocks_on_disk_were_told_before_they_went(tmp_path: Path) -> None:
    places = naive.walk(70.0, 0.5)[:140]
    pipeline = naive.small_pipeline(tmp_path, places)
    pipeline.outbox._slots = np.empty(1, np.int32)  # as if a scan changed more blocks than are told at once
    viewer = _run(pipeline, places)
    assert pipeline.pager.paged_out > 0
    viewer.assert_shows(pipeline, missing_allowed=100)


def test_no_more_blocks_than_a_viewer_takes_and_none_forgotten(tmp_path: Path) -> None:
    mapper = naive.SmallMapper(tmp_path)
    rng = np.random.default_rng(1)
    mapper.add(rng.uniform(-12, 12, (20000, 3)), (0, 0, 0))
    mapper.finish()
    slots = mapper.pager.resident()
    assert len(slots) > 3 * deltas.MOST_BLOCKS
    stamps = rng.permutation(len(slots)) + 1
    mapper.store.block[slots, CHANGED] = stamps
    outbox, told = Outbox(mapper.store), []
    while True:
        d = outbox.changed(0)
        _assert_shape(d)
        if len(d.block) == 0:
            break
        assert len(d.block) <= deltas.MOST_BLOCKS
        told += list(map(tuple, d.block.tolist()))
    by_age = mapper.store.block[slots[np.argsort(stamps)], :3].tolist()
    assert told == list(map(tuple, by_age)), "those that wait longest first"


def test_delta_of_an_empty_map(tmp_path: Path) -> None:
    mapper = naive.SmallMapper(tmp_path)
    d = Outbox(mapper.store).changed(3)
    _assert_shape(d)
    assert d.index == 3 and len(d.block) == 0


def test_confidence_grows_with_hits() -> None:
    evidence = np.zeros((4, 16), np.float32)
    evidence[:, COUNT] = (0, 1, 16, 1000)
    np.testing.assert_allclose(confidence(evidence), [0, 0.2212, 0.9817, 1.0], atol=1e-4)
