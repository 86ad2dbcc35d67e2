"""Which vertices light up for the live questions: by label, and where only some of a class are meant by their boxes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from artemis_edge.frames import F32, U8, Bool
from artemis_edge.status import QueryStatus

_MARGIN_M = 0.1  # vertices of an object that stand out of its box by their noise


def lit(
    points: F32, label: U8, queries: Sequence[QueryStatus]
) -> Iterator[tuple[Bool, tuple[int, int, int]]]:
    """For each question that lights up something: which of the vertices (n,), and in which colour."""
    for query in queries:
        rows = np.isin(label, query.labels)
        if query.boxes and rows.any():
            at = np.flatnonzero(rows)
            inside = np.logical_or.reduce([_in_box(points[at], box) for box in query.boxes])
            rows[at] = inside
        if rows.any():
            yield rows, query.colour


def _in_box(points: F32, box: Sequence[float]) -> Bool:
    """Which points (n, 3) lie in an upright box: centre, size, yaw."""
    centre, half = np.array(box[:3]), 0.5 * np.array(box[3:6]) + _MARGIN_M
    along, across, up = (points - centre).T
    c, s = np.cos(box[6]), np.sin(box[6])
    inside: Bool = np.abs(c * along + s * across) <= half[0]
    inside &= (np.abs(c * across - s * along) <= half[1]) & (np.abs(up) <= half[2])
    return inside
