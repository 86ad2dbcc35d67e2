"""Photographs of the virtual worlds with the class of every pixel: what the shipped network learns from.

    python training/views.py --out VIEWS [--worlds NAME...] [--seeds A:B] [--views N] [--width PIXELS]

One file ``WORLD-SEED.npz`` a world: ``photo`` uint8 (n, h, w, 3) RGB and ``label`` uint8 (n, h, w), indices of
``CLASS_NAMES``. They are photographs of the virtual rig's camera with all its faults. Two thirds of them are taken on
the walk, the others look at a thing of a class drawn by ``_SOUGHT``, from the same walk. Equal arguments, equal bytes.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from artemis_drivers.virtual.camera import VirtualCamera
from artemis_drivers.virtual.mesh_builder import CLASS_NAMES
from artemis_drivers.virtual.scene import Scene
from numpy.typing import NDArray

from artemis_edge.session.rig import Rig, build_rig, read_settings

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
Rng = np.random.Generator

WIDTH = 640  # pixels; the network's input live
WALK_S = 45.0
#: How often views look for a class, relative to each other; the walk itself shows enough of the others.
_SOUGHT = {
    **{"person": 5.0, "bench": 5.0, "backpack": 5.0, "car": 3.0, "tree": 3.0, "bicycle": 2.0, "chair": 2.0},
    **{"statue": 1.5, "table": 1.0, "shelf": 1.0, "sign": 1.0, "pole": 1.0, "other": 1.0, "hedge": 1.0},
    **{"steps": 1.0, "pillar": 1.0, "railing": 1.0, "glass": 1.0},
}
_NEAREST_M, _FARTHEST_M = 0.9, 10.0  # of things that views look for
_CLEAR_M = 0.35  # views that have a twentieth of their pixels nearer than this stand in something
_STEP_S = 0.25  # of the walk, at which places to look from are tried
_ASIDE_M = np.array([0.25, 0.25, 0.3])
_TURN_DEG = np.array([12.0, 35.0, 8.0])  # about x (up and down), y (left and right) and z of the camera
_TRIES = 20


def render(world: str, seed: int, count: int, width: int = WIDTH) -> tuple[U8, U8]:
    """``count`` photographs, ``width`` pixels across, and their labels."""
    rng = np.random.default_rng([seed, 81])
    # a photograph of 1280 pixels scaled down to this width has this share of its noise
    noise = width / 1280 * rng.uniform(0.7, 1.6)
    texts = {"imu": "off", "image_width": str(width), "image_noise": f"{noise:.3f}"}
    rig = build_rig(world, seed, WALK_S, "avia", read_settings(texts))
    camera = rig.new_camera()
    photos, labels = [], []
    for _ in range(count * _TRIES):
        if len(photos) == count:
            break
        taken = _view(rig, camera, rng, sought=len(photos) % 3 == 2)
        if taken is not None:
            photos.append(taken[0])
            labels.append(taken[1])
    return np.stack(photos), np.stack(labels)


def _view(rig: Rig, camera: VirtualCamera, rng: Rng, sought: bool) -> tuple[U8, U8] | None:
    """One photograph, None when the camera would stand in something."""
    at = rng.uniform(0.0, WALK_S)
    aside = np.eye(4)
    scale = rng.choice([0.4, 1.0])
    aside[:3, :3] = cv2.Rodrigues(np.radians(_TURN_DEG * scale * rng.uniform(-1, 1, 3)))[0]
    aside[:3, 3] = _ASIDE_M * scale * rng.uniform(-1, 1, 3)
    if sought:
        found = _look(rig, rng, at)
        if found is None:
            return None
        at, aside = found
    scene = rig.window.at(rig.x_at(at))
    photo = camera.photograph(scene, rig.world.sun, lambda t: rig.camera_pose(t) @ aside, at, 0)
    triangles, depth = camera.seen()
    if np.quantile(depth, 0.05) < _CLEAR_M:
        return None
    bgr = cv2.imdecode(np.frombuffer(photo.data, np.uint8), cv2.IMREAD_COLOR)
    return np.asarray(bgr[:, :, ::-1], np.uint8), labels_of(scene, triangles)


def labels_of(scene: Scene, triangles: NDArray[np.int32]) -> U8:
    """uint8 (h, w): the class that most quarters of a pixel show, the first of equals."""
    quarters = np.where(triangles >= 0, scene.class_id[triangles], np.uint8(0))
    votes = (quarters[..., :, None] == quarters[..., None, :]).sum(axis=-1)
    best = votes.argmax(axis=-1)
    return np.asarray(np.take_along_axis(quarters, best[..., None], axis=-1)[..., 0], np.uint8)


def _look(rig: Rig, rng: Rng, at: float) -> tuple[float, F64] | None:
    """A moment of the walk and T_walk_cam with a thing of a sought class in view; None when none is near."""
    scene = rig.window.at(rig.x_at(at))
    classes = np.zeros(len(scene.object_centre), np.uint8)
    classes[scene.object_of] = scene.class_id[: len(scene.object_of)]
    there = [name for name in _SOUGHT if np.any(classes == CLASS_NAMES.index(name))]
    weight = np.array([_SOUGHT[name] for name in there])
    name = there[int(rng.choice(len(there), p=weight / weight.sum()))]
    thing = int(rng.choice(np.flatnonzero(classes == CLASS_NAMES.index(name))))
    middle = scene.object_centre[thing] + scene.origin
    times = np.arange(0.0, WALK_S, _STEP_S)
    eyes = rig.motion.position(times)
    away = np.linalg.norm(eyes - middle, axis=1)
    near = times[(away > _NEAREST_M) & (away < _FARTHEST_M)]
    if len(near) == 0:
        return None
    chosen = float(rng.choice(near))
    T = rig.camera_pose(chosen)
    moved = T[:3, 3] + _ASIDE_M * rng.uniform(-1, 1, 3)
    size = min(float(scene.object_radius[thing]), 2.0)
    goal = middle + rng.uniform(-0.7, 0.7, 3) * size
    looking = np.eye(4)
    looking[:3, :3] = _towards(goal - moved, float(rng.normal(0.0, np.radians(4.0))))
    looking[:3, 3] = moved
    return chosen, np.linalg.inv(T) @ looking


def _towards(direction: F64, roll: float) -> F64:
    """R_world_cam of a camera that looks along ``direction``, rolled by ``roll`` radians."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= max(float(np.linalg.norm(x)), 1e-9)
    level = np.column_stack([x, np.cross(z, x), z])
    turned: F64 = level @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    return turned


def main(arguments: Sequence[str] | None = None) -> int:
    """Render what is not there yet."""
    parser = argparse.ArgumentParser(prog="python training/views.py")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--worlds", nargs="+", default=["street", "courtyard", "hall", "bench"])
    parser.add_argument("--seeds", default="10000:10050", help="FIRST:LAST+1")
    parser.add_argument("--views", type=int, default=20, help="photographs a world")
    parser.add_argument("--width", type=int, default=WIDTH, help="pixels of a photograph")
    given = parser.parse_args(arguments)
    first, last = (int(n) for n in given.seeds.split(":"))
    given.out.mkdir(parents=True, exist_ok=True)
    for seed in range(first, last):
        for world in given.worlds:
            path = given.out / f"{world}-{seed}.npz"
            if path.exists():
                continue
            began = time.perf_counter()
            photo, label = render(world, seed, given.views, given.width)
            with path.with_suffix(".part").open("wb") as file:
                np.savez(file, photo=photo, label=label)
            path.with_suffix(".part").rename(path)
            print(f"{path.name}: {len(photo)} views in {time.perf_counter() - began:.1f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
