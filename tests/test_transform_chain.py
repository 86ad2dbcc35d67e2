"""A session with its truth: header stamps, /tf and /tf_static, composed by other libraries, place the camera."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation, Slerp

from artemis_edge.frames import F64
from artemis_edge.session.rig import T_IMU_LIDAR, T_LIDAR_CAM
from artemis_edge.session.simulate import simulate
from artemis_edge.session.writer import SessionWriter
from artemis_edge.trajectory import inverse, read_tum

#: Topic, type and decoded message, as a library gives them.
Read = Callable[[Path], Iterator[tuple[str, str, Any]]]
SETTINGS = {
    "image_width": "64",
    "density": "0.02",
    "reach_m": "20",
    "reference": "off",
    "point_truth": "off",
    "mesh": "off",
}
EVERY = 4  # poses of the 400 Hz truth


def by_rosbags(path: Path) -> Iterator[tuple[str, str, Any]]:
    with AnyReader([path]) as bag:
        for connection, _, raw in bag.messages():
            yield connection.topic, connection.msgtype, bag.deserialize(raw, connection.msgtype)


def by_mcap_ros2(path: Path) -> Iterator[tuple[str, str, Any]]:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, _, message in reader.iter_decoded_messages(log_time_order=False):
            yield channel.topic, schema.name, message


LIBRARIES: dict[str, Read] = {"rosbags": by_rosbags, "mcap-ros2-support": by_mcap_ros2}


def stamp_ns(header: Any) -> int:
    """rosbags and mcap-ros2-support name the part below a second differently."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second along a facade, with the true poses of the IMU in /tf of a second file, as odometry would write."""
    folder = tmp_path_factory.mktemp("walk")
    simulate("facade", 3, 0.5, "avia", folder, SETTINGS)
    truth = read_tum(folder / "truth" / "trajectory_400hz.tum")
    with SessionWriter(folder / "tf.mcap") as out:
        for stamp, T in list(zip(truth.stamp_ns.tolist(), truth.T_world_lidar, strict=True))[::EVERY]:
            out.write_tf(stamp, "world", "imu", T @ inverse(T_IMU_LIDAR))
    return folder


def everything(read: Read, walk: Path) -> list[tuple[str, str, Any]]:
    return [*read(walk / "session.mcap"), *read(walk / "tf.mcap")]


def matrix(transform: Any) -> F64:
    t, q = transform.translation, transform.rotation
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = t.x, t.y, t.z
    return T


class Tree:
    """Transforms by child frame, as tf2 keeps them: moving ones are interpolated."""

    def __init__(self, messages: list[tuple[str, str, Any]]) -> None:
        self.parent: dict[str, str] = {}
        self.times: dict[str, list[int]] = {}
        self.poses: dict[str, list[F64]] = {}
        for topic, _, message in messages:
            for item in message.transforms if topic in ("/tf", "/tf_static") else ():
                child = item.child_frame_id
                self.parent[child] = item.header.frame_id
                self.times.setdefault(child, []).append(stamp_ns(item.header))
                self.poses.setdefault(child, []).append(matrix(item.transform))

    def to_parent(self, child: str, at_ns: int) -> F64:
        times, poses = self.times[child], np.array(self.poses[child])
        if len(times) == 1:
            return np.array(poses[0])
        seconds = (np.array(times) - times[0]) * 1e-9
        at = (at_ns - times[0]) * 1e-9
        T = np.eye(4)
        T[:3, :3] = Slerp(seconds, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
        T[:3, 3] = [np.interp(at, seconds, poses[:, axis, 3]) for axis in range(3)]
        return T

    def to_world(self, frame: str, at_ns: int) -> F64:
        T = np.eye(4)
        while frame in self.parent:
            T = self.to_parent(frame, at_ns) @ T
            frame = self.parent[frame]
        assert frame == "world"
        return T


def true_camera(walk: Path, at_ns: int) -> F64:
    """T_world_cam by the truth, whose poses fall on the photographs' stamps."""
    truth = read_tum(walk / "truth" / "trajectory_400hz.tum")
    row = int(np.searchsorted(truth.stamp_ns, at_ns))
    assert truth.stamp_ns[row] == at_ns
    T: F64 = truth.T_world_lidar[row] @ T_LIDAR_CAM
    return T


@pytest.mark.parametrize("library", LIBRARIES)
def test_the_chain_of_transforms_places_the_camera(library: str, walk: Path) -> None:
    messages = everything(LIBRARIES[library], walk)
    tree = Tree(messages)
    assert tree.parent == {"cam": "lidar", "lidar": "imu", "imu": "world"}
    headers = [message.header for topic, _, message in messages if topic == "/camera/image/compressed"]
    assert len(headers) == 5
    for header in headers:
        T, truth = tree.to_world(header.frame_id, stamp_ns(header)), true_camera(walk, stamp_ns(header))
        assert np.linalg.norm(T[:3, 3] - truth[:3, 3]) < 1e-5
        turned = Rotation.from_matrix(T[:3, :3].T @ truth[:3, :3]).magnitude()
        assert turned < 1e-5


def plain(message: Any) -> Any:
    """A message as numbers and texts, whichever library read it; constants of its type left out."""
    if isinstance(message, str | int | float | bool):
        return message
    if isinstance(message, bytes | bytearray | memoryview | np.ndarray):
        return np.asarray(memoryview(message) if not isinstance(message, np.ndarray) else message).tolist()
    if isinstance(message, list | tuple):
        return [plain(item) for item in message]
    names = getattr(message, "__slots__", None) or vars(message)
    return {n: plain(getattr(message, n)) for n in map(str, names) if n.islower() and n[0] != "_"}


def test_both_libraries_find_equal_counts_and_values(walk: Path) -> None:
    one, other = (everything(read, walk) for read in LIBRARIES.values())
    counts = Counter(topic for topic, _, _ in one)
    assert counts == Counter(topic for topic, _, _ in other)
    assert counts["/imu"] == 101 and counts["/lidar/points"] == counts["/camera/exposure"] == 5
    order = [sorted(found, key=lambda item: item[0]) for found in (one, other)]
    for (topic, kind, left), (_, same_kind, right) in zip(*order, strict=True):
        assert kind == same_kind
        assert plain(left) == plain(right), topic
