"""One photograph through a backend, to see what it finds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import U8
from artemis_edge.segmentation.backend import MOST_SLOTS, Backend, Prompt, Segmentation
from artemis_edge.segmentation.words import canonical


def decode(encoded: bytes) -> U8 | None:
    """Pixels uint8 (h, w, 3) RGB of an encoded photograph; None where it is none."""
    # as the sensor took it: poses and calibration know nothing of a note that says it is to be turned
    how = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        pixels = cv2.imdecode(np.frombuffer(encoded, np.uint8), how) if encoded else None
    except cv2.error:
        return None
    return None if pixels is None else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8)


def look(backend: Backend, photograph: Path, words: Sequence[str]) -> Segmentation:
    """What the backend finds of ``words`` (none: its first classes); InputError where it is no photograph."""
    try:
        image = decode(photograph.read_bytes())
    except OSError as error:
        raise InputError(f"cannot read {photograph}: {error.strerror}") from None
    if image is None:
        raise InputError(f"{photograph} is not a photograph that can be read; give a JPEG or PNG file")
    asked = list(dict.fromkeys(canonical(word) for word in words or backend.classes))
    if len(asked) > MOST_SLOTS and words:
        raise InputError(f"{len(asked)} words at once; ask for at most {MOST_SLOTS}")
    return backend.segment(image, [Prompt(k + 1, word) for k, word in enumerate(asked[:MOST_SLOTS])])
