"""A small textured world for tests: a box with a picture on every side, as Mesh and Atlas."""

import numpy as np

from artemis_edge.export.atlas import UNTEXTURED, Atlas
from artemis_edge.export.mesh import Mesh, bare_mesh
from artemis_edge.frames import U8


def smooth_picture(rows: int, columns: int, seed: int) -> U8:
    """Colours that change slowly enough for bilinear sampling to follow, different in every corner."""
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    rng = np.random.default_rng(seed)
    waves = rng.uniform(1.0, 4.0, (3, 2))
    phase = rng.uniform(0, 6, 3)
    picture = 128 + 100 * np.sin(u[..., None] * waves[:, 0] * 3 + v[..., None] * waves[:, 1] * 3 + phase)
    return np.rint(picture).clip(0, 255).astype(np.uint8)


def square_room(size_m: float = 2.0, pixels: int = 64) -> tuple[Mesh, Atlas]:
    """Four walls and a floor around the origin, seen from inside, on two pages; the floor has no texture.

    World z is up. Wall k looks towards the middle; on its page its left upper corner is at (4, 4).
    """
    s = size_m
    h = 0.35 * s
    wall = np.array([[s, s, h], [s, -s, h], [s, -s, -h], [s, s, -h]])  # upper left, upper right, lower ...
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # to the right, as one looks around
    vertices, faces, page, uv, pages = [], [], [], [], []
    for k in range(4):
        base = 4 * k
        vertices.append(wall @ np.linalg.matrix_power(turn, k).T)
        faces += [[base, base + 2, base + 1], [base, base + 3, base + 2]]
        left, upper = 4.0 + (pixels + 8) * (k % 2), 4.0
        right, lower = left + pixels - 1, upper + pixels - 1
        corner = [(left, upper), (right, upper), (right, lower), (left, lower)]
        uv += [[corner[0], corner[2], corner[1]], [corner[0], corner[3], corner[2]]]
        page += [k // 2] * 2
    for k in range(2):
        pages.append(smooth_picture(pixels + 8, 2 * (pixels + 8), k))
    vertices.append(np.array([[s, s, -h], [s, -s, -h], [-s, -s, -h], [-s, s, -h]]))
    faces += [[16, 18, 17], [16, 19, 18]]
    page += [UNTEXTURED] * 2
    uv += [[(0.0, 0.0)] * 3] * 2
    colours = np.full((20, 3), 90, np.uint8)
    colours[16:] = [[250, 10, 10], [10, 250, 10], [10, 10, 250], [250, 250, 10]]
    mesh = bare_mesh(np.concatenate(vertices), np.array(faces, np.int32), colours=colours)
    return mesh, Atlas(tuple(pages), np.array(page, np.int32), np.array(uv, np.float32), padding=4)
