"""How an image is laid into the input of a network, and where the cells of an output lie on the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from artemis_edge.frames import F32, U8
from artemis_edge.segmentation.backend import Grid

_FULL = 255.0


@dataclass(frozen=True, slots=True)
class Letterbox:
    """An image of ``content`` (width, height) pixels at (``left``, ``top``) of an input ``width`` x ``height``.

    ``image`` is (width, height) of the image before it was scaled.
    """

    image: tuple[int, int]
    content: tuple[int, int]
    left: int
    top: int
    width: int
    height: int

    @classmethod
    def fit(
        cls, image: tuple[int, int], size: tuple[int, int], fixed: bool, stride: int, centred: bool
    ) -> Letterbox:
        """An image of (height, width) into an input of at most ``size`` (height, width), all of it if ``fixed``."""
        scale = min(size[0] / image[0], size[1] / image[1])
        high, wide = (max(1, min(round(image[k] * scale), size[k])) for k in (0, 1))
        height, width = size if fixed else (-(-high // stride) * stride, -(-wide // stride) * stride)
        left, top = ((width - wide) // 2, (height - high) // 2) if centred else (0, 0)
        return cls((image[1], image[0]), (wide, high), left, top, width, height)

    def fill(self, image: U8, pad: int, mean: Sequence[float], std: Sequence[float]) -> F32:
        """The input, float32 (1, 3, height, width): (rgb / 255 - mean) / std; ``pad`` as a value of 0..255."""
        smaller = self.content[0] * 2 < self.image[0]
        scaled = cv2.resize(
            image, self.content, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        )
        canvas = np.full((self.height, self.width, 3), pad, np.uint8)
        canvas[self.top : self.top + self.content[1], self.left : self.left + self.content[0]] = scaled
        planes = np.ascontiguousarray(canvas.transpose(2, 0, 1)).astype(np.float32)
        for plane, centre, spread in zip(planes, mean, std, strict=True):
            plane *= 1.0 / (_FULL * spread)
            plane -= centre / spread
        return planes[None]

    def grid(self, width: int, height: int) -> Grid:
        """The grid of a map of ``width`` x ``height`` cells over the whole input."""
        across, down = width / self.width, height / self.height
        scale_x, scale_y = self.content[0] / self.image[0], self.content[1] / self.image[1]
        return Grid(
            scale_x * across,
            scale_y * down,
            (0.5 * scale_x + self.left) * across - 0.5,
            (0.5 * scale_y + self.top) * down - 0.5,
        )

    def cells(self, width: int, height: int) -> tuple[slice, slice]:
        """Rows and columns of a map of ``width`` x ``height`` cells that show the image, without the padding."""
        across, down = width / self.width, height / self.height
        top, left = int(self.top * down), int(self.left * across)
        bottom = -int(-(self.top + self.content[1]) * down // 1)
        right = -int(-(self.left + self.content[0]) * across // 1)
        return slice(top, bottom), slice(left, right)

    def to_image(self, boxes: F32) -> F32:
        """Boxes (n, 4) x0, y0, x1, y1 of the input in pixels of the image, clipped to it; edges, not centres."""
        origin = np.array([self.left, self.top] * 2, np.float32)
        scale = np.array([self.image[k] / self.content[k] for k in (0, 1)] * 2, np.float32)
        limit = np.array(self.image * 2, np.float32)
        return np.asarray(np.clip((boxes - origin) * scale, 0.0, limit), np.float32)
