"""Crops of the rendered views for learning: turned, scaled, mirrored, in other light, blurred, noisy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from labels import IGNORED, NETWORK_CLASSES, to_network
from numpy.typing import NDArray

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
Rng = np.random.Generator

INPUT = (640, 512)  # width, height that whole views are scaled to for the network
FINE_INPUT = (960, 768)  # where nobody waits for a frame, besides
CROP = (288, 224)
_SCALE = (0.75, 1.2)  # of the views, whose crops these are
_SOUGHT_SCALE = (0.75, 1.25)  # of crops that look for a class
_ASIDE = 60  # pixels of the view that such a crop's middle is beside a pixel of the class at most
#: How often crops look for a class, relative to each other (0.5 where not named).
_SOUGHT = {
    "person": 6.0,
    "bench": 6.0,
    "backpack": 4.0,
    "car": 3.0,
    "tree": 3.0,
    "hedge": 1.0,
    "bicycle": 1.0,
}
_LEAST_PIXELS = 40  # of a class in a view that is chosen for it
_TURN_DEG = 5.0


class Views:
    """All views of the given files, in the order of their names; uint8 photographs and the network's labels."""

    def __init__(self, files: Sequence[Path]) -> None:
        table = to_network()
        self.photos: list[U8] = []
        self.labels: list[U8] = []
        for path in sorted(files):
            with np.load(path) as views:
                self.photos.extend(views["photo"])
                self.labels.extend(table[views["label"]])
        counts = [np.bincount(label.reshape(-1), minlength=256) for label in self.labels]
        self.with_class = [
            np.flatnonzero([c[k] >= _LEAST_PIXELS for c in counts]) for k in range(len(NETWORK_CLASSES))
        ]

    def __len__(self) -> int:
        return len(self.photos)

    def shares(self, classes: int) -> NDArray[np.float64]:
        """Share of all pixels that each class has."""
        counts = sum(np.bincount(label.reshape(-1), minlength=256)[:classes] for label in self.labels)
        return np.asarray(counts / np.sum(counts), np.float64)


def whole(photo: U8) -> F32:
    """A whole view as the network's input, float32 (1, 3, h, w), 0..1."""
    smaller = cv2.resize(photo, INPUT, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(smaller.astype(np.float32).transpose(2, 0, 1)[None] / 255)


def batch(views: Views, rng: Rng, chosen: Sequence[int], sought: float) -> tuple[F32, U8]:
    """Pictures float32 (n, 3, h, w), 0..1, and labels uint8 (n, h, w) of crops of the chosen views.

    A share ``sought`` of them are crops of other views, with a class in the middle that is drawn by ``_SOUGHT``.
    """
    crops = [
        _looking(views, rng) if rng.random() < sought else _anywhere(views, rng, view) for view in chosen
    ]
    pictures = np.stack([_in_other_light(photo, rng).transpose(2, 0, 1) for photo, _ in crops])
    return np.ascontiguousarray(pictures), np.stack([label for _, label in crops])


def _anywhere(views: Views, rng: Rng, view: int) -> tuple[U8, U8]:
    """A crop from within a view, where it is not larger."""
    size = np.array(views.labels[view].shape[::-1])
    scale = float(np.exp(rng.uniform(*np.log(_SCALE))))
    room = np.maximum(size / 2 - np.array(CROP) / (2 * scale), 0.0)
    middle = size / 2 + rng.uniform(-1, 1, 2) * room
    return _crop(views.photos[view], views.labels[view], rng, scale, middle)


def _looking(views: Views, rng: Rng) -> tuple[U8, U8]:
    """A crop around a pixel of a class."""
    there = [k for k, found in enumerate(views.with_class) if len(found)]
    weight = np.array([_SOUGHT.get(NETWORK_CLASSES[k], 0.5) for k in there])
    wanted = there[int(rng.choice(len(there), p=weight / weight.sum()))]
    view = int(rng.choice(views.with_class[wanted]))
    row, column = np.divmod(
        rng.choice(np.flatnonzero(views.labels[view] == wanted)), views.labels[view].shape[1]
    )
    scale = float(np.exp(rng.uniform(*np.log(_SOUGHT_SCALE))))
    size = np.array(views.labels[view].shape[::-1])
    half = np.minimum(np.array(CROP) / (2 * scale), size / 2)
    middle = np.clip(np.array([column, row]) + rng.uniform(-_ASIDE, _ASIDE, 2), half, size - half)
    return _crop(views.photos[view], views.labels[view], rng, scale, middle)


def _crop(photo: U8, label: U8, rng: Rng, scale: float, middle: NDArray[np.float64]) -> tuple[U8, U8]:
    """CROP pixels of a view scaled by ``scale`` around ``middle`` (x, y in pixels of the view).

    Beyond the view it is black and IGNORED, as where photographs of other proportions are padded.
    """
    turn = float(np.radians(rng.uniform(-_TURN_DEG, _TURN_DEG)))
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) / scale
    if rng.random() < 0.5:
        R[:, 0] *= -1
    # of pixels: the middle of the first is at (0, 0)
    shift = middle - 0.5 - R @ (np.array(CROP) / 2 - 0.5)
    view_from_crop = np.column_stack([R, shift])
    flags = cv2.WARP_INVERSE_MAP
    picture = cv2.warpAffine(
        photo, view_from_crop, CROP, flags=flags | cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
    )
    named = cv2.warpAffine(
        label,
        view_from_crop,
        CROP,
        flags=flags | cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(IGNORED,),
    )
    return np.asarray(picture, np.uint8), np.asarray(named, np.uint8)


def _in_other_light(photo: U8, rng: Rng) -> F32:
    """Other exposure, contrast and white balance; at times blur; noise."""
    gain = np.exp(rng.normal(0.0, 0.12)) * np.exp(rng.normal(0.0, 0.04, 3))
    gamma = float(np.exp(rng.normal(0.0, 0.06)))
    level = np.arange(256)[None, :, None] / 255
    picture = cv2.LUT(photo, (np.clip(level * gain, 0.0, 1.0) ** gamma).astype(np.float32))
    if rng.random() < 0.1:
        picture = cv2.GaussianBlur(picture, (0, 0), float(rng.uniform(0.3, 1.0)))
    noise = np.empty(picture.shape, np.float32)
    cv2.setRNGSeed(int(rng.integers(2**31)))
    cv2.randn(noise, 0.0, float(rng.uniform(0.0, 0.01)))
    return np.asarray(np.clip(picture + noise, 0.0, 1.0), np.float32)
