"""Loop closure: a walk twice around a block whose poses drift comes back to itself."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from artemis_edge.errors import InputError
from artemis_edge.frames import F64, DeskewedScan, SyncedFrame, TrackedFrame
from artemis_edge.loop import closure, corrected
from artemis_edge.loop.closure import candidates, find_loops, overlap
from artemis_edge.loop.corrected import Closed, CorrectedOdometry, close_loops
from artemis_edge.loop.keyframes import Keyframe, submap, thinned, track_all
from artemis_edge.odometry import se3
from artemis_edge.trajectory import inverse

_SIDE_M, _STEP_M = 8.0, 0.5


def _boxes() -> F64:
    """Points on boxes of many sizes around the way."""
    rng = np.random.default_rng(5)
    parts = []
    for x, y in rng.uniform(-8, 16, (60, 2)):
        size = rng.uniform(0.5, 2.0, 3)
        faces = rng.uniform(0, 1, (700, 3))
        faces[np.arange(700), rng.integers(0, 3, 700)] = rng.integers(0, 2, 700)
        parts.append(faces * size + (x, y, -1.0))
    floor = rng.uniform(-8, 16, (6000, 3)) * (1, 1, 0) - (0, 0, 1)
    return np.concatenate([*parts, floor])


_WORLD = _boxes()


def _way(laps: float = 1.6) -> list[F64]:
    """Poses around a square, looking ahead."""
    poses, T = [], np.eye(4)
    steps = round(_SIDE_M / _STEP_M)
    for k in range(round(laps * 4 * (steps + 3))):
        poses.append(T)
        at = k % (steps + 3)
        twist = np.array([_STEP_M, 0, 0, 0, 0, 0]) if at < steps else np.array([0, 0, 0, 0, 0, np.pi / 6])
        T = T @ se3.exp(twist)
    return poses


class Drifting:
    """Odometry of the way with 2 cm and a fifth of a degree of drift a metre, and perfect scans."""

    def __init__(self) -> None:
        self._true, self._T = _way(), np.eye(4)

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        k = frame.index
        if k:
            step = inverse(self._true[k - 1]) @ self._true[k]
            way = float(np.linalg.norm(step[:3, 3]))
            self._T = self._T @ step @ se3.exp(way * np.array([0.02, 0, 0.01, 0, 0, np.radians(0.2)]))
        T = inverse(self._true[k])
        points = _WORLD @ T[:3, :3].T + T[:3, 3]
        near = (np.linalg.norm(points, axis=1) < 12.0) & (points[:, 0] > 0.0)
        scan = DeskewedScan(points[near][::3].astype(np.float32), np.zeros(3))
        return TrackedFrame(k, frame.stamp_ns, self._T, (scan,), image_poses=(self._T,))


def _frames() -> Iterator[SyncedFrame]:
    return (SyncedFrame(k, 1000 + 100 * k, ()) for k in range(len(_way())))


def test_loops_bring_a_drifting_walk_back() -> None:
    pytest.importorskip("gtsam")
    pytest.importorskip("small_gicp")
    before, keyframes = track_all(Drifting(), _frames())
    closed = close_loops(Drifting, _frames())
    assert closed.loops >= 5 and "loops were closed" in closed.sentence()
    odometry, true = CorrectedOdometry(Drifting(), closed.correction), _way()
    after = [odometry.track(frame).T_world_lidar for frame in _frames()]
    lap = 4 * (round(_SIDE_M / _STEP_M) + 3)
    first, second = range(10), range(lap, lap + 10)

    def gap_m(poses: list[F64]) -> float:
        """How far the second lap is from the first, beyond what it truly is."""
        errors = [
            inverse(inverse(true[a]) @ true[b]) @ inverse(poses[a]) @ poses[b]
            for a, b in zip(first, second, strict=True)
        ]
        return float(np.mean([np.linalg.norm(T[:3, 3]) for T in errors]))

    assert gap_m(list(before.T_world_lidar)) > 0.5
    assert gap_m(after) < 0.15
    for loop in find_loops(keyframes)[:3]:
        assert loop.b > loop.a and np.linalg.eigvalsh(loop.information)[0] > 0.0


def test_without_loops_nothing_changes() -> None:
    pytest.importorskip("gtsam")
    pytest.importorskip("small_gicp")
    frames = list(_frames())[:20]
    closed = close_loops(Drifting, frames)
    assert closed.loops == 0 and closed.end_moved_m == 0.0 and "no place" in closed.sentence()
    np.testing.assert_allclose(
        closed.correction.T_world_lidar, np.tile(np.eye(4), (len(closed.correction), 1, 1)), atol=1e-9
    )
    assert close_loops(Drifting, []).loops == 0


def test_candidates_are_near_look_the_same_way_and_come_long_after() -> None:
    none = np.empty((0, 3))
    keyframes = [Keyframe(k, T, none) for k, T in enumerate(_way(1.2))]
    pairs = candidates(keyframes)
    assert pairs
    for a, b in pairs:
        T = inverse(keyframes[a].T_world_lidar) @ keyframes[b].T_world_lidar
        assert T[0, 0] > 0.5 and np.linalg.norm(T[:3, 3]) < 15.0 and b > a
    assert candidates(keyframes[:10]) == [] and candidates([]) == []
    turned = [k._replace(T_world_lidar=k.T_world_lidar @ np.diag([-1.0, -1, 1, 1])) for k in keyframes]
    assert candidates(keyframes[:60] + turned[76:80]) == candidates(keyframes[:60])


def test_submaps_and_overlap() -> None:
    points = np.random.default_rng(1).uniform(0, 5, (5000, 3))
    assert len(thinned(np.vstack([points, points]))) == len(thinned(points))
    assert overlap(points, points, np.eye(4)) == 1.0
    away = np.eye(4)
    away[0, 3] = 100.0
    assert overlap(points, points, away) == 0.0
    T = se3.exp(np.array([1.0, 0, 0, 0, 0, 0.3]))
    keyframes = [Keyframe(0, np.eye(4), points[:100]), Keyframe(1, T, points[100:200])]
    seen = submap(keyframes, 1)
    np.testing.assert_allclose(sorted(seen[:, 2])[0], min(points[:200, 2]), atol=1e-9)


def test_a_missing_extra_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(InputError, match="extra 'loop'"):
        closure.require_extra()
    with pytest.raises(InputError, match="pip install"):
        corrected.close_loops(Drifting, _frames())


def test_images_and_directions_are_corrected_too() -> None:
    turn = se3.exp(np.array([1.0, 0, 0, 0, 0, np.pi / 2]))

    class One:
        def track(self, frame: SyncedFrame) -> TrackedFrame:
            direction = np.array([1.0, 0, 0])
            return TrackedFrame(0, frame.stamp_ns, np.eye(4), (), True, (), (), np.zeros(6), direction)

    from artemis_edge.frames import Trajectory

    odometry = CorrectedOdometry(One(), Trajectory(np.array([0]), turn[None]))
    found = odometry.track(replace(SyncedFrame(0, 5, ()), index=0))
    np.testing.assert_allclose(found.T_world_lidar, turn)
    assert found.degenerate_direction is not None
    np.testing.assert_allclose(found.degenerate_direction, [0, 1, 0], atol=1e-12)
    assert Closed(odometry.correction, 2, 0.5).sentence().startswith("2 loops")
