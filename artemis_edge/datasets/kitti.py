"""KITTI odometry sequences and KITTI raw drives (Geiger et al., "Vision meets Robotics", IJRR 2013).

A raw scan is one turn of an HDL-64E that spins clockwise seen from above and starts and ends looking
backward; its stamp is the middle of the turn, when it looks forward. Odometry scans have already been freed
of the vehicle's motion. Both stand in the Velodyne's frame: x forward, y left, z up.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from artemis_edge.datasets.common import (
    SECOND_NS,
    add_counts,
    full_intensity,
    imu_between,
    median_interval_ns,
    read_lines,
    split_imu,
    unit_intensity,
    valid_returns,
)
from artemis_edge.datasets.kitti_calibration import (
    odometry_cameras,
    odometry_T_cam_velo,
    raw_cameras,
    raw_imu_mounting,
)
from artemis_edge.datasets.kitti_files import (
    ImageFolder,
    Picture,
    ScanFiles,
    pair_images,
    read_bin,
    read_datetimes,
    read_times,
)
from artemis_edge.errors import InputError
from artemis_edge.frames import F32, F64, I64, CameraImage, ImuSamples, LidarScan, SyncedFrame, Trajectory
from artemis_edge.trajectory import inverse

# The HDL-64E of KITTI turns at 9.65 Hz.
_NOMINAL_TURN_S = 0.1036
# Intervals and turns outside of this are not those of a scanner at about 10 Hz (every second scan, a gap).
_TURN_S = (0.05, 0.15)
# Columns of an OXTS row: accelerations ax ay az, angular rates wx wy wz, in the axes of the vehicle's IMU.
_OXTS_ACCEL, _OXTS_GYRO, _OXTS_COLUMNS = slice(11, 14), slice(17, 20), 30


@dataclass
class KittiSource:
    """FrameSource of either kind: one frame a scan.

    ``turn_s`` (n,) is the duration of each turn, None for scans without motion. ``stamp_ns`` (n,) are the
    stamps of all frames. ``lost`` counts by file, each frame's own ``lost`` by point.
    """

    name: str
    scans: list[Path]
    stamp_ns: I64
    turn_s: F64 | None
    pictures: list[list[Picture]]
    imu: ImuSamples = field(default_factory=ImuSamples.empty)
    poses: Trajectory | None = None
    lost: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        interval = median_interval_ns(self.stamp_ns)
        self.input_hz = SECOND_NS / interval if interval else 1.0 / _NOMINAL_TURN_S
        half_turn = np.zeros(len(self)) if self.turn_s is None else 0.5 * self.turn_s
        starts = self.stamp_ns - (half_turn * SECOND_NS).astype(np.int64)
        self._imu_bounds = split_imu(self.imu.stamp_ns, starts)
        self._full_intensity = full_intensity(read_bin(self.scans[0])[:, 3])

    def __len__(self) -> int:
        return len(self.scans)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[SyncedFrame]:
        """Frames ``start <= index < stop`` in order of time; a file is read when its frame is asked for."""
        for index in range(*slice(start, stop).indices(len(self))):
            scan, lost = self._scan(index)
            imu = imu_between(self.imu, self._imu_bounds[index], self._imu_bounds[index + 1])
            scans = (scan,) if len(scan.points) else ()
            yield SyncedFrame(index, scan.stamp_ns, scans, self._images(index), imu, lost)

    def _scan(self, index: int) -> tuple[LidarScan, dict[str, int]]:
        raw = read_bin(self.scans[index])
        keep, lost = valid_returns(raw[:, :3])
        raw = raw if keep is None else raw[keep]
        points = np.ascontiguousarray(raw[:, :3])
        offset = None if self.turn_s is None else turn_offset_s(points, float(self.turn_s[index]))
        intensity = unit_intensity(raw[:, 3], self._full_intensity)
        return LidarScan(points, int(self.stamp_ns[index]), offset, intensity), lost

    def _images(self, index: int) -> tuple[CameraImage, ...]:
        return tuple(
            CameraImage(p.camera.name, p.stamp_ns, p.path.read_bytes(), p.camera.model, p.camera.T_cam_lidar)
            for p in self.pictures[index]
        )


def turn_offset_s(points: F32, turn_s: float) -> F32:
    """Time (n,) of each point relative to the middle of a clockwise turn that begins looking backward."""
    angle: F32 = np.arctan2(points[:, 1], points[:, 0])
    angle *= np.float32(-0.5 * turn_s / np.pi)
    return angle


def open_odometry(path: Path) -> KittiSource:
    """A KITTI odometry sequence: ``velodyne/*.bin``, ``times.txt``, ``calib.txt``, ``image_2``, ``image_3``.

    All but the scans may be missing. Poses are taken from ``../../poses/NAME.txt`` where that exists. Raises
    InputError if there is no scan or a file does not hold what its name promises.
    """
    scans = ScanFiles(path / "velodyne")
    stamp_ns = scans.stamps(read_times(path / "times.txt", scans), path / "times.txt")
    cameras = odometry_cameras(path, scans.warnings)
    pictures = pair_images([ImageFolder(camera, path / camera.name) for camera in cameras], scans, stamp_ns)
    poses = _odometry_poses(path, scans, stamp_ns)
    name = path.resolve().name
    return KittiSource(
        name, scans.paths, stamp_ns, None, pictures, poses=poses, lost=scans.lost, warnings=scans.warnings
    )


def open_raw(path: Path) -> KittiSource:
    """A KITTI raw drive: ``velodyne_points``, optional ``image_02``, ``image_03`` and ``oxts``.

    Calibration files stand in the folder of the day, above the drive. Stamps count from the first row of
    ``velodyne_points/timestamps.txt``. Raises InputError like ``open_odometry``.
    """
    folder, day = path / "velodyne_points", path.resolve().parent
    scans = ScanFiles(folder / "data")
    times = read_datetimes(folder / "timestamps.txt")
    origin = int(times[0])
    stamp_ns = scans.stamps(times, folder / "timestamps.txt") - origin
    cameras = raw_cameras(path, day, scans.warnings)
    folders = [ImageFolder(c, path / c.name / "data", _image_times(path / c.name, origin)) for c in cameras]
    return KittiSource(
        path.resolve().name,
        scans.paths,
        stamp_ns,
        _turns(folder, scans, stamp_ns),
        pair_images(folders, scans, stamp_ns),
        _read_oxts(path / "oxts", origin, raw_imu_mounting(day), scans),
        lost=scans.lost,
        warnings=scans.warnings,
    )


def _turns(folder: Path, scans: ScanFiles, stamp_ns: I64) -> F64:
    """Duration of each scan's turn in seconds."""
    first, last = folder / "timestamps_start.txt", folder / "timestamps_end.txt"
    interval = median_interval_ns(stamp_ns)
    usual = _NOMINAL_TURN_S if interval is None else interval / SECOND_NS
    usual = usual if _TURN_S[0] <= usual <= _TURN_S[1] else _NOMINAL_TURN_S
    if not (first.is_file() and last.is_file()):
        return np.full(len(stamp_ns), usual)
    starts, ends = (scans.stamps(read_datetimes(file), file) for file in (first, last))
    turns = (ends - starts) / SECOND_NS
    return np.where((turns >= _TURN_S[0]) & (turns <= _TURN_S[1]), turns, usual)


def _image_times(folder: Path, origin: int) -> I64 | None:
    file = folder / "timestamps.txt"
    return read_datetimes(file) - origin if file.is_file() else None


def _read_oxts(folder: Path, origin: int, T_velo_imu: F64, scans: ScanFiles) -> ImuSamples:
    """IMU samples in the Velodyne's axes, ordered by time; rows that are broken are counted."""
    files = sorted((folder / "data").glob("*.txt"))
    if not files:
        return ImuSamples.empty()
    times = read_datetimes(folder / "timestamps.txt") - origin
    stamps, values = [], []
    for position, file in enumerate(files):
        number = int(file.stem) if file.stem.isdecimal() else position
        row = _oxts_row(file)
        if row is not None and number < len(times):
            stamps.append(int(times[number]))
            values.append(row)
    if broken := len(files) - len(stamps):
        add_counts(scans.lost, {"imu_rows": broken})
        scans.warnings.append(f"{broken} IMU rows in {folder} are broken and left out")
    order = np.argsort(stamps, kind="stable")
    rows = np.array(values).reshape(-1, _OXTS_COLUMNS)[order]
    R = T_velo_imu[:3, :3]
    gyro, accel = rows[:, _OXTS_GYRO] @ R.T, rows[:, _OXTS_ACCEL] @ R.T
    return ImuSamples(np.array(stamps, np.int64)[order], gyro, accel, T_velo_imu[:3, 3])


def _oxts_row(file: Path) -> F64 | None:
    try:
        row = np.array(file.read_text().split(), np.float64)
    except (OSError, ValueError):
        return None
    return row if len(row) == _OXTS_COLUMNS and bool(np.isfinite(row).all()) else None


def _odometry_poses(path: Path, scans: ScanFiles, stamp_ns: I64) -> Trajectory | None:
    """Poses of the left camera, turned into poses of the Velodyne in the Velodyne's first frame."""
    file = path.resolve().parent.parent / "poses" / f"{path.resolve().name}.txt"
    if not file.is_file():
        return None
    T_cam_velo = odometry_T_cam_velo(path)
    if T_cam_velo is None:
        scans.warnings.append(f"{file} is not used: {path / 'calib.txt'} with Tr is missing")
        return None
    try:
        rows = np.array([line.split() for line in read_lines(file)], np.float64).reshape(-1, 3, 4)
    except ValueError:
        rows = np.full((1, 3, 4), np.nan)
    if not np.isfinite(rows).all():
        raise InputError(f"{file} must hold twelve finite numbers a line, the pose of the left camera")
    T_cam0_cam = np.tile(np.eye(4), (len(rows), 1, 1))
    T_cam0_cam[:, :3] = rows
    T_velo0_velo = inverse(T_cam_velo) @ T_cam0_cam[scans.rows(len(rows), file)] @ T_cam_velo
    return Trajectory(stamp_ns, T_velo0_velo)
