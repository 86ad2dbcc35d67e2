"""A global-shutter colour camera: pinhole with Brown-Conrady distortion, lit, shadowed, noisy, JPEG.

Exposure is instantaneous here; stamps are those of the middle of the exposure.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from artemis_drivers._jit import njit
from artemis_drivers.virtual.mesh_builder import F32, F64, I32, U8
from artemis_drivers.virtual.scene import Scene
from artemis_drivers.virtual.shading import Rasteriser, ShadowMap, shade_image, shadow_map

_OVERSAMPLING = 2.0  # canvas pixels per image pixel, along each axis
_EXPOSURE_GAIN = 1.15
_UNDISTORT_STEPS = 30
_NOISE_MARGIN = 256


@dataclass(frozen=True, slots=True)
class CameraSpec:
    """Pixels; distortion k1, k2, p1, p2, k3. Defaults: 1/1.8 inch sensor behind a 6 mm lens, 71 degrees wide.

    ``noise`` is the standard deviation of a mid-grey pixel of 8 bits, shot noise plus read noise.
    """

    width: int = 1280
    height: int = 1024
    fx: float = 900.0
    fy: float = 900.0
    cx: float = 644.5
    cy: float = 508.0
    distortion: tuple[float, float, float, float, float] = (-0.09, 0.06, 0.0004, -0.0003, -0.01)
    noise: float = 1.5
    jpeg_quality: int = 92
    exposure_s: float = 0.004

    def scaled(self, width: int) -> CameraSpec:
        """The same view at another resolution (aspect kept)."""
        s = width / self.width
        return CameraSpec(
            width,
            round(self.height * s),
            self.fx * s,
            self.fy * s,
            (self.cx + 0.5) * s - 0.5,
            (self.cy + 0.5) * s - 0.5,
            self.distortion,
            self.noise,
            self.jpeg_quality,
            self.exposure_s,
        )


def distort(x: F64, y: F64, k: tuple[float, float, float, float, float]) -> tuple[F64, F64]:
    """Brown-Conrady: where the lens puts the normalised point (x, y)."""
    k1, k2, p1, p2, k3 = k
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (
        r2 + 2 * y * y
    ) + 2 * p2 * x * y


def undistort(xd: F64, yd: F64, k: tuple[float, float, float, float, float]) -> tuple[F64, F64]:
    """Inverse of :func:`distort` by fixed-point iteration (converges for mild lenses, |k1| r2 < 0.3)."""
    x, y = xd.copy(), yd.copy()
    for _ in range(_UNDISTORT_STEPS):
        ex, ey = distort(x, y, k)
        x, y = x + (xd - ex), y + (yd - ey)
    return x, y


@dataclass(slots=True)
class VirtualCamera:
    """Renders photographs of a scene; keeps what does not change from image to image."""

    spec: CameraSpec
    rasterise: Rasteriser
    seed: int
    lines: F32 = field(init=False)
    canvas: I32 = field(init=False)
    canvas_size: tuple[int, int] = field(init=False)
    canvas_view: tuple[float, float, float, float] = field(init=False)
    _shadow: ShadowMap | None = field(default=None, init=False)
    _shadow_of: Scene | None = field(default=None, init=False)
    _local: F32 = field(init=False)
    _noise: F32 = field(init=False)

    def __post_init__(self) -> None:
        """Lines of sight of all sub-pixels and where they fall on the undistorted canvas."""
        s = self.spec
        v, u = np.mgrid[0 : s.height, 0 : s.width].astype(np.float64)
        offsets = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25), (0.0, 0.0))
        lines = np.empty((s.height, s.width, 5, 2))
        for k, (du, dv) in enumerate(offsets):
            x, y = undistort((u + du - s.cx) / s.fx, (v + dv - s.cy) / s.fy, s.distortion)
            lines[:, :, k, 0], lines[:, :, k, 1] = x, y
        low, high = lines.min(axis=(0, 1, 2)), lines.max(axis=(0, 1, 2))
        fx, fy = s.fx * _OVERSAMPLING, s.fy * _OVERSAMPLING
        width, height = int((high[0] - low[0]) * fx) + 3, int((high[1] - low[1]) * fy) + 3
        self.canvas_view = (fx, fy, 1 - low[0] * fx, 1 - low[1] * fy)
        column = np.rint(lines[:, :, :4, 0] * fx + self.canvas_view[2]).astype(np.int32)
        row = np.rint(lines[:, :, :4, 1] * fy + self.canvas_view[3]).astype(np.int32)
        self.canvas_size = (width, height)
        self.canvas = row * np.int32(width) + column
        self.lines = lines.astype(np.float32)
        rng = np.random.default_rng([self.seed, 13])
        shape = (s.height + _NOISE_MARGIN, s.width + _NOISE_MARGIN, 3)
        self._noise = rng.standard_normal(shape, np.float32)

    def render(self, scene: Scene, sun: F64, T_world_cam: F64) -> F32:
        """Linear light float32 (h, w, 3), 1 = white."""
        if scene is not self._shadow_of or self._shadow is None:
            self._local = (scene.mesh.vertices - scene.origin.astype(np.float32)).astype(np.float32)
            self._shadow = shadow_map(scene, sun, self.rasterise)
            self._shadow_of = scene
        T_view_local = np.eye(4)
        T_view_local[:3, :3] = T_world_cam[:3, :3].T
        T_view_local[:3, 3] = -T_world_cam[:3, :3].T @ (T_world_cam[:3, 3] - scene.origin)
        ids = self._visible(scene, T_view_local)
        return shade_image(scene, self._shadow, ids, self.lines, self.canvas, T_world_cam, 1.0 / self.spec.fx)

    def _visible(self, scene: Scene, T_view_local: F64) -> I32:
        """Numbers of the triangles seen per canvas pixel; only objects within the view are drawn."""
        fx, fy, cx, cy = self.canvas_view
        width, height = self.canvas_size
        centre, radius = scene.object_centre, scene.object_radius
        seen = centre @ T_view_local[:3, :3].T + T_view_local[:3, 3]
        inside = seen[:, 2] > -radius
        # the four planes through the eye and the image's borders, normals inwards
        for x, y in ((cx / fx, 0), ((width - cx) / fx, 0), (0, cy / fy), (0, (height - cy) / fy)):
            sign = 1.0 if (x, y) in ((cx / fx, 0), (0, cy / fy)) else -1.0
            axis = seen[:, 0] if y == 0 else seen[:, 1]
            slope = x + y
            inside &= sign * axis + slope * seen[:, 2] > -radius * np.hypot(1.0, slope)
        chosen = np.flatnonzero(inside[scene.object_of])
        ids, _ = self.rasterise(
            self._local,
            scene.mesh.triangles[chosen],
            T_view_local,
            self.canvas_view,
            self.canvas_size,
            False,
        )
        return np.append(chosen, -1).astype(np.int32)[ids]

    def develop(self, light: F32, index: int) -> U8:
        """8-bit RGB of linear light, with the sensor's noise of image ``index``."""
        rng = np.random.default_rng([self.seed, 11, index])
        # one field of white noise, cut at another place for every image: as random, much cheaper
        row, column = rng.integers(0, _NOISE_MARGIN, 2)
        height, width = light.shape[:2]
        noise = self._noise[row : row + height, column : column + width]
        out = np.empty(light.shape, np.uint8)
        _develop(light, noise, self.spec.noise, _EXPOSURE_GAIN, out)
        return out

    def photograph(self, scene: Scene, sun: F64, T_world_cam: F64, index: int) -> bytes:
        """JPEG bytes of image ``index``."""
        rgb = self.develop(self.render(scene, sun, T_world_cam), index)
        return encode_jpeg(rgb, self.spec.jpeg_quality)


@njit
def _develop(light: F32, noise: F32, sigma: float, gain: float, out: U8) -> None:
    """Gain, square root as the transfer curve, noise, 8 bits."""
    for i in range(light.shape[0]):
        for j in range(light.shape[1]):
            for a in range(3):
                value = np.sqrt(max(light[i, j, a] * gain, 0.0)) * 255.0 + noise[i, j, a] * sigma
                out[i, j, a] = int(min(max(value, 0.0), 255.0) + 0.5)


def encode_jpeg(rgb: U8, quality: int) -> bytes:
    """JPEG bytes of an RGB picture."""
    _, data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()
