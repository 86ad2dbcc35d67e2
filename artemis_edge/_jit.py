"""How kernels are compiled: see the drivers' module, which the map shares, so that both use one cache."""

from __future__ import annotations

from artemis_drivers._jit import cache_dir, kernel, njit, sources_hash

__all__ = ["cache_dir", "kernel", "njit", "sources_hash"]
