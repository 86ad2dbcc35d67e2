"""Kernels of both packages are kept in one place, by our own rules."""

from pathlib import Path

from artemis_drivers import _jit as drivers_jit
from artemis_drivers.livox_slots import track

from artemis_edge import _jit
from artemis_edge.cell_code import code_of


def test_both_packages_use_one_cache() -> None:
    assert _jit.cache_dir is drivers_jit.cache_dir and _jit.njit is drivers_jit.njit
    for kernel in (track, code_of):
        assert Path(kernel._cache.cache_path).is_relative_to(_jit.cache_dir())


def test_the_hash_is_that_of_all_sources() -> None:
    assert len(_jit.sources_hash()) == 16 and int(_jit.sources_hash(), 16) >= 0
