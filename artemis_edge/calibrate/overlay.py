"""A photograph of each camera with the silhouettes of the LiDAR: red as mounted before, green as refined."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from artemis_edge.calibrate.camera import CameraFit
from artemis_edge.calibrate.edges import silhouettes
from artemis_edge.calibrate.material import Camera, Material
from artemis_edge.calibrate.mounts import CameraMount
from artemis_edge.export.atomic import write_bytes
from artemis_edge.frames import F64, U8

_BEFORE, _AFTER = (60, 60, 255), (80, 255, 80)
_ENLARGED = 2
_TRIED = 8  # photographs of which the one with most silhouettes is drawn


def write_overlay(path: Path, material: Material, fits: dict[str, CameraFit | None]) -> bool:
    """Write a PNG, one photograph a camera from top to bottom; False if there is nothing to draw."""
    drawn = [
        picture
        for name, fit in sorted(fits.items())
        if fit is not None
        for picture in [_draw(material, material.cameras[name], fit)]
        if picture is not None
    ]
    if not drawn:
        return False
    width = max(picture.shape[1] for picture in drawn)
    padded = [np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0))) for p in drawn]
    done, data = cv2.imencode(".png", np.vstack(padded))
    if done:
        write_bytes(path, bytes(data))
    return bool(done)


def _draw(material: Material, camera: Camera, fit: CameraFit) -> U8 | None:
    T_lidar_world, _, known = material.views_of(camera, fit.mount.time_offset_s)
    every = max(len(known) // _TRIED, 1)
    best = None
    for n in range(0, len(known), every):
        photograph = camera.photographs[known[n]]
        points = material.around(photograph.stamp_ns)
        rims = silhouettes(camera.size, photograph.K, fit.mount.T_cam_lidar @ T_lidar_world[n], points)
        if best is None or len(rims.points) > len(best[1]):
            best = n, rims.points
    if best is None or len(best[1]) == 0:
        return None
    n, points = best
    photograph = camera.photographs[known[n]]
    grey = cv2.resize(photograph.levels[0], None, fx=_ENLARGED, fy=_ENLARGED)
    picture = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)
    for T_cam_lidar, colour in ((camera.T_cam_lidar, _BEFORE), (fit.mount.T_cam_lidar, _AFTER)):
        _dots(picture, photograph.K, CameraMount(T_cam_lidar).T_cam_lidar @ T_lidar_world[n], points, colour)
    return picture


def _dots(picture: U8, K: F64, T_cam_world: F64, points: F64, colour: tuple[int, int, int]) -> None:
    p = points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    p = p[p[:, 2] > 0.1]
    u, v = K[0] * p[:, 0] / p[:, 2] + K[2], K[1] * p[:, 1] / p[:, 2] + K[3]
    for x, y in zip(u, v, strict=True):
        cv2.circle(picture, (int(_ENLARGED * (x + 0.5)), int(_ENLARGED * (y + 0.5))), 1, colour, -1)
