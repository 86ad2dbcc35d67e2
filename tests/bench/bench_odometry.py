"""CPU time and drift of the odometry on a recording.

    python tests/bench/bench_odometry.py INPUT [--poses FILE.tum] [--no-imu] [--every N] [--set field=value]

Prints CPU ms a frame (all threads, file reading excluded, the first two frames apart because kernels compile
there), frames lost, and with poses (given, or of the input) the errors of ``evaluate trajectory``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from artemis_edge.config import load
from artemis_edge.datasets import open_input
from artemis_edge.evaluate.trajectory import evaluate_trajectory, to_text
from artemis_edge.frames import FrameSource, ImuSamples, SyncedFrame, Trajectory
from artemis_edge.odometry.choice import OwnOdometry, odometry_for
from artemis_edge.trajectory import read_tum

Frames = Callable[[], Iterator[SyncedFrame]]


def measure(source: FrameSource, odometry: OwnOdometry, frames: Frames) -> Trajectory:
    stamps, poses, cpu_ms, degenerate = [], [], [], 0
    for frame in frames():
        start = time.process_time()
        tracked = odometry.track(frame)
        cpu_ms.append((time.process_time() - start) * 1e3)
        stamps.append(tracked.stamp_ns)
        poses.append(tracked.T_world_lidar)
        degenerate += tracked.degenerate
    steady = np.array(cpu_ms[2:])
    p50, p99 = np.percentile(steady, [50, 99])
    print(
        f"{source.name}: {len(stamps)} frames, CPU ms a frame p50 {p50:.1f} p99 {p99:.1f} "
        f"mean {steady.mean():.1f}, first two {sum(cpu_ms[:2]):.0f}, "
        f"degenerate {degenerate}, lost {odometry.lost}"
    )
    return Trajectory(np.array(stamps, np.int64), np.array(poses))


def main() -> None:
    parser = argparse.ArgumentParser(description="CPU time and drift of the odometry on a recording")
    parser.add_argument("input", type=Path)
    parser.add_argument("--poses", type=Path)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--no-imu", action="store_true")
    parser.add_argument("--every", type=int, default=1, help="only every so many frames")
    parser.add_argument("--first", type=int, default=0, help="and of those the ones from this on")
    parser.add_argument("--set", action="append", default=[], metavar="field=value")
    options = parser.parse_args()
    config = load(sets=[f"odometry.{text}" for text in options.set])
    source = open_input(options.input)

    def frames() -> Iterator[SyncedFrame]:
        for k, frame in enumerate(source.frames(0, options.frames)):
            if k % options.every == options.first:
                yield replace(frame, imu=ImuSamples.empty()) if options.no_imu else frame

    estimate = measure(source, odometry_for(config.odometry, frames), frames)
    reference = read_tum(options.poses) if options.poses else source.poses
    if reference is not None:
        print(to_text(evaluate_trajectory(estimate, reference)))


if __name__ == "__main__":
    main()
