"""What the service tells the segmentation process when it starts it."""

from __future__ import annotations

from msgspec import Struct

from artemis_edge.session.asked import Asked


class SegmenterTask(Struct, frozen=True):
    """Topics of the photographs, the questions, thresholds of the network, where the growing mesh is told."""

    cameras: tuple[str, ...]
    asked: Asked
    least_score: float
    overlap: float
    most_hz: float = 0.0
    viewers: str = ""


def slower(one: float, other: float) -> float:
    """Of two rates, of which 0 is without bound."""
    return min((hz for hz in (one, other) if hz > 0.0), default=0.0)
