"""Draws the pictures of the virtual worlds for docs/virtual-rig.md, each world in three views: a photograph, the
LiDAR's cloud coloured by class, the world from above.

    .venv/bin/python docs/pictures/worlds.py [WORLD ...]
"""

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from artemis_drivers.virtual.catalogue import worlds
from artemis_drivers.virtual.lidar import Frame, scan
from artemis_drivers.virtual.mesh_builder import CLASS_NAMES

from artemis_edge.frames import F64, I32, U8
from artemis_edge.render import from_above, render
from artemis_edge.session.rig import FRAME_S, T_IMU_LIDAR, Rig, build_rig, read_settings
from artemis_edge.trajectory import inverse

SECONDS, SEED = 40.0, 1
#: At which second of the walk the photograph is taken: where there is much to see.
MOMENTS = {"street": 9.0, "courtyard": 28.5, "hall": 11.0, "corridor": 8.0, "facade": 8.0}
WIDTH, HEIGHT = 640, 512
CLOUD_S = 1.0  # of scanning, up to the moment
WIDEST_M = 80.0  # of the world that is shown from above
CUT_M = 2.2  # above the floor, where worlds with a ceiling are cut open
INDOORS = ("hall", "corridor")
COLOURS = {
    "ground": (150, 150, 150),
    "building": (222, 184, 135),
    "car": (220, 50, 47),
    "person": (255, 0, 200),
    "bench": (140, 86, 75),
    "tree": (44, 160, 44),
    "pole": (255, 215, 0),
    "sign": (0, 191, 255),
    "other": (90, 90, 90),
    "bicycle": (255, 127, 14),
    "backpack": (0, 0, 255),
    "statue": (230, 230, 230),
    "hedge": (110, 139, 61),
    "steps": (188, 143, 230),
    "shelf": (200, 120, 40),
    "glass": (150, 230, 230),
    "pillar": (250, 128, 114),
    "table": (160, 82, 45),
    "chair": (64, 224, 208),
    "railing": (128, 0, 128),
}
BACKGROUND = 24


def palette() -> U8:
    """Colour by class number, RGB."""
    return np.array([(0, 0, 0), *(COLOURS[name] for name in CLASS_NAMES[1:])], np.uint8)


def photograph(rig: Rig, moment: float) -> U8:
    """What the rig's camera takes, BGR."""
    scene = rig.window.at(rig.x_at(moment))
    photo = rig.new_camera().photograph(scene, rig.world.sun, rig.camera_pose, moment, 0)
    return np.asarray(cv2.imdecode(np.frombuffer(photo.data, np.uint8), cv2.IMREAD_COLOR), np.uint8)


def scanned(rig: Rig, moment: float) -> tuple[F64, U8]:
    """Points in world, as measured, and their classes."""
    points, labels = [], []
    for k in range(round((moment - CLOUD_S) / FRAME_S), round(moment / FRAME_S)):
        scene = rig.window.at(rig.x_at(k * FRAME_S))
        beams = rig.sensor.beams(k, 1.0)
        rng = np.random.default_rng([SEED, 41, k])
        frame: Frame = scan(scene, rig.motion, T_IMU_LIDAR, beams, k * FRAME_S, rig.sensor.spec, rng)
        T = rig.motion.pose(k * FRAME_S + frame.offset_ns * 1e-9) @ T_IMU_LIDAR
        points.append(np.einsum("nij,nj->ni", T[:, :3, :3], frame.points) + T[:, :3, 3])
        labels.append(scene.class_id[frame.triangle])
    return np.concatenate(points), np.concatenate(labels)


def cloud(rig: Rig, moment: float) -> U8:
    """The LiDAR's points of the last second as the camera's place sees them, nearer ones larger, BGR."""
    points, labels = scanned(rig, moment)
    local = points @ inverse(rig.camera_pose(moment))[:3, :3].T + inverse(rig.camera_pose(moment))[:3, 3]
    ahead = local[:, 2] > 0.5
    local, labels = local[ahead], labels[ahead]
    u = rig.camera.fx * local[:, 0] / local[:, 2] + rig.camera.cx
    v = rig.camera.fy * local[:, 1] / local[:, 2] + rig.camera.cy
    shade = 0.45 + 0.55 / (1 + (local[:, 2] / 25.0) ** 2)
    colours = (palette()[labels] * shade[:, None]).astype(np.uint8)
    picture = np.full((HEIGHT, WIDTH, 3), BACKGROUND, np.uint8)
    for k in np.argsort(-local[:, 2]):
        x, y = int(u[k]), int(v[k])
        if 0 <= x < WIDTH and 0 <= y < HEIGHT:
            radius = 2 if local[k, 2] < 6 else 1
            cv2.circle(picture, (x, y), radius, colours[k][::-1].tolist(), -1)
    return picture


def above(rig: Rig, moment: float) -> U8:
    """The world around the rig from above by class, lit from the north-west; the walk in white, BGR."""
    place = rig.motion.position(moment)
    mesh = rig.window.at(float(place[0])).mesh
    vertices = mesh.corners().reshape(-1, 3)
    half = np.array([WIDEST_M, WIDEST_M * HEIGHT / WIDTH]) / 2
    low = np.maximum(place[:2] - half, vertices[:, :2].min(axis=0))
    high = np.minimum(place[:2] + half, vertices[:, :2].max(axis=0))
    scale = float(max((high - low) / (WIDTH, HEIGHT)))  # metres a pixel
    middle, half = (low + high) / 2, np.array([WIDTH, HEIGHT]) * scale / 2
    top = place[2] - 1.45 + CUT_M if rig.world.name in INDOORS else 100.0
    low, high = np.append(middle - half, -10.0), np.append(middle + half, top)
    view = from_above(low, high, scale * 1.000001, cull=False)
    cut = replace(view, projection=view.projection._replace(near=0.0))
    _, normal = mesh.areas_and_normals()
    light = 0.55 + 0.45 * np.clip(normal @ np.array([-0.3, 0.4, 0.866]), 0, 1)
    values = np.repeat(palette()[mesh.class_id] * light[:, None], 3, axis=0).astype(np.float32)
    seen = render(cut, vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), values)
    picture = np.where(seen.covered[..., None], seen.values, BACKGROUND).astype(np.uint8)[:, :, ::-1].copy()

    def at(points: F64) -> I32:
        return np.rint((points[..., :2] - low[:2]) / scale * [1, -1] + [0, HEIGHT]).astype(np.int32)

    walk = at(rig.motion.position(np.arange(0, SECONDS, 0.1)))
    cv2.polylines(picture, [walk], False, (255, 255, 255), 2, cv2.LINE_AA)
    cv2.circle(picture, at(place).tolist(), 5, (0, 0, 255), -1, cv2.LINE_AA)
    return picture


def legend(labels: U8) -> U8:
    """Names and colours of the classes that are there."""
    strip = np.full((22, 3 * WIDTH, 3), BACKGROUND, np.uint8)
    x = 8
    for number in np.unique(labels):
        name, colour = CLASS_NAMES[number], palette()[number][::-1].tolist()
        cv2.circle(strip, (x + 5, 11), 5, colour, -1, cv2.LINE_AA)
        cv2.putText(
            strip, name, (x + 14, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (235, 235, 235), 1, cv2.LINE_AA
        )
        x += 30 + cv2.getTextSize(name, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)[0][0]
    return strip


def main() -> None:
    """One picture for each world beside this file."""
    for name in sys.argv[1:] or worlds():
        settings = read_settings({"image_width": str(WIDTH)})
        rig = build_rig(name, SEED, SECONDS, "avia", settings)
        moment = MOMENTS.get(name, SECONDS / 2)
        views = np.concatenate([photograph(rig, moment), cloud(rig, moment), above(rig, moment)], axis=1)
        labels = np.unique(rig.window.at(rig.x_at(moment)).class_id)
        out = Path(__file__).with_name(f"world-{Path(name).stem}.jpg")
        cv2.imwrite(str(out), np.concatenate([views, legend(labels)]), [cv2.IMWRITE_JPEG_QUALITY, 76])
        print(out, out.stat().st_size // 1000, "kB")


if __name__ == "__main__":
    main()
