"""Readers: whatever the input, a FrameSource of SyncedFrames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from artemis_edge.calibrate.mounts import CalibratedSource, Mounts
from artemis_edge.changed_source import ChangedSource
from artemis_edge.config import ExclusionConfig, InputConfig
from artemis_edge.datasets.kitti import open_odometry, open_raw
from artemis_edge.datasets.rosbag import RosbagSource, bag_files
from artemis_edge.devices.calibration import read_calibration
from artemis_edge.errors import InputError
from artemis_edge.exclusion import Zones
from artemis_edge.frames import FrameSource, Trajectory

_KINDS = "a session or ROS bag (.mcap, .db3, .bag) or a KITTI folder (with velodyne or velodyne_points)"


def open_input(
    path: Path, config: InputConfig | None = None, exclusion: ExclusionConfig | None = None
) -> FrameSource:
    """The frames of a recording or data set, recognised by what it holds; ``config`` chooses topics of a bag.

    Points in the zones of ``exclusion`` are left out. Raises InputError, one sentence, if there is nothing at the path
    that can be read.
    """
    zones = Zones.of(exclusion or ExclusionConfig())
    source = _opened(path, config)
    return ChangedSource(source, zones.applied) if zones else source


def _opened(path: Path, config: InputConfig | None) -> FrameSource:
    opener = _opener(path)
    if opener is None:
        raise InputError(_unknown(path))
    source = RosbagSource(path, config) if opener is RosbagSource else opener(path)
    if config is None or not config.calibration:
        return source
    calibration = read_calibration(Path(config.calibration))
    return CalibratedSource(source, Mounts.of(calibration, source))


def lidar_poses(source: FrameSource, given: Trajectory) -> Trajectory:
    """Given poses as those of the primary LiDAR: see ``RosbagSource.lidar_poses``."""
    while isinstance(source, ChangedSource):
        source = source.source
    return source.lidar_poses(given) if isinstance(source, RosbagSource) else given


def _opener(path: Path) -> Callable[[Path], FrameSource] | None:
    if (path / "velodyne_points").is_dir():
        return open_raw
    if (path / "velodyne").is_dir():
        return open_odometry
    return RosbagSource if bag_files(path) else None


def _unknown(path: Path) -> str:
    if not path.exists():
        return f"there is no {path}; give {_KINDS}"
    entries = sorted(path.iterdir()) if path.is_dir() else []
    if not entries:
        return f"{path} is empty; give {_KINDS}"
    inner = [entry for entry in entries if entry.is_dir() and _opener(entry) is not None]
    if inner:
        return f"{path} is not itself a recording but holds {len(inner)}; give {inner[0]}"
    return f"{path} is no data set; give {_KINDS}"
