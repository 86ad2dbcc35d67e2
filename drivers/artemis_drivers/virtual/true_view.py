"""What a camera would see without its faults: colour, depth, class and instance of every pixel, for any pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from artemis_drivers.virtual.camera import VirtualCamera, undistort
from artemis_drivers.virtual.mesh_builder import F32, F64, I32, U8
from artemis_drivers.virtual.scene import Scene, cast_at
from artemis_drivers.virtual.sensor import REFERENCE, Exposure, ideal

_ROWS = 64  # of the image, cast at a time


@dataclass(frozen=True, slots=True)
class TrueView:
    """Of every pixel (h, w): ``colour`` uint8 RGB (h, w, 3); ``light`` float32 (h, w, 3) linear RGB, 1 = white;
    ``depth`` float32 metres along z, NaN where nothing; ``label`` uint8 class, 0 where nothing; ``instance``
    int32, -1 where nothing.
    """

    colour: U8
    light: F32
    depth: F32
    label: U8
    instance: I32


def truth_images(
    scene: Scene,
    sun: F64,
    T_world_cam: F64,
    camera: VirtualCamera,
    time_s: float,
    exposure: Exposure = REFERENCE,
) -> TrueView:
    """The view of ``camera`` (its lens, but no vignetting, blur or noise) at ``time_s``.

    Colour is anti-aliased and developed as a photograph of ``exposure`` would be. Depth, class and instance are
    those that the exact ray through the pixel's middle meets.
    """
    s = camera.spec
    light = camera.render(scene, sun, T_world_cam, time_s)
    depth = np.empty((s.height, s.width), np.float32)
    triangle = np.empty((s.height, s.width), np.int32)
    for row in range(0, s.height, _ROWS):
        part = slice(row, min(row + _ROWS, s.height))
        depth[part], triangle[part] = _cast_rows(scene, T_world_cam, camera, time_s, part)
    return TrueView(
        colour=ideal(light, s.sensor, exposure),
        light=light,
        depth=depth,
        label=np.where(triangle >= 0, scene.class_id[triangle], np.uint8(0)),
        instance=np.where(triangle >= 0, scene.instance[triangle], np.int32(-1)),
    )


def _cast_rows(
    scene: Scene, T_world_cam: F64, camera: VirtualCamera, time_s: float, rows: slice
) -> tuple[F32, I32]:
    """Depth along z and number of the triangle at the pixels of some rows."""
    s = camera.spec
    v, u = np.mgrid[rows, 0 : s.width].astype(np.float64)
    x, y = undistort((u - s.cx) / s.fx, (v - s.cy) / s.fy, s.distortion)
    line = np.stack([x, y, np.ones_like(x)], axis=2).reshape(-1, 3)
    length = np.linalg.norm(line, axis=1)
    direction = (line / length[:, None]) @ T_world_cam[:3, :3].T
    hits = cast_at(scene, np.tile(T_world_cam[:3, 3], (len(line), 1)), direction, time_s)
    depth = np.where(hits.triangle >= 0, hits.distance_m / length, np.nan)
    return depth.reshape(x.shape).astype(np.float32), hits.triangle.reshape(x.shape)
