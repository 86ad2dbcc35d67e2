"""Atlas files: what was written comes back, and what is broken is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from artemis_edge.errors import InputError
from artemis_edge.export.atlas import Atlas, empty_atlas, read_atlas, write_atlas


def _atlas() -> Atlas:
    rng = np.random.default_rng(0)
    pages = tuple(rng.integers(0, 255, (16, 32, 3), np.uint8) for _ in range(2))
    return Atlas(pages, np.array([0, 1, -1], np.int32), rng.random((3, 3, 2)).astype(np.float32) * 15, 4)


def test_an_atlas_comes_back_as_it_was(tmp_path: Path) -> None:
    atlas = _atlas()
    size = write_atlas(tmp_path, atlas)
    assert size == sum(file.stat().st_size for file in tmp_path.iterdir())
    back = read_atlas(tmp_path)
    assert back is not None and back.padding == 4 and len(back.pages) == 2
    for one, other in zip(atlas.pages, back.pages, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(back.page, atlas.page)
    np.testing.assert_array_equal(back.uv, atlas.uv)


def test_the_same_atlas_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_atlas(tmp_path / name, _atlas())
    for file in (tmp_path / "a").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()


def test_a_map_without_texture_has_none(tmp_path: Path) -> None:
    assert read_atlas(tmp_path) is None
    write_atlas(tmp_path, empty_atlas(5))
    back = read_atlas(tmp_path)
    assert back is not None and back.pages == () and (back.page == -1).all() and len(back) == 5


def test_broken_parts_are_named(tmp_path: Path) -> None:
    write_atlas(tmp_path, _atlas())
    (tmp_path / "atlas_001.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"atlas_001\.png"):
        read_atlas(tmp_path)
    (tmp_path / "atlas.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"atlas\.npz"):
        read_atlas(tmp_path)
