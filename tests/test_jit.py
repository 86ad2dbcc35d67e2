"""Kernels of both packages are kept in one place, by our own rules."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
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


def test_the_service_starts_without_the_mapping() -> None:
    """Its own process loads that: what the service needs at its start is there in a second or two."""
    code = (
        "import sys, artemis_edge.service.daemon as d; "
        "print(sorted(m for m in sys.modules if m.startswith('artemis_edge.')))"
    )
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    for name in (
        "pipeline",
        "mesher",
        "odometry",
        "service.mapper",
        "service.segmenter",
        "session.stream_mapping",
    ):
        assert f"'artemis_edge.{name}'" not in loaded, name


@pytest.mark.skipif(
    platform.machine() != "x86_64" or not drivers_jit._cpu_has_avx2(),
    reason="compiled for the machine's own CPU",
)
def test_every_process_compiles_for_the_portable_cpu(tmp_path: Path) -> None:
    """Else a child would compile what its parent does not find: numba keeps kernels apart by the CPU."""
    compiles = (
        "from artemis_edge._jit import njit; from numba import njit as plain; f = plain(lambda x: x + 1); f(1); "
        "print(f.targetctx.codegen().magic_tuple()[1])"
    )
    child = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {compiles!r}], check=True)"
    fresh = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")}
    fresh["ARTEMIS_CACHE_DIR"] = str(tmp_path)
    code = [sys.executable, "-c", f"{compiles}; print(flush=True); {child}"]
    said = subprocess.run(code, check=True, capture_output=True, text=True, env=fresh).stdout.split()
    assert said == ["x86-64-v3", "x86-64-v3"]
