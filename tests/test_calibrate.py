"""Calibration: derivatives, an IMU on a known motion, a camera in a small virtual session, files, the command."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, RotationSpline

from artemis_edge import cli
from artemis_edge.calibrate.edges import attract, silhouettes, smooth_gradients
from artemis_edge.calibrate.inertial import attitude_rms, fit_imu
from artemis_edge.calibrate.mounts import CalibratedSource, CameraMount, ImuMount, Mounts
from artemis_edge.calibrate.photometric import PARAMETERS, View, compare
from artemis_edge.calibrate.poses import SmoothPoses, integrated_turns
from artemis_edge.config import InputConfig
from artemis_edge.datasets import open_input
from artemis_edge.devices.calibration import Calibration, read_calibration, to_matrix, write_calibration
from artemis_edge.frames import F64, U8, ImuSamples, Trajectory
from artemis_edge.odometry import se3
from artemis_edge.session.simulate import simulate
from artemis_edge.trajectory import inverse

_K = np.array([200.0, 200.0, 99.5, 79.5])
_T_CAM_LIDAR = np.array([[0.0, -1, 0, 0.02], [0, 0, -1, 0.05], [1, 0, 0, -0.03], [0, 0, 0, 1]])
_ORIGIN = np.array([0.05, 0.12, -0.08])  # of the IMU in the LiDAR frame


def _walk() -> tuple[Trajectory, ImuSamples]:
    """A shaken LiDAR at 10 Hz, and a perfect IMU of 200 Hz in its axes."""
    rng = np.random.default_rng(4)
    knots = np.arange(-1.0, 13.5, 0.5)
    turn = RotationSpline(
        knots, Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.25, (len(knots), 3)), axis=0))
    )
    waves = rng.normal(0, 0.5, (3, 3)), rng.uniform(0.5, 4.0, (3, 3)), rng.uniform(0, 6, (3, 3))

    def place(t: F64, derivative: int = 0) -> F64:
        a, w, p = waves
        phase = t[:, None, None] * w + p + 0.5 * np.pi * derivative
        return np.asarray((a * w**derivative * np.sin(phase)).sum(axis=2))

    t = np.arange(0.0, 12.0001, 0.1)
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = turn(t).as_matrix(), place(t)
    s = np.arange(0.0, 12.0001, 0.005)
    R = turn(s).as_matrix()
    rate = (turn(s - 1e-5).inv() * turn(s + 1e-5)).as_rotvec() / 2e-5
    h = 1e-4

    def arm(u: F64) -> F64:
        return np.asarray(turn(u).as_matrix() @ _ORIGIN)

    pull = place(s, 2) + (arm(s + h) - 2 * arm(s) + arm(s - h)) / h**2 + np.array([0, 0, 9.81])
    accel = np.einsum("nji,nj->ni", R, pull)
    stamps = (s * 1e9).round().astype(np.int64)
    return Trajectory((t * 1e9).round().astype(np.int64), T), ImuSamples(stamps, rate, accel)


def test_the_imu_is_found_turned_late_and_where_it_is() -> None:
    poses, imu = _walk()
    turn = Rotation.from_rotvec([0.02, -0.025, 0.015])
    wrong = ImuMount(turn.as_matrix(), 0.010).corrected(imu)
    found = fit_imu(poses, wrong)
    assert found is not None
    assert (Rotation.from_rotvec(found.rotation) * turn).magnitude() < 1e-3
    assert found.time_offset_s == pytest.approx(-0.010, abs=3e-4)
    assert found.position is not None
    np.testing.assert_allclose(found.position, _ORIGIN, atol=5e-3)
    right = ImuMount().then(found.rotation, found.time_offset_s).corrected(wrong)
    assert attitude_rms(poses, right) < 0.2 * attitude_rms(poses, wrong)


def test_a_rig_that_does_not_turn_tells_nothing_of_its_imu() -> None:
    poses, imu = _walk()
    T = poses.T_world_lidar.copy()
    T[:, :3, :3] = np.eye(3)
    assert fit_imu(Trajectory(poses.stamp_ns, T), imu) is None
    assert fit_imu(Trajectory(poses.stamp_ns[:5], T[:5]), imu) is None


def test_integrated_turns_and_poses_between_poses() -> None:
    s = np.arange(0.0, 1.0, 0.01)
    gyro = np.tile([0.0, 0.0, 2.0], (len(s), 1))
    R = integrated_turns(s, gyro, np.array([0.0, 0.0, 0.5]), np.array([0.105, 0.3, 0.905]))
    np.testing.assert_allclose(R[2], Rotation.from_rotvec([0, 0, 1.2]).as_matrix(), atol=1e-9)
    poses, imu = _walk()
    every = Trajectory(poses.stamp_ns[::2], poses.T_world_lidar[::2])
    smooth = SmoothPoses(every, imu)
    off = np.array(
        [se3.log(inverse(a) @ b) for a, b in zip(smooth.at(poses.stamp_ns), poses.T_world_lidar, strict=True)]
    )
    assert np.abs(off[3:-3]).max() < 5e-3
    assert smooth.covers(0) and not smooth.covers(-1)
    np.testing.assert_allclose(smooth.twist(imu.stamp_ns[500:501])[0, 3:], imu.gyro[500], atol=0.02)


def _wall(T_world_lidar: F64, C: F64, gain: float = 1.0) -> U8:
    """Photograph of a textured wall x = 4."""
    u, v = np.meshgrid(np.arange(200.0), np.arange(160.0))
    lines = np.stack([(u - _K[2]) / _K[0], (v - _K[3]) / _K[1], np.ones_like(u)], -1).reshape(-1, 3)
    T = T_world_lidar @ inverse(C)
    beams = lines @ T[:3, :3].T
    hit = T[:3, 3] + beams * ((4.0 - T[0, 3]) / beams[:, 0])[:, None]
    y, z = hit[:, 1], hit[:, 2]
    grey = 120 + 40 * np.sin(5 * y - 3 * z) + 30 * np.sin(9 * y + 7 * z + 1) + 20 * np.sin(2 * y + 13 * z)
    return np.clip(gain * grey, 0, 255).reshape(160, 200).astype(np.uint8)


def test_patches_pull_a_camera_back_to_where_it_is() -> None:
    still = np.zeros(6)
    poses = [
        se3.exp(np.array(x, np.float64))
        for x in (
            (0, 0, 0, 0, 0, 0),
            (1.2, 0.3, 0, 0, 0, 0.3),
            (0.6, -0.3, 0.2, 0.2, 0, -0.2),
            (0.3, 0, 0, 0, 0.25, 0.1),
        )
    ]
    views = [
        View(_wall(T, _T_CAM_LIDAR, g), _K, inverse(T), still)
        for T, g in zip(poses, (1, 0.7, 0.9, 1), strict=True)
    ]
    y, z = np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.6, 0.6, 7))
    anchors = np.hstack(
        [np.stack([np.full(63, 4.0), y.ravel(), z.ravel()], 1), np.tile([0, -0.02, 0, 0, 0, -0.02], (63, 1))]
    )
    wrong = se3.exp(np.array([0.01, -0.01, 0.01, 0.004, -0.005, 0.004])) @ _T_CAM_LIDAR
    C = wrong
    for _ in range(30):
        H, g = np.diag([1.0] * 6 + [1e6]) * 1e-3, np.zeros(PARAMETERS)
        for a in views:
            for b in views:
                if a is not b:
                    said = compare(a, b, np.ascontiguousarray(C), anchors)
                    H, g = H + said.H, g + said.g
        C = se3.exp(-np.linalg.solve(H, g)[:6]) @ C
    left, before = (se3.log(T @ inverse(_T_CAM_LIDAR)) for T in (C, wrong))
    assert np.abs(left[3:]).max() < 1e-3 < np.abs(before[3:]).max()
    assert np.abs(left[:3]).max() < 5e-3
    away = np.full((2, 9), 1000.0)
    assert compare(views[0], views[1], _T_CAM_LIDAR, away).seen == 0


def test_silhouettes_are_drawn_to_edges() -> None:
    grey = np.full((160, 200), 200, np.uint8)
    grey[50:110, 70:130] = 60  # a board 2 m away before a wall at 5 m
    T = np.eye(4)
    view = View(grey, _K, T, np.zeros(6))
    u, v = (a.ravel() for a in np.meshgrid(np.arange(0, 200, 0.7), np.arange(0, 160, 0.7)))
    board = (u >= 69.5) & (u < 129.5) & (v >= 49.5) & (v < 109.5)
    z = np.where(board, 2.0, 5.0)
    seen = np.stack([(u - _K[2]) / _K[0] * z, (v - _K[3]) / _K[1] * z, z], 1)
    points = (seen - _T_CAM_LIDAR[:3, 3]) @ _T_CAM_LIDAR[:3, :3]
    rims = silhouettes((160, 200), _K, _T_CAM_LIDAR, points)
    assert 100 < len(rims.points) < 600
    assert np.abs(rims.points[:, 0] - 2.03).max() < 0.01
    gx, gy = smooth_gradients(grey, 1.0)
    turn = se3.exp(np.array([0, 0, 0, 0.01, -0.012, 0.0])) @ _T_CAM_LIDAR
    C = turn
    for _ in range(10):
        said = attract(view, gx, gy, np.ascontiguousarray(C), rims.points, rims.across, np.zeros(2), 6.0)
        keep = [3, 4, 7, 8]
        H = said.H[np.ix_(keep, keep)] + 1e-6 * np.eye(4)
        x = np.zeros(6)
        x[3:5] = -np.linalg.solve(H, said.g[keep])[:2]
        C = se3.exp(x) @ C
    assert np.abs(se3.log(C @ inverse(_T_CAM_LIDAR))[3:]).max() < 2e-3
    assert said.seen > 100
    nothing = silhouettes((160, 200), _K, _T_CAM_LIDAR, np.empty((0, 3)))
    assert len(nothing.points) == 0


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("walk") / "walk"
    quick = {"image_width": "128", "density": "0.2", "mesh": "off", "reference": "off", "point_truth": "off"}
    simulate("courtyard", 1, 1.2, "avia", folder, quick)
    return folder


def test_a_calibration_file_replaces_the_mounts_of_a_recording(session: Path, tmp_path: Path) -> None:
    source = open_input(session)
    first = next(iter(source.frames(0, 1)))
    T = se3.exp(np.array([0.01, 0.02, 0.03, 0.1, 0.0, 0.0])) @ first.images[0].T_cam_lidar
    turn = Rotation.from_rotvec([0.0, 0.0, 0.1]).as_matrix()
    mounts = Mounts({"cam": CameraMount(T, 0.5)}, ImuMount(turn, -0.25))
    seen = next(iter(CalibratedSource(source, mounts).frames(0, 1)))
    assert seen.images[0].stamp_ns - first.images[0].stamp_ns == 500_000_000
    np.testing.assert_allclose(seen.imu.gyro, first.imu.gyro @ turn.T)

    from artemis_edge.devices.calibration import CameraCalibration

    model = first.images[0].model
    lens = (model.width, model.height, model.fx, model.fy, model.cx, model.cy)
    T_lidar_imu = np.eye(4)
    T_lidar_imu[:3, :3], T_lidar_imu[:3, 3] = turn, (0.1, 0.2, 0.3)
    file = tmp_path / "calibration.toml"
    camera = CameraCalibration(*lens, to_matrix(T), model.distortion, 0.5)
    write_calibration(
        file,
        Calibration(
            T_imu_lidar=to_matrix(inverse(T_lidar_imu)), imu_time_offset_s=-0.25, cameras={"cam": camera}
        ),
    )
    again = next(iter(open_input(session, InputConfig(calibration=str(file))).frames(0, 1)))
    np.testing.assert_allclose(again.images[0].T_cam_lidar, T, atol=1e-12)
    assert again.images[0].stamp_ns == seen.images[0].stamp_ns
    np.testing.assert_allclose(again.imu.accel, seen.imu.accel, atol=1e-12)
    np.testing.assert_allclose(again.imu.origin, (0.1, 0.2, 0.3), atol=1e-12)
    assert replace(again, images=(), imu=ImuSamples.empty(), scans=()).index == first.index


def test_the_command_says_what_it_found_and_refuses_what_is_not_better(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "calibration.toml"
    code = cli.main(
        ["calibrate", str(session), "--out", str(out), "--poses", str(session / "truth" / "trajectory.tum")]
    )
    said = capsys.readouterr()
    assert code in (0, 1) and "imu" in said.out and "cam" in said.out
    assert out.exists() == (code == 0)
    if code == 0:
        assert "cam" in read_calibration(out).cameras
    else:
        assert "none was written" in said.err
    assert cli.main(["calibrate", str(session / "none"), "--out", str(out)]) == 2
