"""Lens distortion of the Brown-Conrady model (Brown 1971), and its inverse per pixel."""

from __future__ import annotations

import numpy as np

from artemis_edge.frames import F32, F64, CameraModel

_NEWTON_STEPS = 20
_TOLERANCE = 1e-6  # normalised: below a thousandth of a pixel for any f < 1000


def distort(x: F64, y: F64, distortion: tuple[float, ...]) -> tuple[F64, F64]:
    """Brown-Conrady (k1, k2, p1, p2, k3): where the lens puts the normalised point (x, y)."""
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


def undistorted_lines(camera: CameraModel) -> F32:
    """Line of sight (x/z, y/z) of every pixel, float32 (h, w, 2); NaN where the lens model has none.

    Newton's method on the distortion; a solution beyond the radius where the model folds back is none.
    """
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    target_x, target_y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    x, y = target_x.copy(), target_y.copy()
    with np.errstate(all="ignore"):  # lines without a solution may run away; they are sorted out below
        for _ in range(_NEWTON_STEPS):
            fx, fy = distort(x, y, camera.distortion)
            (a, b), (c, d) = _distortion_slope(x, y, camera.distortion)
            det = a * d - b * c
            ex, ey = fx - target_x, fy - target_y
            x, y = x - (d * ex - b * ey) / det, y - (a * ey - c * ex) / det
        fx, fy = distort(x, y, camera.distortion)
        solved = np.hypot(fx - target_x, fy - target_y) < _TOLERANCE
        solved &= np.hypot(x, y) < _fold_radius(camera.distortion)
    return np.where(solved[..., None], np.stack([x, y], axis=-1), np.nan).astype(np.float32)


def _distortion_slope(
    x: F64, y: F64, distortion: tuple[float, ...]
) -> tuple[tuple[F64, F64], tuple[F64, F64]]:
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    growth = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))  # d radial / d x is growth * x
    mixed = growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    return (
        (radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x, mixed),
        (mixed, radial + growth * y * y + 6.0 * p1 * y + 2.0 * p2 * x),
    )


def _fold_radius(distortion: tuple[float, ...]) -> float:
    """Smallest radius at which r (1 + k1 r^2 + k2 r^4 + k3 r^6) stops growing; infinite if it never does."""
    k1, k2, _, _, k3 = distortion
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])  # of the derivative, in r^2
    real = roots[np.abs(roots.imag) < 1e-9 * np.abs(roots)].real
    positive = real[real > 0.0]
    return float(np.sqrt(positive.min())) if len(positive) else np.inf
