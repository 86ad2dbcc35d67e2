"""What the control frames of both Livox protocols have in common: first byte, longest length, several a datagram."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

START = 0xAA
MAX_FRAME = 1400

F = TypeVar("F")


def split(
    datagram: bytes, shortest: int, frame_at: Callable[[bytes, int], tuple[F, int] | None]
) -> tuple[list[F], int]:
    """All frames of a datagram (devices may pack several into one), and how many bytes were not understood.

    ``frame_at`` gives the frame that begins at a place and its length, or None; ``shortest``: bytes it needs.
    """
    frames = []
    at = skipped = 0
    while len(datagram) - at >= shortest:
        found = frame_at(datagram, at)
        if found is None:
            at += 1
            skipped += 1
        else:
            frames.append(found[0])
            at += found[1]
    return frames, skipped + len(datagram) - at


def require_short(length: int) -> None:
    """ValueError when a frame would be too long."""
    if length > MAX_FRAME:
        raise ValueError(f"a control frame has at most {MAX_FRAME} bytes, not {length}")
