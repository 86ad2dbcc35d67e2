"""Drift of a virtual session with and without loop closure: python tests/bench/bench_loop.py SESSION [options].

``--drift`` adds a drift to the true poses, ``--no-imu`` leaves the IMU out.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from artemis_edge.config import Config
from artemis_edge.datasets import open_input
from artemis_edge.evaluate.trajectory import evaluate_trajectory
from artemis_edge.frames import F64, ImuSamples, Odometry, SyncedFrame, TrackedFrame, Trajectory
from artemis_edge.loop.corrected import close_loops
from artemis_edge.loop.keyframes import track_all
from artemis_edge.odometry import se3
from artemis_edge.odometry.choice import odometry_for
from artemis_edge.odometry.given_poses import GivenPoses
from artemis_edge.trajectory import interpolate, inverse, read_tum


class Drifting:
    """True poses with 1 cm, 5 mm upwards and 0.1 deg of yaw added a metre."""

    def __init__(self, truth: Trajectory) -> None:
        self._truth, self._last, self._T = GivenPoses(truth), np.eye(4), np.eye(4)

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        tracked = self._truth.track(frame)
        step = inverse(self._last) @ tracked.T_world_lidar
        way = float(np.linalg.norm(step[:3, 3]))
        wrong = way * np.array([0.01, 0, 0.005, 0, 0.0005, np.radians(0.1)])
        self._T, self._last = self._T @ step @ se3.exp(wrong), tracked.T_world_lidar
        return replace(tracked, T_world_lidar=self._T)


def end_drift_m(poses: F64, truth: F64) -> float:
    error = inverse(inverse(truth[0]) @ truth[-1]) @ inverse(poses[0]) @ poses[-1]
    return float(np.linalg.norm(error[:3, 3]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("session", type=Path)
    parser.add_argument("--drift", action="store_true")
    parser.add_argument("--no-imu", action="store_true")
    given = parser.parse_args()
    source = open_input(given.session)
    truth = read_tum(given.session / "truth" / "trajectory.tum")

    def frames() -> Iterator[SyncedFrame]:
        for frame in source.frames():
            yield replace(frame, imu=ImuSamples.empty()) if given.no_imu else frame

    def make() -> Odometry:
        return Drifting(truth) if given.drift else odometry_for(Config().odometry, frames)

    before, _ = track_all(make(), frames())
    start = time.process_time()
    closed = close_loops(make, frames())
    print(f"{closed.sentence()}; {time.process_time() - start:.1f} s of CPU with the odometry")
    after = Trajectory(
        before.stamp_ns, interpolate(closed.correction, before.stamp_ns) @ before.T_world_lidar
    )
    wanted = interpolate(truth, before.stamp_ns)
    for name, poses in (("before", before), ("after", after)):
        drift = end_drift_m(poses.T_world_lidar, wanted)
        print(
            f"{name}: end-point drift {drift:.3f} m, ATE {evaluate_trajectory(poses, truth).ate_rmse_m:.3f} m"
        )


if __name__ == "__main__":
    main()
