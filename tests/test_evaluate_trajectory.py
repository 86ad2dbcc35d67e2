"""Trajectory errors: known disturbances give known figures."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from artemis_edge.errors import InputError
from artemis_edge.evaluate import trajectory as evaluation
from artemis_edge.evaluate.trajectory import (
    evaluate_trajectory,
    pair_by_time,
    relative_error,
    rigid_alignment,
)
from artemis_edge.frames import Trajectory
from artemis_edge.trajectory import write_tum


def circuit(count: int = 400, step_m: float = 0.5) -> Trajectory:
    """A spiral ramp walked at 0.5 m a pose, turning all the time."""
    s = np.arange(count) * step_m
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_euler("zyx", np.stack([s / 20, 0 * s + 0.1, 0 * s], 1)).as_matrix()
    T[:, :3, 3] = np.stack([20 * np.sin(s / 20), 20 * (1 - np.cos(s / 20)), 0.01 * s], 1)
    return Trajectory(np.arange(count) * 100_000_000, T)


def moved(trajectory: Trajectory, T: np.ndarray) -> Trajectory:
    return Trajectory(trajectory.stamp_ns, T @ trajectory.T_world_lidar)


def some_motion() -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [0.5, -1.0, 2.0]).as_matrix()
    T[:3, 3] = [30, -4, 2]
    return T


def test_a_rigid_motion_is_no_error() -> None:
    truth = circuit()
    result = evaluate_trajectory(moved(truth, some_motion()), truth)
    assert result.ate_rmse_m < 1e-9 and result.ate_max_m < 1e-9
    assert result.matched == 400
    assert result.length_m == pytest.approx(399 * 0.5, rel=1e-3)
    assert set(result.to_json()["rpe"]) == {"10", "50", "100"}
    for error in result.relative.values():
        assert error.percent < 1e-7 and error.deg_per_m < 1e-7


def test_noise_gives_its_own_rms() -> None:
    truth = circuit()
    noise = np.random.default_rng(1).normal(0, 0.1, (400, 3))
    noisy = circuit()
    noisy.T_world_lidar[:, :3, 3] += noise
    result = evaluate_trajectory(moved(noisy, some_motion()), truth)
    rms = np.sqrt((noise**2).sum(axis=1).mean())
    assert result.ate_rmse_m == pytest.approx(rms, rel=0.02) and result.ate_rmse_m <= rms
    assert result.ate_max_m == pytest.approx(np.linalg.norm(noise, axis=1).max(), rel=0.1)


def test_alignment_is_a_rotation_even_for_a_line_and_a_mirror() -> None:
    line = np.outer(np.arange(5.0), [1, 2, 3])
    R, t = rigid_alignment(line, line @ Rotation.from_euler("x", 1).as_matrix().T + 3)
    np.testing.assert_allclose(
        line @ R.T + t, line @ Rotation.from_euler("x", 1).as_matrix().T + 3, atol=1e-12
    )
    points = np.random.default_rng(2).normal(size=(50, 3))
    R, _ = rigid_alignment(points, points * [1, 1, -1])
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_scale_and_turn_errors_per_metre() -> None:
    count = 300
    s = np.arange(count) * 0.5
    straight, long = np.tile(np.eye(4), (2, count, 1, 1))
    straight[:, 0, 3], long[:, 0, 3] = s, s * 1.02
    error = relative_error(long, straight, s, 10.0)
    assert error is not None and error.percent == pytest.approx(2.0) and error.deg_per_m == 0.0
    assert error.stretches == 280
    turned = straight.copy()
    turned[:, :3, :3] = Rotation.from_euler("z", np.radians(0.03) * s[:, None]).as_matrix()
    error = relative_error(turned, straight, s, 50.0)
    assert error is not None and error.deg_per_m == pytest.approx(0.03)
    assert relative_error(long, straight, s, 1000.0) is None


def test_relative_error_equals_the_obvious_loop() -> None:
    rng = np.random.default_rng(4)
    truth, estimate = circuit(60, 1.0), circuit(60, 1.0)
    estimate.T_world_lidar[:, :3, :3] @= Rotation.from_rotvec(rng.normal(0, 0.02, (60, 3))).as_matrix()
    estimate.T_world_lidar[:, :3, 3] += rng.normal(0, 0.2, (60, 3))
    travelled = evaluation.path_length(truth.T_world_lidar[:, :3, 3])
    percent, degrees = [], []
    for i in range(60):
        for j in range(i, 60):
            length = travelled[j] - travelled[i]
            if length >= 10:
                P, Q = estimate.T_world_lidar, truth.T_world_lidar
                E = np.linalg.inv(np.linalg.inv(Q[i]) @ Q[j]) @ (np.linalg.inv(P[i]) @ P[j])
                percent.append(100 * np.linalg.norm(E[:3, 3]) / length)
                degrees.append(np.degrees(Rotation.from_matrix(E[:3, :3]).magnitude()) / length)
                break
    error = relative_error(estimate.T_world_lidar, truth.T_world_lidar, travelled, 10.0)
    assert error is not None and error.stretches == len(percent)
    assert error.percent == pytest.approx(np.mean(percent)) and error.deg_per_m == pytest.approx(
        np.mean(degrees)
    )


@pytest.mark.parametrize(
    ("a", "b", "pairs"),
    [
        ([], [0], []),
        ([0], [], []),
        ([0], [9], [(0, 0)]),
        ([0], [11], []),
        ([0, 5, 100, 200], [4, 99, 150, 209], [(1, 0), (2, 1), (3, 3)]),
    ],
)
def test_pairs_are_mutual_and_within_10_ms(a: list[int], b: list[int], pairs: list[tuple[int, int]]) -> None:
    i, j = pair_by_time(np.array(a, np.int64) * 1_000_000, np.array(b, np.int64) * 1_000_000)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == pairs


def test_other_clock_is_an_input_error() -> None:
    truth = circuit()
    late = Trajectory(truth.stamp_ns + 40_000_000, truth.T_world_lidar)
    with pytest.raises(InputError, match="same clock"):
        evaluate_trajectory(late, truth)


def test_command_prints_the_contract(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_tum(tmp_path / "a.tum", circuit())
    assert evaluation.main([str(tmp_path / "a.tum"), "--reference", str(tmp_path / "a.tum"), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert set(shown) == {"ate_rmse_m", "ate_max_m", "matched", "length_m", "rpe"}
    assert shown["ate_rmse_m"] < 1e-5 and {"percent", "deg_per_m"} <= set(shown["rpe"]["50"])
    assert evaluation.main([str(tmp_path / "b.tum"), "--reference", str(tmp_path / "a.tum")]) == 2
    assert "b.tum" in capsys.readouterr().err
