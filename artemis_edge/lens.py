"""Lenses: distortion of the Brown-Conrady model (Brown 1971) with its inverse per pixel, and fall-off of the light.

The fall-off is that of the pixel's value, not of the light: its logarithm is a polynomial of the squared distance from
the principal point, without a constant (cf. Goldman & Chen 2005).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.frames import F32, F64, CameraModel

# Focal lengths and principal points of cameras [px]: from a fisheye thumbnail to a telescope.
_SHORTEST_PX, _FARTHEST_PX = 0.1, 1e6
#: What ``is_camera`` asks for.
CAMERA_RULE = f"fx and fy must be {_SHORTEST_PX:g} to {_FARTHEST_PX:,.0f} pixels, cx and cy no farther from 0"
_NEWTON_STEPS = 20  # four or five are enough where the model is sane
_TOLERANCE = 1e-7  # normalised: below a thousandth of a pixel for any f < 10,000


@njit
def distort(x: float, y: float, distortion: F64) -> tuple[float, float]:
    """Where the lens puts the normalised point (x, y); ``distortion`` k1, k2, p1, p2, k3."""
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


@njit
def slope(x: float, y: float, distortion: F64) -> tuple[float, float, float]:
    """Derivatives of :func:`distort`: of x by x, of x by y (and of y by x, the same), of y by y."""
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    growth = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))  # the derivative of radial by x is growth x
    return (
        radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
        radial + growth * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@njit
def _undistort(u: float, v: float, distortion: F64, fold: float) -> tuple[float, float]:
    """The point (x, y) within radius ``fold`` that the lens puts at (u, v), by Newton's method; else NaN."""
    x, y = u, v
    for _ in range(_NEWTON_STEPS):
        at_u, at_v = distort(x, y, distortion)
        error_u, error_v = at_u - u, at_v - v
        if abs(error_u) < _TOLERANCE and abs(error_v) < _TOLERANCE:
            return (x, y) if x * x + y * y < fold * fold else (np.nan, np.nan)
        a, b, d = slope(x, y, distortion)
        det = a * d - b * b
        x -= (d * error_u - b * error_v) / det
        y -= (a * error_v - b * error_u) / det
    return np.nan, np.nan


@njit
def _undistort_pixels(focal: F64, centre: F64, distortion: F64, fold: float, lines: F32) -> None:
    for row in range(lines.shape[0]):
        for column in range(lines.shape[1]):
            u, v = (column - centre[0]) / focal[0], (row - centre[1]) / focal[1]
            lines[row, column, 0], lines[row, column, 1] = _undistort(u, v, distortion, fold)


def undistorted_lines(camera: CameraModel) -> F32:
    """Line of sight (x/z, y/z) of every pixel, float32 (h, w, 2); NaN where the lens model has none.

    A solution beyond the radius where the model folds back upon itself is none.
    """
    lines = np.empty((camera.height, camera.width, 2), np.float32)
    distortion = np.array(camera.distortion, np.float64)
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    _undistort_pixels(focal, centre, distortion, fold_radius(distortion), lines)
    return lines


def corner_radius2(camera: CameraModel) -> float:
    """Squared distance of the farthest corner from the principal point [pixels^2]."""
    x = max(camera.cx, camera.width - camera.cx)
    y = max(camera.cy, camera.height - camera.cy)
    return float(x * x + y * y)


def is_camera(fx: float, fy: float, cx: float, cy: float) -> bool:
    """Whether these can be focal lengths and principal point of a camera; ``CAMERA_RULE`` says it in words."""
    return all(_SHORTEST_PX <= f <= _FARTHEST_PX for f in (fx, fy)) and all(
        abs(c) <= _FARTHEST_PX for c in (cx, cy)
    )


def log_falloff(coefficients: F64 | Sequence[float], q: F64) -> F64:
    """Logarithm of the fall-off, a1 q + a2 q^2 + ..., at squared distances ``q``, 1 in the farthest corner."""
    total = np.zeros(np.shape(q))
    for a in reversed(list(coefficients)):
        total = (total + a) * q
    return total


def falloff(camera: CameraModel, coefficients: Sequence[float]) -> F32:
    """What the lens leaves of a pixel's value, float32 (h, w), 1 at the principal point."""
    x = (np.arange(camera.width) - camera.cx) ** 2
    y = (np.arange(camera.height) - camera.cy) ** 2
    q = (x + y[:, None]) / corner_radius2(camera)
    return np.exp(log_falloff(coefficients, q)).astype(np.float32)


def fold_radius(distortion: F64) -> float:
    """Smallest radius at which r (1 + k1 r^2 + k2 r^4 + k3 r^6) stops growing; infinite if it never does."""
    k1, k2, _, _, k3 = distortion
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])  # of the derivative, in r^2
    real = roots[np.abs(roots.imag) < 1e-9 * np.abs(roots)].real
    positive = real[real > 0.0]
    return float(np.sqrt(positive.min())) if len(positive) else np.inf
