"""What pictures of a map share: colour scales, text, colour bars, scale bars, lines."""

from __future__ import annotations

import cv2
import numpy as np

from artemis_edge.export.mesh import finite_rows
from artemis_edge.frames import F32, F64, U8

Colour = tuple[int, int, int]

PAPER: Colour = (255, 255, 255)
INK: Colour = (38, 42, 48)
PATH: Colour = (226, 62, 87)
# Label colours: 0, the background, is quiet; the others differ in hue and in lightness.
LABEL_COLOURS = np.array(
    [
        [196, 199, 204], [228, 87, 46], [23, 118, 182], [46, 158, 91], [154, 82, 199], [240, 183, 28],
        [0, 172, 193], [209, 73, 140], [124, 110, 74], [110, 180, 60], [85, 98, 209], [176, 48, 48],
        [122, 198, 255], [255, 153, 112], [20, 96, 84], [140, 140, 40],
    ],
    np.uint8,
)  # fmt: skip
# Dark blue-green to pale yellow, lightness rising evenly, so that it reads in grey too.
_SCALE = np.array(
    [
        [33, 20, 69],
        [49, 59, 124],
        [42, 102, 138],
        [34, 143, 134],
        [92, 183, 108],
        [180, 211, 88],
        [246, 232, 140],
    ],
    np.float64,
)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_TEXT_PX = 22.0  # height of the font at scale 1


def scale_colours(values: F32 | F64) -> U8:
    """Colours uint8 (..., 3) for values 0 (dark) to 1 (light)."""
    position = np.clip(np.nan_to_num(values), 0.0, 1.0) * (len(_SCALE) - 1)
    low = np.minimum(position.astype(np.int64), len(_SCALE) - 2)
    share = (position - low)[..., None]
    mixed: U8 = np.rint(_SCALE[low] * (1.0 - share) + _SCALE[low + 1] * share).astype(np.uint8)
    return mixed


def text(image: U8, words: str, corner: tuple[int, int], size_px: float = 14.0, colour: Colour = INK) -> None:
    """Write ``words`` with their lower left ``corner`` (u, v)."""
    plain = words.encode("ascii", errors="replace").decode()  # the font has no other characters
    cv2.putText(image, plain, corner, _FONT, size_px / _TEXT_PX, colour, 1, cv2.LINE_AA)


def text_width(words: str, size_px: float = 14.0) -> int:
    """Width in pixels of what :func:`text` writes."""
    return int(cv2.getTextSize(words, _FONT, size_px / _TEXT_PX, 1)[0][0])


def polyline(image: U8, pixels: F64, colour: Colour = PATH, width: int = 2) -> None:
    """Draw a line through pixels float64 (n, 2) on a pale casing; rows with NaN interrupt it."""
    finite = finite_rows(pixels)
    for run in np.split(np.arange(len(pixels)), np.flatnonzero(np.diff(finite.astype(np.int8))) + 1):
        if len(run) > 1 and finite[run[0]]:
            corners = np.rint(pixels[run] * 16).clip(-(1 << 20), 1 << 20).astype(np.int32)
            cv2.polylines(image, [corners], False, (255, 255, 255), width + 2, cv2.LINE_AA, 4)
            cv2.polylines(image, [corners], False, colour, width, cv2.LINE_AA, 4)


def dot(image: U8, pixel: F64, colour: Colour = PATH, radius: int = 5) -> None:
    """A filled dot with a pale rim; nothing for a pixel with NaN."""
    if np.isfinite(pixel).all() and np.abs(pixel).max() < 1 << 15:
        centre = (round(float(pixel[0])), round(float(pixel[1])))
        cv2.circle(image, centre, radius + 1, (255, 255, 255), -1, cv2.LINE_AA)
        cv2.circle(image, centre, radius, colour, -1, cv2.LINE_AA)


def scale_bar(image: U8, metres_per_pixel: float) -> None:
    """A bar of a round length in the lower left corner."""
    length = round_length(0.2 * image.shape[1] * metres_per_pixel)
    width = round(length / metres_per_pixel)
    left, bottom = 16, image.shape[0] - 16
    words = f"{length:g} m"
    panel(image, (left - 8, bottom - 26), (left + max(width, text_width(words)) + 8, bottom + 8))
    cv2.rectangle(image, (left, bottom - 4), (left + width, bottom), INK, -1)
    text(image, words, (left, bottom - 9))


def round_length(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not longer than ``length``."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(k * power for k in (1.0, 2.0, 5.0) if k * power <= length * (1 + 1e-9)))


def panel(image: U8, low: tuple[int, int], high: tuple[int, int]) -> None:
    """Brighten a rectangle, so that writing on it can be read."""
    area = image[max(low[1], 0) : high[1], max(low[0], 0) : high[0]]
    area[:] = (area.astype(np.uint16) + 3 * 255) // 4


def colour_bar(image: U8, ticks: list[tuple[float, str]], title: str, *, bright_low: bool = False) -> None:
    """A vertical bar at the right edge; ``ticks`` are (position 0..1 from below, text)."""
    height, width = image.shape[:2]
    tall = max(min(height - 90, 220), 40)
    room = max([text_width(words) for _, words in ticks] + [text_width(title) - 20])
    left, top = width - room - 44, height - tall - 30
    panel(image, (left - 10, top - 36), (width - 6, top + tall + 16))
    ramp = np.linspace(0.0, 1.0, tall)
    image[top : top + tall, left : left + 16] = scale_colours(ramp if bright_low else ramp[::-1])[:, None]
    cv2.rectangle(image, (left - 1, top - 1), (left + 16, top + tall), INK, 1)
    text(image, title, (left, top - 16))
    for position, words in ticks:
        v = top + round((1.0 - position) * (tall - 1))
        cv2.line(image, (left + 16, v), (left + 20, v), INK, 1)
        text(image, words, (left + 24, v + 5))


def legend(image: U8, names: list[tuple[str, Colour]]) -> None:
    """Names with their colours, one below the other, in the upper right corner."""
    if not names:
        return
    width = max(text_width(name) for name, _ in names) + 34
    left = image.shape[1] - width - 8
    panel(image, (left - 8, 8), (image.shape[1] - 6, 22 + 22 * len(names)))
    for row, (name, colour) in enumerate(names):
        v = 30 + 22 * row
        cv2.rectangle(image, (left, v - 11), (left + 14, v + 1), colour, -1)
        text(image, name, (left + 22, v))
