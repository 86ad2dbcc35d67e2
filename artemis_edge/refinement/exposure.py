"""Exposures of many images at once, and the fall-off of each lens towards its corners.

Brightness of a place, exposure of an image and fall-off of a lens multiply, so their logarithms add up: with many
places seen in several images this is a linear least-squares problem (Goldman & Chen 2005). An image compared with the
map alone would hand on the errors of those before it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from artemis_edge.frames import F32, F64, I64, CameraModel
from artemis_edge.lens import corner_radius2, log_falloff
from artemis_edge.refinement.reliability import Observations

# Of the vertices every so-manieth by its slot, the same ones in each image; about 1500 of a view
_MOST_OF_ONE_VIEW = 1500
_DARK, _BRIGHT = 12.0, 245.0
_ROUNDS = 40  # of alternating least squares with weights 1 / (1 + (e / _SCATTER)^2)
_TURNS, _INNER_ROUNDS = 6, 8  # of fall-off and gains in turn
_SCATTER = 0.15
_POWERS = 3  # of r^2 in the logarithm of the fall-off
SHADES = 65  # of the table of a fall-off, over r^2 from the principal point to the corner


@dataclass(slots=True)
class Exposures:
    """Colours of vertices in several images, and what they say of the images' exposures."""

    vignetting: bool
    _slot: list[I64] = field(default_factory=list)
    _colour: list[F32] = field(default_factory=list)
    _radius2: list[F64] = field(default_factory=list)
    _camera: list[int] = field(default_factory=list)
    _cameras: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self._slot)

    def add(self, name: str, model: CameraModel, seen: Observations) -> None:
        """The next image, of camera ``name``: its vertices as observed, colours as the camera gave them."""
        good = (seen.geometric > 0.5) & ((seen.colour > _DARK) & (seen.colour < _BRIGHT)).all(axis=1)
        slot = seen.slot[good].astype(np.int64)
        every = max(len(seen.slot) // _MOST_OF_ONE_VIEW, 1)
        chosen = np.flatnonzero((slot * 2654435761 >> 7) % _power_of_two(every) == 0)
        rows = np.flatnonzero(good)[chosen]
        self._slot.append(slot[chosen])
        self._colour.append(np.log(seen.colour[rows]))
        self._radius2.append(radius2(model, seen.pixel[rows]))
        self._camera.append(self._cameras.setdefault(name, len(self._cameras)))

    def solve(self) -> tuple[F32, dict[str, F64]]:
        """Gain of each image to a common exposure, float32 (n, 3), and the fall-off of each camera's lens."""
        c = self._common()
        falloff, bare = self._falloff_of(c), c.colour.copy()
        for camera, coefficients in enumerate(falloff.values()):
            own = c.camera == camera
            bare[own] -= log_falloff(coefficients, c.r2[own])[:, None]
        gain = np.stack([_gains(c.place, c.image, bare[:, k], len(self)) for k in range(3)], axis=1)
        return np.exp(gain).astype(np.float32), falloff

    def falloff(self) -> dict[str, F64]:
        """Of each camera's lens the fall-off, float64 (``_POWERS``,), as ``lens.log_falloff`` takes it."""
        return self._falloff_of(self._common())

    def _falloff_of(self, c: _Common) -> dict[str, F64]:
        found = np.zeros((len(self._cameras), _POWERS))
        if self.vignetting:
            found = _falloff(c.place, c.image, c.colour.mean(axis=1), c.r2, c.camera, len(found), len(self))
        return {name: found[k] for name, k in self._cameras.items()}

    def _common(self) -> _Common:
        """What more than one image saw."""
        image = np.repeat(np.arange(len(self)), [len(rows) for rows in self._slot])
        place = np.unique(np.concatenate(self._slot), return_inverse=True)[1]
        shared = np.bincount(place)[place] > 1
        image = image[shared]
        return _Common(
            np.unique(place[shared], return_inverse=True)[1],
            image,
            np.array(self._camera)[image],
            np.concatenate(self._colour)[shared].astype(np.float64),
            np.concatenate(self._radius2)[shared],
        )


class _Common(NamedTuple):
    """Observations of places that several images saw, one row each: ``colour`` (n, 3) in logarithm, ``r2`` (n,)."""

    place: I64
    image: I64
    camera: I64
    colour: F64
    r2: F64


def undoing(falloff: F64) -> F32:
    """Table of ``SHADES`` factors that undo a fall-off, over the squared distance from the principal point."""
    return np.exp(-log_falloff(falloff, np.linspace(0.0, 1.0, SHADES))).astype(np.float32)


def radius2(model: CameraModel, pixel: F32) -> F64:
    """Squared distance from the principal point, float64 (n,), 1 in the farthest corner of the image."""
    away: F64 = (np.asarray(pixel, np.float64) - (model.cx, model.cy)) ** 2
    total: F64 = away.sum(axis=1) / corner_radius2(model)
    return total


def _power_of_two(n: int) -> int:
    return 1 << (n - 1).bit_length()


def _mean_by(key: I64, weight: F64, value: F64, n: int) -> F64:
    """Weighted mean of the values of each key, 0 where it has none."""
    total = np.bincount(key, weight, n)
    mean: F64 = np.bincount(key, weight * value, n) / np.maximum(total, 1e-9)
    return mean


def _gains(place: I64, image: I64, colour: F64, n: int, rounds: int = _ROUNDS) -> F64:
    """Logarithms of the gains, float64 (n,), of mean zero."""
    gain, weight = np.zeros(n), np.ones(len(colour))
    places = int(place.max()) + 1 if len(place) else 0
    for _ in range(rounds):
        bright = _mean_by(place, weight, colour + gain[image], places)
        gain = _mean_by(image, weight, bright[place] - colour, n)
        gain -= gain.mean()
        error = colour + gain[image] - bright[place]
        weight = 1.0 / (1.0 + (error / _SCATTER) ** 2)
    return gain


def _falloff(place: I64, image: I64, colour: F64, r2: F64, camera: I64, cameras: int, n: int) -> F64:
    """Coefficients of each camera's fall-off, float64 (cameras, ``_POWERS``)."""
    columns = [np.where(camera == c, r2 ** (k + 1), 0.0) for c in range(cameras) for k in range(_POWERS)]
    F = np.stack(columns, axis=1)
    places = int(place.max()) + 1 if len(place) else 0
    weight, out = np.ones(len(colour)), np.zeros(len(columns))
    for _ in range(_TURNS):
        gain = _gains(place, image, colour - F @ out, n, _INNER_ROUNDS)
        rest = colour + gain[image]
        # what places cannot explain: columns and values less their means over each place
        bare = F - np.stack([_mean_by(place, weight, f, places)[place] for f in F.T], axis=1)
        left = rest - _mean_by(place, weight, rest, places)[place]
        normal = (bare * weight[:, None]).T @ bare + 1e-3 * np.eye(len(out))
        out = np.linalg.solve(normal, (bare * weight[:, None]).T @ left)
        error = left - bare @ out
        weight = 1.0 / (1.0 + (error / _SCATTER) ** 2)
    return out.reshape(cameras, _POWERS)
