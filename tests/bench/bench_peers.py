"""CPU of the odometry a frame, beside KISS-ICP and small_gicp on the same points, one frame after the other.

    python tests/bench/bench_peers.py [--avia SESSION] [--kitti DRIVE] [--frames N] [--repeat N]

Without inputs a virtual courtyard is walked with an Avia and a camera, and a street is seen by an HDL-64. All updates
are on. The others (PyPI, their defaults for such data, one thread) register the points alone; they take no IMU and no
image. CPU is that of all threads of the process; the first frames, in which kernels compile and maps begin, are left
out. Several rounds: the median of a frame over the rounds counts.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import small_gicp
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP

from artemis_edge.config import OdometryConfig
from artemis_edge.datasets import open_input
from artemis_edge.frames import F64, FrameSource, SyncedFrame
from artemis_edge.odometry.choice import odometry_for
from artemis_edge.odometry.visual import VisualUpdate
from artemis_edge.session.simulate import simulate

_FIRST = 5  # frames left out
_SETTINGS = {"reference": "false", "mesh": "false", "point_truth": "false"}

#: Registers one frame.
Track = Callable[[SyncedFrame], object]


def ours(source: FrameSource, frames: int, images: bool) -> Track:
    """The odometry as a recording gets it."""

    def seen() -> Iterator[SyncedFrame]:
        return source.frames(0, frames)

    return odometry_for(OdometryConfig(), seen, VisualUpdate() if images else None).track


def kiss_icp() -> Track:
    """KISS-ICP in its default configuration, with the points' times."""
    config = KISSConfig()
    config.mapping.voxel_size = 0.01 * config.data.max_range  # as its own loader does
    odometry = KissICP(config)

    def track(frame: SyncedFrame) -> object:
        scan = frame.scans[0]
        time_s = np.zeros(len(scan.points)) if scan.offset_s is None else scan.offset_s.astype(np.float64)
        span = max(float(np.ptp(time_s)), 1e-9)
        return odometry.register_frame(scan.points.astype(np.float64), (time_s - time_s.min()) / span)

    return track


def gicp() -> Track:
    """GICP of small_gicp against a voxel map that grows, as in its own example of an odometry."""
    target = small_gicp.GaussianVoxelMap(1.0)
    T: list[F64] = []

    def track(frame: SyncedFrame) -> object:
        points, tree = small_gicp.preprocess_points(
            frame.scans[0].points.astype(np.float64), downsampling_resolution=0.25, num_threads=1
        )
        if T:
            guess = T[-1] @ np.linalg.inv(T[-2]) @ T[-1] if len(T) > 1 else T[-1]
            found = small_gicp.align(target, points, guess, max_correspondence_distance=1.0, num_threads=1)
            T.append(found.T_target_source)
        else:
            T.append(np.eye(4))
        target.insert(points, T[-1])
        return tree

    return track


def measure(source: FrameSource, frames: int, repeat: int, makers: dict[str, Callable[[], Track]]) -> str:
    """A row of CPU ms a frame: median and mean of each."""
    spent: dict[str, list[list[float]]] = {name: [] for name in makers}
    for _ in range(repeat):
        tracks = {name: make() for name, make in makers.items()}
        rounds: dict[str, list[float]] = {name: [] for name in makers}
        for frame in source.frames(0, frames):
            for name, track in tracks.items():
                start = time.process_time()
                track(frame)
                rounds[name].append(1e3 * (time.process_time() - start))
        for name, values in rounds.items():
            spent[name].append(values)
    figures = []
    for name, rounds_of in spent.items():
        each = np.median(np.array(rounds_of)[:, _FIRST:], axis=0)
        figures.append(
            f"{name} {np.median(each):5.1f} (mean {each.mean():5.1f}, p95 {np.percentile(each, 95):5.1f})"
        )
    return "; ".join(figures)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--avia", type=Path, help="a session with Avia, IMU and camera")
    parser.add_argument("--kitti", type=Path, help="a KITTI raw drive")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--repeat", type=int, default=3)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="artemis-bench-") as name:
        seconds = given.frames / 10
        avia, kitti = given.avia, given.kitti
        if avia is None:
            avia = simulate("courtyard", 1, seconds, "avia", Path(name) / "avia", _SETTINGS).session
        if kitti is None:
            settings = _SETTINGS | {"camera": "false", "imu": "false", "speed": "3"}
            kitti = simulate("street", 1, min(seconds, 5.0), "hdl64", Path(name) / "kitti", settings).session
        peers: dict[str, Callable[[], Track]] = {"KISS-ICP": kiss_icp, "small_gicp": gicp}
        print("CPU ms a frame, median over frames")
        for what, path, images in (
            ("Avia", avia, False),
            ("Avia + image", avia, True),
            ("KITTI", kitti, False),
        ):
            source = open_input(path)
            makers = {"ours": lambda source=source, images=images: ours(source, given.frames, images)}
            print(f"{what:<14}{measure(source, given.frames, given.repeat, makers | peers)}", flush=True)


if __name__ == "__main__":
    main()
