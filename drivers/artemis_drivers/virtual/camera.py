"""A global-shutter colour camera: pinhole with Brown-Conrady distortion and vignetting, lit, shadowed, blurred
by its true motion within the exposure, noisy, as JPEG or as Bayer mosaic.

The image is rendered once, in the middle of the exposure; motion blur is a filter along each pixel's own path
over the exposure, which follows from its depth and from the true motion of camera and mover. Not modelled: what
a mover's silhouette uncovers within the exposure, lens blur, rolling shutter, flare.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np

from artemis_drivers._jit import njit
from artemis_drivers.virtual.mesh_builder import F32, F64, I32, U8
from artemis_drivers.virtual.scene import Scene
from artemis_drivers.virtual.sensor import (
    AutoExposure,
    Exposure,
    Optics,
    SensorSpec,
    amplifier,
    bayer_bytes,
    cut,
    developed,
    expose,
    metered,
    white_noise,
)
from artemis_drivers.virtual.shading import (
    Film,
    Parts,
    ShadowMap,
    local_mover,
    local_vertices,
    mover_shadows,
    shade_pixels,
    shadow_map,
)
from artemis_drivers.virtual.spans import Canvas, View, clear, draw, new_canvas

_OVERSAMPLING = 2.0  # canvas pixels per image pixel, along each axis
_UNDISTORT_STEPS = 30
_UNDISTORTED2 = 1e-28  # squared correction that is no more than rounding

#: T_world_cam (4, 4) at a time in seconds.
CameraPath = Callable[[float], F64]


@dataclass(frozen=True, slots=True)
class CameraSpec:
    """Pixels; distortion k1, k2, p1, p2, k3. Defaults: 4.8 um pixels behind a 4.3 mm lens, 71 degrees wide.

    ``vignetting`` is the exponent of the cosine of the field angle: 4 is that of an ideal lens.
    """

    width: int = 1280
    height: int = 1024
    fx: float = 900.0
    fy: float = 900.0
    cx: float = 644.5
    cy: float = 508.0
    distortion: tuple[float, float, float, float, float] = (-0.09, 0.06, 0.0004, -0.0003, -0.01)
    vignetting: float = 4.0
    jpeg_quality: int = 92
    output: Literal["jpeg", "bayer"] = "jpeg"
    sensor: SensorSpec = field(default_factory=SensorSpec)

    def scaled(self, width: int) -> CameraSpec:
        """The same view at another resolution (aspect kept)."""
        s = width / self.width
        return replace(
            self,
            width=width,
            height=round(self.height * s),
            fx=self.fx * s,
            fy=self.fy * s,
            cx=(self.cx + 0.5) * s - 0.5,
            cy=(self.cy + 0.5) * s - 0.5,
        )


@dataclass(frozen=True, slots=True)
class Photo:
    """``data``: JPEG, or row by row the bytes of the mosaic (``encoding`` "jpeg" or "bayer_rggb8")."""

    data: bytes
    encoding: str
    exposure_s: float
    gain: float


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
    x, y = np.empty(np.shape(xd)), np.empty(np.shape(xd))
    _undistort(np.ravel(xd), np.ravel(yd), k, x.reshape(-1), y.reshape(-1))
    return x, y


@njit
def _undistort(xd: F64, yd: F64, k: tuple[float, float, float, float, float], out_x: F64, out_y: F64) -> None:
    k1, k2, p1, p2, k3 = k
    for i in range(len(xd)):
        x, y = xd[i], yd[i]
        for _ in range(_UNDISTORT_STEPS):
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            ex = xd[i] - (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x))
            ey = yd[i] - (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
            x, y = x + ex, y + ey
            if ex * ex + ey * ey < _UNDISTORTED2:
                break
        out_x[i], out_y[i] = x, y


@dataclass(slots=True)
class VirtualCamera:
    """Takes photographs of a scene; keeps what does not change from image to image, and the exposure control:
    photographs must be taken in order. Kernels work on ``threads`` bands of the image at once; the result does
    not depend on their number.
    """

    spec: CameraSpec
    seed: int
    threads: int = 2
    lines: F32 = field(init=False)
    sub_pixels: I32 = field(init=False)
    view: View = field(init=False)
    _canvas: Canvas = field(init=False)
    _film: Film = field(init=False)
    _falloff: F32 = field(init=False)
    _noise: F32 = field(init=False)
    _exposure: AutoExposure = field(init=False)
    _scene: Scene | None = field(default=None, init=False)
    _shadow: ShadowMap = field(init=False)
    _local: F32 = field(init=False)
    _pool: ThreadPoolExecutor = field(init=False)

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
        self.view = View(fx, fy, float(1 - low[0] * fx), float(1 - low[1] * fy), False)
        column = np.rint(lines[:, :, :4, 0] * fx + self.view.cx).astype(np.int32)
        row = np.rint(lines[:, :, :4, 1] * fy + self.view.cy).astype(np.int32)
        self._canvas = new_canvas(width, height)
        self.sub_pixels = row * np.int32(width) + column
        self.lines = lines.astype(np.float32)
        count = s.height * s.width
        self._film = Film(
            np.empty((count, 3), np.float32), np.empty(count, np.float32), np.empty(count, np.int16)
        )
        cosine = 1 / np.sqrt(1 + (lines[:, :, 4] ** 2).sum(axis=2))
        self._falloff = (cosine**s.vignetting).astype(np.float32)
        self._noise = white_noise(s.height, s.width, self.seed)
        self._exposure = AutoExposure(s.sensor)
        self._pool = ThreadPoolExecutor(self.threads)

    def render(self, scene: Scene, sun: F64, T_world_cam: F64, time_s: float = 0.0) -> F32:
        """Linear light float32 (h, w, 3), 1 = white: no blur, no vignetting, no noise."""
        self._see(scene, sun, T_world_cam, time_s)
        return self._film.light.reshape(self.spec.height, self.spec.width, 3).copy()

    def photograph(self, scene: Scene, sun: F64, path: CameraPath, time_s: float, index: int) -> Photo:
        """Photograph ``index``, the middle of whose exposure is at ``time_s``."""
        parts = self._see(scene, sun, path(time_s), time_s)
        used = self._exposure.next(float((self._film.light[::8, 1] * self._falloff.reshape(-1)[::8]).mean()))
        raw = self._raw(scene, parts, path, time_s, used, index)
        self._exposure.measured(used, metered(raw, self.spec.sensor))
        if self.spec.output == "bayer":
            data, encoding = bayer_bytes(raw, self.spec.sensor).tobytes(), "bayer_rggb8"
        else:
            data, encoding = encode_jpeg(developed(raw, self.spec.sensor), self.spec.jpeg_quality), "jpeg"
        return Photo(data, encoding, used.exposure_s, used.gain)

    def seen(self) -> tuple[I32, F32]:
        """Of the picture taken last: int32 (h, w, 4) numbers of the triangles in the quarters of each pixel, -1
        the sky, and float32 (h, w) depth in metres along z, inf the sky; in the middle of the exposure.
        """
        shape = self.spec.height, self.spec.width
        triangles: I32 = self._canvas.triangle.reshape(-1)[self.sub_pixels]
        return triangles, self._film.depth.reshape(shape).copy()

    def _raw(
        self, scene: Scene, parts: Parts, path: CameraPath, time_s: float, used: Exposure, index: int
    ) -> np.ndarray[tuple[int, int], np.dtype[np.uint16]]:
        s = self.spec
        raw = np.empty((s.height, s.width), np.uint16)
        moved = _moved(scene, parts, path, time_s, used.exposure_s)
        lens, noise = Optics(s.fx, s.fy, s.distortion), cut(self._noise, self.seed, index)
        efficiency, amplified = np.array(s.sensor.efficiency), amplifier(s.sensor, used)

        def band(first: int, last: int) -> None:
            lines, rows = self.lines[:, :, 4], (first, last)
            expose(self._film, lines, moved, lens, self._falloff, noise, efficiency, amplified, rows, raw)

        self._in_bands(band, self.spec.height)
        return raw

    def _see(self, scene: Scene, sun: F64, T_world_cam: F64, time_s: float) -> Parts:
        """Fill the film with what is seen."""
        if scene is not self._scene:
            self._local = local_vertices(scene)
            self._shadow = shadow_map(scene, sun, self._local)
            self._scene = scene
        parts = _parts(scene, T_world_cam, time_s)
        self._draw(scene, parts)
        passing, arrays = mover_shadows(scene, parts, sun), scene.atlas.arrays
        ids, wide, width = self._canvas.triangle.reshape(-1), 1.0 / self.spec.fx, self.spec.width
        sub_pixels, lines = self.sub_pixels.reshape(-1, 4), self.lines.reshape(-1, 5, 2)

        def band(first: int, last: int) -> None:
            n = slice(first * width, last * width)
            film = Film(self._film.light[n], self._film.depth[n], self._film.part[n])
            shade_pixels(
                scene.surface, arrays, self._shadow, passing, parts, ids, sub_pixels[n], lines[n], wide, film
            )

        self._in_bands(band, self.spec.height)
        return parts

    def _in_bands(self, work: Callable[[int, int], None], rows: int) -> None:
        """Do work(first, last) on bands that together are so many rows."""
        edges = [k * rows // self.threads for k in range(self.threads + 1)]
        list(self._pool.map(work, edges[:-1], edges[1:]))

    def _draw(self, scene: Scene, parts: Parts) -> None:
        """Numbers of the triangles seen per canvas pixel; only objects within the view are drawn."""
        clear(self._canvas)
        T = _view_of(parts, 0)
        seen = scene.object_centre @ T[:3, :3].T + T[:3, 3]
        chosen = np.flatnonzero(self._within(seen, scene.object_radius)[scene.object_of]).astype(np.int32)

        def band(first: int, last: int) -> None:
            canvas = self._canvas._replace(top=first, bottom=last)
            draw(canvas, self.view, T, self._local, scene.mesh.triangles, chosen, 0)

        self._in_bands(band, self._canvas.nearness.shape[0])
        for k, mover in enumerate(scene.movers, start=1):
            T = _view_of(parts, k)
            if self._within(T[None, :3, 3], np.array([mover.radius]))[0]:
                every = np.arange(len(mover.mesh.triangles), dtype=np.int32)
                draw(self._canvas, self.view, T, local_mover(mover), mover.mesh.triangles, every, mover.first)

    def _within(self, centre: F64, radius: F64) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Whether spheres (n, 3) in view coordinates may be seen."""
        fx, fy, cx, cy, _ = self.view
        height, width = self._canvas.nearness.shape
        inside = centre[:, 2] > -radius
        # the four planes through the eye and the image's borders, normals inwards
        for axis, sign, slope in (
            (0, 1.0, cx / fx),
            (0, -1.0, (width - cx) / fx),
            (1, 1.0, cy / fy),
            (1, -1.0, (height - cy) / fy),
        ):
            inside &= sign * centre[:, axis] + slope * centre[:, 2] > -radius * np.hypot(1.0, slope)
        return inside


def _parts(scene: Scene, T_world_cam: F64, time_s: float) -> Parts:
    count = 1 + len(scene.movers)
    first = np.zeros(count, np.int32)
    T_world_local = np.tile(np.eye(4), (count, 1, 1))
    T_world_local[0, :3, 3] = scene.origin
    for k, mover in enumerate(scene.movers, start=1):
        first[k], T_world_local[k] = mover.first, mover.pose(time_s)[0]
    turned = np.swapaxes(T_world_local[:, :3, :3], 1, 2)
    away = T_world_cam[:3, 3] - T_world_local[:, :3, 3]
    return Parts(
        first,
        np.einsum("nij,nj->ni", turned, away),
        np.ascontiguousarray(turned @ T_world_cam[:3, :3]),
        np.ascontiguousarray(T_world_local[:, :3, :3]),
        T_world_local[:, :3, 3] - scene.origin,
    )


def _moved(scene: Scene, parts: Parts, path: CameraPath, time_s: float, exposure_s: float) -> F64:
    """Per part D (k, 4, 4): its points p in the camera move by D (p, 1) over the exposure around ``time_s``."""
    D = np.zeros((len(parts.first), 4, 4))
    for sign in (-1.0, 1.0):
        then = _parts(scene, path(time_s + sign * exposure_s / 2), time_s + sign * exposure_s / 2)
        for k in range(len(D)):
            R = then.R_local_cam[k].T
            D[k, :3, :3] += sign * R @ parts.R_local_cam[k]
            D[k, :3, 3] += sign * R @ (parts.eye[k] - then.eye[k])
    return D


def _view_of(parts: Parts, k: int) -> F64:
    """T_cam_local of a part."""
    T = np.eye(4)
    T[:3, :3] = parts.R_local_cam[k].T
    T[:3, 3] = -T[:3, :3] @ parts.eye[k]
    return T


def encode_jpeg(bgr: U8, quality: int) -> bytes:
    """JPEG bytes of a BGR picture."""
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()
