"""Sessions of the virtual rig: complete, reproducible, with a fitting truth; and the measures by it."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from artemis_drivers.virtual.proximity import anything_within
from artemis_drivers.virtual.raycast import build_bvh
from mcap.reader import make_reader
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from artemis_edge.config import InputConfig
from artemis_edge.datasets import open_input
from artemis_edge.errors import InputError, RunError
from artemis_edge.evaluate.by_class import score_classes
from artemis_edge.export.ply import Mesh, bare_mesh, read_mesh, read_points
from artemis_edge.frames import F32, F64, CameraModel
from artemis_edge.render import render_camera
from artemis_edge.session import simulate as sim
from artemis_edge.session import true_views, truth, winding
from artemis_edge.session.messages import CameraExposure, CompressedImage, Image, Imu, PointCloud2, TFMessage
from artemis_edge.session.recording import record
from artemis_edge.session.rig import START_NS, Settings, build_rig, read_settings
from artemis_edge.session.truth_files import POINT_TRUTH, POINTS_TOPIC
from artemis_edge.session.writer import POINT
from artemis_edge.trajectory import interpolate, inverse, read_tum

FAST = {
    "image_width": "96",
    "truth_images": "2",
    "density": "0.5",
    "reach_m": "60",
    "reference_spacing_m": "0.05",
}


SECONDS, FRAMES, SAMPLES = 1.5, 15, 301


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sim") / "session"
    seen: list[tuple[int, int]] = []
    summary = sim.simulate("street", 7, SECONDS, "avia", out, FAST, lambda a, b: seen.append((a, b)))
    assert seen == [(k + 1, FRAMES) for k in range(FRAMES)]
    assert summary.frames == summary.images == FRAMES
    assert summary.imu_samples == SAMPLES
    assert summary.beams == FRAMES * 12_000
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
    assert count["/lidar/points"] == FRAMES and count["/imu"] == SAMPLES
    assert count["/camera/image/compressed"] == count["/camera/camera_info"] == FRAMES
    assert "/tf" not in count and "/odom" not in count  # the truth is not in the recording
    log = [t for topic, t, _ in rows if topic != "/tf_static"]
    assert log == sorted(log)
    stamps = [p for topic, _, p in rows if topic == "/lidar/points"]
    assert stamps == [START_NS + k * 100_000_000 for k in range(FRAMES)]
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
    assert len(poses) == FRAMES and poses.stamp_ns[0] == START_NS
    np.testing.assert_allclose(poses.T_world_lidar[0], np.eye(4), atol=2e-6)
    dense = read_tum(session / "truth" / "trajectory_400hz.tum")
    assert len(dense) == 2 * SAMPLES - 1
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
    sim.simulate("street", 7, SECONDS, "avia", again, FAST)
    for name in (
        "session.mcap",
        "truth/trajectory.tum",
        "truth/mesh.ply",
        "truth/reference.ply",
        "truth/world.json",
    ):
        assert (session / name).read_bytes() == (again / name).read_bytes(), name


def test_threads_do_not_show(tmp_path: Path) -> None:
    """Whatever is made ahead, the same bytes are written."""
    settings = read_settings({"image_width": "64", "density": "0.1", "reach_m": "40"})
    files = []
    for ahead in (1, 4):
        rig = build_rig("courtyard", 3, 1.0, "mid360", settings)
        path = tmp_path / f"{ahead}.mcap"
        counts = record(rig, 10, path, lambda frame, scene, k: None, None, ahead)
        assert (counts.images, counts.imu) == (10, 201)
        files.append(path.read_bytes())
    assert files[0] == files[1]


def test_a_failing_disk_ends_the_recording(tmp_path: Path) -> None:
    rig = build_rig("facade", 3, 1.0, "avia", read_settings({"image_width": "64", "density": "0.05"}))

    def fails(frame: object, scene: object, k: int) -> None:
        raise RunError("the disk is full")

    with pytest.raises(RunError, match="the disk is full"):
        record(rig, 10, tmp_path / "s.mcap", fails, None)


# every world with one of the LiDARs in turn, and every LiDAR in the first world
_PAIRS = [(world, sim.LIDAR_NAMES[k % len(sim.LIDAR_NAMES)]) for k, world in enumerate(sim.WORLDS)]
_PAIRS += [(sim.WORLDS[0], lidar) for lidar in sim.LIDAR_NAMES if (sim.WORLDS[0], lidar) not in _PAIRS]


@pytest.mark.parametrize(("world", "lidar"), _PAIRS)
def test_every_world_and_lidar(world: str, lidar: str, tmp_path: Path) -> None:
    settings = {"camera": "off", "density": "0.05", "reach_m": "40", "reference_spacing_m": "0.2"}
    summary = sim.simulate(world, 2, 0.2, lidar, tmp_path, settings)
    # a facade and half the sky, a street's sky, and a spinning sensor's beams above the roofs
    assert 0.2 * summary.beams < summary.points <= summary.beams
    assert summary.reference_points > 100
    reference = truth.read_reference(tmp_path / "truth" / "reference.ply")
    assert reference.views is not None
    assert ((reference.views * reference.normals).sum(axis=1) > 0).all()


def test_dual_return_and_mosaic(tmp_path: Path) -> None:
    settings = {**FAST, "returns": "2", "image_output": "bayer", "mesh": "off", "reference": "off"}
    sim.simulate("courtyard", 2, 0.3, "avia", tmp_path, settings)
    cloud = clouds(tmp_path / "session.mcap")[0][1]
    assert set(np.unique(cloud["tag"] >> 4)) >= {1, 2}
    image = Image.decode(messages(tmp_path / "session.mcap", "/camera/image")[0])
    assert (image.width, image.height, image.encoding) == (96, 77, "bayer_rggb8")
    assert np.frombuffer(bytes(image.data), np.uint8).std() > 5
    frames = list(open_input(tmp_path, InputConfig()).frames())
    assert len(frames) == 3 and len(frames[0].images) == 1


def test_exposure_is_in_the_session(session: Path) -> None:
    found = [CameraExposure.decode(data) for data in messages(session / "session.mcap", "/camera/exposure")]
    assert len(found) == FRAMES
    assert all(5e-5 <= item.exposure_s <= 0.005 and 1 <= item.gain <= 8 for item in found)
    read = [
        image.exposure_s for frame in open_input(session, InputConfig()).frames() for image in frame.images
    ]
    assert read == [item.exposure_s for item in found]


def test_points_know_what_they_are(session: Path) -> None:
    world = json.loads((session / "truth" / "world.json").read_text())
    assert world["classes"]["1"] == "ground"
    poses = read_tum(session / "truth" / "trajectory_400hz.tum")
    (stamp, cloud), said = (
        clouds(session / "session.mcap")[8],
        point_truths(session / "truth" / "points.mcap")[8],
    )
    assert len(cloud) == len(said)
    T = interpolate(poses, stamp + cloud["t"].astype(np.int64))
    points = np.column_stack([cloud["x"], cloud["y"], cloud["z"]]).astype(np.float64)
    place = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
    near = (np.linalg.norm(points, axis=1) < 15) & (said["mixed"] == 0)
    assert np.median(place[near & (said["label"] == 1), 2]) == pytest.approx(-1.45, abs=0.2)
    assert (said["instance"] >= 0).all()
    # what moves is told apart, and written where it was met
    moving = read_points(session / "truth" / "moving.ply")
    assert moving.labels is not None
    assert (len(moving.points) > 0) == any(
        p["moving"].any() for p in point_truths(session / "truth/points.mcap")
    )


def test_true_views_agree_with_the_mesh(session: Path) -> None:
    index = json.loads((session / "truth" / "views" / "PHOTOS.json").read_text())["photos"]
    assert len(index) == 2
    mesh = read_mesh(session / "truth" / "mesh.ply")
    for entry in index:
        picture = cv2.imread(str(session / "truth" / "views" / entry["file"]))
        assert picture is not None and picture.shape == (77, 96, 3) and picture.std() > 10
        arrays = np.load(session / "truth" / "views" / entry["truth"])
        keys = ("fx", "fy", "cx", "cy")
        camera = CameraModel(96, 77, *(entry[k] for k in keys), tuple(entry["distortion"]))
        seen = render_camera(camera, inverse(np.array(entry["T_cam_world"])), mesh.vertices, mesh.faces)
        both = np.isfinite(seen.depth) & np.isfinite(arrays["depth"])
        assert both.mean() > 0.5
        assert np.median(np.abs(seen.depth - arrays["depth"])[both]) < 1e-3
        label = mesh.labels[mesh.faces[seen.triangle, 0]]
        assert np.mean((label == arrays["label"])[both]) > 0.95


def test_any_view_of_a_written_session(session: Path, tmp_path: Path) -> None:
    index = json.loads((session / "truth" / "views" / "PHOTOS.json").read_text())["photos"]
    T = inverse(np.array(index[1]["T_cam_world"]))
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    pose = " ".join(repr(float(v)) for v in (*T[:3, 3], x, y, z, w))
    arguments = [
        str(session / "truth"),
        "--pose",
        pose,
        "--time",
        repr(index[1]["time_s"]),
        "--out",
        str(tmp_path),
    ]
    assert true_views.main(arguments) == 0
    again, first = (
        np.load(f / n)["depth"] for f, n in ((tmp_path, "0000.npz"), (session / "truth/views", "0001.npz"))
    )
    np.testing.assert_allclose(again, first, atol=1e-4)
    assert true_views.main([str(tmp_path), *arguments[1:]]) == 2  # no session there


def test_recorded_motion_drives_the_rig(tmp_path: Path) -> None:
    """A walk's own poses and IMU samples as the recording."""
    source = sim.simulate(
        "facade", 1, 6.0, "avia", tmp_path / "a", {**FAST, "imu_noise": "0", "density": "0.02"}
    )
    imu = [Imu.decode(data) for data in messages(source.session / "session.mcap", "/imu")]
    rows = [[m.header.stamp_ns * 1e-9, *m.accel, *m.gyro] for m in imu]
    np.savetxt(tmp_path / "imu.txt", rows, fmt="%.9f")
    files = f"{source.truth / 'trajectory.tum'},{tmp_path / 'imu.txt'}"
    base = {"camera": "off", "reference": "off", "mesh": "off", "density": "0.02", "motion": files}
    made = sim.simulate("street", 1, 4.0, "avia", tmp_path / "b", base)
    assert made.length_m == pytest.approx(source.length_m * 4 / 6, rel=0.35)
    with pytest.raises(InputError, match="the recorded motion lasts"):
        sim.simulate("street", 1, 9.0, "avia", tmp_path / "c", base)
    with pytest.raises(InputError, match="give two files"):
        sim.simulate("street", 1, 1.0, "avia", tmp_path / "c", {**base, "motion": "poses.tum"})


def test_settings_and_seed_change_the_session(tmp_path: Path) -> None:
    base = {"camera": "off", "reference": "off", "mesh": "off", "density": "0.1", "reach_m": "40"}
    sizes = []
    for k, (seed, more) in enumerate([(1, {}), (2, {}), (1, {"imu": "off"}), (1, {"range_noise_m": "0"})]):
        summary = sim.simulate("corridor", seed, 0.3, "avia", tmp_path / str(k), {**base, **more})
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
        ("street", "avia", 0.01, {}, "give 0.1 (one frame)"),
        ("street", "avia", float("inf"), {}, "give 0.1 (one frame)"),
        ("street", "avia", 1e300, {}, "give 0.1 (one frame)"),
        ("none.glb", "avia", 1.0, {}, "none.glb"),
        ("street", "avia", 1.0, {"returns": "4"}, "returns"),
        ("street", "avia", 1.0, {"motion": "no.tum,no.txt"}, "no.tum"),
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


def test_a_recording_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "session.mcap").write_bytes(b"recorded")
    with pytest.raises(InputError, match="no simulation"):
        sim.simulate("corridor", 0, 0.1, "avia", tmp_path)
    assert [item.name for item in tmp_path.iterdir()] == ["session.mcap"]


def test_every_setting_is_documented() -> None:
    page = (Path(__file__).parents[1] / "docs" / "virtual-rig.md").read_text()
    for name in Settings.__struct_fields__:
        assert f"`{name}`" in page, name


# --- truth.py, winding.py, by_class.py


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


def test_what_hangs_where_something_moved_is_a_ghost() -> None:
    world, mesh = bridged(gap=1.0, spacing=0.1)
    alone = truth.evaluate_against_world(mesh, world)
    strip = np.stack(np.meshgrid(np.linspace(2, 3, 41), np.linspace(0, 2, 81), [0.0]), axis=-1).reshape(-1, 3)
    report = truth.evaluate_against_world(mesh, world, None, strip.astype(np.float32))
    assert alone.ghost_area_share == report.bridging_area_share == 0.0
    assert report.ghost_area_share == alone.bridging_area_share > 0


def test_a_strip_across_a_narrow_gap_is_not() -> None:
    world, mesh = bridged(gap=0.25, spacing=0.1)
    assert truth.evaluate_against_world(mesh, world).bridging_area_share == 0.0
    assert truth.evaluate_against_world(world, world).bridging_area_share == 0.0


def test_grouped_median_equals_numpy() -> None:
    rng = np.random.default_rng(0)
    group, value = rng.integers(0, 20, 300), rng.normal(size=300)
    expected: F64 = np.array([np.median(value[group == k]) if (group == k).any() else 0 for k in range(21)])
    np.testing.assert_allclose(truth._grouped_median(group, value, 21), expected)


def test_three_judges_of_a_thin_board() -> None:
    """Both sides of a board of 1 cm are observed, from either side; the mesh lies in its middle."""
    mesh = grid(10, 0.1, z=0.006)
    rng = np.random.default_rng(0)
    front, back = (rng.uniform(-0.1, 1.1, (4000, 3)).astype(np.float32) for _ in range(2))
    front[:, 2], back[:, 2] = 0.01, 0.0
    points = np.concatenate([front, back])
    up = np.repeat(np.array([[0, 0, 1], [0, 0, -1]], np.float32), 4000, axis=0)
    observed = truth.Reference(
        points, up, up, np.repeat(np.array([1, 2], np.uint8), 4000), None, {1: "a", 2: "b"}
    )
    world = bare_mesh(grid(10, 0.1).vertices, grid(10, 0.1).faces)
    report = truth.evaluate_against_world(mesh, world, observed)
    assert report.winding["nearest"].judged == report.winding["facing"].judged == 200
    assert report.winding["mean"].judged == 0  # opposite sides in reach
    assert 0.5 < report.winding["nearest"].share < 0.9  # by chance a point of the other side is nearer
    assert report.classes["a"]["facing"].share == 1.0
    assert sum(found["nearest"].judged for found in report.classes.values()) == 200


def test_near_equals_its_slow_twin() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.5, 0.5, (500, 3)).astype(np.float32)
    normals = rng.normal(size=(500, 3)).astype(np.float32)
    places = np.concatenate([rng.uniform(-0.7, 0.7, (300, 3)), [[np.nan, 0, 0], [9, 9, 9]]])
    found = winding.near(places, points, normals)
    away = np.linalg.norm(places[:, None] - points[None], axis=2)
    for k, row in enumerate(away):
        within = row <= winding.NEAR_M
        if not within.any():
            assert found.nearest[k] == -1 and (found.mean[k] == 0).all()
            continue
        assert found.nearest[k] == np.argmin(row)
        np.testing.assert_allclose(found.mean[k], normals[within].mean(axis=0), atol=1e-5)
    nothing = winding.near(places, points[:0], normals[:0])
    assert (nothing.nearest == -1).all()
    verdict = winding.verdicts(np.ones((302, 3)), nothing, normals[:0], None)["nearest"]
    assert not verdict.judged.any() and not verdict.agrees.any()


def test_anything_within_equals_its_slow_twin() -> None:
    rng = np.random.default_rng(2)
    corners = rng.uniform(-1, 1, (40, 3, 3)).astype(np.float32)
    corners[0, 2] = corners[0, 1]  # no area
    corners[1] = corners[1, 0]  # a point
    places = rng.uniform(-1.5, 1.5, (400, 3))
    limit = rng.uniform(0.01, 0.4, 400)
    nearest = trimesh_distance(corners, places)
    clear = np.abs(nearest - limit) > 1e-5
    found = anything_within(build_bvh(corners), places, limit)
    np.testing.assert_array_equal(found[clear], (nearest < limit)[clear])
    assert 0.2 < found.mean() < 0.9
    assert not anything_within(build_bvh(corners[:0]), places, limit).any()
    assert not anything_within(build_bvh(corners), np.full((1, 3), np.nan), np.ones(1)).any()


def trimesh_distance(corners: F32, places: F64) -> F64:
    """Distance to the nearest triangle, all against all; degenerate ones as their edges."""
    out = np.full(len(places), np.inf)
    for triangle in corners.astype(np.float64):
        foot = trimesh.triangles.closest_point(np.tile(triangle, (len(places), 1, 1)), places)
        steps = np.linspace(0, 1, 2001)[:, None]
        edges = np.concatenate([triangle[k] + steps * (triangle[k - 1] - triangle[k]) for k in range(3)])
        along = cKDTree(edges).query(places)[0]
        inside = np.linalg.norm(foot - places, axis=1)
        out = np.minimum(out, np.where(np.isfinite(inside), np.fmin(inside, along), along))
    return out


def test_scores_by_class() -> None:
    """A floor of which half is mapped, and a wall mapped 7 cm off."""
    floor, wall = grid(20, 0.05), grid(20, 0.05)
    floor_points, wall_points = grid(100, 0.01).vertices, grid(100, 0.01).vertices + np.array([3.0, 0, 0])
    half = bare_mesh(floor.vertices, floor.faces[floor.vertices[floor.faces][:, :, 0].max(axis=1) < 0.501])
    off = bare_mesh(wall.vertices + np.array([3.0, 0, 0.07], np.float32), wall.faces)
    moved = grid(20, 0.05).vertices + np.array([0.0, 0, 1.0], np.float32)
    ghost = bare_mesh(moved, grid(20, 0.05).faces)
    vertices = np.concatenate([half.vertices, off.vertices, ghost.vertices])
    n = len(half.vertices)
    faces = np.concatenate([half.faces, off.faces + n, ghost.faces + n + len(off.vertices)])
    mesh = bare_mesh(vertices, faces.astype(np.int32))
    points = np.concatenate([floor_points, wall_points]).astype(np.float32)
    labels = np.repeat(np.array([1, 2], np.uint8), [len(floor_points), len(wall_points)])
    fine = score_classes(mesh, points, labels, {1: "floor", 2: "wall"}, 0.05, moved)
    assert fine["floor"].precision == 1.0
    assert fine["floor"].recall == pytest.approx(0.55, abs=0.03)
    assert fine["wall"].precision == fine["wall"].recall == fine["wall"].f1 == 0.0
    coarse = score_classes(mesh, points, labels, {1: "floor", 2: "wall"}, 0.1)
    assert coarse["wall"].precision == coarse["wall"].recall == 1.0
    assert (
        coarse["floor"].precision < 0.7
    )  # the ghost, which lies nearest to the floor, counts without the movers
    assert coarse["all"].points == coarse["floor"].points + coarse["wall"].points
    with pytest.raises(InputError, match="no reference"):
        score_classes(mesh, points[:0], labels[:0], {}, 0.1)


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
