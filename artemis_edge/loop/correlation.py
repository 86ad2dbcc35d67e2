"""Every place and heading of a map at once: facets of a piece of the way correlated with those of the map.

Both are drawn into grids, a layer for floors and one for every direction of walls, and for each heading the sums of
all shifts are one product of Fourier transforms (in the spirit of Olson's correlative matching, ICRA 2009, with all
shifts instead of a window). Attitude but for the heading must be known: z is up in both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import maximum_filter

from artemis_edge.frames import F32, F64, I64, Bool
from artemis_edge.loop.facets import Facets
from artemis_edge.odometry import se3

_LEAST_CELL_M = 1.0
_MOST_CELLS = 400_000  # of a padded grid: a layer takes 10 ms to transform
_DIRECTIONS = 6  # of walls, 30 degrees each
_BOTH = 1.0 / 3.0  # of a direction's width: a wall this near to the next counts there, too
_BESIDE = 0.5  # of a facet in the next cell
_FLOORS = 0.25  # weight of floors and ceilings, which are everywhere
_REACH_M = 20.0  # facets of a piece farther from its middle would need more headings
_REACH_UP_M = 6.0
_PEAKS = 6  # of a heading

Spectrum = NDArray[np.complex64]


class Guess(NamedTuple):
    """T_map_piece (4, 4), and the weighted share of the piece's facets that lie on such of the map, 0..1."""

    T_map_piece: F64
    share: float


class Correlator:
    """The map's side, transformed once; ``cell_m`` is how exact a guess is."""

    def __init__(self, known: Facets) -> None:
        low, high = known.centre.min(axis=0), known.centre.max(axis=0)
        around = 2.0 * np.array([_REACH_M, _REACH_M, _REACH_UP_M])
        self.cell_m = max(_LEAST_CELL_M, (float(np.prod(high - low + around)) / _MOST_CELLS) ** (1 / 3))
        self._origin = low
        padded = np.ceil((high - low + around) / self.cell_m).astype(np.int64) + 2
        self._shape = tuple(int(fft.next_fast_len(int(n), real=True)) for n in padded)
        cells = np.floor((known.centre - low) / self.cell_m).astype(np.int64)
        self._layers = [self._known_layer(cells[inside]) for inside in _layers_of(known.normal, _BOTH)]

    def guesses(self, piece: Facets, most: int) -> list[Guess]:
        """The best shifts and headings of a piece, the best first, no two alike."""
        if len(piece.centre) == 0:
            return []
        middle = np.median(piece.centre, axis=0)
        flat = np.linalg.norm((piece.centre - middle)[:, :2], axis=1) < _REACH_M
        low = np.abs(piece.centre - middle)[:, 2] < _REACH_UP_M
        near = Facets(piece.centre[flat & low] - middle, piece.normal[flat & low])
        headings = 2 * int(np.ceil(np.pi * _REACH_M / self.cell_m / 2))
        found: list[tuple[float, int, F64]] = []
        for k in range(headings):
            found += self._at_heading(near, 2 * np.pi * k / headings, k)
        found.sort(key=lambda item: -item[0])
        chosen: list[tuple[float, int, F64]] = []
        for item in found:
            if not any(_alike(item, other, headings, self.cell_m) for other in chosen):
                chosen.append(item)
            if len(chosen) == most:
                break
        return [Guess(_turned(2 * np.pi * k / headings, shift, middle), score) for score, k, shift in chosen]

    def _at_heading(self, piece: Facets, heading: float, number: int) -> list[tuple[float, int, F64]]:
        turned = piece.moved(_turned(heading, np.zeros(3), np.zeros(3)))
        if len(turned.centre) == 0:
            return []
        low = turned.centre.min(axis=0)
        cells = np.floor((turned.centre - low) / self.cell_m).astype(np.int64)
        weight = _weights(turned)
        total = np.zeros((*self._shape[:2], self._shape[2] // 2 + 1), np.complex64)
        for known, inside in zip(self._layers, _layers_of(turned.normal, 0.0), strict=True):
            if known is not None and inside.any():
                layer = np.zeros(self._shape, np.float32)
                np.add.at(layer, tuple(cells[inside].T), weight[inside])
                total += known * np.conj(fft.rfftn(layer))
        scores = fft.irfftn(total, self._shape)
        peaks = np.flatnonzero(scores.ravel() == maximum_filter(scores, 3, mode="wrap").ravel())
        best = peaks[np.argsort(-scores.ravel()[peaks], kind="stable")[:_PEAKS]]
        shift: I64 = np.stack(np.unravel_index(best, self._shape), axis=1)
        shift = np.where(shift > np.array(self._shape) - cells.max(axis=0) - 1, shift - self._shape, shift)
        places = self._origin + shift * self.cell_m - low
        return [(float(scores.ravel()[b]), number, place) for b, place in zip(best, places, strict=True)]

    def _known_layer(self, cells: I64) -> Spectrum | None:
        if len(cells) == 0:
            return None
        layer: F32 = np.zeros(self._shape, np.float32)
        layer[tuple(cells.T)] = 1.0
        layer = np.maximum(layer, np.float32(_BESIDE) * maximum_filter(layer, 3, mode="wrap"))
        return np.asarray(fft.rfftn(layer), np.complex64)


def _layers_of(normal: F64, both: float) -> list[Bool]:
    """Which facets (n,) are of each layer: floors, then directions of walls; others are of none."""
    level, upright = np.abs(normal[:, 2]) > 0.8, np.abs(normal[:, 2]) < 0.6
    turn = (np.arctan2(normal[:, 1], normal[:, 0]) % np.pi) * (_DIRECTIONS / np.pi)
    own = np.floor(turn).astype(np.int64) % _DIRECTIONS
    before, after = np.floor(turn - both).astype(np.int64), np.floor(turn + both).astype(np.int64)
    walls = [
        upright & ((own == k) | (before % _DIRECTIONS == k) | (after % _DIRECTIONS == k))
        for k in range(_DIRECTIONS)
    ]
    return [level, *walls]


def _weights(piece: Facets) -> F32:
    """Of each facet, 1 in all."""
    level = np.abs(piece.normal[:, 2]) > 0.8
    weight = np.where(level, _FLOORS / max(level.sum(), 1), (1 - _FLOORS) / max((~level).sum(), 1))
    return np.asarray(weight / weight.sum(), np.float32)


def _turned(heading: float, shift: F64, middle: F64) -> F64:
    """Turn about the upright axis through ``middle``, which then lies at ``shift``."""
    T: F64 = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, heading]))
    T[:3, 3] = shift - T[:3, :3] @ middle
    return T


def _alike(a: tuple[float, int, F64], b: tuple[float, int, F64], headings: int, cell_m: float) -> bool:
    apart = abs(a[1] - b[1])
    return min(apart, headings - apart) < 2 and float(np.linalg.norm(a[2] - b[2])) < 1.6 * cell_m
