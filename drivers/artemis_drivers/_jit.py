"""Compiled kernels of both packages: their flags, where their cache lives, and for which CPU they are compiled.

``nogil`` lets the capture side run while a kernel works; ``error_model="numpy"`` makes division by zero
give inf as numpy does instead of a branch; no ``fastmath``, because equal input must give an equal map.

``kernel`` is for helpers that allocate nothing: without numba's run time they do not count references when an
array (or a tuple of twenty) is handed on, which measured 5 to 10 times faster for the map's small functions.

Three facts decide about the cache (measured, docs/tuning.md): numba keeps a caller's cache when only a callee in
another file has changed, and then computes wrong results, so the cache folder carries a hash of all our
sources; a cache inside a read-only installation is ignored or raises, so it lives in a state folder; code for
x86-64-v3 runs as fast as for the machine's own AVX-512 and can be moved between machines.
"""

from __future__ import annotations

import hashlib
import os
import platform
import tempfile
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path

import numba

_PORTABLE_CPU = {"x86_64": "x86-64-v3", "AMD64": "x86-64-v3"}
_PACKAGES = ("artemis_drivers", "artemis_edge")


@cache
def sources_hash() -> str:
    """Hash of every Python source of both packages and of where they are, for numba tells kernels apart by both."""
    digest = hashlib.sha256()
    for name in _PACKAGES:
        spec = find_spec(name)
        for root in (spec.submodule_search_locations or []) if spec is not None else []:
            digest.update(str(Path(root).resolve()).encode())
            for path in sorted(Path(root).rglob("*.py")):
                digest.update(path.relative_to(root).as_posix().encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_root() -> Path:
    if "ARTEMIS_CACHE_DIR" in os.environ:
        return Path(os.environ["ARTEMIS_CACHE_DIR"])
    base = os.environ.get("XDG_CACHE_HOME")
    if base is None:
        try:
            base = str(Path.home() / ".cache")
        except RuntimeError:  # a service user without a home
            base = tempfile.gettempdir()
    return Path(base) / "artemis-edge" / "numba"


def _usable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


def cache_dir() -> Path:
    """Folder of the compiled kernels of exactly these sources; a writable one, whatever the installation.

    ``NUMBA_CACHE_DIR`` wins when the administrator has set it, then ``ARTEMIS_CACHE_DIR``, then the user's cache
    folder, then the temporary folder.
    """
    if "NUMBA_CACHE_DIR" in os.environ:
        return Path(os.environ["NUMBA_CACHE_DIR"])
    folder = _cache_root() / sources_hash()
    if _usable(folder):
        return folder
    fallback = Path(tempfile.gettempdir()) / f"artemis-edge-numba-{os.getuid()}" / sources_hash()
    if not _usable(fallback):
        fallback = Path(tempfile.mkdtemp(prefix="artemis-edge-numba-"))
    return fallback


def _configure() -> None:
    """Set the environment, not numba.config alone: numba reads it anew as soon as it has changed."""
    os.environ["NUMBA_CACHE_DIR"] = str(cache_dir())
    target = _PORTABLE_CPU.get(platform.machine())
    if target and "NUMBA_CPU_NAME" not in os.environ and _cpu_has_avx2():
        os.environ["NUMBA_CPU_NAME"], os.environ["NUMBA_CPU_FEATURES"] = target, ""
    numba.config.reload_config()


def _cpu_has_avx2() -> bool:
    try:
        flags = Path("/proc/cpuinfo").read_text()
    except OSError:
        return False
    return " avx2" in flags and " fma" in flags and " bmi2" in flags


_configure()

njit = partial(numba.njit, cache=True, nogil=True, error_model="numpy")
kernel = partial(numba.njit, cache=True, nogil=True, error_model="numpy", _nrt=False)
