"""A small recording of our own: a room, a rig that moves a little, one camera, an IMU."""

from pathlib import Path

import cv2
import numpy as np

from artemis_edge.frames import U8, CameraModel
from artemis_edge.session.writer import SessionWriter

SECOND = 10**9
START = 1_000 * SECOND
FRAME = SECOND // 10
MODEL = CameraModel(64, 48, 50.0, 50.0, 32.0, 24.0)
# camera axes (z forward, y down) in those of the LiDAR
T_LIDAR_CAM = np.array([[0, 0, 1, 0.03], [-1, 0, 0, 0], [0, -1, 0, -0.06], [0, 0, 0, 1.0]])
SPEED = 0.3  # m/s along x


def room(rng: np.random.Generator, count: int) -> np.ndarray:
    """Points on the walls and the floor of a room of 10 x 8 x 4 m with a box in it."""
    points = rng.uniform([-5, -4, -1.5], [5, 4, 2.5], (count, 3))
    side = rng.integers(0, 5, count)
    for number, (axis, value) in enumerate([(0, 5.0), (0, -5.0), (1, 4.0), (1, -4.0), (2, -1.5)]):
        points[side == number, axis] = value
    box = rng.random(count) < 0.1
    points[box] = rng.uniform([2, 1, -1.5], [3, 2, 0], (int(box.sum()), 3))
    points[box, 0] = 2.0
    return points


def write(
    path: Path, frames: int = 20, points: int = 4000, camera: bool = True, photograph: U8 | None = None
) -> Path:
    """The session at ``path`` (a folder); ``photograph`` is what the camera sees, BGR, else noise."""
    rng = np.random.default_rng(7)
    picture = rng.integers(0, 255, (MODEL.height, MODEL.width, 3)).astype(np.uint8)
    if photograph is not None:
        picture[:] = cv2.resize(photograph, (MODEL.width, MODEL.height), interpolation=cv2.INTER_AREA)
    with SessionWriter(path / "session.mcap") as out:
        out.write_tf_static(START, "lidar", "cam", T_LIDAR_CAM)
        out.write_tf_static(START, "lidar", "imu", np.eye(4))
        out.write_camera_info(START, MODEL)
        for k in range(frames):
            stamp = START + k * FRAME
            for sample in range(20):
                at = stamp + sample * FRAME // 20
                out.write_imu(at, np.zeros(3), np.array([0.0, 0.0, 9.81]))
            if camera:
                picture[:] = np.roll(picture, 1, axis=1)
                encoded = cv2.imencode(".jpg", picture)[1].tobytes()
                middle = stamp + FRAME // 2
                out.write_exposure(middle, 0.004, 1.0, receive_ns=middle + 20_000_000)
                out.write_image(middle, encoded, receive_ns=middle + 20_000_000)
            offset = np.sort(rng.choice(24_000, points, replace=False)) * (1e9 / 240_000)
            seen = room(rng, points)
            seen[:, 0] -= SPEED * (k * FRAME + offset) / SECOND
            out.write_points(
                stamp,
                seen.astype(np.float32),
                intensity=np.full(points, 0.5, np.float32),
                offset_ns=np.rint(offset).astype(np.uint32),
                receive_ns=stamp + FRAME,
            )
    return path
