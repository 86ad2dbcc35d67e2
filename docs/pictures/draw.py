"""Draws demo.png, the picture of the README, from what `make demo` wrote.

.venv/bin/python docs/pictures/draw.py demo-out
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from artemis_edge.export.ply import read_mesh
from artemis_edge.frames import F64, CameraModel
from artemis_edge.render import perspective, render, write_png

WIDTH, HEIGHT, FINER = 1200, 540, 2
EYE, TARGET = np.array([-2.0, 0.0, 4.5]), np.array([25.0, 0.0, -1.0])
SUN = np.array([0.35, 0.5, 0.8])
LOW, HIGH = np.array([196.0, 206.0, 214.0]), np.array([246.0, 214.0, 168.0])  # colours of street and roofs
HIGH_M = 9.0
SKY = np.array([250.0, 250.0, 248.0])


def looking_at(eye: F64, target: F64) -> F64:
    """T_world_cam of an upright camera."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :4] = np.stack([x, np.cross(z, x), z, eye], axis=1)
    return T


def main() -> None:
    """Write the picture beside this file."""
    mesh = read_mesh(Path(sys.argv[1]) / "mesh.ply")
    width, height, f = WIDTH * FINER, HEIGHT * FINER, 800.0 * FINER
    camera = CameraModel(width, height, f, f, width / 2, 0.42 * height)
    values = np.concatenate([mesh.normals, mesh.vertices[:, 2:]], axis=1)
    seen = render(perspective(camera, looking_at(EYE, TARGET)), mesh.vertices, mesh.faces, values)
    normal = seen.values[..., :3] / np.maximum(
        np.linalg.norm(seen.values[..., :3], axis=2, keepdims=True), 1e-6
    )
    light = 0.45 + 0.55 * (0.5 + 0.5 * (normal @ (SUN / np.linalg.norm(SUN))))
    share = np.clip((seen.values[..., 3:] + 1.5) / HIGH_M, 0.0, 1.0)
    image = np.where(seen.covered[..., None], (LOW + (HIGH - LOW) * share) * light[..., None], SKY)
    small = cv2.resize(image.astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    write_png(Path(__file__).with_name("demo.png"), small.astype(np.uint8))


if __name__ == "__main__":
    main()
