"""ROS recordings and sessions as frames: MCAP, SQLite and ROS 1 bags, one file or a folder of them.

One pass over the files finds out what is where (bag_index.py), the sensors are chosen and their mountings
looked up (bag_sensors.py), and the clouds are put together to frames here. Clouds and images are decoded when
their frame is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from artemis_edge.config import InputConfig
from artemis_edge.datasets import mcap_bag, ros1_bag, sqlite_bag
from artemis_edge.datasets.bag import Bag
from artemis_edge.datasets.bag_index import BagIndex, OdometryTrack
from artemis_edge.datasets.bag_sensors import (
    BagCamera,
    Lidar,
    find_cameras,
    find_imu,
    find_lidars,
    find_odometry,
    imu_mounting,
)
from artemis_edge.datasets.clouds import CloudFormat
from artemis_edge.datasets.common import (
    SECOND_NS,
    add_counts,
    imu_between,
    median_interval_ns,
    natural_order,
    split_imu,
)
from artemis_edge.datasets.tf_tree import TransformTree
from artemis_edge.errors import InputError
from artemis_edge.frames import F64, I64, Bool, CameraImage, LidarScan, SyncedFrame, Trajectory
from artemis_edge.session.cdr import CdrError

SUFFIXES = (".mcap", ".db3", ".bag")
# Clouds of several LiDARs this close in time are one frame.
_SAME_NS = 1_000_000
# An image further from every frame than this share of the interval between frames stands alone ...
_NEAR_SHARE = 0.75
# ... and, where frames are rare, than this: the platform has moved on.
_NEAR_NS = 300_000_000
# Metres, and entries of a rotation: given poses this close to those of tf are the same.
_SAME_POSE = 0.005
# Rate of a recording with a single frame
_NOMINAL_HZ = 10.0


@dataclass(slots=True)
class _Plan:
    """What a frame will hold: (LiDAR, its k-th cloud) and (camera, its k-th image)."""

    stamp_ns: int
    clouds: list[tuple[int, int]] = field(default_factory=list)
    images: list[tuple[int, int]] = field(default_factory=list)


class RosbagSource:
    """FrameSource of a recording.

    ``poses`` are those of tf, else of an Odometry topic, at the stamps of the frames that they cover, else
    None; the world is the root of the tree above the primary LiDAR. ``stamp_ns`` (n,) are the stamps of all
    frames. A frame may hold images without scans. IMU samples are in the axes of the primary LiDAR;
    ``T_lidar_imu`` is how the recording says that the IMU is mounted.
    """

    def __init__(self, path: Path, config: InputConfig | None = None) -> None:
        config = config or InputConfig()
        index = BagIndex(open_bags(path))
        self.name = path.resolve().stem if path.is_file() else path.resolve().name
        self._lidars = find_lidars(index, config)
        lidar_frame = self._lidars[0].track.frame_id
        self._cameras = find_cameras(index, config, lidar_frame)
        plans = _group_clouds(self._lidars, index)
        timing = self._lidars[0].format
        self._plans = _attach_images(plans, self._cameras, timing)
        self.stamp_ns: I64 = np.array([plan.stamp_ns for plan in self._plans], np.int64)
        self._imu = find_imu(index, config, lidar_frame)
        self.T_lidar_imu: F64 = imu_mounting(index, config, lidar_frame)
        starts = self.stamp_ns + round(timing.start_s * SECOND_NS)
        self._imu_bounds = split_imu(self._imu.stamp_ns, starts)
        self.poses: Trajectory | None = _poses(index, config, lidar_frame, self.stamp_ns)
        interval = median_interval_ns(self.stamp_ns)
        self.input_hz = SECOND_NS / interval if interval else _NOMINAL_HZ
        self.lost: dict[str, int] = index.lost
        self.warnings: list[str] = index.warnings
        self._tree, self._lidar_frame = index.tree, lidar_frame

    def __len__(self) -> int:
        return len(self._plans)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[SyncedFrame]:
        """Frames ``start <= index < stop`` in order of time, decoded one by one.

        Raises InputError at a frame that has clouds of which none can be decoded.
        """
        for index in range(*slice(start, stop).indices(len(self))):
            yield self._frame(index)

    def lidar_poses(self, given: Trajectory) -> Trajectory:
        """Poses of the primary LiDAR, given those of whatever part of the rig tf says they are of.

        Pose files of a recording are often of its base. Where tf moves the base (or another frame above the
        LiDAR) exactly so, the mounting is applied and a warning says so; otherwise the poses are the LiDAR's.
        """
        path = self._tree.path_up(self._lidar_frame)
        for frame in path[:-1]:
            T, known = self._tree.lookup(path[-1], frame, given.stamp_ns)
            if known.all() and np.abs(T - given.T_world_lidar).max() < _SAME_POSE:
                T_frame_lidar, _ = self._tree.lookup(frame, self._lidar_frame, given.stamp_ns)
                if frame != path[0]:
                    self.warnings.append(
                        f"the given poses are those of {frame} in tf; the mounting of {path[0]} is applied"
                    )
                return Trajectory(given.stamp_ns, given.T_world_lidar @ T_frame_lidar)
        return given

    def _frame(self, index: int) -> SyncedFrame:
        plan, lost = self._plans[index], dict[str, int]()
        scans, images, damaged = [], [], 0
        for lidar, k in plan.clouds:
            try:
                scan = _scan(self._lidars[lidar], k, lost)
            except CdrError as error:
                damaged += 1
                if damaged == len(plan.clouds):
                    raise InputError(f"frame {index} of {self.name} cannot be decoded: {error}") from None
                add_counts(lost, {"undecodable_clouds": 1})
                continue
            if len(scan.points):
                scans.append(scan)
        for camera, k in plan.images:
            try:
                images.append(_photo(self._cameras[camera], k))
            except CdrError:
                add_counts(lost, {"undecodable_images": 1})
        imu = imu_between(self._imu, self._imu_bounds[index], self._imu_bounds[index + 1])
        return SyncedFrame(index, plan.stamp_ns, tuple(scans), tuple(images), imu, lost)


def bag_files(path: Path) -> list[Path]:
    """The recordings at a path: the file itself, or those in the folder, in order of their numbers.

    Where a folder holds several kinds, one is a copy of the other: MCAP comes before SQLite before ROS 1.
    """
    if path.is_file():
        return [path]
    for suffix in SUFFIXES:
        files = sorted((file for file in path.glob(f"*{suffix}") if file.is_file()), key=natural_order)
        if files:
            return files
    return []


def open_bags(path: Path) -> list[Bag]:
    """All files of the recording at a path; InputError if one cannot be read."""
    return [_open_bag(file) for file in bag_files(path)]


def _open_bag(file: Path) -> Bag:
    """By the first bytes, not by the name."""
    try:
        with file.open("rb") as stream:
            start = stream.read(16)
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror}") from None
    if start.startswith(sqlite_bag.MAGIC):
        return sqlite_bag.SqliteBag(file)
    if start.startswith(ros1_bag.MAGIC):
        return ros1_bag.Ros1Bag(file)
    if start.startswith(mcap_bag.MAGIC):
        return mcap_bag.McapBag(file)
    what = "is empty" if not start else "is neither an MCAP file, a ROS 2 bag in SQLite nor a ROS 1 bag"
    raise InputError(f"{file} {what}; give a recording that was closed or cut off, not overwritten")


def _group_clouds(lidars: list[Lidar], index: BagIndex) -> list[_Plan]:
    """Clouds of about the same stamp make a frame; its stamp is the primary LiDAR's if that took part."""
    events = sorted(
        (int(stamp), number, k)
        for number, lidar in enumerate(lidars)
        for k, stamp in enumerate(lidar.stamp_ns)
        if lidar.known[k]
    )
    plans: list[_Plan] = []
    first, taken, previous = 0, set[int](), (-1, -1)
    for stamp, number, k in events:
        if (stamp, number) == previous:
            add_counts(index.lost, {"duplicate_clouds": 1})
            continue
        previous = (stamp, number)
        if not plans or stamp - first > _SAME_NS or number in taken:
            first, taken = stamp, set()
            # Never two frames of one stamp, however odd the stamps are.
            plans.append(_Plan(max(stamp, plans[-1].stamp_ns + 1) if plans else stamp))
        elif number == 0:
            plans[-1].stamp_ns = stamp
        taken.add(number)
        plans[-1].clouds.append((number, k))
    if count := index.lost.get("duplicate_clouds"):
        index.warnings.append(f"{count} clouds repeat the stamp of another of their topic and are left out")
    return plans


def _attach_images(plans: list[_Plan], cameras: list[BagCamera], timing: CloudFormat) -> list[_Plan]:
    """Each image goes to the frame nearest in time; one far from all of them makes a frame of its own.

    The distance counts from the middle of a frame's window, and a window's own images are never far.
    """
    half_ns = round(0.5 * (timing.end_s - timing.start_s) * SECOND_NS)
    middle_ns = round(timing.start_s * SECOND_NS) + half_ns
    middles = np.array([plan.stamp_ns + middle_ns for plan in plans], np.int64)
    interval = median_interval_ns(middles)
    near = _NEAR_NS if interval is None else min(_NEAR_SHARE * interval, _NEAR_NS)
    reach = max(near, half_ns + _SAME_NS)
    alone: list[_Plan] = []
    events = sorted(
        (int(stamp), number, k)
        for number, camera in enumerate(cameras)
        for k, stamp in enumerate(camera.stamp_ns)
        if camera.known[k]
    )
    for stamp, number, k in events:
        nearest = _nearest(middles, stamp)
        if abs(int(middles[nearest]) - stamp) <= reach:
            plans[nearest].images.append((number, k))
            continue
        if not alone or stamp - alone[-1].stamp_ns > _SAME_NS:
            alone.append(_Plan(stamp))
        alone[-1].images.append((number, k))
    return sorted(plans + alone, key=lambda plan: plan.stamp_ns)


def _nearest(stamps: I64, stamp: int) -> int:
    """Index of the nearest stamp, of two the later."""
    right = int(np.searchsorted(stamps, stamp))
    if right == len(stamps):
        return right - 1
    if right == 0 or stamps[right] - stamp <= stamp - stamps[right - 1]:
        return right
    return right - 1


def _scan(lidar: Lidar, k: int, lost: dict[str, int]) -> LidarScan:
    cloud = lidar.cloud(k)
    add_counts(lost, cloud.lost)
    stamp, T = int(lidar.stamp_ns[k]), lidar.T_lidar_sensor[k].copy()
    return LidarScan(cloud.points, stamp, cloud.offset_s, cloud.intensity, T, lidar.name)


def _photo(camera: BagCamera, k: int) -> CameraImage:
    stamp, T = int(camera.stamp_ns[k]), camera.T_cam_lidar[k].copy()
    return CameraImage(camera.name, stamp, camera.image(k), camera.model, T, float(camera.exposure_s[k]))


def _poses(index: BagIndex, config: InputConfig, lidar_frame: str, stamp_ns: I64) -> Trajectory | None:
    """``T_world_lidar`` at the stamps that tf or an Odometry topic covers, None without either."""
    if index.tree.moves(lidar_frame):
        world = index.tree.path_up(lidar_frame)[-1]
        T, known = index.tree.lookup(world, lidar_frame, stamp_ns)
    else:
        track = find_odometry(index, config)
        if track is None:
            return None
        T, known = _odometry_poses(index, track, lidar_frame, stamp_ns)
    if not known.all():
        missing = f"{int((~known).sum())} of {len(known)} frames"
        index.warnings.append(f"the recording's own poses (tf or odometry) do not cover {missing}")
    return Trajectory(stamp_ns[known], T[known]) if known.any() else None


def _odometry_poses(
    index: BagIndex, track: OdometryTrack, lidar_frame: str, stamp_ns: I64
) -> tuple[F64, Bool]:
    """``T_world_lidar`` (n, 4, 4) by an Odometry topic and the mounting of its child, and where known."""
    path = TransformTree()
    for stamp, value in zip(track.stamps, track.values, strict=True):
        path.add("world", "child", stamp, value[:3], value[3:], moving=True)
    T_world_child, known = path.lookup("world", "child", stamp_ns)
    child = track.child_frame_id
    if not child or not index.tree.connected(child, lidar_frame):
        index.warnings.append(
            f"tf does not say how {lidar_frame} is mounted to the odometry's '{child}'; they are taken as one"
        )
        return T_world_child, known
    T_child_lidar, mounted = index.tree.lookup(child, lidar_frame, stamp_ns)
    return T_world_child @ T_child_lidar, known & mounted
