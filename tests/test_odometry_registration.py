import numpy as np
import pytest

from artemis_edge.config import OdometryConfig
from artemis_edge.frames import ImuSamples
from artemis_edge.odometry import plane_map as pm
from artemis_edge.odometry import registration as reg
from artemis_edge.odometry import se3
from artemis_edge.odometry.motion import Motion, Prediction
from artemis_edge.odometry.plane_map import PlaneMap
from artemis_edge.odometry.search import RINGS, ball, guesses
from artemis_edge.odometry.thin import TimedPoints

OFF = np.array([0.05, -0.04, 0.03, 0.01, -0.008, 0.012])


def room(n, noise=0.0, seed=0):
    """Points on the walls, floor and ceiling of a room of 8 x 6 x 3 m around the origin."""
    rng = np.random.default_rng(seed)
    half = np.array([4.13, 3.07, 1.52])
    points = rng.uniform(-half, half, (n, 3))
    axis = rng.integers(0, 3, n)
    points[np.arange(n), axis] = rng.choice([-1, 1], n) * half[axis] + noise * rng.normal(size=n)
    return points.astype(np.float32)


def room_map(noise=0.0):
    plane_map = PlaneMap(0.5, 4, 20_000)
    plane_map.insert(room(30_000, noise), np.eye(4))
    return plane_map


def loose(T_world_lidar):
    """A prediction that hardly counts."""
    return Prediction(np.eye(4), T_world_lidar, 0.1, 10.0, 10.0)


def still(points):
    return TimedPoints(points, np.zeros(len(points), np.float32))


def moved(points, T):
    return (points.astype(float) @ T[:3, :3].T + T[:3, 3]).astype(np.float32)


def naive_match(plane_map, points, T, finest, noise2):
    """Like ``match``, from the rows of the map, one point and one level at a time."""
    pm.fit_all(plane_map.table, len(plane_map), plane_map.voxel_m)
    rows = {
        int(k): r for k, r in zip(plane_map.table.keys[: len(plane_map)], plane_map.table.rows, strict=False)
    }
    out = []
    for p in points.astype(float):
        q = T[:3, :3] @ p + T[:3, 3]
        for level in range(finest, plane_map.levels):
            cell = np.floor(np.floor(q / plane_map.voxel_m) / 2**level).astype(int).tolist()
            row = rows.get(int(pm.cell_key(level, *cell)))
            if row is None or row[pm.THICKNESS] < 0:
                continue
            normal, centre = row[pm.NORMAL : pm.NORMAL + 3], row[pm.CENTRE : pm.CENTRE + 3]
            sight = q - T[:3, 3]
            if abs(normal @ sight) < 0.05 * np.linalg.norm(sight):
                continue
            M = np.zeros((3, 3))
            M[np.triu_indices(3)] = row[pm.SPREAD : pm.SPREAD + 6]
            M = M + M.T - np.diag(np.diag(M))
            d = q - centre
            variance = row[pm.THICKNESS] * (1 + (1 + d @ M @ d) / row[pm.COUNT])
            if (normal @ d) ** 2 <= 9 * (noise2 + variance):
                out.append([*p, *normal, normal @ centre, variance])
                break
    return np.array(out).reshape(-1, 8)


def naive_linearise(matched, T, noise2):
    """Numerical Jacobian of every residual, sums as in the formula."""
    H, g, count, weight, score = np.zeros((6, 6)), np.zeros(6), 0, 0.0, 0.0

    def residual(row, x):
        pose = T @ se3.exp(x)
        return row[3:6] @ (pose[:3, :3] @ row[:3] + pose[:3, 3]) - row[6]

    for row in matched:
        r, s2 = residual(row, np.zeros(6)), noise2 + row[7]
        if r * r > 9 * s2:
            continue
        step = 1e-6
        J = np.array([residual(row, step * e) - residual(row, -step * e) for e in np.eye(6)]) / (2 * step)
        robust = (4 / (4 + r * r / s2)) ** 2
        H += robust / s2 * np.outer(J, J)
        g += robust / s2 * r * J
        count, weight, score = count + 1, weight + robust / s2, score + robust
    return H, g, count, weight, score


@pytest.mark.parametrize("finest", [0, 1, 3])
@pytest.mark.parametrize("n", [0, 1, 400])
def test_match_and_linearise_equal_their_naive_twins(finest, n):
    plane_map, T = room_map(0.02), se3.exp(OFF)
    points = room(n, 0.05, seed=9)
    matched = reg.match(plane_map, points, T, finest, 0.03**2)
    expected = naive_match(plane_map, points, T, finest, 0.03**2)
    np.testing.assert_allclose(matched[:, :8], expected, rtol=1e-6, atol=1e-9)
    lin = reg.linearise(matched, T, 0.03**2)
    for fast, slow in zip(lin, naive_linearise(matched, T, 0.03**2), strict=True):
        np.testing.assert_allclose(fast, slow, rtol=1e-5, atol=1e-4)
    assert lin.matches > 0 or n < 2
    assert np.trace(lin.observed()) == pytest.approx(1.0 if lin.matches else 0.0)


@pytest.mark.parametrize("far", [1.0, 8.0])
def test_a_known_motion_is_recovered_exactly(far):
    """Noise-free planes: the pose comes back to a millimetre, from near and from a metre off."""
    T = se3.exp(far * OFF)
    scan = still(moved(room(3000, seed=4), se3.inverse(T)))
    guess, tau = np.eye(4), 0.1 * far
    found = reg.register(room_map(), scan, loose(np.eye(4)), guess, tau, 0.03)
    error = se3.log(se3.inverse(T) @ found.T_world_lidar)
    assert np.linalg.norm(error[:3]) < 1e-3 and np.linalg.norm(error[3:]) < 3e-4
    assert found.score > 0.95 and found.matches > 2900
    assert np.linalg.eigvalsh(found.N)[0] > 0.1


def test_motion_within_the_scan_is_undone_on_the_way():
    """Points are measured while the sensor moves on from the start: only the right pose undoes it."""
    twist = np.array([2.0, -1.0, 0.3, 0.2, -0.1, 1.5])
    T = se3.exp(0.1 * twist)
    world, time_s = room(3000, seed=4), np.linspace(-0.05, 0.05, 3000).astype(np.float32)
    points = np.array(
        [
            moved(p[None], se3.inverse(T @ se3.exp(float(t) * twist)))[0]
            for p, t in zip(world, time_s, strict=True)
        ]
    )
    found = reg.register(room_map(), TimedPoints(points, time_s), loose(np.eye(4)), np.eye(4), 0.3, 0.03)
    np.testing.assert_allclose(found.T_world_lidar, T, atol=2e-3)


def test_outliers_do_not_pull():
    T = se3.exp(OFF)
    points = moved(room(3000, seed=4), se3.inverse(T))
    points[::3] += np.random.default_rng(0).uniform(-0.5, 0.5, points[::3].shape).astype(np.float32)
    found = reg.register(room_map(0.01), still(points), loose(np.eye(4)), np.eye(4), 0.1, 0.03)
    assert np.linalg.norm(se3.log(se3.inverse(T) @ found.T_world_lidar)[:3]) < 5e-3


def corridor(n, seed, noise=0.01):
    points = room(n, noise, seed) * np.array([6, 1, 1], np.float32)
    return points[np.abs(points[:, 0]) < 22]  # the ends are out of sight


def test_along_a_corridor_the_prediction_counts():
    plane_map = PlaneMap(0.5, 4, 20_000)
    plane_map.insert(corridor(60_000, 1), np.eye(4))
    T = se3.exp(np.array([0.4, 0.03, 0.02, 0.0, 0.0, 0.01]))
    scan = still(moved(corridor(3000, 2), se3.inverse(T)))
    predicted = se3.exp(np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0]))
    prediction = Prediction(np.eye(4), predicted, 0.1, 0.05, 0.05)
    found = reg.register(plane_map, scan, prediction, predicted, 0.1, 0.03)
    assert np.linalg.eigvalsh(found.N)[0] < reg.DEGENERATE
    np.testing.assert_allclose(found.T_world_lidar, T, atol=0.01)


def test_nothing_to_match_leaves_the_prediction():
    predicted = se3.exp(OFF)
    for points in (np.empty((0, 3), np.float32), np.full((10, 3), 500.0, np.float32)):
        found = reg.register(room_map(), still(points), loose(predicted), predicted, 0.1, 0.03)
        assert found.matches == 0 and found.score == 0.0
        np.testing.assert_allclose(found.T_world_lidar, predicted, atol=1e-9)


def test_ball_reaches_and_is_bounded():
    points = ball(1.0, 0.4)
    assert (points[0] == 0).all()
    assert np.linalg.norm(points, axis=1).max() == pytest.approx(1.0)
    assert len(np.unique(points, axis=0)) == len(points) <= (2 * RINGS + 1) ** 3
    np.testing.assert_array_equal(ball(0.0, 0.4), np.zeros((1, 3)))
    assert len(ball(100.0, 0.1)) <= (2 * RINGS + 1) ** 3


def test_guesses_shift_and_turn():
    T = se3.exp(OFF)
    poses = guesses(T, 1.0, 0.5, 10.0, 1.0)
    np.testing.assert_array_equal(poses[0], T)
    twists = np.array([se3.log(se3.inverse(T) @ pose) for pose in poses])
    assert np.linalg.norm(twists[:, :3], axis=1).max() == pytest.approx(1.0)
    assert np.linalg.norm(twists[:, 3:], axis=1).max() == pytest.approx(0.5)


def imu(rate, accel=(0.0, 0.0, 9.81), n=20, start_ns=0):
    stamps = start_ns + np.arange(n) * 5_000_000
    return ImuSamples(stamps, np.tile(np.array(rate), (n, 1)), np.tile(np.array(accel), (n, 1)))


def test_constant_velocity_and_its_deviation():
    twist = np.array([5.0, 0.1, 0.0, 0.0, 0.0, 0.4])
    motion = Motion(se3.exp(OFF), 10**9, twist, known=True)
    config = OdometryConfig(acceleration=2.0, angular_acceleration=4.0)
    prediction = motion.predict(10**9 + 500_000_000, config, ImuSamples.empty())
    np.testing.assert_allclose(prediction.T_world_lidar, se3.exp(OFF) @ se3.exp(0.5 * twist))
    assert (prediction.sigma_m, prediction.sigma_rad) == (0.25, 0.5)
    np.testing.assert_allclose(prediction.twist(prediction.T_world_lidar), twist, atol=1e-12)
    T = se3.exp(np.array([1.0, 0, 0, 0, 0, 0]))
    rebased = prediction.rebased(T)
    np.testing.assert_allclose(rebased.T_world_lidar, T @ se3.exp(0.5 * twist), atol=1e-12)


def test_a_gyroscope_knows_the_turn():
    motion = Motion(np.eye(4), 0, np.zeros(6), known=True)
    prediction = motion.predict(100_000_000, OdometryConfig(), imu([0.0, 0.0, 2.0], n=30))
    np.testing.assert_allclose(prediction.T_world_lidar, se3.exp(np.array([0, 0, 0, 0, 0, 0.2])), atol=1e-12)
    np.testing.assert_allclose(prediction.twist(np.eye(4)), [0, 0, 0, 0, 0, 2.0])
    assert prediction.sigma_rad == pytest.approx(OdometryConfig().gyro_sigma * 0.1)
