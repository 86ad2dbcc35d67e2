"""Pictures, report.json and report.html."""

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from artemis_edge.errors import RunError
from artemis_edge.evaluate.mesh import evaluate_mesh
from artemis_edge.evaluate.trajectory import evaluate_trajectory
from artemis_edge.export.ply import Mesh, bare_mesh
from artemis_edge.frames import TrackedFrame, Trajectory
from artemis_edge.session import charts, drawing, pictures, report_html
from artemis_edge.session.report import Evaluation, RunStatistics, report_object, write_report
from artemis_edge.trajectory import matrix_from_quaternion

CONTRACT = {
    "frames", "frames_dropped", "frame_ms", "cpu_ms", "stages", "vertices", "triangles", "area_m2",
    "peak_rss_mb", "map_bytes", "realtime_factor", "input_hz", "queries", "versions",
}  # fmt: skip


def hilly(n: int = 40, size: float = 20.0) -> Mesh:
    """A square of ground with a bump, red in one half and blue in the other, labelled alike."""
    x, y = np.meshgrid(np.linspace(0, size, n), np.linspace(0, size, n), indexing="ij")
    z = 2.0 * np.exp(-((x - 10) ** 2 + (y - 10) ** 2) / 20)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij"))
    a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + j + 1, i * n + j + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    half = (x.ravel() > size / 2).astype(np.uint8)
    return bare_mesh(
        np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1),
        faces,
        colours=np.where(half[:, None] > 0, np.uint8([30, 40, 220]), np.uint8([220, 40, 30])),
        labels=half,
        confidence=np.linspace(0, 1, n * n, dtype=np.float32),
        label_names={0: "background", 1: "red <car> & bench"},
    )


def walk(count: int = 30) -> Trajectory:
    """A straight walk over the ground, looking along x."""
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 0, 3], T[:, 1, 3], T[:, 2, 3] = np.linspace(2, 18, count), 10, 3
    return Trajectory(np.arange(count) * 100_000_000, T)


def statistics(frames: int = 30) -> RunStatistics:
    run = RunStatistics(input_name="walk <1>", input_hz=10.0, warmup_s=0.5, map_bytes=1234, peak_rss_mb=321.0)
    for k in range(frames):
        tracked = TrackedFrame(k, 0, np.eye(4), (), degenerate=k < 2)
        run.add_frame(20.0 + k, 15.0, {"odometry": 5.0, "mesher": 10.0 + k}, tracked)
    run.add_lost({"nan_points": 3})
    run.add_lost({"nan_points": 2, "packets": 0})
    run.config_toml = "[mesher]\nname = 'a < b & c'\n"
    return run


def test_report_has_every_key_of_the_contract(tmp_path: Path) -> None:
    mesh = hilly()
    returned = write_report(
        tmp_path, mesh, walk(), statistics(), [{"text": "a car", "status": "approximate"}]
    )
    report = json.loads((tmp_path / "report.json").read_text())
    assert report == returned
    assert set(report) >= CONTRACT
    assert report["frames"] == 30 and report["frames_dropped"] == 0
    assert report["frames_degenerate"] == 2
    assert report["frame_ms"]["mean"] == pytest.approx(34.5) and report["frame_ms"]["max"] == 49.0
    assert report["frame_ms"]["p50"] == pytest.approx(34.5) and report["frame_ms"]["p99"] > 48
    assert report["cpu_ms"]["mean"] == 15.0
    assert list(report["stages"]) == ["odometry", "mesher"]
    assert report["stages"]["mesher"] == {"p50": 24.5, "p99": pytest.approx(38.71), "mean": 24.5}
    assert report["lost"] == {"nan_points": 5, "packets": 0}
    assert report["area_m2"] == pytest.approx(400, rel=0.1)
    assert report["realtime_factor"] == pytest.approx(3.0 / 1.035, abs=2e-3)
    assert report["queries"] == [{"text": "a car", "status": "approximate"}]
    assert report["versions"]["numpy"] == np.__version__


def test_report_of_nothing(tmp_path: Path) -> None:
    empty = bare_mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    nowhere = Trajectory(np.empty(0, np.int64), np.empty((0, 4, 4)))
    report = write_report(tmp_path, empty, nowhere, RunStatistics())
    assert report["frames"] == 0 and report["frame_ms"]["p99"] == 0.0 and report["realtime_factor"] is None
    assert report["peak_rss_mb"] > 10  # measured
    ET.fromstring((tmp_path / "report.html").read_text())


def test_numbers_that_are_not_finite_become_null() -> None:
    run = RunStatistics()
    run.add_frame(float("nan"), 1.0, {})
    text = json.dumps(report_object(hilly(4), run), allow_nan=False)
    assert json.loads(text)["frame_ms"]["max"] is None


class _Links(HTMLParser):
    """Collects everything that could load something."""

    def __init__(self) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.targets += [value or "" for name, value in attrs if name in ("src", "href", "data", "poster")]


def evaluated() -> Evaluation:
    mesh, path = hilly(), walk()
    reference = mesh.vertices[:1000] + np.float32([0.01, 0, 0.02])
    return Evaluation(evaluate_mesh(mesh, reference, (0.1, 0.2)), evaluate_trajectory(path, path))


def test_page_is_well_formed_and_loads_nothing(tmp_path: Path) -> None:
    report = write_report(
        tmp_path, hilly(), walk(), statistics(), [{"text": "<b>", "status": "ok"}], evaluated()
    )
    assert set(report["evaluation"]) == {"mesh", "trajectory"}
    page = (tmp_path / "report.html").read_text()
    root = ET.fromstring(page)
    space = "{http://www.w3.org/1999/xhtml}"
    assert root.tag == f"{space}html"
    headings = [h.text for h in root.iter(f"{space}h2")]
    assert headings == ["Map", "Measured against the reference", "Time", "Run", "Questions", "Configuration"]
    assert root.find(f".//{space}pre").text == statistics().config_toml  # type: ignore[union-attr]
    assert len(list(root.iter("{http://www.w3.org/2000/svg}svg"))) == 3
    links = _Links()
    links.feed(page)
    assert len(links.targets) == 7 and all(t.startswith("data:image/webp;base64,") for t in links.targets)
    assert not {"script", "link", "iframe"} & set(links.tags)
    assert "url(" not in page and "@import" not in page
    assert "5 nan points" in page and "F1" in page


def test_page_and_json_repeat(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_report(tmp_path / name, hilly(), walk(), statistics())
    for file in ("report.json", "report.html"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_report_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"report\.json"):
        write_report(tmp_path / "absent", hilly(4), walk(), statistics())


def test_map_from_above_shows_colours_where_they_are() -> None:
    shown = pictures.scene(hilly(), Trajectory(np.empty(0, np.int64), np.empty((0, 4, 4))))
    image = pictures.map_from_above(shown, "texture")
    height, width = image.shape[:2]
    assert height == 800 and 780 < width <= 820
    left, right = image[height // 4, width // 4].astype(int), image[height // 4, 3 * width // 4].astype(int)
    assert left[0] > left[2] + 80 and right[2] > right[0] + 80
    assert (image[2, 2] == drawing.PAPER).all()  # the margin
    labelled = pictures.map_from_above(shown, "label")
    assert np.ptp(labelled[height // 4, width // 4].astype(int)) < 16  # background is grey
    assert np.ptp(labelled[height // 4, 3 * width // 4].astype(int)) > 60


@pytest.mark.parametrize("kind", ["texture", "label", "confidence", "height"])
def test_a_long_corridor_has_a_picture(kind: pictures.Kind) -> None:
    hills = hilly()
    long = replace(hills, vertices=hills.vertices * np.array([100.0, 0.5, 1.0], np.float32))
    shown = pictures.scene(long, Trajectory(np.empty(0, np.int64), np.empty((0, 4, 4))))
    height, width = pictures.map_from_above(shown, kind).shape[:2]
    assert width == pytest.approx(1200, abs=2) and height > 200


@pytest.mark.parametrize("kind", ["texture", "label", "confidence", "height"])
def test_path_is_drawn_where_it_went(kind: pictures.Kind) -> None:
    image = pictures.map_from_above(pictures.scene(hilly(), walk()), kind)
    near_path = np.abs(image.astype(int) - drawing.PATH).sum(axis=2) < 60
    rows, columns = np.nonzero(near_path)
    middle = np.abs(rows - 400) < 12
    assert middle.mean() > 0.5 and np.ptp(columns[middle]) > 500


def test_world_that_is_not_z_up_is_turned() -> None:
    # The same scene in camera axes (x right, y down, z forward) gives the same view but for the heading.
    T = matrix_from_quaternion(np.zeros(3), np.array([0.5, -0.5, 0.5, 0.5]))
    mesh, path = hilly(), walk()
    turned = bare_mesh(mesh.vertices @ T[:3, :3].T, mesh.faces, colours=mesh.colours)
    shown = pictures.scene(turned, Trajectory(path.stamp_ns, T @ path.T_world_lidar))
    assert np.ptp(shown.vertices[:, 2]) == pytest.approx(2.0, abs=0.1)
    assert shown.path[:, 2].min() > shown.vertices[:, 2].mean()
    assert pictures.map_from_above(shown, "texture").shape[0] == 800


def test_perspective_view_sees_the_map() -> None:
    image = pictures.perspective_view(pictures.scene(hilly(), walk()))
    assert image.shape == (pictures.HEIGHT, pictures.WIDTH, 3)
    covered = (image != drawing.PAPER).any(axis=2)
    assert 0.15 < covered.mean() < 0.9 and covered[400, 600]


def test_heat_maps_are_darker_where_worse(tmp_path: Path) -> None:
    mesh = hilly(160)  # vertices 0.13 m apart
    reference = mesh.vertices.copy()
    reference[reference[:, 0] > 10, 2] += 0.15
    pictures.write_heat_maps(tmp_path / "heat.png", evaluate_mesh(mesh, reference, (0.2,)))
    image = cv2.imread(str(tmp_path / "heat.png")).astype(float).mean(axis=2)
    height, width = image.shape
    assert width > height  # two square maps side by side
    panel = image[60:300, : width // 2]
    grey = np.where(panel < 250, panel, np.nan)
    left, right = np.nanmean(grey[:, 40 : width // 4 - 40]), np.nanmean(grey[:, width // 4 + 40 : -40])
    assert left > right + 15


def test_scale_bar_lengths() -> None:
    assert [drawing.round_length(x) for x in (1.0, 1.9, 4.9, 50.0, 0.73)] == [1.0, 1.0, 2.0, 50.0, 0.5]


def test_charts_hold_many_frames_and_outliers() -> None:
    many = charts.time_chart([20.0] * 100_000 + [900.0])
    assert len(many) < 20_000
    ET.fromstring(many)
    assert charts.trajectory_chart(np.empty((0, 3))) == ""
    ET.fromstring(charts.stage_chart({"a & b": {"p50": 0.0, "p99": 0.0, "mean": 0.0}}))


def test_answers_are_told_in_words() -> None:
    found = {"text": "car", "status": "matched", "score": 0.917, "reason": "", "objects": [1, 2]}
    absent = {
        "text": "red tree",
        "status": "not_found",
        "score": 0.0,
        "reason": "no tree is red",
        "objects": [],
    }
    page = report_html._queries([found, absent])
    assert "matched, 2 of them, the best with score 0.92" in page
    assert "not found (no tree is red)" in page
