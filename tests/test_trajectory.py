"""TUM files, interpolation and pairing with frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from artemis_edge.errors import InputError
from artemis_edge.frames import F64, Trajectory
from artemis_edge.trajectory import (
    hole_sentence,
    interpolate,
    inverse,
    matrix_from_quaternion,
    pose_per_frame,
    quaternion_from_matrix,
    read_tum,
    seconds_text,
    write_tum,
)

SECOND = 1_000_000_000
GOOD = "0.5 1 2 3 0 0 0 1"


def _random_poses(count: int, seed: int = 0) -> F64:
    rng = np.random.default_rng(seed)
    return matrix_from_quaternion(rng.normal(size=(count, 3)), rng.normal(size=(count, 4)))


def _file(folder: Path, text: str) -> Path:
    path = folder / "poses.tum"
    path.write_text(text)
    return path


def test_write_then_read(tmp_path: Path) -> None:
    stamps = np.array([-1_500_000_001, 0, 1, 1_630_577_758_569_489_920])
    written = Trajectory(stamps, _random_poses(4))
    write_tum(tmp_path / "a.tum", written)
    read = read_tum(tmp_path / "a.tum")
    assert read.stamp_ns.tolist() == stamps.tolist()
    np.testing.assert_allclose(read.T_world_lidar, written.T_world_lidar, atol=1e-6)
    write_tum(tmp_path / "b.tum", read)
    assert (tmp_path / "a.tum").read_bytes() == (tmp_path / "b.tum").read_bytes()


def test_comments_blank_lines_and_exponents(tmp_path: Path) -> None:
    text = "# stamp tx ty tz qx qy qz qw\n\n 1.5e0 1e1 -2 3.5 0 0 0.6 0.8 \n# end\n2 0 0 0 0 0 0 -1\n"
    read = read_tum(_file(tmp_path, text))
    assert read.stamp_ns.tolist() == [1_500_000_000, 2_000_000_000]
    np.testing.assert_allclose(read.T_world_lidar[0, :3, 3], [10, -2, 3.5])
    np.testing.assert_allclose(read.T_world_lidar[1], np.eye(4), atol=1e-15)
    np.testing.assert_allclose(quaternion_from_matrix(read.T_world_lidar[0]), [0, 0, 0.6, 0.8], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "holds no poses"),
        ("# only a comment\n", "holds no poses"),
        ("1 2 3\n", "line 1 .* has 3 columns"),
        (f"{GOOD} 9\n", "9 columns"),
        (f"{GOOD}\n1 a 2 3 0 0 0 1\n", "line 2 .* not eight numbers"),
        ("1,0,0,0,0,0,0,1\n", "1 columns"),
        ("1 nan 2 3 0 0 0 1\n", "not finite"),
        ("nan 1 2 3 0 0 0 1\n", "not finite"),
        ("1 1 2 inf 0 0 0 1\n", "not finite"),
        ("1 1 2 1e300 0 0 0 1\n", "line 1 .* beyond 100,000 km"),
        ("1 -1.1e8 2 3 0 0 0 1\n", "beyond 100,000 km"),
        ("1 1 2 3 0 0 0 0\n", "unit length"),
        ("1 1 2 3 4 5 6 7\n", "unit length"),
        ("1e300 1 2 3 0 0 0 1\n", "not in seconds"),
        ("1e999999999 1 2 3 0 0 0 1\n", "not finite"),
        ("1630577758569489920 1 2 3 0 0 0 1\n", "not in seconds"),
        (f"{GOOD}\n0.4 1 2 3 0 0 0 1\n", "do not ascend at pose 2"),
        (f"{GOOD}\n{GOOD}\n", "do not ascend"),
    ],
)
def test_bad_files(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(InputError, match=says) as caught:
        read_tum(_file(tmp_path, text))
    assert "\n" not in str(caught.value)


def test_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read"):
        read_tum(tmp_path / "none.tum")
    with pytest.raises(InputError, match="cannot read"):
        read_tum(tmp_path)
    (tmp_path / "binary.tum").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not a text file"):
        read_tum(tmp_path / "binary.tum")


@given(st.text())
@settings(max_examples=200, deadline=None)
def test_arbitrary_text(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "any.tum"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError):
        read_tum(path)


def test_matrix_and_quaternion_are_inverse() -> None:
    T = _random_poses(100)
    q = quaternion_from_matrix(T)
    assert (q[:, 3] >= 0).all()
    np.testing.assert_allclose(matrix_from_quaternion(T[:, :3, 3], q), T, atol=1e-12)
    np.testing.assert_allclose(inverse(T) @ T, np.broadcast_to(np.eye(4), T.shape), atol=1e-12)
    assert quaternion_from_matrix(np.empty((0, 4, 4))).shape == (0, 4)
    assert matrix_from_quaternion(np.empty((0, 3)), np.empty((0, 4))).shape == (0, 4, 4)


def _naive_interpolate(trajectory: Trajectory, stamp: int) -> F64:
    """One stamp at a time, with the textbook quaternion slerp."""
    times = trajectory.stamp_ns.tolist()
    stamp = min(max(stamp, times[0]), times[-1])
    k = max(i for i, t in enumerate(times) if t <= stamp)
    if times[k] == stamp:
        return trajectory.T_world_lidar[k]
    share = (stamp - times[k]) / (times[k + 1] - times[k])
    a, b = trajectory.T_world_lidar[k], trajectory.T_world_lidar[k + 1]
    p, q = Rotation.from_matrix(a[:3, :3]).as_quat(), Rotation.from_matrix(b[:3, :3]).as_quat()
    if p @ q < 0:
        q = -q
    angle = np.arccos(min(p @ q, 1.0))
    mix = (np.sin((1 - share) * angle) * p + np.sin(share * angle) * q) / np.sin(angle) if angle > 1e-9 else p
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(mix).as_matrix()
    T[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    return T


@pytest.mark.parametrize("count", [1, 2, 7])
def test_interpolation_equals_the_naive_one(count: int) -> None:
    stamps = np.cumsum(np.random.default_rng(count).integers(1, SECOND, count)) + 1_630_577_758 * SECOND
    trajectory = Trajectory(stamps, _random_poses(count, count))
    asked = np.sort(
        np.concatenate([stamps, np.linspace(stamps[0] - SECOND, stamps[-1] + SECOND, 40).astype(int)])
    )
    got = interpolate(trajectory, asked)
    for stamp, T in zip(asked.tolist(), got, strict=True):
        np.testing.assert_allclose(T, _naive_interpolate(trajectory, stamp), atol=1e-9)
    assert interpolate(trajectory, np.empty(0, np.int64)).shape == (0, 4, 4)


def test_interpolation_is_exact_at_the_poses() -> None:
    trajectory = Trajectory(np.arange(5) * SECOND, _random_poses(5))
    assert np.array_equal(interpolate(trajectory, trajectory.stamp_ns), trajectory.T_world_lidar)


def test_one_row_per_frame_pairs_by_row() -> None:
    poses = Trajectory(np.arange(5) * SECOND, _random_poses(5))
    frames = 1000 * SECOND + np.arange(5) * SECOND // 10
    paired = pose_per_frame(poses, frames, 1, 3)
    assert paired.stamp_ns.tolist() == frames[1:3].tolist()
    assert np.array_equal(paired.T_world_lidar, poses.T_world_lidar[1:3])


def test_other_counts_interpolate_by_time() -> None:
    poses = Trajectory(np.arange(3) * SECOND, _random_poses(3))
    frames = np.arange(0, 21) * SECOND // 10
    paired = pose_per_frame(poses, frames)
    assert len(paired) == 21
    assert np.allclose(paired.T_world_lidar[10], poses.T_world_lidar[1])
    assert np.allclose(paired.T_world_lidar[5], _naive_interpolate(poses, SECOND // 2))


def test_holes_are_told() -> None:
    frames = np.arange(20) * SECOND // 10
    times = np.arange(20) * SECOND // 10
    whole = Trajectory(times, _random_poses(20))
    assert hole_sentence(whole, frames) is None
    every_other = Trajectory(times[::2], whole.T_world_lidar[::2])
    assert hole_sentence(every_other, frames) is None
    kept = np.r_[0:5, 9:20]
    told = hole_sentence(Trajectory(times[kept], whole.T_world_lidar[kept]), frames)
    assert told is not None
    assert told.startswith("4 frames lie in holes of the poses, the longest 0.50 s")
    assert hole_sentence(Trajectory(times[:1], whole.T_world_lidar[:1]), frames) is None
    assert hole_sentence(whole, frames[:1]) is None


def test_rounded_stamps_at_the_ends_are_covered() -> None:
    poses = Trajectory(np.array([400_000, SECOND - 400_000]), _random_poses(2))
    assert len(pose_per_frame(poses, np.array([0, SECOND // 2, SECOND]))) == 3


def test_frames_that_are_not_covered() -> None:
    poses = Trajectory(np.arange(2, 5) * SECOND, _random_poses(3))
    frames = np.arange(10) * SECOND
    with pytest.raises(InputError, match=r"do not cover 7 of the 10 frames .*--frames 2:5"):
        pose_per_frame(poses, frames)
    assert len(pose_per_frame(poses, frames, 2, 5)) == 3
    with pytest.raises(InputError, match=r"do not cover 1 of the 3 frames .*--frames 3:5"):
        pose_per_frame(poses, frames, 3, 6)
    with pytest.raises(InputError, match="cover none of the 10 frames"):
        pose_per_frame(poses, frames + 1000 * SECOND, name="a.tum")


def test_seconds_text() -> None:
    texts = [seconds_text(v) for v in (0, 1, -1, 1_500_000_000, -2_000_000_000)]
    assert texts == ["0.000000000", "0.000000001", "-0.000000001", "1.500000000", "-2.000000000"]
