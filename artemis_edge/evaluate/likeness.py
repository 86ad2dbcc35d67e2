"""How like a photograph a picture is, over the pixels that the picture covers: PSNR and SSIM."""

from __future__ import annotations

import cv2
import numpy as np

from artemis_edge.frames import F32, F64, U8, Bool

_PEAK = 255.0
# Equal pictures would have an infinite PSNR, which JSON cannot hold: half a level off at one pixel in 40 million.
_HIGHEST_DB = 130.0
# SSIM of Wang et al., "Image Quality Assessment: From Error Visibility to Structural Similarity", IEEE TIP 13
# (2004), section III-C: window of 11 x 11, sigma 1.5 pixels, constants K1 and K2.
_WINDOW, _SIGMA_PX = 11, 1.5
_C1, _C2 = (0.01 * _PEAK) ** 2, (0.03 * _PEAK) ** 2
_LUMA = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601, of the non-linear values


def psnr_db(photo: U8, picture: F32, covered: Bool) -> float:
    """Peak signal-to-noise ratio of (h, w, 3) images 0..255 over the pixels ``covered`` (h, w), of which
    there must be some.
    """
    error = photo[covered].astype(np.float64) - picture[covered]
    mean_square = float(np.mean(error**2))
    if mean_square <= 0.0:
        return _HIGHEST_DB
    return min(float(10.0 * np.log10(_PEAK**2 / mean_square)), _HIGHEST_DB)


def channel_gains(photo: U8, picture: F32, covered: Bool) -> F64:
    """Factors (3,) on the channels of ``picture`` that bring it nearest to ``photo`` by least squares.

    A channel that is black all over keeps 1.
    """
    target, own = photo[covered].astype(np.float64), picture[covered].astype(np.float64)
    power = (own**2).sum(axis=0)
    gains: F64 = np.where(power > 0.0, (target * own).sum(axis=0) / np.maximum(power, 1e-12), 1.0)
    return gains


def ssim(photo: U8 | F32, picture: U8 | F32, covered: Bool) -> float:
    """Mean structural similarity of the lumas over the pixels ``covered``, of which there must be some.

    Each window is normalised by the covered pixels under it: what is not covered has no influence.
    """
    mask = covered.astype(np.float64)
    weight = _blurred(mask)
    x, y = (np.where(covered, image.astype(np.float64) @ _LUMA, 0.0) for image in (photo, picture))
    shown = np.where(covered, weight, 1.0)
    mean_x, mean_y = _blurred(x) / shown, _blurred(y) / shown
    var_x, var_y = _blurred(x * x) / shown - mean_x**2, _blurred(y * y) / shown - mean_y**2
    both = _blurred(x * y) / shown - mean_x * mean_y
    # rounding can leave a variance just below zero
    var_x, var_y = np.maximum(var_x, 0.0), np.maximum(var_y, 0.0)
    likeness = (2.0 * mean_x * mean_y + _C1) * (2.0 * both + _C2)
    likeness /= (mean_x**2 + mean_y**2 + _C1) * (var_x + var_y + _C2)
    return float(likeness[covered].mean())


def _blurred(image: F64) -> F64:
    """Gaussian sum over the window; nothing lies beyond the border."""
    size = (_WINDOW, _WINDOW)
    blurred: F64 = np.asarray(cv2.GaussianBlur(image, size, _SIGMA_PX, borderType=cv2.BORDER_CONSTANT))
    return blurred
