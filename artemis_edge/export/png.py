"""Pictures as PNG."""

from __future__ import annotations

import cv2
import numpy as np

from artemis_edge.frames import U8


def png_bytes(image: U8) -> bytes:
    """RGB or RGBA uint8 (h, w, 3 or 4) as the bytes of a PNG."""
    order = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    return bytes(cv2.imencode(".png", cv2.cvtColor(np.ascontiguousarray(image), order))[1])
