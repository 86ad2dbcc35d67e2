"""Which colour word a surface deserves, from its mean colour in CIELAB."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import ArrayLike

_FULL_TURN = 360.0
# Below the first chroma a surface has no hue to the eye, above the second it has (CIELAB units).
_CHROMA = (6.0, 14.0)
_SOFT_DEG = 20.0
_SOFT_LIGHT = 12.0
_SOFT_CHROMA = 12.0


@dataclass(frozen=True, slots=True)
class _Named:
    """Hues from ``low`` to ``high`` degrees, lightness ``dark`` to ``light`` (0..100), chroma up to ``vivid``."""

    low: float
    high: float
    dark: float = 0.0
    light: float = 100.0
    vivid: float = 1000.0


_CHROMATIC: Mapping[str, _Named] = MappingProxyType(
    {
        "red": _Named(10, 45, 0, 68),
        "orange": _Named(45, 75, 50, 100),
        "brown": _Named(30, 85, 0, 52, 42),
        "yellow": _Named(75, 110, 50, 100),
        "green": _Named(105, 185),
        "cyan": _Named(175, 235),
        "blue": _Named(225, 310),
        "purple": _Named(300, 340, 0, 70),
        "pink": _Named(325, 375, 48, 100),
    }
)
_GREY: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"black": (-100.0, 25.0), "grey": (25.0, 80.0), "white": (80.0, 200.0)}
)
_LIGHT: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"dark": (-100.0, 40.0), "bright": (60.0, 200.0)}
)


def colour_fit(colour: ArrayLike, word: str) -> float:
    """How well a colour word fits an sRGB colour of 0..255: 0 not at all, 1 fully, 0.5 at the border."""
    rgb = np.asarray(colour, np.float32).reshape(1, 1, 3) / 255
    lightness, a, b = (float(v) for v in cv2.cvtColor(np.clip(rgb, 0, 1), cv2.COLOR_RGB2LAB)[0, 0])
    if word in _LIGHT:
        return _within(lightness, *_LIGHT[word], _SOFT_LIGHT)
    chroma = float(np.hypot(a, b))
    hued = float(np.clip((chroma - _CHROMA[0]) / (_CHROMA[1] - _CHROMA[0]), 0.0, 1.0))
    if word in _GREY:
        return (1.0 - hued) * _within(lightness, *_GREY[word], _SOFT_LIGHT)
    named = _CHROMATIC[word]
    hue = float(np.degrees(np.arctan2(b, a))) % _FULL_TURN
    middle = (named.low + named.high) / 2
    off = (hue - middle + _FULL_TURN / 2) % _FULL_TURN - _FULL_TURN / 2
    right_hue = _within(middle + off, named.low, named.high, _SOFT_DEG)
    # an upper or lower end of the scale is no border
    dark = -_FULL_TURN if named.dark <= 0.0 else named.dark
    light = _FULL_TURN if named.light >= 100.0 else named.light
    muted = _within(chroma, -_FULL_TURN, named.vivid, _SOFT_CHROMA)
    return hued * right_hue * muted * _within(lightness, dark, light, _SOFT_LIGHT)


def _within(value: float, low: float, high: float, soft: float) -> float:
    """1 well within, 0 well outside, linear over ``soft`` around each border."""
    inside = min(value - low, high - value) / soft + 0.5
    return float(np.clip(inside, 0.0, 1.0))
