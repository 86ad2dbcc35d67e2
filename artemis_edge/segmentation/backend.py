"""What a segmentation network is to the rest of the system: base classes and an image in, soft masks out.

A backend is asked for base classes only ("car"); attributes and relations ("red car") select among the objects
of the map afterwards (query.py). ``sigma_mask`` of eq. 1 at a pixel is the probability of the instance there
times the mask's own probability. It is never normalised over the regions of an image, so that what is absent
scores low everywhere and comes out as not found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from artemis_edge.frames import F32, U8

BACKGROUND = 0
MOST_SLOTS = 15
FULL_SCORE = 255  # of DenseScores: probability 1


class Status(StrEnum):
    """How far a question was answered."""

    MATCHED = "matched"
    APPROXIMATE = "approximate"  # answered, but by less than what was asked
    NOT_FOUND = "not_found"  # understood, and nothing seen
    UNSUPPORTED = "unsupported"  # this model cannot tell


@dataclass(frozen=True, slots=True)
class Prompt:
    """A base class that is looked for: its slot in the map, 1..15, and its name (singular, lower case)."""

    slot: int
    text: str


@dataclass(frozen=True, slots=True)
class Support:
    """What a backend can do with a base class; ``reason`` is a sentence where it is not MATCHED."""

    status: Status
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Grid:
    """Where the cells of a score map lie on the image: cell (x, y) = scale * (u, v) + offset.

    Integer coordinates are centres, of pixels and of cells.
    """

    scale_x: float
    scale_y: float
    offset_x: float
    offset_y: float

    def cropped(self, x: int, y: int) -> Grid:
        """The grid of a part of the map that begins at cell (x, y)."""
        return Grid(self.scale_x, self.scale_y, self.offset_x - x, self.offset_y - y)

    def at_pixels(self, cells: F32 | U8, width: int, height: int, repeat: bool = False) -> F32 | U8:
        """A map (h, w) seen at every pixel of an image, bilinear; beyond it 0, or its border where ``repeat``."""
        return self.at_cells(cells, Grid(1.0, 1.0, 0.0, 0.0), width, height, repeat)

    def at_cells(
        self, cells: F32 | U8, other: Grid, width: int, height: int, repeat: bool = False
    ) -> F32 | U8:
        """As ``at_pixels``, but at the ``width`` x ``height`` cells of another map of the same image."""
        across, down = self.scale_x / other.scale_x, self.scale_y / other.scale_y
        from_other = np.array(
            [
                [across, 0.0, self.offset_x - across * other.offset_x],
                [0.0, down, self.offset_y - down * other.offset_y],
            ]
        )
        return cv2.warpAffine(  # type: ignore[no-any-return]
            np.ascontiguousarray(cells),
            from_other,
            (width, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE if repeat else cv2.BORDER_CONSTANT,
        )


@dataclass(frozen=True, slots=True)
class Instance:
    """One object in one image.

    ``probability`` is p(base class | instance); ``mask`` float32 (h, w) 0..1 the mask's own probability on
    ``grid``, cut to the box (0 beyond); ``box`` x0, y0, x1, y1 are its edges on the image, where pixel k reaches
    from k to k + 1; ``label`` what the model itself calls it.
    """

    slot: int
    text: str
    label: str
    probability: float
    box: tuple[float, float, float, float]
    mask: F32
    grid: Grid
    status: Status = Status.MATCHED

    def image_mask(self, width: int, height: int) -> F32:
        """The mask at every pixel of the image: float32 (height, width) 0..1."""
        return np.asarray(self.grid.at_pixels(self.mask, width, height), np.float32)


@dataclass(frozen=True, slots=True)
class DenseScores:
    """sigma_mask of every slot at every cell, for fusion: uint8 (h, w, layers), 255 is probability 1.

    ``slots`` names the slot of each layer. Layer 0 is BACKGROUND: the probability that the cell shows none of
    the classes asked for. A slot without a layer was not asked for, which says nothing of it.
    """

    slots: tuple[int, ...]
    score: U8
    grid: Grid

    def layer(self, slot: int, width: int, height: int) -> U8:
        """Scores of one slot at every pixel of an image: uint8 (height, width), 255 is probability 1."""
        cells = self.score[:, :, self.slots.index(slot)]
        return np.asarray(self.grid.at_pixels(cells, width, height, repeat=True), np.uint8)

    def sample(self, u: NDArray[np.floating], v: NDArray[np.floating]) -> F32:
        """Scores 0..1 at pixels (u, v), each (n,): float32 (n, layers), bilinear, clamped to the map."""
        height, width, _ = self.score.shape
        x = np.clip(u * self.grid.scale_x + self.grid.offset_x, 0, width - 1)
        y = np.clip(v * self.grid.scale_y + self.grid.offset_y, 0, height - 1)
        x0, y0 = np.minimum(x.astype(np.int64), width - 2), np.minimum(y.astype(np.int64), height - 2)
        x0, y0 = np.maximum(x0, 0), np.maximum(y0, 0)
        x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
        fx, fy = (x - x0)[:, None], (y - y0)[:, None]
        cells = self.score.astype(np.float32)
        upper = cells[y0, x0] * (1 - fx) + cells[y0, x1] * fx
        lower = cells[y1, x0] * (1 - fx) + cells[y1, x1] * fx
        return np.asarray((upper * (1 - fy) + lower * fy) / FULL_SCORE, np.float32)


@dataclass(frozen=True, slots=True)
class Answer:
    """What one image said about one prompt; ``score`` is the best sigma_mask, 0 where nothing was found."""

    prompt: Prompt
    status: Status
    score: float = 0.0
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Segmentation:
    """What a backend sees in an image of ``width`` x ``height`` pixels; ``answers`` in the order of prompts."""

    width: int
    height: int
    answers: tuple[Answer, ...]
    instances: tuple[Instance, ...]
    dense: DenseScores


class Backend(Protocol):
    """A segmentation network at work. Not thread-safe: one thread uses it at a time."""

    @property
    def name(self) -> str:
        """Name of the model in the registry."""
        ...

    @property
    def classes(self) -> tuple[str, ...]:
        """Base classes it knows, in the model's words; empty where it takes any text."""
        ...

    def support(self, text: str) -> Support:
        """Whether it can look for a base class."""
        ...

    def segment(self, image: U8, prompts: Sequence[Prompt]) -> Segmentation:
        """Look for the prompts in an image uint8 (h, w, 3) RGB; those without support find nothing."""
        ...
