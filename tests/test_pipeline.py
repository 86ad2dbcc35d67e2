"""The stages together: same input, same bytes; frames with nothing in them; what is told."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from artemis_edge.export.ply import read_mesh
from artemis_edge.frames import CameraModel, LidarScan, SyncedFrame
from artemis_edge.pipeline import Pipeline
from artemis_edge.sight import DEPTH
from tests import naive

STAGES = ["odometry", "refinement", "voxel_map", "free_space", "mesher", "delta"]


@pytest.fixture(autouse=True)
def _closed_files() -> Iterator[None]:
    with naive.closing_page_files():
        yield


def _run(folder: Path, budget_mb: int = 30, length_m: float = 8.0) -> Pipeline:
    places = naive.walk(length_m, 0.5)
    folder.mkdir()
    pipeline = naive.small_pipeline(folder, places, budget_mb)
    for frame in naive.corridor(places, 1000):
        pipeline.process(frame)
    pipeline.finish()
    pipeline.write_mesh(folder / "mesh.ply")
    pipeline.save(folder / "map")
    return pipeline


@pytest.mark.parametrize(("budget_mb", "length_m"), [(30, 8.0), (0, 60.0)], ids=["in memory", "paged"])
def test_same_input_gives_the_same_bytes(tmp_path: Path, budget_mb: int, length_m: float) -> None:
    runs = [_run(tmp_path / name, budget_mb, length_m) for name in ("a", "b")]
    assert (runs[0].pager.paged_in > 0) == (budget_mb == 0)
    for file in ("mesh.ply", "map/blocks.bin", "map/config.toml"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file
    assert not (tmp_path / "a" / "pages.bin").exists(), "the map is saved: its pages on disk are done with"


def test_corridor_is_mapped_whole(tmp_path: Path) -> None:
    pipeline = _run(tmp_path / "a")
    mesh = read_mesh(tmp_path / "a" / "mesh.ply")
    naive.assert_manifold(mesh.faces.astype(np.int64))
    inside = np.abs(mesh.vertices[mesh.faces].mean(axis=1)[:, 0] - 3.75) < 3.0
    part = mesh.faces[inside]
    p, q, r = (mesh.vertices[part[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(q - p, r - p)
    assert np.linalg.norm(normal, axis=1).sum() / 2 == pytest.approx(4 * 2.1 * 6.0, rel=0.05)
    # seen from within: normals look at the corridor's axis
    axis = (p + q + r) / 3 * (0, -1, -1) + (0, 0, 0.1)
    assert ((normal * axis).sum(axis=1) > 0).mean() > 0.99
    off = np.minimum(
        np.abs(np.abs(mesh.vertices[:, 1]) - 1.05), np.abs(np.abs(mesh.vertices[:, 2] - 0.1) - 1.05)
    )
    assert np.quantile(off, 0.95) < 0.02
    assert pipeline.lost == {}
    assert [stamp for stamp, _ in pipeline.trajectory] == [k * 100_000_000 for k in range(32)]
    # a camera in the corridor that looks along it knows the wall, where a ray at 0.7 to the right meets it
    T_world_cam = np.array([[0, 0, 1.0, 1.0], [-1, 0, 0, 0], [0, -1, 0, 0.1], [0, 0, 0, 1]])
    view = pipeline.sight(CameraModel(160, 128, 90.0, 90.0, 79.5, 63.5), T_world_cam)
    assert view.depth[64, 143, DEPTH] == pytest.approx(1.05 / 0.7, abs=0.12)
    assert np.isfinite(view.depth[:, :, DEPTH]).mean() > 0.8


def test_every_stage_tells_its_time_and_the_time_of_this_frame_only(tmp_path: Path) -> None:
    places = [(0.0, 0.0, 0.0)] * 3
    pipeline = naive.small_pipeline(tmp_path, places)
    for frame in naive.corridor(places):
        pipeline.process(frame)
        assert list(pipeline.stage_ms) == STAGES
        assert all(ms >= 0.0 for ms in pipeline.stage_ms.values())
    pipeline.finish()
    assert "mesher" in pipeline.stage_ms and "odometry" not in pipeline.stage_ms


def test_frames_with_nothing_in_them(tmp_path: Path) -> None:
    places = [(0.0, 0.0, 0.0)] * 12
    pipeline = naive.small_pipeline(tmp_path, places)
    nothing = LidarScan(np.empty((0, 3), np.float32), 0)
    nonsense = LidarScan(np.full((50, 3), np.nan, np.float32), 0)
    full = naive.corridor(places)
    for k in range(12):
        scans = ((), (nothing,), (nothing, nothing), (nonsense,), full[k].scans, (*full[k].scans, nothing))[
            k % 6
        ]
        pipeline.process(SyncedFrame(k, k, scans))
    pipeline.finish()
    assert len(pipeline.trajectory) == 12
    assert len(pipeline.write_mesh(tmp_path / "mesh.ply").faces) > 500
    assert pipeline.lost == {}


def test_no_frame_at_all(tmp_path: Path) -> None:
    pipeline = naive.small_pipeline(tmp_path, [])
    assert len(pipeline.finish().block) == 0
    assert len(pipeline.write_mesh(tmp_path / "mesh.ply").faces) == 0
    assert pipeline.save(tmp_path / "map") == 0


def test_what_finds_no_memory_is_counted(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    pipeline = naive.small_pipeline(tmp_path, [(0.0, 0.0, 0.0)])
    points = rng.uniform(-20, 20, (60_000, 3)).astype(np.float32)
    pipeline.process(SyncedFrame(0, 0, (LidarScan(points, 0),)))
    assert pipeline.lost["points_without_memory"] > 10_000


def test_a_box_that_drove_off_is_not_in_the_mesh(tmp_path: Path) -> None:
    places = [(0.0, 0.0, 0.0)] * 40
    pipeline = naive.small_pipeline(tmp_path, places, 30)
    rng = np.random.default_rng(2)
    for frame in naive.corridor(places, 4000, reach_m=6.0):
        points = frame.scans[0].points
        if frame.index < 6:
            box = naive.rectangle(rng, (2.5, -0.5, -0.5), (0, 1, 0), (0, 0, 1), 800, 0.005).astype(np.float32)
            ahead = points[:, 0] > 2.5
            hidden = ahead & (np.abs(points[:, 1:] * 2.5 / points[:, :1]) < 0.5).all(axis=1)
            points = np.concatenate((points[~hidden], box))
        end = naive.rectangle(rng, (6.1, -1, -0.9), (0, 2, 0), (0, 0, 2), 600, 0.005).astype(np.float32)
        behind = (np.abs(end[:, 1:] * 2.5 / end[:, :1]) < 0.5).all(axis=1) & (frame.index < 6)
        scan = LidarScan(np.concatenate((points, end[~behind])), frame.stamp_ns)
        pipeline.process(SyncedFrame(frame.index, frame.stamp_ns, (scan,)))
    pipeline.finish()
    mesh = pipeline.write_mesh(tmp_path / "mesh.ply")
    x, y, z = mesh.vertices.T
    assert not ((np.abs(x - 2.5) < 0.1) & (np.abs(y) < 0.6) & (np.abs(z) < 0.6)).any()
    assert ((np.abs(x - 6.1) < 0.1) & (np.abs(y) < 0.4)).sum() > 40
