"""What of the input stays beside the map: points where they were measured, images with their poses."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from artemis_edge.colouring import coloured_points
from artemis_edge.config import Config, KeepConfig, SegmentationConfig
from artemis_edge.evaluate.photos import read_photos
from artemis_edge.frames import (
    CameraImage,
    CameraModel,
    DeskewedScan,
    LidarScan,
    SyncedFrame,
    TrackedFrame,
    Trajectory,
)
from artemis_edge.keeper import Keeper
from artemis_edge.kept_images import INDEX
from artemis_edge.kept_points import FULL_INTENSITY, open_points
from artemis_edge.runtime import Request, reprocess
from artemis_edge.segmentation.keyframes import read_keyframes
from artemis_edge.sight import Sight, new_sight
from tests.conftest import FakeMapper

CAMERA = CameraModel(40, 30, 30.0, 30.0, 20.0, 15.0)
LOOKING_AHEAD = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # T_cam_lidar


def grey_image(level: int) -> bytes:
    return bytes(cv2.imencode(".png", np.full((30, 40, 3), level, np.uint8))[1])


class Forward:
    """Tracks half a metre along x a frame."""

    tracked: TrackedFrame | None = None

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        T = np.eye(4)
        T[0, 3] = 0.5 * frame.index
        scans = tuple(DeskewedScan(scan.points, np.zeros(3)) for scan in frame.scans)
        self.tracked = TrackedFrame(frame.index, frame.stamp_ns, T, scans, images=frame.images)
        return self.tracked


def frames(count: int, cameras: int = 1) -> list[SyncedFrame]:
    wall = np.array([[9.0, y, z] for y in np.linspace(-2, 2, 30) for z in np.linspace(-1, 1, 20)], np.float32)
    out = []
    for k in range(count):
        points = wall - np.float32([0.5 * k, 0, 0])
        offset = np.linspace(0, 0.1, len(points), dtype=np.float32)
        scan = LidarScan(points, k * 10**8, offset, np.full(len(points), 0.5, np.float32))
        images = tuple(
            CameraImage(f"cam_{c}", k * 10**8, grey_image(10 * k + 100 * c), CAMERA, LOOKING_AHEAD)
            for c in range(cameras)
        )
        out.append(SyncedFrame(k, k * 10**8, (scan,), images))
    return out


def keep(folder: Path, rules: KeepConfig, every: list[SyncedFrame]) -> Path:
    spool, out = folder / "spool", folder / "map"
    spool.mkdir()
    out.mkdir()
    keeper, tracker, poses = Keeper(spool, rules), Forward(), []
    prepare = keeper.between(lambda frame: frame, tracker)
    for frame in every:
        poses.append(tracker.track(prepare(frame)).T_world_lidar)
    keeper.save(out, Trajectory(np.array([f.stamp_ns for f in every]), np.array(poses)))
    return out


def test_points_lie_in_the_world_and_have_the_mean_colour(tmp_path: Path) -> None:
    kept = coloured_points(keep(tmp_path, KeepConfig(), frames(4)))
    assert kept is not None
    rows = np.concatenate(list(kept.chunks()))
    np.testing.assert_allclose(rows["position"][:, 0], 9.0, atol=1e-5)
    assert (rows["intensity"] == round(0.5 * FULL_INTENSITY)).all()
    np.testing.assert_allclose(rows["tick"].reshape(4, -1)[:, -1] * 1e-5, [0.1, 0.2, 0.3, 0.4], atol=1e-5)
    assert (rows["seen"] == 4).all() and (rows["colour"] == 15).all()  # mean of 0, 10, 20, 30


def test_images_keep_their_poses_and_their_number_is_bounded(tmp_path: Path) -> None:
    every = frames(11, cameras=2)
    out = keep(tmp_path, KeepConfig(images=6), every)
    photos = list(read_photos(out / INDEX))
    names = sorted(photo.file for photo in photos)
    assert names == sorted(f"images/cam_{c}_{k:06d}.png" for c in (0, 1) for k in (0, 4, 8))
    assert sorted(path.name for path in (out / "images").iterdir()) == [n.split("/")[1] for n in names]
    for photo in photos:
        index = int(photo.file[-10:-4])
        assert photo.T_world_cam[0, 3] == pytest.approx(0.5 * index)
        assert photo.image[0, 0, 0] == 10 * index + 100 * int(photo.file[11])


def test_nothing_is_kept_on_request_or_of_nothing(tmp_path: Path) -> None:
    assert list(keep(tmp_path, KeepConfig(points=0, images=0), frames(3)).iterdir()) == []
    (tmp_path / "b").mkdir()
    assert list(keep(tmp_path / "b", KeepConfig(), []).iterdir()) == []


def test_reprocess_keeps_the_points_and_says_how_much(
    kitti: Path, fake_pipeline: list[FakeMapper], tmp_path: Path
) -> None:
    request = Request(kitti, tmp_path / "out", Config(keep=KeepConfig(points=8000)), tmp_path / "poses.tum")
    outcome = reprocess(request)
    kept = open_points(tmp_path / "out" / "map")
    assert kept is not None and kept.stride == 4 and kept.rows == 7500  # of ten scans of 3000 points
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["kept_bytes"] == (tmp_path / "out" / "map" / "points.bin").stat().st_size
    assert report["map_bytes"] == 6 and outcome.report["kept_bytes"] == report["kept_bytes"]
    assert [path.name for path in (tmp_path / "out").iterdir() if path.name.startswith(".")] == []


def test_a_frame_that_could_not_be_tracked_brings_nothing(tmp_path: Path) -> None:
    keeper, tracker = Keeper(tmp_path, KeepConfig()), Forward()
    prepare = keeper.between(lambda frame: frame, tracker)
    first, second = frames(2)
    tracker.track(prepare(first))
    prepare(second)
    (tmp_path / "map").mkdir()
    keeper.save(tmp_path / "map", Trajectory(np.array([0, 10**8]), np.stack([np.eye(4)] * 2)))
    kept = open_points(tmp_path / "map")
    assert kept is not None and kept.rows == len(first.scans[0].points)
    assert len(list((tmp_path / "map" / "images").iterdir())) == 1


class Posed(Forward):
    """Knows the poses of the images too, and that a wall is 3 m before each."""

    def sight(self, camera: CameraModel, T_world_cam: np.ndarray) -> Sight:
        assert self.tracked is not None and T_world_cam[0, 3] == self.tracked.T_world_lidar[0, 3]
        view = new_sight(camera, T_world_cam)
        view.depth[:] = 3.0, 1 / 3.0, 0.0, 0.0
        return view

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        tracked = super().track(frame)
        self.tracked = replace(tracked, image_poses=tuple(tracked.T_world_lidar for _ in frame.images))
        return self.tracked


def test_keyframes_are_kept_where_they_show_something_new(tmp_path: Path) -> None:
    (tmp_path / "spool").mkdir()
    keeper, tracker = Keeper(tmp_path / "spool", KeepConfig(), SegmentationConfig(keyframe_m=0.9)), Posed()
    prepare = keeper.between(lambda frame: frame, tracker)
    for frame in frames(5):
        tracker.track(prepare(frame))
    every = np.arange(5) * 10**8
    keeper.save(tmp_path, Trajectory(every, np.tile(np.eye(4), (5, 1, 1))))
    found = read_keyframes(tmp_path)
    assert [item.stamp_ns // 10**8 for item in found] == [0, 2, 4]
    np.testing.assert_allclose(found[1].T_world_cam[:3, 3], [1.0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(found[1].T_world_cam[:3, 2], [1.0, 0, 0], atol=1e-12)  # looks along x
    lens = new_sight(CAMERA, np.eye(4)).lens
    assert all(np.allclose(item.known_depth(lens, pytest.fail)[:, :, 0], 3.0, rtol=0.002) for item in found)
