"""Photographs of a recording made ready: grey, without lens distortion, in halves of their size."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from artemis_edge.frames import F64, U8, CameraImage, CameraModel


@dataclass(frozen=True, slots=True)
class Photograph:
    """``levels`` grey images uint8, each half the last; ``K`` fx, fy, cx, cy of the first; recorded stamp.

    ``frame`` is the index of the frame it came with.
    """

    name: str
    stamp_ns: int
    frame: int
    K: F64
    levels: tuple[U8, ...]

    def at(self, level: int) -> tuple[U8, F64]:
        """Image and fx, fy, cx, cy of a level: pixel centres stay where they are in the scene."""
        scale = 0.5**level
        fx, fy, cx, cy = self.K
        centred = np.array([fx * scale, fy * scale, (cx + 0.5) * scale - 0.5, (cy + 0.5) * scale - 0.5])
        return self.levels[level], centred


class Developer:
    """Decodes photographs of one camera."""

    def __init__(self, model: CameraModel, levels: int) -> None:
        self._levels = levels
        self.K: F64 = np.array([model.fx, model.fy, model.cx, model.cy])
        K = np.array([[model.fx, 0, model.cx], [0, model.fy, model.cy], [0, 0, 1]])
        self._maps = cv2.initUndistortRectifyMap(
            K, np.array(model.distortion), None, K, (model.width, model.height), cv2.CV_16SC2
        )

    def develop(self, image: CameraImage, frame: int) -> Photograph | None:
        """The photograph, None if it cannot be decoded."""
        grey = cv2.imdecode(np.frombuffer(image.encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
        if grey is None:
            return None
        levels = [cv2.remap(grey, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)]
        for _ in range(self._levels - 1):
            levels.append(cv2.pyrDown(levels[-1]))
        return Photograph(
            image.name, image.stamp_ns, frame, self.K, tuple(np.asarray(g, np.uint8) for g in levels)
        )
