"""Compiled kernels: where their cache lives, and for which CPU they are compiled.

Three facts decide this file (measured, docs/tuning.md): numba keeps a caller's cache when only a callee in
another file has changed, and then computes wrong results, so the cache folder carries a hash of all our
sources; a cache inside a read-only installation is ignored or raises, so it lives in a state folder; code for
x86-64-v3 runs as fast as for the machine's own AVX-512 and can be moved between machines.
"""

from __future__ import annotations

import hashlib
import os
import platform
import tempfile
from functools import cache
from pathlib import Path

_PORTABLE_CPU = {"x86_64": "x86-64-v3", "AMD64": "x86-64-v3"}


@cache
def sources_hash() -> str:
    """Hash of every Python source of both packages and of where they are, for numba tells kernels apart by both."""
    import artemis_drivers

    digest = hashlib.sha256()
    for root in (Path(__file__).parent, Path(artemis_drivers.__file__).parent):
        digest.update(str(root.resolve()).encode())
        for path in sorted(root.rglob("*.py")):
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
    folder = cache_dir()
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    import numba

    numba.config.CACHE_DIR = str(folder)
    target = _PORTABLE_CPU.get(platform.machine())
    if target and "NUMBA_CPU_NAME" not in os.environ and _cpu_has_avx2():
        numba.config.CPU_NAME = target
        numba.config.CPU_FEATURES = ""


def _cpu_has_avx2() -> bool:
    try:
        flags = Path("/proc/cpuinfo").read_text()
    except OSError:
        return False
    return " avx2" in flags and " fma" in flags and " bmi2" in flags


_configure()

from artemis_drivers._jit import kernel, njit  # noqa: E402  (the cache must be set before numba looks for it)

__all__ = ["cache_dir", "kernel", "njit", "sources_hash"]
