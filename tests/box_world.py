"""A small world of boxes with a spinning LiDAR and an IMU, where every pose is known."""

import numpy as np

from artemis_edge.frames import ImuSamples, LidarScan, SyncedFrame
from artemis_edge.odometry import se3

RINGS, COLUMNS, PERIOD_S = 24, 450, 0.1
START_NS = 10**15
GRAVITY = np.array([0.0, 0.0, -9.80665])


def street():
    """Boxes (n, 6) lower and upper corner: houses with gaps, posts, parked cars; the ground is z = 0."""
    rng = np.random.default_rng(3)
    boxes = []
    for side in (-1, 1):
        for x in np.arange(-50, 110, 14.0):
            y = side * rng.uniform(8, 11)
            boxes.append([x, min(y, 2 * y), 0, x + rng.uniform(9, 14), max(y, 2 * y), rng.uniform(4, 9)])
            post = x + rng.uniform(2, 12)
            boxes.append([post, side * 6.5 - 0.2, 0, post + 0.4, side * 6.5 + 0.2, 5])
            car = x + rng.uniform(0, 9)
            boxes.append([car, side * 5 - 0.9, 0.2, car + 4.2, side * 5 + 0.9, 1.5])
    return np.array(boxes, float)


def corridor():
    """Two smooth walls and a ceiling, without ends in sight."""
    return np.array(
        [[-500, 1.5, 0, 500, 3, 4], [-500, -3, 0, 500, -1.5, 4], [-500, -3, 2.5, 500, 3, 4]], float
    )


def ranges(origin, direction, boxes):
    """Distance (n,) along rays to the ground or the nearest box; infinite where there is none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / direction
        ground = -origin[:, 2] * inverse[:, 2]
        t = np.where(ground > 0, ground, np.inf)
        for box in boxes:
            a, b = (box[:3] - origin) * inverse, (box[3:] - origin) * inverse
            enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            t = np.where((enter <= leave) & (enter > 0) & (enter < t), enter, t)
    return t


def scan(pose_at, middle_s, boxes, noise=0.01, seed=0, period_s=PERIOD_S, reach=60.0):
    """A spinning LiDAR: every column at its own time and pose; points in the sensor's frame then."""
    time_s = np.linspace(-period_s / 2, period_s / 2, COLUMNS, endpoint=False)
    azimuth = -2 * np.pi * time_s / period_s
    elevation = np.radians(np.linspace(-25, 20, RINGS))[:, None]
    beam = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation) + 0 * azimuth,
        ],
        axis=-1,
    )
    T = np.array([pose_at(middle_s + t) for t in time_s])
    direction = np.einsum("cij,rcj->rci", T[:, :3, :3], beam).reshape(-1, 3)
    origin = np.broadcast_to(T[:, :3, 3], beam.shape).reshape(-1, 3)
    distance = ranges(origin, direction, boxes)
    seen = distance < reach
    distance = distance[seen] + noise * np.random.default_rng(seed).normal(size=seen.sum())
    points = (beam.reshape(-1, 3)[seen] * distance[:, None]).astype(np.float32)
    return points, np.tile(time_s, RINGS)[seen].astype(np.float32)


def frame(k, pose_at, boxes, spacing_s=PERIOD_S, offset_s=0.0, **options):
    """Frame k; its stamp lies ``offset_s`` before the middle of the turn."""
    points, time_s = scan(pose_at, k * spacing_s + offset_s, boxes, seed=k, **options)
    stamp = START_NS + round(k * spacing_s * 1e9)
    return SyncedFrame(k, stamp, (LidarScan(points, stamp, time_s + np.float32(offset_s)),))


def imu(pose_at, first_s, last_s, origin=(0.0, 0.0, 0.0), hz=200.0, noise=0.0, bias=0.0, seed=0):
    """Samples of an IMU at ``origin`` in the lidar frame, from the derivatives of the LiDAR's poses."""
    h, gyro, force = 1e-3, [], []
    stamps = START_NS + np.rint(np.arange(np.ceil(first_s * hz), last_s * hz) / hz * 1e9).astype(np.int64)
    for t in (stamps - START_NS) * 1e-9:
        before, now, after = (pose_at(t + dt) for dt in (-h, 0.0, h))
        gyro.append(se3.log(se3.inverse(before) @ after)[3:] / (2 * h))
        places = [T[:3, :3] @ np.array(origin) + T[:3, 3] for T in (before, now, after)]
        force.append(now[:3, :3].T @ ((places[0] - 2 * places[1] + places[2]) / h**2 - GRAVITY))
    draw = np.random.default_rng(seed).normal(size=(2, len(stamps), 3))
    gyro = np.array(gyro) + 0.1 * (bias + noise * draw[0])
    return ImuSamples(stamps, gyro, np.array(force) + bias + noise * draw[1], np.array(origin))
