"""How good the shipped network is on views that it has not seen: IoU by class, and what it sees that is not there.

    python training/score.py --views VIEWS [--model artemis_edge/segmentation/shipped/virtual-worlds.json]

Runs the ONNX file as the program does. ``false`` is over views without any of the class: the share of their pixels
that were taken for it, and the share of views with a patch of it that would count as seen (``_PATCH`` of the
pixels in one piece, mean probability at least ``_SURE``).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from labels import IGNORED
from numpy.typing import NDArray
from samples import Views, whole

from artemis_edge.segmentation.manifest import read_manifest
from artemis_edge.segmentation.network import Network
from artemis_edge.segmentation.semantic import probabilities

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
_PATCH = 0.002
_SURE = 0.5
SIX = ("car", "person", "bench", "tree", "building", "ground")
_SHIPPED = Path("artemis_edge/segmentation/shipped/virtual-worlds.json")


@dataclass(slots=True)
class Score:
    """Counts over views of ``classes`` classes."""

    classes: int
    confusion: I64 = field(init=False)
    absent: I64 = field(init=False)  # views without the class
    false_pixels: I64 = field(init=False)  # of those
    false_views: I64 = field(init=False)
    pixels: int = 0

    def __post_init__(self) -> None:
        self.confusion = np.zeros((self.classes, self.classes), np.int64)
        self.absent, self.false_pixels, self.false_views = (
            np.zeros(self.classes, np.int64) for _ in range(3)
        )

    def add(self, probability: F32, label: NDArray[np.uint8]) -> None:
        """One view: probabilities (classes, h, w) and labels (h, w)."""
        found = probability.argmax(axis=0)
        known = label != IGNORED
        pairs = label[known].astype(np.int64) * self.classes + found[known]
        self.confusion += np.bincount(pairs, minlength=self.classes**2).reshape(self.confusion.shape)
        self.pixels = label.size
        for k in range(1, self.classes):
            if np.any(label == k):
                continue
            won = found == k
            self.absent[k] += 1
            self.false_pixels[k] += int(won.sum())
            self.false_views[k] += _has_patch(won, probability[k])

    def iou(self) -> NDArray[np.float64]:
        """Per class; NaN where there is none."""
        hit = np.diag(self.confusion)
        union = self.confusion.sum(axis=0) + self.confusion.sum(axis=1) - hit
        there = self.confusion.sum(axis=1) > 0
        return np.where(there, hit / np.maximum(union, 1), np.nan)


def _has_patch(won: NDArray[np.bool_], probability: F32) -> bool:
    count, patch, stats, _ = cv2.connectedComponentsWithStats(won.astype(np.uint8))
    return any(
        stats[k, cv2.CC_STAT_AREA] >= _PATCH * won.size and probability[patch == k].mean() >= _SURE
        for k in range(1, count)
    )


def scored(network: Network, views: Views, classes: int) -> tuple[Score, float]:
    """The score, and the CPU seconds that an image takes."""
    score, times = Score(classes), []
    for photo, label in zip(views.photos, views.labels, strict=True):
        began = time.process_time()
        (logits,) = network.run(whole(photo)).values()
        times.append(time.process_time() - began)
        height, width = label.shape
        larger = cv2.resize(probabilities(logits[0]).transpose(1, 2, 0), (width, height))
        score.add(larger.transpose(2, 0, 1), label)
    return score, float(np.median(times))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print tables in Markdown."""
    parser = argparse.ArgumentParser(prog="python training/score.py")
    parser.add_argument("--views", type=Path, required=True)
    parser.add_argument("--model", type=Path, default=_SHIPPED)
    given = parser.parse_args(arguments)
    manifest = read_manifest(given.model)
    network, names = Network(given.model.parent / manifest.file), manifest.classes
    worlds = sorted({path.name.split("-")[0] for path in given.views.glob("*.npz")})
    total, by_world = Score(len(names)), {}
    for world in worlds:
        views = Views(list(given.views.glob(f"{world}-*.npz")))
        by_world[world], seconds = scored(network, views, len(names))
        total.confusion += by_world[world].confusion
        total.absent += by_world[world].absent
        total.false_pixels += by_world[world].false_pixels
        total.false_views += by_world[world].false_views
        total.pixels = by_world[world].pixels
    print(f"{seconds * 1e3:.0f} ms of CPU time an image\n")
    print(f"| class | IoU | {' | '.join(worlds)} | false pixels | false patches |")
    print("|---" * (len(worlds) + 4) + "|")
    each = {world: score.iou() for world, score in by_world.items()}
    for k, name in enumerate(names):
        cells = [_cell(total.iou()[k]), *(_cell(each[world][k]) for world in worlds)]
        pixels = total.false_pixels[k] / max(total.absent[k] * total.pixels, 1)
        patches = f"{total.false_views[k]} of {total.absent[k]}" if k else ""
        print(f"| {name} | {' | '.join(cells)} | {f'{pixels:.3%}' if k else ''} | {patches} |")
    six = [total.iou()[names.index(name)] for name in SIX]
    print(f"| **{', '.join(SIX)}** | **{np.nanmean(six):.3f}** |")
    return 0


def _cell(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.3f}"


if __name__ == "__main__":
    sys.exit(main())
