"""A map is continued: the place is recognised, or it is said that it is not; what the map held stays."""

import json
import shutil
import socket
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import quote

import cv2
import numpy as np
import pytest

from artemis_edge.cli import main
from artemis_edge.config import Config, KeepConfig, OdometryConfig, SegmentationConfig, load
from artemis_edge.continuing import EarlierMap, find_earlier, open_earlier
from artemis_edge.errors import InputError
from artemis_edge.export.ply import read_mesh
from artemis_edge.frames import (
    F64,
    CameraImage,
    CameraModel,
    DeskewedScan,
    LidarScan,
    SyncedFrame,
    TrackedFrame,
    Trajectory,
)
from artemis_edge.keeper import Keeper
from artemis_edge.kept_images import ImageSpool
from artemis_edge.kept_points import open_points
from artemis_edge.loop.correlation import Correlator
from artemis_edge.loop.facets import Facets, facets_of
from artemis_edge.loop.recognition import Place, Recognition
from artemis_edge.loop.relocate import Search
from artemis_edge.odometry import se3
from artemis_edge.odometry.known_map import KnownMap, Start
from artemis_edge.odometry.lidar_odometry import LidarOdometry
from artemis_edge.odometry.local_map import LocalMap
from artemis_edge.paging import read_pages
from artemis_edge.segmentation.keyframes import KeyframeStore, photographs, read_keyframes
from artemis_edge.service.mapper import LiveMapper
from artemis_edge.service.mapper_task import MapperTask
from artemis_edge.session import feed
from artemis_edge.session.line_channel import LineChannel
from artemis_edge.session.message_ring import MessageRing
from artemis_edge.session.stream_mapping import StreamMapping
from artemis_edge.session.stream_search import StreamSearch
from artemis_edge.session.writer import SessionWriter
from artemis_edge.sight import new_sight
from artemis_edge.trajectory import read_tum
from tests import box_world
from tests.conftest import FakeMapper
from tests.recordings import publish

_FRAMES = 10


def _turned(yaw: float, place: tuple[float, float, float]) -> F64:
    T = np.eye(4)
    T[:3, :3] = se3.exp(np.array([0.0, 0, 0, 0, 0, yaw]))[:3, :3]
    T[:3, 3] = place
    return T


def _houses(seed: int, side: float = 30.0) -> np.ndarray:
    """Points float32 on a floor and on walls of houses, as a LiDAR at the height of 0 sees them."""
    rng = np.random.default_rng(seed)
    parts = [np.column_stack([rng.uniform(0, side, (9000, 2)), np.full(9000, -1.5)])]
    for _ in range(10):
        (x, y), size = rng.uniform(0, side, 2), rng.uniform(2, 7, 2)
        yaw = rng.uniform(0, np.pi)
        for a in range(4):
            s = rng.uniform(-0.5, 0.5, 900)
            wall = np.column_stack(
                [s * size[a % 2], np.full(900, 0.5 * size[1 - a % 2] * (1 if a < 2 else -1))]
            )
            wall = wall if a % 2 == 0 else wall[:, ::-1]
            c, d = np.cos(yaw), np.sin(yaw)
            flat = wall @ np.array([[c, d], [-d, c]]) + (x, y)
            parts.append(np.column_stack([flat, rng.uniform(-1.5, 3.0, 900)]))
    points = np.concatenate(parts)
    return (points + rng.normal(0, 0.01, points.shape)).astype(np.float32)


def _piece(points: np.ndarray, T_map_piece: F64, reach: float = 14.0) -> np.ndarray:
    near = np.linalg.norm(points - T_map_piece[:3, 3], axis=1) < reach
    T = se3.inverse(T_map_piece)
    return (points[near] @ T[:3, :3].T + T[:3, 3]).astype(np.float32)


def test_a_piece_is_recognised_wherever_it_lies_and_however_it_is_turned() -> None:
    world = _houses(1)
    recognition = Recognition(world[::2])
    for yaw, x, y in ((2.3, 12.0, 17.0), (-0.7, 20.0, 12.0)):
        T = _turned(yaw, (x, y, 0.3))
        place = recognition.find(_piece(world[1::2], T))
        assert place is not None and place.share > 0.8 and place.clear and place.other < place.share
        off = se3.log(se3.inverse(T) @ place.T_map_piece)
        assert np.linalg.norm(off[:3]) < 0.03 and np.linalg.norm(off[3:]) < 0.005


def test_another_place_must_explain_fewer_walls_than_chance_allows() -> None:
    T = np.eye(4)
    assert Place(T, 0.99, 200, 0.85).clear and not Place(T, 0.99, 40, 0.85).clear
    assert not Place(T, 0.66, 300, 0.5).clear and Place(T, 0.7, 300, 0.3).clear
    assert not Place(T, 0.9, 0, 0.0).clear and not Place(T, 0.99, 500, 0.97).clear


def test_what_the_map_does_not_show_is_not_recognised() -> None:
    recognition = Recognition(_houses(1))
    assert recognition.find(_piece(_houses(2), _turned(0.4, (15.0, 15.0, 0.0)))) is None
    assert recognition.find(np.empty((0, 3), np.float32)) is None
    assert recognition.find(np.full((50, 3), 7, np.float32)) is None
    assert Recognition(np.empty((0, 3), np.float32)).find(_houses(1)) is None


def test_a_place_along_walls_that_all_face_one_way_is_not_clear() -> None:
    rng = np.random.default_rng(4)
    walls = np.concatenate(
        [
            np.column_stack([rng.uniform(0, 40, 20000), np.full(20000, y), rng.uniform(-1, 2, 20000)])
            for y in (0, 3)
        ]
    ).astype(np.float32)
    recognition = Recognition(walls)
    assert recognition.find(_piece(walls, _turned(0.1, (20.0, 1.5, 0.0)), 10.0)) is None


def test_the_best_shift_is_that_of_trying_all_of_them() -> None:
    """The slow twin: every shift by whole cells, counted."""
    known = facets_of(_houses(3, 24.0))
    correlator = Correlator(known)
    T = _turned(np.radians(36.0), (11.0, 13.0, 0.0))
    inside = np.linalg.norm(known.centre - T[:3, 3], axis=1) < 8.0
    piece = Facets(known.centre[inside], known.normal[inside]).moved(se3.inverse(T))
    best = correlator.guesses(piece, 3)[0]
    assert np.linalg.norm(best.T_map_piece[:3, 3] - T[:3, 3]) < 1.8 * correlator.cell_m

    def explained(shift: F64) -> int:
        moved = piece.moved(_turned(np.radians(36.0), (0, 0, 0))).centre + shift
        cells = {tuple(c) for c in np.floor(known.centre / correlator.cell_m).astype(int).tolist()}
        return sum(tuple(c) in cells for c in np.floor(moved / correlator.cell_m).astype(int).tolist())

    shifts = [np.array([x, y, 0.0]) for x in range(0, 24) for y in range(0, 24)]
    counts = [explained(shift) for shift in shifts]
    assert np.linalg.norm(shifts[int(np.argmax(counts))] - best.T_map_piece[:3, 3]) < 2.0 * correlator.cell_m
    assert 0.5 < best.share <= 1.01
    assert correlator.guesses(Facets(np.empty((0, 3)), np.empty((0, 3))), 3) == []


def test_a_known_map_is_recalled_around_the_sensor() -> None:
    points = np.random.default_rng(1).uniform(-60, 60, (4000, 3)).astype(np.float32)
    known = KnownMap(points)
    cells = known.nearest(np.array([10.0, 0, 0]), 30.0)
    found = known.points_of(cells)
    cell = np.floor(points / 8.0)
    near = np.linalg.norm((cell + 0.5) * 8.0 - (10.0, 0, 0), axis=1) <= 30.0
    assert {tuple(p) for p in found.tolist()} == {tuple(p) for p in points[near].tolist()}
    away = np.linalg.norm(known.centre[cells] - (10.0, 0, 0), axis=1)
    assert (np.diff(away) >= 0).all() and len(known) == len(np.unique(cell, axis=0))
    assert len(known.points_of(cells[:0])) == 0 and len(KnownMap(points[:0])) == 0


def test_the_local_map_recalls_what_is_known_and_forgets_it_again() -> None:
    wall = np.array([[x, y, 0.0] for x in np.arange(0, 90, 0.1) for y in np.arange(0, 2, 0.1)], np.float32)
    local = LocalMap(OdometryConfig(max_range_m=20.0), KnownMap(wall))
    local.begin(np.empty((0, 3), np.float32), np.eye(4))

    def reach() -> tuple[float, float]:
        _, centres, _ = local.planes.planes(0)
        return float(centres[:, 0].min()), float(centres[:, 0].max())

    assert reach()[0] < 1.0 and 12.0 < reach()[1] < 26.0
    for x in range(0, 70, 3):
        assert local.add(np.empty((0, 3), np.float32), _turned(0.0, (float(x), 0.0, 0.0))) == 0
    assert reach()[0] > 40.0 and reach()[1] > 80.0


def _pose(start: F64, time_s: float) -> F64:
    return start @ se3.exp(time_s * np.array([1.0, 0.1, 0, 0, 0, 0.15]))


_FIRST, _SECOND = _turned(0.0, (0, 0, 1.6)), _turned(1.0, (1.5, 1.0, 1.6))


def _record(path: Path, start: F64, boxes: np.ndarray) -> Path:
    """A walk of a second past houses; LiDAR only."""
    with SessionWriter(path / "session.mcap") as out:
        for k in range(_FRAMES):
            middle = 0.05 + 0.1 * k
            points, time_s = box_world.scan(lambda t: _pose(start, t), middle, boxes, seed=k)
            order = np.argsort(time_s, kind="stable")
            stamp, late = box_world.START_NS + k * 100_000_000, time_s[order] + 0.05
            offset = np.rint(late * 1e9).clip(0).astype(np.uint32)
            half = np.full(len(points), 0.5, np.float32)
            out.write_points(
                stamp, points[order], intensity=half, offset_ns=offset, receive_ns=stamp + 100_000_000
            )
    return path


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """A map of a street, another walk in it, and a walk elsewhere."""
    folder, boxes = tmp_path_factory.mktemp("walks"), box_world.street()
    elsewhere = np.array([[-8, 5, 0, 30, 7, 3], [-8, -7, 0, 30, -5, 6], [12, -7, 0, 13, 7, 4]], float)
    first = _record(folder / "first", _FIRST, boxes)
    out = folder / "map"
    assert main(["reprocess", str(first), "--out", str(out)]) == 0
    return out, _record(folder / "second", _SECOND, boxes), _record(folder / "elsewhere", _FIRST, elsewhere)


def test_a_map_is_extended_in_its_own_frame(walks: tuple[Path, Path, Path], tmp_path: Path) -> None:
    earlier, second, _ = walks
    assert main(["reprocess", str(second), "--out", str(tmp_path), "--continue", str(earlier)]) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["continued"]["map"] == str(earlier) and report["continued"]["share_of_walls"] > 0.65
    poses = read_tum(tmp_path / "trajectory.tum")
    for stamp_ns, T in zip(poses.stamp_ns, poses.T_world_lidar, strict=True):
        true = se3.inverse(_FIRST) @ _pose(_SECOND, (int(stamp_ns) - box_world.START_NS) * 1e-9)
        assert np.linalg.norm(T[:3, 3] - true[:3, 3]) < 0.05
    before, after = read_mesh(earlier / "mesh.ply"), read_mesh(tmp_path / "mesh.ply")
    kept = {tuple(v) for v in np.round(before.vertices, 1).tolist()}
    now = {tuple(v) for v in np.round(after.vertices, 1).tolist()}
    assert len(kept & now) > 0.8 * len(kept) and len(after.faces) > 1.1 * len(before.faces)
    points = [
        sum(p.block.shape[0] for p in read_pages(f / "map" / "blocks.bin")) for f in (earlier, tmp_path)
    ]
    assert points[1] > points[0]


def test_another_place_is_refused(
    walks: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    earlier, _, elsewhere = walks
    assert (
        main(["reprocess", str(elsewhere), "--out", str(tmp_path / "out"), "--continue", str(earlier)]) == 2
    )
    said = capsys.readouterr().err
    assert f"was not recognised in {earlier}" in said and "walk" in said
    assert not (tmp_path / "out").exists(), "an empty folder would look like a result"


def test_what_is_no_map_is_refused(walks: tuple[Path, Path, Path], tmp_path: Path) -> None:
    earlier = walks[0]
    with pytest.raises(InputError, match="holds no map to continue"):
        open_earlier(tmp_path, Config())
    assert find_earlier(tmp_path, Config()) is None
    with pytest.raises(InputError, match=r"voxels of 0.4 m.*--set voxel_map.voxel_m=0.4"):
        open_earlier(earlier, load(sets=["voxel_map.voxel_m=0.2"]))
    session = tmp_path / "session"
    shutil.copytree(earlier, session / "result")
    (session / "result_2").mkdir()  # of a run that has not ended
    assert open_earlier(session, Config()).root == session / "result"
    assert open_earlier(earlier / "mesh.ply", Config()).root == earlier
    blocks = session / "result" / "map" / "blocks.bin"
    blocks.write_bytes(blocks.read_bytes()[:-3])
    with pytest.raises(InputError, match="is damaged"):
        list(open_earlier(session, Config())._pages())
    blocks.write_bytes(b"")
    with pytest.raises(InputError, match="no blocks of the mesh"):
        list(open_earlier(session, Config())._pages())
    (session / "result" / "map" / "config.toml").write_bytes(b"\xff")
    with pytest.raises(InputError, match="not valid TOML"):
        open_earlier(session, Config())


def test_a_stream_is_recognised_and_then_mapped_from_its_beginning(
    walks: tuple[Path, Path, Path], tmp_path: Path, fake_pipeline: list[FakeMapper]
) -> None:
    earlier = open_earlier(walks[0], Config())
    search = StreamSearch(Config(), earlier)
    messages = list(feed.messages(walks[1]))
    found = next((place for sent in messages if (place := search.take(sent)) is not None), None)
    found = found or search.last_look()
    assert found is not None and str(walks[0]) in search.sentence()
    mapping = StreamMapping(Config(), tmp_path)
    mapping.go_on_in(earlier, found, search.first_ns or 0)
    for sent in messages:
        mapping.take(sent)
    stamp_ns, T = mapping.mapper.trajectory[-1]
    true = se3.inverse(_FIRST) @ _pose(_SECOND, (stamp_ns - box_world.START_NS) * 1e-9)
    assert np.linalg.norm(T[:3, 3] - true[:3, 3]) < 0.05
    assert fake_pipeline[-1].earlier and mapping.statistics.continued is not None


def test_a_stream_that_is_never_recognised_is_given_up(walks: tuple[Path, Path, Path]) -> None:
    search = StreamSearch(Config(), EarlierMap(walks[0], _houses(5)))
    assert all(search.take(sent) is None for sent in feed.messages(walks[1]))
    assert search.last_look() is None and "look at walls" in search.sentence()
    search.given_up = True
    assert "mapped on its own" in search.sentence()


def test_a_search_waits_until_enough_is_seen() -> None:
    world = _houses(1)
    search, T = Search(Recognition(world)), _turned(0.5, (17.0, 15.0, 0.0))
    empty = TrackedFrame(0, 0, np.eye(4), (DeskewedScan(np.empty((0, 3), np.float32), np.zeros(3)),))
    assert search.add(empty) is None and search.last_look() is None and search.looks == 0
    scan = (DeskewedScan(_piece(world, T), np.zeros(3)),)
    assert search.add(TrackedFrame(1, 10**9, np.eye(4), scan)) is None  # it looks every two seconds
    found = search.add(TrackedFrame(2, 3 * 10**9, np.eye(4), scan))
    assert found is not None and np.allclose(found.T_map_world, T, atol=0.02) and found.looks == 1


def test_an_odometry_that_has_not_begun_is_where_it_is_placed() -> None:
    T = _turned(0.3, (4.0, 5.0, 0.0))
    odometry = LidarOdometry(OdometryConfig(), start=Start(T, KnownMap(_houses(1))))
    assert np.allclose(odometry.track(SyncedFrame(0, 0, ())).T_world_lidar, T)


@pytest.mark.parametrize("camera", ["cam", "robot/cam", "../cam", "/cam"])
def test_points_and_photographs_of_the_earlier_map_stay(camera: str, tmp_path: Path) -> None:
    png = cv2.imencode(".png", np.full((4, 6, 3), 128, np.uint8))[1].tobytes()
    model, poses = (
        CameraModel(6, 4, 5.0, 5.0, 3.0, 2.0),
        Trajectory(np.array([0, 10**9]), np.stack([np.eye(4)] * 2)),
    )
    folders = [tmp_path / name for name in ("map_1", "map_2")]
    for run, folder in enumerate(folders):
        (tmp_path / f"scratch_{run}").mkdir()
        folder.mkdir()
        keeper = Keeper(tmp_path / f"scratch_{run}", KeepConfig(), SegmentationConfig())
        if run:
            keeper.take_over(folders[0])
        T = _turned(0.0, (5.0 * run, 0.0, 0.0))
        scan, image = (
            LidarScan(np.full((3, 3), run, np.float32), 0),
            CameraImage(camera, 5, png, model, np.eye(4)),
        )
        frame = SyncedFrame(run, 0, (scan,), (image,))
        moved = (DeskewedScan(scan.points, np.zeros(3)),)
        tracked = TrackedFrame(run, 0, np.eye(4), moved, images=(image,), image_poses=(T,))
        keeper.between(lambda frame: frame, SimpleNamespace(tracked=tracked, sight=new_sight))(frame)
        keeper.save(folder, poses)
    kept = open_points(folders[1])
    assert kept is not None and kept.rows == 6
    rows = np.concatenate(list(kept.chunks()))
    assert rows["position"][:, 0].tolist() == [0, 0, 0, 1, 1, 1] and (rows["tick"] == 0).all()
    index = json.loads((folders[1] / "images.json").read_text())["photos"]
    stem = quote(camera, safe="")  # a frame's name may hold what a file's may not
    assert [entry["file"] for entry in index] == [f"images/{stem}_000000.png", f"images/{stem}_000001.png"]
    assert all((folders[1] / entry["file"]).read_bytes() == png for entry in index)
    keyframes = read_keyframes(folders[1])
    assert sorted(float(k.T_world_cam[0, 3]) for k in keyframes) == [0.0, 5.0]


@pytest.mark.parametrize(
    "damage",
    [
        {"fx": float("nan")},
        {"stamp_ns": float("inf")},
        {"file": "../cam.png"},
        {"depth": "/dev/zero"},
        {"depth": "a\0b"},
        {"depth": 5},
        {"T_cam_world": np.zeros((4, 4)).tolist()},
        {"distortion": [float("inf")] * 5},
    ],
)
def test_damaged_indices_of_photographs_are_refused(damage: dict[str, object], tmp_path: Path) -> None:
    entry = {"file": "cam.png", "camera": "cam", "stamp_ns": 5, "width": 6, "height": 4, "fx": 5.0, "fy": 5.0}
    entry |= {"cx": 3.0, "cy": 2.0, "distortion": [0.0] * 5, "T_cam_world": np.eye(4).tolist()}
    index = tmp_path / "keyframes" / "index.json"
    index.parent.mkdir()
    store = KeyframeStore.by(SegmentationConfig(), tmp_path / "store")
    index.write_text(json.dumps({"photos": [entry]}))
    assert len(read_keyframes(tmp_path)) == 1
    index.write_text(json.dumps({"photos": [entry | damage]}))
    with pytest.raises(InputError, match="map the recording again"):
        store.take_over(tmp_path)
    with pytest.raises(InputError, match="map the recording again"):
        list(photographs(tmp_path))


def kept_images(folder: Path, *changes: dict[str, object]) -> Path:
    """A map with an index of images, an entry for each change, and the one picture that they name otherwise."""
    entry = {"file": "images/cam_000000.png", "stamp_ns": 5, "fx": 5.0, "fy": 5.0, "cx": 3.0, "cy": 2.0}
    entry |= {"distortion": [0.0] * 5, "T_cam_world": np.eye(4).tolist()}
    (folder / "images").mkdir(parents=True)
    (folder / "images" / "cam_000000.png").write_bytes(b"\x89PNG")
    (folder / "images.json").write_text(json.dumps({"photos": [entry | change for change in changes]}))
    return folder


@pytest.mark.parametrize(
    "damage",
    [
        {"fx": float("nan")},
        {"stamp_ns": float("inf")},
        {"T_cam_world": np.zeros((4, 4)).tolist()},
        {"distortion": [float("inf")] * 5},
    ],
)
def test_a_damaged_index_of_kept_images_is_refused(damage: dict[str, object], tmp_path: Path) -> None:
    (tmp_path / "spool").mkdir()
    ImageSpool(tmp_path / "spool", 10).take_over(kept_images(tmp_path / "sound", {}))
    with pytest.raises(InputError, match="make that map again"):
        ImageSpool(tmp_path / "spool", 10).take_over(kept_images(tmp_path / "damaged", damage))


def test_of_two_entries_of_one_kept_image_the_first_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "spool").mkdir()
    (tmp_path / "next").mkdir()
    folder = kept_images(
        tmp_path / "map", {}, {"fx": 7.0}, {"file": "images/cam_0.png"}, {"file": "images/cam_1.png"}
    )
    (folder / "images" / "cam_0.png").write_bytes(b"the same camera and number")
    spool = ImageSpool(tmp_path / "spool", 1)
    spool.take_over(folder)
    said = capsys.readouterr().err
    assert "2 entries of" in said and "cam_000000.png" in said and "keeps the first entry" in said
    assert "1 of the 4 photographs" in said
    spool.save(tmp_path / "next", Trajectory(np.array([0, 10**9]), np.stack([np.eye(4)] * 2)))
    (entry,) = json.loads((tmp_path / "next" / "images.json").read_text())["photos"]
    assert entry["fx"] == 5.0 and (tmp_path / "next" / entry["file"]).read_bytes() == b"\x89PNG"


def test_photographs_for_questions_that_are_gone_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = CameraImage("cam", 5, b"\x89PNG", CameraModel(6, 4, 5.0, 5.0, 3.0, 2.0), np.eye(4))
    for run in range(2):
        store = KeyframeStore.by(SegmentationConfig(), tmp_path / f"store_{run}")
        if run:
            next((tmp_path / "keyframes").glob("*.png")).unlink()
            store.take_over(tmp_path)
        store.offer(image, np.eye(4))
        assert len(store) == 1
        store.save(tmp_path)
    assert "1 photographs kept for questions cannot be read" in capsys.readouterr().err


@pytest.mark.parametrize("known", [True, False])
def test_the_live_mapping_looks_first_and_then_maps_from_its_first_message(
    walks: tuple[Path, Path, Path], tmp_path: Path, fake_pipeline: list[FakeMapper], known: bool
) -> None:
    session, pages = tmp_path / "session", tmp_path / "pages"
    shutil.copytree(walks[0], session / "result")
    pages.mkdir()
    ring = MessageRing.create(64.0)
    for sent in feed.messages(walks[1]):
        publish(ring, sent)
    here, there = (LineChannel(end) for end in socket.socketpair())
    mapper = LiveMapper(
        MapperTask(str(session), str(tmp_path / "out"), earlier=str(session)), ring, here, pages
    )
    assert any("looking for the place" in sentence for sentence in mapper.status()["coaching"])
    if not known:
        mapper._search = StreamSearch(Config(), EarlierMap(walks[0], _houses(5)))
    there.say({"do": "stop", "at": ring.published})
    mapper._loop()
    assert (
        len(fake_pipeline[-1].trajectory) == _FRAMES
        and (mapper.mapping.statistics.continued is not None) == known
    )
    assert any("mapped on its own" in sentence for sentence in mapper.status()["coaching"]) != known
    assert bool(fake_pipeline[-1].earlier) == known
    there.socket.close()
    here.socket.close()
