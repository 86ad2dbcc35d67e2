"""The colour state of vertices, and the gain that brings an image's exposure to that of the map."""

from __future__ import annotations

import numpy as np

from artemis_edge._jit import kernel
from artemis_edge.block_store import COLOUR, INFORMATION, N_CELLS, Store
from artemis_edge.frames import F32, F64
from artemis_edge.refinement.reliability import CLIPPED_WEIGHT, Observations, Photo, Trust, photometric

# Vertices that an image must share with the map before their colours tell its exposure
_LEAST_COMMON = 50
# Of so many the median is taken: its error is then below half a per cent for colours that scatter by 20 %
_MOST_COMMON = 4000
# Levels between which a pixel is in proportion to the light
_DARK, _BRIGHT = 12.0, 245.0
# Share of the map that may be clipped when it is written, and the least factor on its colours for that
_MAY_CLIP, _LEAST_EXPOSURE = 0.005, 0.5
# A camera's exposure does not step further than this between images that can be compared
_LARGEST_GAIN = 8.0


def estimate_gain(store: Store, seen: Observations, photo: Photo, trust: Trust) -> F32:
    """Factor per channel, float32 (3,), from the colours of an image as taken to those of the map.

    The median over the vertices both know: people who walk through and highlights do not move it. Ones where image
    and map have too little in common.
    """
    rows = np.arange(0, len(seen.slot), max(len(seen.slot) // _MOST_COMMON, 1))
    known = store.attribute[seen.slot[rows], INFORMATION] * trust.noise2 >= 0.5
    rows = rows[known & (seen.geometric[rows] > 0.5)]
    mean = store.attribute[seen.slot[rows], COLOUR : COLOUR + 3]
    colour = seen.colour[rows]
    shade = shades(photo, seen.pixel[rows])
    usable = ((colour > _DARK) & (colour < _BRIGHT) & (mean > _DARK)).all(axis=1)
    if np.count_nonzero(usable) < _LEAST_COMMON:
        return np.ones(3, np.float32)
    mean, colour = mean[usable], (colour * shade[:, None])[usable]
    gain: F64 = np.median(mean / colour, axis=0)
    within: F32 = gain.clip(1.0 / _LARGEST_GAIN, _LARGEST_GAIN).astype(np.float32)
    return within


def shades(photo: Photo, pixel: F32) -> F32:
    """Factors that undo the lens's fall-off at pixels (n, 2), float32 (n,)."""
    away = (pixel[:, 0] - photo.camera.cx) ** 2 + (pixel[:, 1] - photo.camera.cy) ** 2
    steps = np.linspace(0.0, 1.0, len(photo.shade))
    return np.interp(away * photo.inverse_r2, steps, photo.shade).astype(np.float32)


def little_known(store: Store, seen: Observations, least: float) -> Observations:
    """The observations of vertices whose colour has less information than ``least``."""
    few = store.attribute[seen.slot, INFORMATION] < least
    return Observations(*(column[few] for column in seen))


def exposure_of(store: Store) -> float:
    """Factor on the map's colours that leaves all but ``_MAY_CLIP`` of the coloured vertices in memory below 255.

    The map's exposure is that of its first image; what that one clipped another may have seen. At least
    ``_LEAST_EXPOSURE``: a few lamps must not make everything dark.
    """
    used = store.attribute[: int(store.counter[N_CELLS])]
    if used.shape[1] <= INFORMATION:
        return 1.0
    brightest = used[used[:, INFORMATION] > 0.0, COLOUR : COLOUR + 3].max(axis=1, initial=0.0)
    if len(brightest) == 0:
        return 1.0
    white = float(np.quantile(brightest, 1.0 - _MAY_CLIP))
    return min(max(255.0 / max(white, 255.0), _LEAST_EXPOSURE), 1.0)


@kernel
def update_vertices(store: Store, seen: Observations, size: float, sharpness: float, trust: Trust) -> None:
    """Bayesian update of the vertices' colours (mu, Sigma), modulated by W.

    The variance of an observation is ``trust.noise2`` over its weight: W, how sharply the image resolves ``size``
    pixels times metres (focal length times the vertices' spacing), motion blur, clipping. A contradicted colour
    loses a share of its information.
    """
    for i in range(seen.slot.shape[0]):
        m, c = store.attribute[seen.slot[i]], seen.colour[i]
        g = np.float64(seen.geometric[i])
        quality = min(size * seen.cosine[i] / seen.depth[i], 1.0)
        quality *= quality * sharpness * seen.level[i]
        information = np.float64(m[INFORMATION]) * trust.noise2
        dr, dg, db = c[0] - m[COLOUR], c[1] - m[COLOUR + 1], c[2] - m[COLOUR + 2]
        if seen.level[i] == CLIPPED_WEIGHT and information > 0.0:  # at least that bright
            dr, dg, db = max(dr, np.float32(0.0)), max(dg, np.float32(0.0)), max(db, np.float32(0.0))
        p = photometric(np.float64(dr) * dr + np.float64(dg) * dg + np.float64(db) * db, information, trust)
        w = g * p
        if w >= trust.least and quality > 0.0:
            w *= quality
            gain = w / (information + w)
            m[COLOUR] += gain * dr
            m[COLOUR + 1] += gain * dg
            m[COLOUR + 2] += gain * db
            information += w
        information *= 1.0 - trust.forget * (1.0 - p) * g * quality
        m[INFORMATION] = min(information, trust.most) / trust.noise2
