"""Draws demo.png, the picture of the README, from what `make demo` wrote: the textured map, and what was asked for.

.venv/bin/python docs/pictures/draw.py demo-out
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from artemis_edge.frames import F64, CameraModel
from artemis_edge.opened_map import open_map
from artemis_edge.render import perspective, render, render_coloured, write_png

WIDTH, HEIGHT, FINER = 1200, 540, 2
EYE, TARGET = np.array([-2.0, 0.0, 4.5]), np.array([25.0, 0.0, -1.0])
SKY = np.array([250.0, 250.0, 248.0])
ASKED = {"car": (255.0, 120.0, 0.0), "tree": (0.0, 220.0, 120.0)}
GLOW = 0.55  # share of the highlight's colour
LIGHTER = 1.3  # the virtual camera exposes for the sky


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
    mesh, atlas = open_map(Path(sys.argv[1]))
    width, height, f = WIDTH * FINER, HEIGHT * FINER, 800.0 * FINER
    camera = CameraModel(width, height, f, f, width / 2, 0.42 * height)
    T_world_cam = looking_at(EYE, TARGET)
    seen = render_coloured(mesh, atlas, camera, T_world_cam)
    image = np.where(seen.covered[..., None], np.minimum(seen.values * LIGHTER, 255.0), SKY)
    numbers = {name: label for label, name in mesh.label_names.items()}
    for name, colour in ASKED.items():
        if name in numbers:
            is_it = (mesh.labels == numbers[name]).astype(np.float32)[:, None]
            marked = render(perspective(camera, T_world_cam), mesh.vertices, mesh.faces, is_it)
            share = GLOW * marked.values
            image = image * (1.0 - share) + np.array(colour) * share
    small = cv2.resize(image.astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    write_png(Path(__file__).with_name("demo.png"), small.astype(np.uint8))


if __name__ == "__main__":
    main()
