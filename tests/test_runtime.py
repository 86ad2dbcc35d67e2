"""reprocess: what it writes, what it counts, and what is left when something goes wrong."""

import json
import mmap
import os
import signal
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from artemis_edge import health
from artemis_edge.batch import places
from artemis_edge.cli import main
from artemis_edge.config import Config
from artemis_edge.datasets import open_input
from artemis_edge.errors import InputError, RunError
from artemis_edge.export.ply import Mesh, bare_mesh, write_ply
from artemis_edge.frames import CameraImage, CameraModel, SyncedFrame, Trajectory
from artemis_edge.runtime import Request, reprocess
from artemis_edge.session.photos import HeldOut
from artemis_edge.session.results import Results, prepare
from artemis_edge.trajectory import read_tum

CONTRACT = {
    "mesh.ply",
    "mesh.glb",
    "trajectory.tum",
    "objects.json",
    "report.json",
    "report.html",
    "config.toml",
    "map",
}


def poses_of(kitti: Path) -> Path:
    return kitti.parents[1] / "poses.tum"


def test_writes_the_output_directory_of_the_contract(
    kitti: Path, fake_pipeline: list[Any], tmp_path: Path
) -> None:
    outcome = reprocess(Request(kitti, tmp_path / "out", poses=poses_of(kitti)))
    assert {path.name for path in (tmp_path / "out").iterdir()} == CONTRACT
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report == outcome.report
    assert report["frames"] == 10
    assert report["frames_dropped"] == 0
    assert set(report["stages"]) == {"odometry", "mesher"}
    assert report["map_bytes"] == 6
    assert json.loads((tmp_path / "out" / "objects.json").read_text()) == {"objects": []}
    assert np.allclose(
        read_tum(tmp_path / "out" / "trajectory.tum").T_world_lidar[:, 0, 3], 0.5 * np.arange(10)
    )
    assert fake_pipeline[-1].finished


def test_warm_up_has_a_map_of_its_own(kitti: Path, fake_pipeline: list[Any], tmp_path: Path) -> None:
    reprocess(Request(kitti, tmp_path / "out", poses=poses_of(kitti)))
    warm, real = fake_pipeline
    assert len(warm.trajectory) == 3
    assert len(real.trajectory) == 10


def test_a_second_run_replaces_the_first(kitti: Path, fake_pipeline: list[Any], tmp_path: Path) -> None:
    out = tmp_path / "out"
    reprocess(Request(kitti, out, poses=poses_of(kitti)))
    (out / "map" / "old").write_text("old")
    reprocess(Request(kitti, out, poses=poses_of(kitti), stop=4))
    assert {path.name for path in out.iterdir()} == CONTRACT
    assert {path.name for path in (out / "map").iterdir()} == {"blocks.bin", "points.bin"}
    assert json.loads((out / "report.json").read_text())["frames"] == 4


def test_holes_in_the_poses_are_told(kitti: Path, fake_pipeline: list[Any], tmp_path: Path) -> None:
    holey = tmp_path / "holey.tum"
    rows = poses_of(kitti).read_text().splitlines(keepends=True)
    holey.write_text("".join(rows[:2] + rows[6:]))
    outcome = reprocess(Request(kitti, tmp_path / "out", poses=holey))
    assert len(outcome.warnings) == 1
    assert "holey.tum: 4 frames lie in holes of the poses, the longest 0.50 s" in outcome.warnings[0]


def test_without_poses_the_odometry_runs(kitti: Path, fake_pipeline: list[Any], tmp_path: Path) -> None:
    reprocess(Request(kitti, tmp_path / "out", stop=3))
    assert type(fake_pipeline[-1].odometry).__name__ == "LidarOdometry"


def test_poses_of_the_input_are_used_unless_refused(
    kitti: Path, fake_pipeline: list[Any], tmp_path: Path
) -> None:
    rows = "".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(10))
    (kitti.parents[1] / "poses").mkdir()
    (kitti.parents[1] / "poses" / "00.txt").write_text(rows)
    (kitti / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    reprocess(Request(kitti, tmp_path / "a", stop=3))
    assert type(fake_pipeline[-1].odometry).__name__ == "GivenPoses"
    reprocess(Request(kitti, tmp_path / "b", own_odometry=True, stop=3))
    assert type(fake_pipeline[-1].odometry).__name__ == "LidarOdometry"


@pytest.mark.parametrize(("start", "stop", "frames"), [(0, 3, 3), (7, None, 3), (8, 99, 2)])
def test_frames_bound_what_is_mapped(
    start: int, stop: int | None, frames: int, kitti: Path, fake_pipeline: list[Any], tmp_path: Path
) -> None:
    outcome = reprocess(Request(kitti, tmp_path / "out", poses=poses_of(kitti), start=start, stop=stop))
    assert outcome.report["frames"] == frames
    assert fake_pipeline[-1].trajectory[0][1][0, 3] == pytest.approx(0.5 * start)


def test_frames_beyond_the_input(kitti: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"10 frames, none of them in --frames 50:"):
        reprocess(Request(kitti, tmp_path / "out", start=50))


def test_a_frame_that_cannot_be_mapped_is_counted(
    kitti: Path, fake_pipeline: list[Any], tmp_path: Path
) -> None:
    outcome = _reprocess_failing(
        kitti, tmp_path, fake_pipeline, {2: InputError("no"), 5: InputError("nor this")}
    )
    assert outcome.report["frames"] == 8
    assert outcome.report["frames_dropped"] == 2
    assert outcome.report["lost"]["frames_skipped"] == 2
    assert outcome.warnings == ["2 frames were skipped; the first: no"]


def test_a_mesh_without_triangles_is_a_failed_run(
    kitti: Path, fake_pipeline: list[Any], tmp_path: Path
) -> None:
    from artemis_edge.pipeline import Pipeline

    def nothing(path: Path) -> Mesh:
        mesh = bare_mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
        write_ply(path, mesh)
        return mesh

    def make(config: Config, odometry: Any, folder: Path) -> Any:
        mapper: Any = Pipeline(config, odometry, folder)
        mapper.write_mesh = nothing
        return mapper

    request = Request(kitti, tmp_path / "out", poses=poses_of(kitti))
    with pytest.raises(RunError, match=r"10 frames has no triangles .*nothing.*max_range_m = 60.*kept in"):
        reprocess(request, evaluate=lambda mesh, path: pytest.fail("there is nothing to evaluate"), make=make)
    assert {path.name for path in (tmp_path / "out").iterdir()} == CONTRACT


def test_nothing_mapped_is_an_error_of_the_input(
    kitti: Path, fake_pipeline: list[Any], tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"none of the 10 frames of 00 could be mapped: bad"):
        _reprocess_failing(kitti, tmp_path, fake_pipeline, dict.fromkeys(range(10), InputError("bad")))


@pytest.mark.parametrize(
    "error", [OSError(28, "No space left on device", "page"), RunError("no room for pages")]
)
def test_a_full_disk_keeps_what_is_mapped(
    error: Exception, kitti: Path, fake_pipeline: list[Any], tmp_path: Path
) -> None:
    with pytest.raises(RunError, match=r"(No space|no room).*kept in .*mesh\.ply"):
        _reprocess_failing(kitti, tmp_path, fake_pipeline, {6: error})
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["frames"] == 6
    assert report["lost"]["frames_not_reached"] == 4


def test_an_interruption_keeps_what_is_mapped(
    kitti: Path, fake_pipeline: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(RunError, match=r"interrupted after 4 of 10 frames; kept in .*report"):
        _reprocess_failing(kitti, tmp_path, fake_pipeline, {3: None})
    assert "what is mapped is kept" in capsys.readouterr().err
    assert json.loads((tmp_path / "out" / "report.json").read_text())["frames"] == 4
    assert signal.getsignal(signal.SIGINT) is before


def _reprocess_failing(
    kitti: Path, tmp_path: Path, made: list[Any], faults: dict[int, Exception | None]
) -> Any:
    """Reprocess with errors raised in some frames; None is Ctrl-C."""

    def before_frame(index: int) -> None:
        if index in faults and len(made) > 1:  # not in the warm-up
            fault = faults[index]
            if fault is not None:
                raise fault
            os.kill(os.getpid(), signal.SIGINT)

    from artemis_edge.pipeline import Pipeline

    def make(config: Config, odometry: Any, folder: Path) -> Any:
        mapper: Any = Pipeline(config, odometry, folder)
        mapper.before_frame = before_frame
        return mapper

    return reprocess(Request(kitti, tmp_path / "out", poses=poses_of(kitti)), make=make)


def test_a_result_that_cannot_be_written_leaves_the_others(tmp_path: Path) -> None:
    results = Results(tmp_path)
    results.text("a", "1")

    def fail(path: Path) -> None:
        raise OSError(28, "No space left on device")

    assert results.attempt("b", fail) is None
    assert results.directory("c", fail) is None
    results.json("d", {"x": 1})
    assert results.kept == ["a", "d"]
    assert results.fault is not None
    assert "No space left on device; free space" in results.fault
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "d"]


def test_output_folders_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="is a file"):
        prepare(tmp_path / "file")
    with pytest.raises(InputError, match="cannot write to"):
        prepare(tmp_path / "file" / "b")
    prepare(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()


def test_several_inputs_have_folders_of_their_own(
    kitti: Path, fake_pipeline: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    arguments = ["reprocess", str(kitti), str(kitti), "--out", str(out), "--frames", "0:3", "--json"]
    arguments += ["--jobs", "1"]
    assert main(arguments) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    assert sorted(runs) == [str(out / "00"), str(out / "00_2")]
    assert main(["reprocess", str(tmp_path / "missing"), *arguments[2:]]) == 1
    assert "1 of 2 inputs failed" in capsys.readouterr().err
    assert places([kitti], out) == [(kitti, out)]


def test_report_json_alone_on_stdout(
    kitti: Path, fake_pipeline: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["reprocess", str(kitti), "--out", str(tmp_path / "out"), "--set", "odometry.points=500"]
    assert main([*arguments, "--json"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["frames"] == 10
    assert "10 of 10" in told.err
    assert "points = 500" in (tmp_path / "out" / "config.toml").read_text()
    assert main([*arguments, "--frames", "0:2"]) == 0
    assert "2 frames mapped, 0 dropped" in capsys.readouterr().out


def test_bench_measures_an_input(
    kitti: Path, fake_pipeline: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", str(kitti), "--frames", "5", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["frames"] == 5
    assert set(found["stages"]["mesher"]) == {"p50", "p95", "p99", "mean"}
    assert main(["bench", str(kitti), "--frames", "5"]) == 0
    assert "frame, CPU" in capsys.readouterr().out
    assert main(["bench", str(kitti), "--frames", "0"]) == 2


def test_photographs_held_out_have_poses(tmp_path: Path) -> None:
    model = CameraModel(8, 6, 5.0, 5.0, 3.5, 2.5)
    T_cam_lidar = np.eye(4)
    T_cam_lidar[0, 3] = 0.25
    held = HeldOut(tmp_path, 2)
    for k in range(5):
        image = CameraImage("cam", k * 100 + 50, b"\x89PNG%d" % k, model, T_cam_lidar)
        frame = held.take(SyncedFrame(k, k * 100, (), (image,)))
        assert len(frame.images) == (1 if k % 2 == 0 else 0)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = np.arange(4.0)
    stamps = np.arange(4, dtype=np.int64) * 100
    assert held.write_index(tmp_path / "PHOTOS.json", Trajectory(stamps, poses)) == 0
    photos = json.loads((tmp_path / "PHOTOS.json").read_text())["photos"]
    assert [photo["file"] for photo in photos] == ["photos/cam_000002.png", "photos/cam_000004.png"]
    assert (tmp_path / photos[0]["file"]).read_bytes() == b"\x89PNG1"
    assert photos[0]["T_cam_world"][0][3] == pytest.approx(0.25 - 1.5)
    assert photos[0]["distortion"] == [0.0] * 5


def test_photographs_of_an_earlier_run_are_removed(
    kitti: Path, fake_pipeline: list[Any], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    (out / "photos").mkdir(parents=True)
    for name in ("PHOTOS.json", "photos/cam_000002.png", "photos/holiday.jpg"):
        (out / name).write_bytes(b"{}")
    reprocess(Request(kitti, out, poses=poses_of(kitti)))
    assert not (out / "PHOTOS.json").exists()
    assert [path.name for path in (out / "photos").iterdir()] == ["holiday.jpg"]
    (out / "photos" / "cam_000002.png").write_bytes(b"without an index, not ours")
    reprocess(Request(kitti, out, poses=poses_of(kitti)))
    assert (out / "photos" / "cam_000002.png").exists()


def test_photographs_of_this_run_stay(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "PHOTOS.json").write_text("{}")
    (tmp_path / "photos" / "cam_000007.jpg").write_bytes(b"old")
    held = HeldOut(tmp_path, 1)
    image = CameraImage("cam", 0, b"new", CameraModel(8, 6, 5.0, 5.0, 3.5, 2.5), np.eye(4))
    held.take(SyncedFrame(0, 0, (), (image,)))
    held.remove_earlier()
    assert [path.name for path in (tmp_path / "photos").iterdir()] == ["cam_000001.jpg"]


def test_photographs_beyond_the_trajectory_are_counted(tmp_path: Path) -> None:
    held = HeldOut(tmp_path, 1)
    held.take(
        SyncedFrame(0, 0, (), (CameraImage("c", 10**12, b"x", CameraModel(1, 1, 1, 1, 0, 0), np.eye(4)),))
    )
    nothing = Trajectory(np.zeros(1, np.int64), np.eye(4)[None])
    assert held.write_index(tmp_path / "PHOTOS.json", nothing) == 1
    assert json.loads((tmp_path / "PHOTOS.json").read_text()) == {"photos": []}


def test_readings_of_the_machine(tmp_path: Path) -> None:
    assert health.resident_mb() > 10.0
    health.restart_peak()
    before = health.peak_resident_mb()
    with mmap.mmap(-1, 40 << 20) as fresh:  # numpy might reuse memory that is resident already
        fresh.write(b"x" * len(fresh))
        assert health.peak_resident_mb() >= before + 30.0
    assert health.available_memory_mb() > 10.0
    assert health.processors() >= 1
    assert health.free_disk_mb(tmp_path / "not" / "there") > 0.0


def test_the_warm_up_map_is_small(kitti: Path, fake_pipeline: list[Any], tmp_path: Path) -> None:
    budgets: list[int] = []

    def make(config: Config, odometry: Any, folder: Path) -> Any:
        from artemis_edge.pipeline import Pipeline

        budgets.append(config.voxel_map.memory_budget_mb)
        return Pipeline(config, odometry, folder)

    config = msgspec.convert({"voxel_map": {"memory_budget_mb": 5000}}, Config)
    reprocess(Request(kitti, tmp_path / "out", config, poses=poses_of(kitti)), make=make)
    assert budgets == [600, 5000]


def test_sources_carry_stamps_and_warnings(kitti: Path) -> None:
    source = open_input(kitti)
    assert len(source.stamp_ns) == len(source) == 10
    assert source.warnings == []
