"""Sessions of the virtual rig: complete, reproducible, with a fitting truth; and the measures by it."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from scipy.spatial import cKDTree

from artemis_edge.errors import InputError
from artemis_edge.export.ply import Mesh, bare_mesh, read_mesh, read_points
from artemis_edge.frames import F32, F64
from artemis_edge.session import simulate as sim
from artemis_edge.session import truth
from artemis_edge.session.messages import CompressedImage, Imu, PointCloud2, TFMessage
from artemis_edge.session.rig import START_NS
from artemis_edge.session.truth_files import POINT_TRUTH, POINTS_TOPIC
from artemis_edge.session.writer import POINT
from artemis_edge.trajectory import interpolate, read_tum

FAST = {
    "image_width": "96",
    "truth_images": "2",
    "density": "0.5",
    "reach_m": "60",
    "reference_spacing_m": "0.05",
}


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sim") / "session"
    seen: list[tuple[int, int]] = []
    summary = sim.simulate("street", 7, 2.5, "avia", out, FAST, lambda a, b: seen.append((a, b)))
    assert seen == [(k + 1, 25) for k in range(25)]
    assert summary.frames == summary.images == 25
    assert summary.imu_samples == 501
    assert summary.beams == 25 * 12_000
    assert 0.6 * summary.beams < summary.points < summary.beams
    assert summary.reference_points > 50_000
    assert summary.views == 2
    return out


def messages(path: Path, topic: str) -> list[bytes]:
    with path.open("rb") as file:
        return [m.data for _, _, m in make_reader(file).iter_messages(topics=[topic])]


def clouds(path: Path) -> list[tuple[int, np.ndarray]]:  # type: ignore[type-arg]
    out = []
    for data in messages(path, "/lidar/points"):
        cloud = PointCloud2.decode(data)
        out.append((cloud.header.stamp_ns, np.frombuffer(bytes(cloud.data), POINT)))
    return out


def point_truths(path: Path) -> list[np.ndarray]:  # type: ignore[type-arg]
    return [
        np.frombuffer(bytes(PointCloud2.decode(data).data), POINT_TRUTH)
        for data in messages(path, POINTS_TOPIC)
    ]


def test_topics_rates_and_order(session: Path) -> None:
    with (session / "session.mcap").open("rb") as file:
        reader = make_reader(file)
        rows = [
            (c.topic, m.log_time, m.publish_time) for _, c, m in reader.iter_messages(log_time_order=False)
        ]
    count = Counter(topic for topic, _, _ in rows)
    assert count["/lidar/points"] == 25 and count["/imu"] == 501
    assert count["/camera/image/compressed"] == count["/camera/camera_info"] == 25
    assert "/tf" not in count and "/odom" not in count  # the truth is not in the recording
    log = [t for topic, t, _ in rows if topic != "/tf_static"]
    assert log == sorted(log)
    stamps = [p for topic, _, p in rows if topic == "/lidar/points"]
    assert stamps == [START_NS + k * 100_000_000 for k in range(25)]
    assert all(stamp % 100_000_000 == 0 for stamp in stamps)
    imu = np.array([p for topic, _, p in rows if topic == "/imu"])
    assert (np.diff(imu) == 5_000_000).all() and imu[0] == START_NS
    photos = [p for topic, _, p in rows if topic == "/camera/image/compressed"]
    assert photos == [stamp + 50_000_000 for stamp in stamps]


def test_points_lie_on_the_world_when_moved_by_the_truth(session: Path) -> None:
    poses = read_tum(session / "truth" / "trajectory_400hz.tum")
    reference = read_points(session / "truth" / "reference.ply").points
    tree = cKDTree(reference)
    distance = []
    said = point_truths(session / "truth" / "points.mcap")
    for (stamp, cloud), point in list(zip(clouds(session / "session.mcap"), said, strict=True))[::6]:
        points = np.column_stack([cloud["x"], cloud["y"], cloud["z"]]).astype(np.float64)
        T = interpolate(poses, stamp + cloud["t"].astype(np.int64))
        world = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
        near = (np.linalg.norm(points, axis=1) < 25) & (point["moving"] == 0) & (point["mixed"] == 0)
        assert near.mean() > 0.25
        distance.append(tree.query(world[near])[0])
    joined = np.concatenate(distance)
    assert np.median(joined) < 0.035  # 2 cm of noise, 5 cm between reference points
    assert np.mean(joined < 0.12) > 0.98


def test_lines_and_times_are_those_of_the_sensor(session: Path) -> None:
    _, cloud = clouds(session / "session.mcap")[3]
    assert set(np.unique(cloud["line"])) == set(range(6))
    assert (np.diff(cloud["t"].astype(np.int64)) > 0).all() and cloud["t"].max() < 100_000_000
    number = np.rint(cloud["t"] * 1e-9 * 240_000).astype(int)
    np.testing.assert_array_equal(number % 6, cloud["line"])
    assert cloud["intensity"].min() > 0 and cloud["intensity"].max() <= 1


def test_world_frame_is_the_first_lidar_frame_levelled(session: Path) -> None:
    poses = read_tum(session / "truth" / "trajectory.tum")
    assert len(poses) == 25 and poses.stamp_ns[0] == START_NS
    np.testing.assert_allclose(poses.T_world_lidar[0], np.eye(4), atol=2e-6)
    dense = read_tum(session / "truth" / "trajectory_400hz.tum")
    assert len(dense) == 1001
    np.testing.assert_allclose(interpolate(dense, poses.stamp_ns), poses.T_world_lidar, atol=1e-5)
    ground = read_mesh(session / "truth" / "mesh.ply")
    names = {name: label for label, name in ground.label_names.items()}
    under = (ground.labels == names["ground"]) & (np.abs(ground.vertices[:, :2]).max(axis=1) < 3)
    assert np.median(ground.vertices[under, 2]) == pytest.approx(-1.45, abs=0.2)


def test_calibration_is_in_the_session(session: Path) -> None:
    frames = {}
    for data in messages(session / "session.mcap", "/tf_static"):
        for item in TFMessage.decode(data).transforms:
            frames[(item.header.frame_id, item.child_frame_id)] = item
    assert set(frames) == {("lidar", "cam"), ("imu", "lidar")}
    np.testing.assert_allclose(frames[("imu", "lidar")].translation, [0.04165, 0.02326, -0.0284])


def test_photographs_are_pictures(session: Path) -> None:
    pictures = messages(session / "session.mcap", "/camera/image/compressed")
    picture = CompressedImage.decode(pictures[5])
    image = cv2.imdecode(np.frombuffer(bytes(picture.data), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (77, 96, 3)
    assert image.std() > 20


def test_imu_begins_at_rest(session: Path) -> None:
    samples = [Imu.decode(data) for data in messages(session / "session.mcap", "/imu")[:200]]
    accel = np.array([s.accel for s in samples])
    np.testing.assert_allclose(accel.mean(axis=0), [0, 0, 9.80665], atol=0.1)
    assert accel.std(axis=0).max() < 0.05


def test_truth_describes_itself(session: Path) -> None:
    world = json.loads((session / "truth" / "world.json").read_text())
    assert world["seed"] == 7 and world["lidar"] == "avia"
    assert world["settings"]["density"] == 0.5
    assert world["classes"]["3"] == "car"
    reference = read_points(session / "truth" / "reference.ply")
    assert reference.label_names[1] == "ground"
    assert reference.labels is not None
    assert {1, 2, 3, 6} <= set(np.unique(reference.labels).tolist())


def test_equal_input_gives_equal_bytes(session: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    sim.simulate("street", 7, 2.5, "avia", again, FAST)
    for name in (
        "session.mcap",
        "truth/trajectory.tum",
        "truth/mesh.ply",
        "truth/reference.ply",
        "truth/world.json",
    ):
        assert (session / name).read_bytes() == (again / name).read_bytes(), name


def test_settings_and_seed_change_the_session(tmp_path: Path) -> None:
    base = {"camera": "off", "reference": "off", "mesh": "off", "density": "0.1", "reach_m": "40"}
    sizes = []
    for k, (seed, more) in enumerate([(1, {}), (2, {}), (1, {"imu": "off"}), (1, {"range_noise_m": "0"})]):
        summary = sim.simulate("street", seed, 0.3, "avia", tmp_path / str(k), {**base, **more})
        assert summary.images == 0 and summary.reference_points == 0
        assert not (tmp_path / str(k) / "truth" / "mesh.ply").exists()
        assert summary.imu_samples == (0 if "imu" in more else 61)
        sizes.append((tmp_path / str(k) / "session.mcap").read_bytes())
    assert len(set(sizes)) == 4


@pytest.mark.parametrize(
    ("world", "lidar", "seconds", "settings", "message"),
    [
        ("moon", "avia", 1.0, {}, "no virtual world named 'moon'; there are: street"),
        ("street", "sonar", 1.0, {}, "no virtual LiDAR named 'sonar'; there are: avia"),
        ("street", "avia", 0.01, {}, "give 0.1 or more"),
        ("street", "avia", 1.0, {"colour": "red"}, "there are: density"),
        ("street", "avia", 1.0, {"density": "2"}, "density"),
        ("street", "avia", 1.0, {"density": "much"}, "density"),
        ("street", "avia", 60.0, {"length": "30"}, "give length="),
    ],
)
def test_mistakes_are_told_in_one_sentence(
    world: str, lidar: str, seconds: float, settings: dict[str, str], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError) as told:
        sim.simulate(world, 0, seconds, lidar, tmp_path / "s", settings)
    assert message in str(told.value)
    assert "\n" not in str(told.value)
    assert not (tmp_path / "s").exists()


# --- truth.py


def grid(n: int, spacing: float, z: float = 0.0) -> Mesh:
    """Flat square of n x n cells, facing up."""
    x, y = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
    vertices = np.column_stack([x.ravel() * spacing, y.ravel() * spacing, np.full((n + 1) ** 2, z)])
    k = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate(
        [np.column_stack([k, k + n + 1, k + n + 2]), np.column_stack([k, k + n + 2, k + 1])]
    )
    return bare_mesh(vertices.astype(np.float32), faces.astype(np.int32))


def flipped(mesh: Mesh, share: float) -> Mesh:
    faces = mesh.faces.copy()
    count = int(len(faces) * share)
    faces[:count] = faces[:count, ::-1]
    return bare_mesh(mesh.vertices, faces)


def test_winding_counts_flipped_triangles() -> None:
    world, mesh = grid(4, 0.5), grid(20, 0.1, z=0.02)
    for share in (0.0, 0.25, 1.0):
        report = truth.evaluate_against_world(flipped(mesh, share), world)
        assert report.winding["nearest"].judged == report.triangles == 800
        assert report.winding["nearest"].share == pytest.approx(1 - share)
        assert report.winding["nearest"].area_share == pytest.approx(1 - share, abs=1e-3)
        assert report.area_m2 == pytest.approx(4.0, rel=1e-4)


def test_only_triangles_near_a_surface_are_judged() -> None:
    report = truth.evaluate_against_world(grid(20, 0.1, z=0.3), grid(4, 0.5))
    assert report.winding["nearest"].judged == 0
    assert np.isnan(report.winding["nearest"].share)
    assert report.bridging_area_share == 1.0  # all of it hangs 0.3 m in the air


def test_observed_surfaces_judge_the_winding() -> None:
    mesh = grid(20, 0.1)
    both = grid(4, 0.5)
    world = bare_mesh(both.vertices, np.concatenate([both.faces, both.faces[:, ::-1]]))
    points: F32 = np.random.default_rng(0).uniform(0, 2, (20_000, 3)).astype(np.float32)
    points[:, 2] = 0
    normals = np.tile(np.array([0, 0, 1], np.float32), (len(points), 1))
    assert truth.evaluate_against_world(mesh, world, truth.Reference(points, normals)).winding == {
        "nearest": truth.Winding(1.0, pytest.approx(1.0), 800),
        "mean": truth.Winding(1.0, pytest.approx(1.0), 800),
    }


def bridged(gap: float, spacing: float) -> tuple[Mesh, Mesh]:
    """World: two plates ``gap`` apart. Mesh: both plates, and a strip of triangles across the gap."""
    plate = grid(20, spacing)
    offset = np.array([20 * spacing + gap, 0, 0], np.float32)
    count = len(plate.vertices)
    vertices = np.concatenate([plate.vertices, plate.vertices + offset])
    faces = np.concatenate([plate.faces, plate.faces + count])
    world = bare_mesh(vertices, faces)
    left, right = 20 * 21 + np.arange(20), count + np.arange(20)
    strip = np.concatenate(
        [np.column_stack([left, right, right + 1]), np.column_stack([left, right + 1, left + 1])]
    )
    return world, bare_mesh(vertices, np.concatenate([faces, strip]).astype(np.int32))


def test_a_strip_across_a_wide_gap_is_bridging() -> None:
    world, mesh = bridged(gap=1.0, spacing=0.1)
    report = truth.evaluate_against_world(mesh, world)
    whole = 2 * 4.0 + 2.0
    # at the rims the median edge lies between 0.1 m and the diagonals' 0.14 m: what is further than 0.15 to
    # 0.21 m from both rims hangs
    assert 0.58 * 2.0 / whole < report.bridging_area_share < 0.70 * 2.0 / whole
    assert report.winding["nearest"].share > 0.99


def test_a_strip_across_a_narrow_gap_is_not() -> None:
    world, mesh = bridged(gap=0.25, spacing=0.1)
    assert truth.evaluate_against_world(mesh, world).bridging_area_share == 0.0
    assert truth.evaluate_against_world(world, world).bridging_area_share == 0.0


def test_grouped_median_equals_numpy() -> None:
    rng = np.random.default_rng(0)
    group, value = rng.integers(0, 20, 300), rng.normal(size=300)
    expected: F64 = np.array([np.median(value[group == k]) if (group == k).any() else 0 for k in range(21)])
    np.testing.assert_allclose(truth._grouped_median(group, value, 21), expected)


def test_empty_mesh_is_refused() -> None:
    empty = bare_mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    with pytest.raises(InputError, match="without triangles"):
        truth.evaluate_against_world(empty, grid(2, 1.0))


def test_world_judges_itself_as_right(session: Path) -> None:
    world = session / "truth" / "mesh.ply"
    mesh = read_mesh(world)
    near = np.linalg.norm(mesh.vertices[mesh.faces].mean(axis=1)[:, :2], axis=1) < 12
    report = truth.evaluate_against_world(
        bare_mesh(mesh.vertices, mesh.faces[near]),
        mesh,
        truth.read_reference(session / "truth" / "reference.ply"),
    )
    assert report.bridging_area_share < 1e-3
    assert (
        report.winding["nearest"].area_share > 0.9
    )  # thin things have their hidden sides beside the observed ones


def test_a_foreign_reference_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "reference.ply"
    path.write_text("ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(InputError, match="simulate it again"):
        truth.read_reference(path)
