"""Backend ``attribute``: no network. What a piece of the mesh could be is judged by its size and shape.

It finds nothing in images. The map's objects get their class scores from :func:`shape_scores`, and every answer is
APPROXIMATE: a box of the size of a car is called a car.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from functools import lru_cache
from importlib import resources

import numpy as np

from artemis_edge.frames import U8
from artemis_edge.segmentation import scores
from artemis_edge.segmentation.backend import Grid, Prompt, Segmentation, Status, Support
from artemis_edge.segmentation.layout import Box
from artemis_edge.segmentation.manifest import Manifest

NAME = "attribute"
# Beyond its usual range a size may be off by this factor before it counts against the class fully.
_TOLERANCE = 1.5


def manifest() -> Manifest:
    """As the registry lists it."""
    return Manifest(
        name=NAME,
        kind="attribute",
        file="none",
        sha256="0" * 64,
        licence="part of the program",
        classes=tuple(usual_sizes()),
        note="no network: colour, size and shape of pieces of the mesh; answers are approximate",
    )


@lru_cache(maxsize=1)
def usual_sizes() -> dict[str, dict[str, tuple[float, float]]]:
    """Height, length and width of each class that sizes.toml lists, least and most [m]."""
    text = (resources.files("artemis_edge.segmentation") / "sizes.toml").read_text("utf-8")
    return {
        name: {side: (float(low), float(high)) for side, (low, high) in sides.items()}
        for name, sides in tomllib.loads(text).items()
    }


def shape_scores(box: Box) -> dict[str, float]:
    """How well the size of a box fits each class that sizes.toml lists: 0..1, those of 0 left out."""
    fits = {
        name: min(_fit(box.measure(side), low, high) for side, (low, high) in sides.items())
        for name, sides in usual_sizes().items()
    }
    return {name: fit for name, fit in fits.items() if fit > 0.0}


def _fit(value: float, low: float, high: float) -> float:
    """1 within the range, falling to 0 at a factor of _TOLERANCE beyond it."""
    if value <= 0.0:
        return 0.0
    off = max(low / value, value / high, 1.0)
    return float(np.clip(1.0 - np.log(off) / np.log(_TOLERANCE), 0.0, 1.0))


class AttributeBackend:
    """Knows usual sizes of things, and nothing of images."""

    name = NAME

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes whose size is known."""
        return tuple(usual_sizes())

    def support(self, text: str) -> Support:
        """APPROXIMATE at best."""
        if text in usual_sizes():
            return Support(
                Status.APPROXIMATE, f"'{text}' is judged by size and shape only, without a network"
            )
        return Support(Status.UNSUPPORTED, f"without a network '{text}' is not known by its size")

    def segment(self, image: U8, prompts: Sequence[Prompt]) -> Segmentation:
        """Finds nothing: it has no eyes."""
        height, width = image.shape[:2]
        support = [self.support(prompt.text) for prompt in prompts]
        dense = scores.dense_scores((), (), (1, 1), Grid(1.0 / width, 1.0 / height, 0.0, 0.0))
        return Segmentation(width, height, scores.answers(prompts, support, ()), (), dense)
