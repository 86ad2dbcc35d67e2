"""The visual update: warps and derivatives against numeric ones, and a textured wall that gives the pose back."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from artemis_edge.frames import F64, CameraImage, CameraModel
from artemis_edge.odometry import se3
from artemis_edge.odometry.image_update import SeenScan
from artemis_edge.odometry.path import PoseAt
from artemis_edge.odometry.plane_map import PlaneMap
from artemis_edge.odometry.state import CAMERAS, POSITION, ROTATION, State
from artemis_edge.odometry.visual import VisualUpdate, picture
from artemis_edge.odometry.visual_patch import (
    SIDE,
    Eye,
    bilinear,
    project,
    sample,
    seen_at,
    shifts,
    transform,
)

_MODEL = CameraModel(320, 256, 220.0, 221.0, 158.0, 130.0, (-0.1, 0.05, 1e-3, -1e-3, 0.0))
_T_CAM_LIDAR = se3.exp(np.array([0.02, 0.05, -0.03, 0.02, -0.01, 0.03])) @ np.array(
    [[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
)
_EYE = Eye(np.array([_MODEL.fx, _MODEL.fy, _MODEL.cx, _MODEL.cy]), np.array(_MODEL.distortion), _T_CAM_LIDAR)
_WALL_M = 4.0  # the wall is x = 4 in world
_TWIST = np.array([0.4, 0.3, -0.2, 0.1, -0.2, 0.3])


@dataclass
class SteadyPath:
    """A body that is the LiDAR and moves with a constant twist."""

    twist: F64

    def at(self, state: State, time_s: float) -> PoseAt:
        T = state.T_world_body @ se3.exp(time_s * self.twist)
        J = np.zeros((6, len(state)))
        # right perturbation of the state's pose: R' of the position, and the rotation, carried to the time
        J[:3, POSITION] = T[:3, :3].T
        J[3:, ROTATION] = T[:3, :3].T @ state.T_world_body[:3, :3]
        arm = state.T_world_body[:3, :3].T @ (T[:3, 3] - state.T_world_body[:3, 3])
        J[:3, ROTATION] = -T[:3, :3].T @ state.T_world_body[:3, :3] @ se3.skew(arm)
        return PoseAt(T, self.twist, J)


def _texture(y: F64, z: F64) -> F64:
    """Grey values of the wall: waves of several lengths and directions."""
    waves = ((2.0, 1.0, 0.3), (5.0, -7.0, 1.0), (11.0, 4.0, 2.0), (-3.0, 13.0, 0.5), (19.0, -17.0, 1.4))
    return 120.0 + sum(18.0 * np.sin(a * y + b * z + c) for a, b, c in waves)


def _photograph(T_world_lidar: F64, gain: float = 1.0, name: str = "cam", stamp_ns: int = 0) -> CameraImage:
    columns, rows = np.meshgrid(np.arange(_MODEL.width), np.arange(_MODEL.height))
    pixels = np.stack([columns, rows], -1).reshape(-1, 1, 2).astype(np.float64)
    K = np.array([[_MODEL.fx, 0, _MODEL.cx], [0, _MODEL.fy, _MODEL.cy], [0, 0, 1]])
    lines = cv2.undistortPoints(pixels, K, np.array(_MODEL.distortion))[:, 0]
    T_world_cam = T_world_lidar @ se3.inverse(_T_CAM_LIDAR)
    beams = np.hstack([lines, np.ones((len(lines), 1))]) @ T_world_cam[:3, :3].T
    hit = T_world_cam[:3, 3] + beams * ((_WALL_M - T_world_cam[0, 3]) / beams[:, 0])[:, None]
    grey = np.clip(gain * _texture(hit[:, 1], hit[:, 2]), 0, 255).reshape(_MODEL.height, _MODEL.width)
    encoded = cv2.imencode(".png", np.rint(grey).astype(np.uint8))[1].tobytes()
    return CameraImage(name, stamp_ns, encoded, _MODEL, _T_CAM_LIDAR)


def _wall(T_world_lidar: F64) -> tuple[SeenScan, PlaneMap]:
    y, z = np.meshgrid(np.arange(-4, 4, 0.05), np.arange(-3, 3, 0.05))
    world = np.stack([np.full(y.size, _WALL_M), y.ravel(), z.ravel()], axis=1)
    T = se3.inverse(T_world_lidar)
    points = (world @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    planes = PlaneMap(0.5, 3, 20_000)
    planes.insert(points, T_world_lidar)
    return SeenScan(points), planes


def _state(T_world_lidar: F64) -> State:
    P = np.diag([0.05**2] * 3 + [0.02**2] * 3 + [0.1] * 3 + [1e-4] * 9)
    return State(0, T_world_lidar, np.zeros(3), np.zeros(3), np.zeros(3), np.array([0, 0, -9.81]), P)


def test_shifts_are_the_derivatives_of_the_warp() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        T_world_lidar = se3.exp(rng.normal(0, 0.2, 6))
        anchor = np.r_[_WALL_M, rng.normal(0, 0.5, 2), rng.normal(0, 0.02, 6)]
        warp, P, B = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 6))
        T_cam_world = _T_CAM_LIDAR @ se3.inverse(T_world_lidar)
        if not seen_at(_EYE, T_cam_world, anchor, 2.0, warp, P):
            anchor[3:6] *= -1.0  # seen from behind
            assert seen_at(_EYE, T_cam_world, anchor, 40.0, warp, P) or warp[0, 1] != 0.0
        shifts(_EYE, T_cam_world, anchor, warp, P, B)
        for k in range(6):
            pixels = []
            for h in (1e-5, -1e-5):
                moved = _T_CAM_LIDAR @ se3.inverse(T_world_lidar @ se3.exp(h * np.eye(6)[k]))
                pixels.append(project(_EYE, *transform(moved, anchor[:3])))
            numeric = (np.array(pixels[0]) - np.array(pixels[1])) / 2e-5
            np.testing.assert_allclose(warp[:, 1:] @ B[:, k], numeric, rtol=1e-5, atol=1e-4)


def test_sample_is_bilinear_interpolation_on_a_grid() -> None:
    grey = np.random.default_rng(2).integers(0, 255, (40, 50)).astype(np.uint8)
    warp = np.array([[20.3, 1.1, -0.2], [17.8, 0.3, 0.9]])
    out = np.empty(SIDE * SIDE)
    assert sample(grey, warp, SIDE, out)
    s, t = np.meshgrid(np.arange(SIDE) - 3.5, np.arange(SIDE) - 3.5)
    u, v = (warp[:, :1] + warp[:, 1:] @ np.stack([s.ravel(), t.ravel()]))[:, :]
    np.testing.assert_allclose(out, map_coordinates(grey.astype(float), [v, u], order=1), atol=1e-9)
    assert bilinear(grey, 3.0, 4.0) == grey[4, 3]
    assert not sample(grey, np.array([[2.0, 1, 0], [20, 0, 1]]), SIDE, out)


def _sure(state: State) -> State:
    """The same with its pose known."""
    P = state.P.copy()
    P[:6] *= 1e-3
    P[:, :6] *= 1e-3
    return replace(state, P=P)


def test_no_patches_are_taken_while_the_attitude_is_unsure() -> None:
    visual, path = VisualUpdate(), SteadyPath(np.zeros(6))
    scan, planes = _wall(np.eye(4))
    image = _photograph(np.eye(4))
    state = visual.update(_state(np.eye(4)), path, image, scan, planes)
    assert np.sqrt(state.P[3, 3]) > 0.005
    for known, later in ((state, True), (_sure(state), False)):
        visual.remember(known, path, image, scan, planes)
        found = visual.update(state, path, replace(image, stamp_ns=1), scan, planes)
        assert (found is state) == later


@pytest.mark.parametrize("gain", [1.0, 0.4])
def test_a_wall_gives_back_place_attitude_exposure_and_delay(gain: float) -> None:
    visual, path = VisualUpdate(), SteadyPath(np.zeros(6))
    first, second = np.eye(4), se3.exp(np.array([0.1, 0.05, 0.02, 0.01, -0.02, 0.015]))
    scan, planes = _wall(first)
    state = visual.update(_state(first), path, _photograph(first), scan, planes)
    assert state.cameras == ("cam",)
    visual.remember(_sure(state), path, _photograph(first), scan, planes)
    wrong = second @ se3.exp(np.array([0.004, 0.02, -0.01, 0.003, -0.002, 0.002]))
    prior = replace(state, T_world_body=wrong)
    found = visual.update(prior, path, _photograph(second, gain, stamp_ns=1), scan, planes)
    error = se3.log(se3.inverse(second) @ found.T_world_body)
    assert np.abs(error[:3]).max() < 3e-3 and np.abs(error[3:]).max() < 1e-3
    assert np.exp(found.log_inverse_exposure[0]) == pytest.approx(1.0 / gain, rel=0.01)
    assert np.trace(found.P[:6, :6]) < 0.2 * np.trace(prior.P[:6, :6])
    assert visual.lost == {}


def test_a_wrong_time_of_images_is_found_where_the_camera_moves() -> None:
    visual, path = VisualUpdate(), SteadyPath(_TWIST)
    still, scan_and_planes = np.eye(4), _wall(np.eye(4))
    state = visual.update(_state(still), path, _photograph(still), *scan_and_planes)
    visual.remember(_sure(state), path, _photograph(still), *scan_and_planes)
    P = state.P.copy()
    P[:6, :6] *= 1e-6
    late = _photograph(se3.exp(-0.01 * _TWIST), stamp_ns=0)  # says 0, was taken 10 ms before
    found = visual.update(replace(state, P=P), path, replace(late, stamp_ns=2), *scan_and_planes)
    assert found.image_delay_s[0] == pytest.approx(0.010, abs=1e-3)


def test_no_patches_no_image_and_two_cameras() -> None:
    visual, path = VisualUpdate(), SteadyPath(np.zeros(6))
    scan, planes = _wall(np.eye(4))
    state = visual.update(_state(np.eye(4)), path, _photograph(np.eye(4)), scan, planes)
    broken = replace(_photograph(np.eye(4)), encoded=b"nothing", stamp_ns=5)
    assert visual.update(state, path, broken, scan, planes) is state
    visual.remember(_sure(state), path, broken, scan, planes)
    assert visual.lost == {"images not decodable": 1} and picture(broken) is None
    assert picture(replace(broken, encoded=b"")) is None  # held out: only its pose is asked for
    none = SeenScan(np.empty((0, 3), np.float32))
    visual.remember(_sure(state), path, _photograph(np.eye(4)), none, planes)
    state = visual.update(state, path, _photograph(np.eye(4), name="other"), none, planes)
    assert state.cameras == ("cam", "other") and len(state) == CAMERAS + 4
    away = se3.exp(np.array([0.0, 0, 0, 0, 0, 3.0]))
    visual.remember(_sure(state), path, _photograph(np.eye(4)), scan, planes)
    turned = replace(state, T_world_body=away)
    assert visual.update(turned, path, _photograph(np.eye(4), stamp_ns=9), scan, planes) is turned
    assert visual.lost["images without patches"] == 1


def test_an_image_of_something_else_is_not_believed() -> None:
    visual, path = VisualUpdate(), SteadyPath(np.zeros(6))
    scan, planes = _wall(np.eye(4))
    image = _photograph(np.eye(4))
    state = visual.update(_state(np.eye(4)), path, image, scan, planes)
    visual.remember(_sure(state), path, image, scan, planes)
    noise = np.random.default_rng(3).integers(0, 255, (_MODEL.height, _MODEL.width)).astype(np.uint8)
    other = replace(image, stamp_ns=3, encoded=cv2.imencode(".png", noise)[1].tobytes())
    found = visual.update(state, path, other, scan, planes)
    np.testing.assert_array_equal(found.T_world_body, state.T_world_body)
    assert visual.lost == {"images not believed": 1}
