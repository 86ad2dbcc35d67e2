"""Mounts and clocks disturbed in memory and recovered: python tests/bench/bench_calibrate.py SESSION [options].

Prints how far the refined mounts are from the recording's own, which are exact in a virtual session.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from artemis_edge.calibrate.mounts import CalibratedSource, CameraMount, ImuMount, Mounts
from artemis_edge.calibrate.refine import refine
from artemis_edge.calibrate.session import open_for_calibration
from artemis_edge.frames import F64, FrameSource
from artemis_edge.odometry import se3
from artemis_edge.trajectory import inverse


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("session", type=Path)
    parser.add_argument("--poses", type=Path)
    parser.add_argument("--deg", type=float, default=2.0)
    parser.add_argument("--cm", type=float, default=5.0)
    parser.add_argument("--ms", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    source, make = open_for_calibration(given.session, None, given.poses, False)
    own = _mounts(source)
    rng = np.random.default_rng(given.seed)
    wrong = {
        name: CameraMount(se3.exp(_twist(rng, given.deg, given.cm)) @ T, given.ms / 1e3)
        for name, T in own.items()
    }
    turn = Rotation.from_rotvec(_twist(rng, given.deg, 0.0)[3:]).as_matrix()
    disturbed = CalibratedSource(source, Mounts(wrong, ImuMount(turn, given.ms / 1e3)))
    found = refine(disturbed, make, lambda done, total: None)
    result = {"imu": None, "cameras": {}, "changed": found.changed}
    if found.imu_fit is not None:
        left = found.mounts.imu.R @ turn
        result["imu"] = {
            "deg": float(np.degrees(Rotation.from_matrix(left).magnitude())),
            "ms": 1e3 * (found.mounts.imu.time_offset_s + given.ms / 1e3),
        }
    for name, T in own.items():
        mount = found.mounts.cameras.get(name)
        C = wrong[name].T_cam_lidar if mount is None else mount.T_cam_lidar
        offset = wrong[name].time_offset_s + (0.0 if mount is None else mount.time_offset_s)
        result["cameras"][name] = {
            "deg": float(np.degrees(np.linalg.norm(se3.log(C @ inverse(T))[3:]))),
            "mm": float(1e3 * np.linalg.norm(C[:3, 3] - T[:3, 3])),
            "ms": 1e3 * offset,
        }
    print(json.dumps(result, indent=1))


def _mounts(source: FrameSource) -> dict[str, F64]:
    found: dict[str, F64] = {}
    for frame in source.frames(0, 20):
        found |= {image.name: image.T_cam_lidar for image in frame.images}
    return found


def _twist(rng: np.random.Generator, deg: float, cm: float) -> F64:
    """A displacement of exactly that size in a random direction."""
    x = rng.normal(size=6)
    x[:3] *= cm / 100 / np.linalg.norm(x[:3])
    x[3:] *= np.radians(deg) / np.linalg.norm(x[3:])
    return x


if __name__ == "__main__":
    main()
