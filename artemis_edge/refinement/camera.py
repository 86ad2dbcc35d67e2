"""A camera as kernels take it: pose, lens, bounds; and points of the world projected through it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from artemis_edge._jit import kernel
from artemis_edge.frames import F32, F64, CameraModel
from artemis_edge.lens import fold_radius, undistorted_lines

_BORDER_STEP = 16  # pixels between the lines of sight that bound the view
_MARGIN = 1.1  # on the lens's enlargement between them, and across the axes


class Camera(NamedTuple):
    """One image's camera. ``R`` (3, 3) and ``t`` (3,) map world to camera (z forward, y down)."""

    R: F64
    t: F64
    centre: F64  # (3,) in world
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float
    fold2: float  # x^2 + y^2 from where the lens model folds back upon itself
    left: float  # bounds of the view: x / z and y / z
    right: float
    top: float
    bottom: float
    stretch: float  # by how much the lens enlarges a small angle at most, against fx and fy


def make_camera(
    model: CameraModel, T_world_cam: F64, bounds: tuple[float, float, float, float, float]
) -> Camera:
    """Camera of a model at a pose (4, 4); ``bounds`` as :func:`view_bounds` gives them."""
    R = np.ascontiguousarray(T_world_cam[:3, :3].T)
    centre = np.ascontiguousarray(T_world_cam[:3, 3])
    fold = fold_radius(np.array(model.distortion))
    return Camera(
        R,
        -R @ centre,
        centre,
        model.width,
        model.height,
        float(model.fx),
        float(model.fy),
        float(model.cx),
        float(model.cy),
        model.distortion[0],
        model.distortion[1],
        model.distortion[2],
        model.distortion[3],
        model.distortion[4],
        float(fold * fold),
        *bounds,
    )


def view_bounds(model: CameraModel) -> tuple[float, float, float, float, float]:
    """Least and greatest x / z and y / z that the image shows: left, right, top, bottom; and ``Camera.stretch``.

    NaN where no pixel has a line of sight.
    """
    step = _BORDER_STEP
    coarse = CameraModel(
        model.width // step + 2,
        model.height // step + 2,
        model.fx / step,
        model.fy / step,
        model.cx / step,
        model.cy / step,
        model.distortion,
    )
    lines = undistorted_lines(coarse)
    if not np.isfinite(lines).any():
        return (math.nan,) * 5
    low, high = np.nanmin(lines, axis=(0, 1)), np.nanmax(lines, axis=(0, 1))
    return float(low[0]), float(high[0]), float(low[1]), float(high[1]), _stretch(lines, model)


def _stretch(lines: F32, model: CameraModel) -> float:
    """Of the lines of sight of pixels ``_BORDER_STEP`` apart: pixels to angle at most, in focal lengths."""
    apart = [np.abs(np.diff(lines[..., k], axis=1 - k)) * f for k, f in enumerate((model.fx, model.fy))]
    least = min(float(np.nanmin(a, initial=np.inf)) for a in apart)
    return max(_BORDER_STEP / max(least, 1e-3) * _MARGIN, 1.0)


@kernel
def to_camera(camera: Camera, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A point of the world in the camera's coordinates."""
    R, t = camera.R, camera.t
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0],
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1],
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2],
    )


@kernel
def to_pixel(camera: Camera, x: float, y: float) -> tuple[float, float]:
    """Pixel of the line of sight x / z, y / z (``lens.distort``); NaN beyond the lens model's fold."""
    r2 = x * x + y * y
    if r2 >= camera.fold2:
        return math.nan, math.nan
    radial = 1.0 + r2 * (camera.k1 + r2 * (camera.k2 + r2 * camera.k3))
    u = x * radial + 2.0 * camera.p1 * x * y + camera.p2 * (r2 + 2.0 * x * x)
    v = y * radial + camera.p1 * (r2 + 2.0 * y * y) + 2.0 * camera.p2 * x * y
    return camera.fx * u + camera.cx, camera.fy * v + camera.cy


@kernel
def sees_sphere(
    camera: Camera, x: float, y: float, z: float, radius: float, near_m: float, far_m: float
) -> bool:
    """Whether a sphere around a point of the world may be in view (frustum culling)."""
    a, b, c = to_camera(camera, x, y, z)
    if c < near_m - radius or c > far_m + radius:
        return False
    return bool(
        (camera.left * c - a) < radius * math.sqrt(1.0 + camera.left * camera.left)
        and (a - camera.right * c) < radius * math.sqrt(1.0 + camera.right * camera.right)
        and (camera.top * c - b) < radius * math.sqrt(1.0 + camera.top * camera.top)
        and (b - camera.bottom * c) < radius * math.sqrt(1.0 + camera.bottom * camera.bottom)
    )
