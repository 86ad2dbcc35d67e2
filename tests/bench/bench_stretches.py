"""Relative error on a KITTI raw drive beside KISS-ICP, and who is right.

    python tests/bench/bench_stretches.py DRIVE REFERENCE.tum

Poses of ours and of KISS-ICP (PyPI, default configuration, with and without the points' times) over the same scans,
against the reference, and against scans 10 m apart that are registered to each other directly, from the reference and
from ours (small_gicp, points to planes): a chain of neighbours may drift, a single step cannot.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import small_gicp
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP

from artemis_edge.config import OdometryConfig
from artemis_edge.datasets import open_input
from artemis_edge.frames import F64, SyncedFrame
from artemis_edge.odometry import se3
from artemis_edge.odometry.deskew import deskew_frame
from artemis_edge.odometry.lidar_odometry import LidarOdometry
from artemis_edge.odometry.scan_motion import steady
from artemis_edge.trajectory import read_tum

_STRETCH_M = 10.0
_NEAR_M, _FAR_M = 3.0, 80.0
_SPACING_M, _REACH_M = 0.2, 0.5


def ours(frames: list[SyncedFrame]) -> F64:
    """Poses (n, 4, 4) as a recording gets them, LiDAR alone."""
    odometry = LidarOdometry.looking_ahead(OdometryConfig(), frames)
    return np.array([odometry.track(frame).T_world_lidar for frame in frames])


def kiss_icp(frames: list[SyncedFrame], times: bool) -> F64:
    """Poses (n, 4, 4); without times its de-skewing has nothing to do."""
    config = KISSConfig()
    config.mapping.voxel_size = 0.01 * config.data.max_range  # as its own loader does
    odometry, poses = KissICP(config), []
    for frame in frames:
        scan = frame.scans[0]
        at = np.zeros(len(scan.points))
        if times and scan.offset_s is not None:
            at = (scan.offset_s.astype(np.float64) - scan.offset_s.min()) / np.ptp(scan.offset_s)
        odometry.register_frame(scan.points.astype(np.float64), at if times else np.empty(0))
        poses.append(odometry.last_pose.copy())
    return np.array(poses)


def stretches(poses: F64) -> list[tuple[int, int]]:
    """First and last frame of every stretch of 10 m."""
    way = np.append(0.0, np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).cumsum())
    ends = np.searchsorted(way, way + _STRETCH_M)
    return [(i, int(j)) for i, j in enumerate(ends) if j < len(way)]


def percent(poses: F64, true: dict[tuple[int, int], F64]) -> F64:
    """Errors of the stretches in per cent of their length."""
    off = [
        np.linalg.norm((se3.inverse(T) @ se3.inverse(poses[i]) @ poses[j])[:3, 3])
        for (i, j), T in true.items()
    ]
    return 100.0 * np.array(off) / _STRETCH_M


def direct(frames: list[SyncedFrame], poses: F64, guess: F64, i: int, j: int) -> F64:
    """T_i_j (4, 4) by registering scan j to scan i, each de-skewed by the motion around it."""
    clouds = []
    for k in (i, j):
        a, b = max(k - 1, 0), min(k + 1, len(frames) - 1)
        elapsed_s = (frames[b].stamp_ns - frames[a].stamp_ns) * 1e-9
        twist = se3.log(se3.inverse(poses[a]) @ poses[b]) / elapsed_s
        points = deskew_frame(frames[k], steady(twist))[0].points.astype(np.float64)
        away = np.linalg.norm(points, axis=1)
        clouds.append(points[(away > _NEAR_M) & (away < _FAR_M)])
    (target, tree), (source, _) = (small_gicp.preprocess_points(c, _SPACING_M, num_threads=1) for c in clouds)
    found = small_gicp.align(
        target, source, tree, se3.inverse(guess[i]) @ guess[j], registration_type="PLANE_ICP",
        max_correspondence_distance=_REACH_M, max_iterations=60, num_threads=1,
    )  # fmt: skip
    return np.asarray(found.T_target_source, np.float64)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("reference", type=Path)
    given = parser.parse_args()
    frames, reference = list(open_input(given.drive).frames()), read_tum(given.reference).T_world_lidar
    found = {
        "ours": ours(frames),
        "KISS-ICP with times": kiss_icp(frames, True),
        "KISS-ICP without": kiss_icp(frames, False),
        "reference": reference,
    }
    pairs = stretches(reference)
    said = {(i, j): se3.inverse(reference[i]) @ reference[j] for i, j in pairs}
    begun = {
        name: {p: direct(frames, found["ours"], found[name], *p) for p in pairs}
        for name in ("reference", "ours")
    }
    apart = [np.linalg.norm((begun["reference"][p] - begun["ours"][p])[:3, 3]) for p in pairs]
    print(
        f"{len(pairs)} stretches; registered from two guesses they differ by {1e3 * max(apart):.0f} mm at most"
    )
    for name, poses in found.items():
        a, b = percent(poses, said), percent(poses, begun["reference"])
        print(
            f"{name:<20} against the reference {a.mean():.2f} % ({a[1:].mean():.2f} but for the first), "
            f"against direct registration {b.mean():.2f} % ({b[1:].mean():.2f})"
        )


if __name__ == "__main__":
    main()
