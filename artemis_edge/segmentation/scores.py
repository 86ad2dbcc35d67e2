"""From instances to sigma_mask of every slot at every cell, as the fusion wants it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from artemis_edge.frames import F32
from artemis_edge.segmentation.backend import (
    BACKGROUND,
    FULL_SCORE,
    Answer,
    DenseScores,
    Grid,
    Instance,
    Prompt,
    Status,
    Support,
)


def dense_scores(
    instances: Sequence[Instance], prompts: Sequence[Prompt], size: tuple[int, int], grid: Grid
) -> DenseScores:
    """Per slot the best of its instances at each of ``size`` (h, w) cells; instances are cut from ``grid``.

    Background is what no instance claims: 1 less the best score of any slot.
    """
    slots = (BACKGROUND, *dict.fromkeys(prompt.slot for prompt in prompts))
    layer = {slot: k for k, slot in enumerate(slots)}
    score = np.zeros((*size, len(slots)), np.float32)
    for found in instances:
        rows, columns = place(found.grid, grid, found.mask.shape)
        into = score[rows, columns, layer[found.slot]]
        np.maximum(into, found.probability * found.mask, out=into)
    score[:, :, 0] = 1.0 - score[:, :, 1:].max(axis=2, initial=0.0)
    return DenseScores(slots, quantised(score), grid)


def place(part: Grid, whole: Grid, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of ``whole`` that a map of ``shape`` on a grid cropped from it covers."""
    x, y = round(whole.offset_x - part.offset_x), round(whole.offset_y - part.offset_y)
    return slice(y, y + shape[0]), slice(x, x + shape[1])


def quantised(score: F32) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """Probabilities as uint8, 255 is 1."""
    return np.asarray(np.clip(score * FULL_SCORE + 0.5, 0, FULL_SCORE), np.uint8)


def answers(
    prompts: Sequence[Prompt], support: Sequence[Support], instances: Sequence[Instance]
) -> tuple[Answer, ...]:
    """What an image says about each prompt, from the instances found."""
    out = []
    for prompt, able in zip(prompts, support, strict=True):
        if able.status is Status.UNSUPPORTED:
            out.append(Answer(prompt, Status.UNSUPPORTED, 0.0, able.reason))
            continue
        best = max((found.probability for found in instances if found.slot == prompt.slot), default=0.0)
        out.append(Answer(prompt, able.status if best else Status.NOT_FOUND, best, able.reason))
    return tuple(out)
