"""Backend ``semantic``: one logit a class at every pixel; instances are what hangs together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import F32, F64, U8
from artemis_edge.segmentation import scores
from artemis_edge.segmentation.backend import (
    BACKGROUND,
    DenseScores,
    Grid,
    Instance,
    Prompt,
    Segmentation,
    Status,
    Support,
)
from artemis_edge.segmentation.letterbox import Letterbox
from artemis_edge.segmentation.manifest import Manifest
from artemis_edge.segmentation.network import Array, Network
from artemis_edge.segmentation.words import canonical
from artemis_edge.segmentation.yolo_seg import Thresholds, closed_support, input_sizes

_LEAST_CELLS = 4  # smaller patches are noise of single cells
_PAD = 0
# Exponent of a class' share that each image's probabilities are divided by (docs/semantics.md)
_TAKEN_OUT = 0.25
# Share of a class that calibration hardly saw
_RAREST = 1e-3


def probabilities(logits: Array) -> F32:
    """Softmax over the classes of every cell: (C, h, w) logits to float32 probabilities."""
    weight = logits.astype(np.float32)
    weight -= weight.max(axis=0)
    np.exp(weight, out=weight)
    weight /= weight.sum(axis=0)
    return weight


def without_frequency(probability: F32, rows: Sequence[int], shares: F64) -> F32:
    """Scores (1 + r, h, w) of background and the classes ``rows`` from ``probability`` (C, h, w) of all, less what
    each class owes to its frequency ``shares`` (C,); background, all other classes, has that of all of them together.

    Calibrated probabilities hold how frequent a class is. A map that adds up what many images say would count that
    once an image, and what is rare and small would be lost to what is behind it.
    """
    shares = np.maximum(shares, _RAREST)
    factor = shares**-_TAKEN_OUT
    rest = np.ones(len(shares), bool)
    rest[rows] = False
    if rest.any():
        # what is rare in the background is as little lost to what is frequent there
        together = shares[rest].sum()
        factor[rest] *= together ** (1.0 - _TAKEN_OUT) / (shares[rest] * factor[rest]).sum()
    weight = factor.astype(np.float32)
    # with zeros instead of a choice of the rest, which would copy most of what is there
    nothing = np.tensordot(np.where(rest, weight, np.float32(0.0)), probability, 1)
    score: F32 = np.stack([nothing, *(weight[row] * probability[row] for row in rows)])
    score /= score.sum(axis=0)
    return score


@dataclass(frozen=True, slots=True)
class _View:
    """The part of the output that shows the image: ``probability`` (C, h, w), where it lies, and which class wins."""

    probability: F32
    grid: Grid
    box: Letterbox


class Semantic:
    """Labels every pixel. The classes exclude each other, so a softmax over them at a pixel is right."""

    def __init__(self, network: Network, manifest: Manifest, thresholds: Thresholds) -> None:
        self.name = manifest.name
        self.classes = manifest.classes
        self._network = network
        self._manifest = manifest
        self._thresholds = thresholds
        self._shares = np.array(manifest.shares)
        if len(self._shares) not in (0, len(self.classes)):
            raise InputError(f"the manifest of {self.name} names another number of shares than of classes")
        self._row = {canonical(label): k for k, label in reversed(list(enumerate(manifest.classes)))}
        self._row.pop("background", None)

    def support(self, text: str) -> Support:
        """Whether it is one of the classes."""
        return closed_support(self.name, self._row, text)

    def segment(self, image: U8, prompts: Sequence[Prompt]) -> Segmentation:
        """Label the image by the network; see :class:`Backend`."""
        view = self._look(image)
        box = view.box
        support = [self.support(prompt.text) for prompt in prompts]
        known = [p for p, s in zip(prompts, support, strict=True) if s.status is not Status.UNSUPPORTED]
        found = self._instances(view, known)
        return Segmentation(
            box.image[0],
            box.image[1],
            scores.answers(prompts, support, found),
            tuple(found),
            self._dense(view, known),
        )

    def _look(self, image: U8) -> _View:
        """The image at all sizes that it is read at: the mean of their probabilities, on the cells of the finest."""
        sizes, fixed = input_sizes(self._network, self._manifest, image.shape)
        *coarser, view = (self._read(image, size, fixed) for size in sizes)
        for other in coarser:
            for mine, theirs in zip(view.probability, other.probability, strict=True):
                mine += other.grid.at_cells(theirs, view.grid, mine.shape[1], mine.shape[0], repeat=True)
        if coarser:
            view.probability[:] /= len(sizes)
        return view

    def _read(self, image: U8, size: tuple[int, int], fixed: bool) -> _View:
        box = Letterbox.fit(image.shape[:2], size, fixed, self._manifest.stride, centred=False)
        filled = box.fill(image, _PAD, self._manifest.mean, self._manifest.std)
        (logits,) = self._network.run(filled).values()
        if logits.shape[1] != len(self.classes):
            raise InputError(
                f"the model {self.name} gives {logits.shape[1]} classes, {len(self.classes)} are named; "
                "register it again with the names that it was trained with"
            )
        rows, columns = box.cells(logits.shape[3], logits.shape[2])
        grid = box.grid(logits.shape[3], logits.shape[2]).cropped(columns.start, rows.start)
        return _View(probabilities(logits[0, :, rows, columns]), grid, box)

    def _dense(self, view: _View, prompts: Sequence[Prompt]) -> DenseScores:
        """A layer a prompt; what is left of probability 1 is background."""
        rows = list(dict.fromkeys(self._row[prompt.text] for prompt in prompts))
        if len(self._shares):
            score = without_frequency(view.probability, rows, self._shares)
        else:
            nothing = 1.0 - view.probability[rows].sum(axis=0)
            score = np.stack([nothing, *view.probability[rows]])
        layers = [0, *(1 + rows.index(self._row[prompt.text]) for prompt in prompts)]
        slots = (BACKGROUND, *(prompt.slot for prompt in prompts))
        planes = [scores.quantised(plane) for plane in score]
        return DenseScores(slots, np.stack([planes[k] for k in layers], axis=2), view.grid)

    def _instances(self, view: _View, prompts: Sequence[Prompt]) -> list[Instance]:
        highest = view.probability.max(axis=0)
        out: list[Instance] = []
        for prompt in prompts:
            row = self._row[prompt.text]
            won = (view.probability[row] >= highest).astype(np.uint8)
            _, label, stats, _ = cv2.connectedComponentsWithStats(won, connectivity=8)
            big = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= _LEAST_CELLS)
            for part in big[big > 0]:
                left, top, wide, high, _ = (int(v) for v in stats[part])
                cut = slice(top, top + high), slice(left, left + wide)
                out.append(
                    self._instance(view, prompt, label[cut] == part, view.probability[row][cut], (left, top))
                )
        likely = [found for found in out if found.probability >= self._thresholds.score]
        likely.sort(key=lambda found: -found.probability)
        return likely[: self._thresholds.most]

    def _instance(
        self, view: _View, prompt: Prompt, inside: np.ndarray, probability: F32, start: tuple[int, int]
    ) -> Instance:
        """One connected part. Its probability is the mean; the mask makes p times mask the network's own, up to 1."""
        mean = float(probability[inside].mean())
        mask = np.where(inside, np.minimum(probability / mean, 1.0), 0.0).astype(np.float32)
        grid = view.grid.cropped(*start)
        high, wide = inside.shape
        corner = np.array([[-0.5, -0.5], [wide - 0.5, high - 0.5]])
        pixel = (corner - [grid.offset_x, grid.offset_y]) / [grid.scale_x, grid.scale_y] + 0.5
        (x0, y0), (x1, y1) = np.clip(pixel, 0, view.box.image).tolist()
        return Instance(
            prompt.slot, prompt.text, self.classes[self._row[prompt.text]], mean, (x0, y0, x1, y1), mask, grid
        )
