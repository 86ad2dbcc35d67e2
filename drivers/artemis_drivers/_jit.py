"""The one place where the flags of compiled kernels are set (used by both packages).

``nogil`` lets the capture side run while a kernel works; ``error_model="numpy"`` makes division by zero
give inf as numpy does instead of a branch; no ``fastmath``, because equal input must give an equal map.

``kernel`` is for helpers that allocate nothing: without numba's run time they do not count references when an
array (or a tuple of twenty) is handed on, which measured 5 to 10 times faster for the map's small functions.
"""

from __future__ import annotations

from functools import partial

import numba

njit = partial(numba.njit, cache=True, nogil=True, error_model="numpy")
kernel = partial(numba.njit, cache=True, nogil=True, error_model="numpy", _nrt=False)
