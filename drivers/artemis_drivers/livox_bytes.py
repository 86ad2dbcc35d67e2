"""Little-endian numbers at a place of a packet, for compiled decoders.

int() of a byte would be unsigned in compiled code, and unsigned with signed becomes a float there: hence
np.int64 everywhere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from artemis_drivers._jit import kernel


@kernel
def u16_at(b: NDArray[np.uint8], at: int) -> np.int64:
    """Unsigned, 2 bytes."""
    value: np.int64 = np.int64(b[at]) | np.int64(b[at + 1]) << 8
    return value


@kernel
def u32_at(b: NDArray[np.uint8], at: int) -> np.int64:
    """Unsigned, 4 bytes."""
    value: np.int64 = u16_at(b, at) | u16_at(b, at + 2) << 16
    return value


@kernel
def i64_at(b: NDArray[np.uint8], at: int) -> np.int64:
    """Signed, 8 bytes."""
    value: np.int64 = u32_at(b, at) | u32_at(b, at + 4) << 32
    return value


@kernel
def i16_at(b: NDArray[np.uint8], at: int) -> np.int64:
    """Signed, 2 bytes."""
    return np.int64(np.int16(u16_at(b, at)))


@kernel
def i32_at(b: NDArray[np.uint8], at: int) -> np.int64:
    """Signed, 4 bytes."""
    return np.int64(np.int32(u32_at(b, at)))


@kernel
def f32_at(b: NDArray[np.uint8], at: int) -> np.float32:
    """Float, 4 bytes, at any place (a view of the array would have to be aligned on some CPUs)."""
    value: np.float32 = np.uint32(u32_at(b, at)).view(np.float32)
    return value
