"""The written mesh and map: complete files, every vertex used, no islands."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from artemis_edge import map_writer
from artemis_edge.config import Config, load
from artemis_edge.errors import RunError
from artemis_edge.export.ply import read_mesh
from artemis_edge.map_writer import gather_mesh, save_map, write_mesh
from artemis_edge.paging import page_bytes, page_from_bytes
from tests import naive

LONGEST_M = 0.4


@pytest.fixture(autouse=True)
def _closed_files() -> Iterator[None]:
    with naive.closing_page_files():
        yield


def _scene(folder: Path) -> naive.SmallMapper:
    """A wall of thousands of triangles and, two metres before it, a speck of a few."""
    rng = np.random.default_rng(1)
    mapper = naive.SmallMapper(folder)
    for _ in range(6):
        wall = naive.rectangle(rng, (5.1, -2, -1), (0, 4, 0), (0, 0, 3), 300, 0.005)
        speck = naive.rectangle(rng, (3.1, 0.02, 0.52), (0, 0.24, 0), (0, 0, 0.24), 600, 0.002)
        mapper.add(np.concatenate((wall, speck)), (0, 0, 1))
    mapper.mesher.flush(mapper.stamp)
    return mapper


def _pieces(faces: np.ndarray, vertices: int) -> list[int]:
    """Triangles of each connected piece, by repeated merging."""
    group = np.arange(vertices)
    while True:
        least = group[faces].min(axis=1)
        new = group.copy()
        for k in range(3):
            np.minimum.at(new, faces[:, k], least)
        if (new == group).all():
            return sorted(np.unique(group[faces[:, 0]], return_counts=True)[1].tolist())
        group = new


def test_islands_below_the_limit_are_left_out(tmp_path: Path) -> None:
    mapper = _scene(tmp_path)
    everything = gather_mesh(mapper.pager, LONGEST_M, 1)
    pieces = _pieces(everything.faces, len(everything.vertices))
    assert len(pieces) == 2 and 2 <= pieces[0] < 40 < 1000 < pieces[1]
    same = gather_mesh(mapper.pager, LONGEST_M, pieces[0])
    np.testing.assert_array_equal(same.faces, everything.faces)
    large = gather_mesh(mapper.pager, LONGEST_M, pieces[0] + 1)
    assert _pieces(large.faces, len(large.vertices)) == [pieces[1]]
    assert large.vertices[:, 0].min() > 4.5, "vertices of what was left out are gone too"
    none = gather_mesh(mapper.pager, LONGEST_M, 10**6)
    assert len(none.faces) == len(none.vertices) == 0


def test_every_vertex_is_used_and_every_row_belongs_together(tmp_path: Path) -> None:
    mapper = _scene(tmp_path)
    mesh = gather_mesh(mapper.pager, LONGEST_M, 10)
    assert np.unique(mesh.faces).tolist() == list(range(len(mesh.vertices)))
    rows = {len(a) for a in (mesh.vertices, mesh.normals, mesh.colours, mesh.labels, mesh.confidence)}
    assert rows == {len(mesh.vertices)}
    living = {tuple(p) for p in np.array(list(naive.living_vertices(mapper.pager).values())).tolist()}
    assert {tuple(p) for p in mesh.vertices.tolist()} <= living
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-4)
    assert (mesh.confidence > 0).all() and (mesh.confidence <= 1).all()


def test_finished_mesh_keeps_the_triangles_and_stays_manifold(tmp_path: Path) -> None:
    mapper = _scene(tmp_path)
    raw, mesh = naive.raw_mesh(mapper.pager), gather_mesh(mapper.pager, LONGEST_M, 10)
    naive.assert_manifold(mesh.faces.astype(np.int64))

    def names(m: object) -> set[frozenset[tuple[float, ...]]]:
        return {frozenset(map(tuple, corners)) for corners in m.vertices[m.faces].tolist()}  # type: ignore[attr-defined]

    common = len(names(raw) & names(mesh))
    assert common > 0.95 * len(raw.faces) and common > 0.9 * len(mesh.faces)


def test_triangles_of_vertices_that_no_longer_live_are_left_out(tmp_path: Path) -> None:
    mapper = _scene(tmp_path)
    before = gather_mesh(mapper.pager, LONGEST_M, 10)
    cells = mapper.store.counter[2]
    gone = np.flatnonzero(mapper.store.vertex[:cells, 1] > 1.0)
    mapper.store.state[gone] = 2  # carved, patches not made anew yet
    mesh = gather_mesh(mapper.pager, LONGEST_M, 10)
    assert 0 < len(mesh.faces) < 0.9 * len(before.faces)
    assert mesh.vertices[:, 1].max() <= 1.0


def test_empty_map_gives_an_empty_mesh(tmp_path: Path) -> None:
    mapper = naive.SmallMapper(tmp_path)
    mesh = write_mesh(tmp_path / "mesh.ply", mapper.pager, LONGEST_M, 10)
    assert len(mesh.vertices) == len(mesh.faces) == 0
    assert len(read_mesh(tmp_path / "mesh.ply").faces) == 0
    assert save_map(tmp_path / "map", mapper.pager, Config()) == 0


def test_written_mesh_is_the_mesh(tmp_path: Path) -> None:
    mapper = _scene(tmp_path)
    mesh = write_mesh(tmp_path / "mesh.ply", mapper.pager, LONGEST_M, 10)
    back = read_mesh(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_array_equal(back.confidence, mesh.confidence)
    assert back.label_names == map_writer.LABELS


def test_saved_blocks_are_all_pages_one_after_the_other(tmp_path: Path) -> None:
    mapper = _scene(tmp_path / "pages")
    pages = [page_bytes(p) for p in mapper.pager.pages()]
    config = Config()
    size = save_map(tmp_path / "map", mapper.pager, config)
    data = (tmp_path / "map" / "blocks.bin").read_bytes()
    assert size == len(data) and data == b"".join(pages)
    at = 0
    for page in pages:
        assert page_bytes(page_from_bytes(data[at:])) == page
        at += len(page)
    assert load(tmp_path / "map" / "config.toml") == config


def test_failure_leaves_the_older_files_untouched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = _scene(tmp_path / "pages")
    folder = tmp_path / "map"
    save_map(folder, mapper.pager, Config())
    before = (folder / "blocks.bin").read_bytes()
    written = []

    def full_disk(page: object) -> bytes:
        if written:
            raise OSError(28, "No space left on device")
        written.append(page)
        return b"half a page"

    monkeypatch.setattr(map_writer, "page_bytes", full_disk)
    with pytest.raises(RunError, match="No space left"):
        save_map(folder, mapper.pager, Config())
    assert written and (folder / "blocks.bin").read_bytes() == before
    assert sorted(p.name for p in folder.iterdir()) == ["blocks.bin", "config.toml"]


def test_mesh_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    mapper = _scene(tmp_path)
    with pytest.raises(RunError):
        write_mesh(tmp_path / "not there" / "mesh.ply", mapper.pager, LONGEST_M, 10)
