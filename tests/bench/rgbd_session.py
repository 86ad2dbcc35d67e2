"""An RGB-D recording (7-Scenes layout) as a session: python tests/bench/rgbd_session.py FOLDER SESSION.mcap

FOLDER holds ``camera-intrinsics.txt`` (3 x 3, of colour and depth) and for each frame ``frame-N.color.jpg``,
``.depth.png`` (uint16 mm; 0 and 65535: nothing) and ``.pose.txt`` (T_world_cam). Every second depth pixel each way
becomes a point; the session's world has z up where the first camera has -y. Frames are given a tenth of a second each,
whatever time lay between.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from artemis_edge.frames import F32, F64, CameraModel
from artemis_edge.session.writer import SessionWriter

_PERIOD_NS = 100_000_000
_FIRST_NS = 1_000_000_000_000
_STEP_PX = 2
_UP = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def points_of(depth_mm: np.ndarray[tuple[int, int], np.dtype[np.uint16]], K: F64) -> F32:
    """Points (n, 3) in camera coordinates [m]."""
    v, u = np.mgrid[0 : depth_mm.shape[0] : _STEP_PX, 0 : depth_mm.shape[1] : _STEP_PX]
    z = depth_mm[::_STEP_PX, ::_STEP_PX]
    known = (z > 0) & (z < 65535)
    z_m = z[known] * 1e-3
    x, y = (u[known] - K[0, 2]) / K[0, 0] * z_m, (v[known] - K[1, 2]) / K[1, 1] * z_m
    return np.stack([x, y, z_m], axis=1).astype(np.float32)


def main() -> None:
    folder, session = Path(sys.argv[1]), Path(sys.argv[2])
    K = np.loadtxt(folder / "camera-intrinsics.txt")
    frames = sorted(path.name.split(".")[0] for path in folder.glob("frame-*.pose.txt"))
    with SessionWriter(session) as writer:
        writer.write_tf_static(_FIRST_NS, "lidar", "cam", np.eye(4))
        for k, frame in enumerate(frames):
            stamp = _FIRST_NS + k * _PERIOD_NS
            depth = np.asarray(cv2.imread(str(folder / f"{frame}.depth.png"), cv2.IMREAD_UNCHANGED))
            colour = (folder / f"{frame}.color.jpg").read_bytes()
            height, width = depth.shape
            model = CameraModel(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
            writer.write_tf(stamp, "world", "lidar", _UP @ np.loadtxt(folder / f"{frame}.pose.txt"))
            writer.write_camera_info(stamp, model)
            writer.write_image(stamp, colour)
            writer.write_points(stamp, points_of(depth, K))


if __name__ == "__main__":
    main()
