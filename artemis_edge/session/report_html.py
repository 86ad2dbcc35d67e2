"""The page ``report.html``: one file, nothing loaded from elsewhere, well-formed also as XML."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from artemis_edge.export.ply import Mesh
from artemis_edge.frames import U8, Trajectory
from artemis_edge.session import charts, pictures
from artemis_edge.session.statistics import RunStatistics

if TYPE_CHECKING:
    from artemis_edge.session.report import Evaluation

_WEBP_QUALITY = 90
_KINDS: tuple[pictures.Kind, ...] = ("texture", "label", "confidence", "height")
_NAMES = ("texture", "labels", "confidence", "height")
_STYLE = """
:root { color: #26292f; background: #f4f5f6; font: 15px/1.5 system-ui, "Segoe UI", sans-serif; }
* { box-sizing: border-box; }
body { max-width: 1180px; margin: 0 auto; padding: 36px 24px 64px; }
h1 { font-size: 26px; font-weight: 650; margin: 0; letter-spacing: -0.01em; }
h2 { font-size: 18px; font-weight: 650; margin: 40px 0 14px; }
p.sub { color: #6b727c; margin: 4px 0 24px; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; }
.tile, figure, .card { background: #fff; border: 1px solid #e3e5e8; border-radius: 10px; }
.tile { padding: 12px 16px; }
.tile b { display: block; font-size: 22px; font-weight: 650; font-variant-numeric: tabular-nums; }
.tile span { color: #6b727c; font-size: 13px; }
.grid { display: grid; grid-template-columns: repeat(auto-fit, minmax(440px, 1fr)); gap: 16px; }
.wide { grid-column: 1 / -1; }
figure { margin: 0; padding: 10px; display: flex; flex-direction: column; }
figure img, figure svg { width: 100%; max-height: 720px; object-fit: contain; margin: auto; display: block; }
figcaption { color: #6b727c; font-size: 13px; padding: 8px 4px 0; }
.card { padding: 8px 16px; overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: 6px 12px 6px 0; border-bottom: 1px solid #eceef0; vertical-align: top; }
tr:last-child th, tr:last-child td { border-bottom: 0; }
th { font-weight: 500; color: #6b727c; white-space: nowrap; }
.warn { color: #b3261e; }
pre { font-size: 12.5px; white-space: pre-wrap; }
summary { cursor: pointer; padding: 6px 0; }
@media (max-width: 520px) { .grid { grid-template-columns: 1fr; } }
@media print { :root { background: #fff; } figure, .tile, .card { break-inside: avoid; } }
"""


def page(
    report: dict[str, Any],
    mesh: Mesh,
    trajectory: Trajectory,
    statistics: RunStatistics,
    evaluation: Evaluation | None,
) -> str:
    """The whole page; ``report`` is the content of ``report.json``."""
    title = f"Artemis Edge: {report['input'] or 'run'}"
    made = f"{report['frames']} frames, {report['area_m2']:,.0f} m² of surface"
    sections = [
        f'<h1>{escape(title)}</h1><p class="sub">{made}</p>',
        _tiles(report),
        "<h2>Map</h2>",
        _maps(mesh, trajectory, evaluation),
        _scores(report.get("evaluation", {})),
        "<h2>Time</h2>",
        _times(report, statistics),
        "<h2>Run</h2>",
        _run_table(report),
        _queries(report["queries"]),
        _config(statistics.config_toml),
    ]
    body = "\n".join(section for section in sections if section)
    return (
        '<!DOCTYPE html>\n<html xmlns="http://www.w3.org/1999/xhtml" lang="en">\n<head>\n'
        '<meta charset="utf-8"/>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1"/>\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _tiles(report: dict[str, Any]) -> str:
    pace = report["realtime_factor"]
    figures = [
        (f"{report['frame_ms']['p50']:.0f} ms", f"median frame, p99 {report['frame_ms']['p99']:.0f} ms"),
        (f"{report['cpu_ms']['mean']:.0f} ms", "CPU per frame"),
        ("unknown" if pace is None else f"{pace:.1f} times", "the pace of the input"),
        (f"{report['triangles']:,}", "triangles"),
        (f"{report['peak_rss_mb']:,.0f} MB", "largest memory"),
    ]
    measured = report.get("evaluation", {})
    for tau, score in measured.get("mesh", {}).get("thresholds", {}).items():
        figures.append((f"{score['f1']:.3f}", f"F1 within {tau} m"))
    if "trajectory" in measured:
        figures.append((f"{measured['trajectory']['ate_rmse_m']:.2f} m", "trajectory error, rms"))
    tiles = "".join(f'<div class="tile"><b>{escape(v)}</b><span>{escape(t)}</span></div>' for v, t in figures)
    return f'<div class="tiles">{tiles}</div>'


def _maps(mesh: Mesh, trajectory: Trajectory, evaluation: Evaluation | None) -> str:
    shown = pictures.scene(mesh, trajectory)
    figures = [
        _picture(pictures.perspective_view(shown), "In perspective, with the way that was gone", wide=True),
        *(
            _picture(picture, f"From above: {name}")
            for picture, name in zip(pictures.maps_from_above(shown, _KINDS), _NAMES, strict=True)
        ),
    ]
    reference = None
    if evaluation is not None and evaluation.mesh is not None:
        for comparison in evaluation.mesh.comparisons:
            words = f"Precision and recall within {comparison.tau_m:g} m; darker is worse"
            figures.append(_picture(pictures.heat_maps(comparison), words, wide=True))
    path = trajectory.T_world_lidar[:, :3, 3]
    words = "Trajectory from above; the dark dot is its start"
    if evaluation is not None and evaluation.trajectory is not None:
        path, reference = evaluation.trajectory.aligned, evaluation.trajectory.reference
        words += "; the reference is dashed"
    chart = charts.trajectory_chart(path, reference)
    if chart:
        figures.append(_figure(chart, words, wide=True))
    return f'<div class="grid">{"".join(figures)}</div>'


def _times(report: dict[str, Any], statistics: RunStatistics) -> str:
    figures = [
        _figure(charts.time_chart(statistics.frame_ms), "Each frame, from handed in to mesh ready (ms)")
    ]
    if report["stages"]:
        words = "Each stage: bar to the median, whisker to the 99th percentile (ms)"
        figures.insert(0, _figure(charts.stage_chart(report["stages"]), words))
    return f'<div class="grid">{"".join(figures)}</div>'


def _picture(image: U8, caption: str, wide: bool = False) -> str:
    bgr = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR)
    packed = cv2.imencode(".webp", bgr, [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY])[1]
    data = base64.b64encode(packed.tobytes()).decode()
    return _figure(f'<img alt="{escape(caption)}" src="data:image/webp;base64,{data}"/>', caption, wide)


def _figure(content: str, caption: str, wide: bool = False) -> str:
    kind = ' class="wide"' if wide else ""
    return f"<figure{kind}>{content}<figcaption>{escape(caption)}</figcaption></figure>"


def _table(rows: Iterable[tuple[str, str]]) -> str:
    body = "".join(f"<tr><th>{escape(name)}</th><td>{value}</td></tr>" for name, value in rows)
    return f'<div class="card"><table>{body}</table></div>'


def _scores(measured: dict[str, Any]) -> str:
    rows: list[tuple[str, str]] = []
    mesh = measured.get("mesh")
    if mesh is not None:
        for tau, s in mesh["thresholds"].items():
            value = f"precision {s['precision']:.4f}, recall {s['recall']:.4f}, F1 {s['f1']:.4f}"
            rows.append((f"Mesh within {tau} m", value))
        rows.append(
            (
                "Distances",
                f"accuracy {mesh['accuracy_cm']:.2f} cm, completeness {mesh['completeness_cm']:.2f} cm, "
                f"Chamfer {mesh['chamfer_cm']:.2f} cm",
            )
        )
        edges = mesh["edges"]
        rows.append(
            (
                "Edges",
                f"{edges['non_manifold_share']:.3%} non-manifold, {edges['boundary_share']:.2%} boundary, "
                f"{edges['orientation_share']:.3%} consistently oriented",
            )
        )
    rows += _world_scores(measured.get("world"))
    path = measured.get("trajectory")
    if path is not None:
        rows.append(
            (
                "Trajectory",
                f"{path['ate_rmse_m']:.3f} m rms, {path['ate_max_m']:.3f} m at most, "
                f"{path['matched']} poses over {path['length_m']:.1f} m",
            )
        )
        rows += [
            (f"Relative, per {length} m", f"{e['percent']:.3f} %, {e['deg_per_m']:.4f} °/m")
            for length, e in path["rpe"].items()
        ]
    return f"<h2>Measured against the reference</h2>{_table(rows)}" if rows else ""


def _world_scores(world: dict[str, Any] | None) -> list[tuple[str, str]]:
    """Shares are None where nothing could be judged."""
    if world is None or world["wound_share"] is None or world["bridging_area_share"] is None:
        return []
    return [
        ("Wound as the world", f"{world['wound_share']:.3%} of {world['judged']:,} triangles"),
        ("Bridging a gap", f"{world['bridging_area_share']:.3%} of the area"),
    ]


def _run_table(report: dict[str, Any]) -> str:
    lost = ", ".join(
        f"{count:,} {reason.replace('_', ' ')}" for reason, count in report["lost"].items() if count
    )
    dropped, open_ways = report["frames_dropped"], report["frames_degenerate"]
    frame, rate = report["frame_ms"], report["input_hz"]
    return _table(
        [
            ("Input", escape(report["input"] or "unnamed") + (f", {rate:g} Hz" if rate else "")),
            ("Frames", f"{report['frames']} mapped, " + _warned(f"{dropped} dropped", dropped > 0)),
            (
                "Degenerate",
                _warned(f"{open_ways} frames leave a direction open", True) if open_ways else "none",
            ),
            ("Lost", _warned(escape(lost), True) if lost else "nothing"),
            ("Frame", ", ".join(f"{name} {value:.1f} ms" for name, value in frame.items())),
            ("CPU", f"{report['cpu_ms']['mean']:.1f} ms per frame on average"),
            (
                "Apart from frames",
                f"{report['warmup_s']:.2f} s warm-up, {report['flush_ms']:.1f} ms final flush",
            ),
            ("Mesh", f"{report['vertices']:,} vertices, {report['triangles']:,} triangles"),
            ("Surface", f"{report['area_m2']:,.1f} m²"),
            ("Memory", f"{report['peak_rss_mb']:,.0f} MB at most, map {report['map_bytes'] / 1e6:,.1f} MB"),
            ("Versions", escape(", ".join(f"{name} {v}" for name, v in report["versions"].items()))),
        ]
    )


def _warned(words: str, warn: bool) -> str:
    return f'<span class="warn">{words}</span>' if warn else words


def _queries(queries: list[dict[str, Any]]) -> str:
    rows = [(str(q.get("text", "")), _answer(q)) for q in queries]
    return f"<h2>Questions</h2>{_table(rows)}" if rows else ""


def _answer(query: dict[str, Any]) -> str:
    """As ``ask`` says it: the status, the best score and how many objects, and why."""
    told = str(query.get("status", "")).replace("_", " ")
    if found := query.get("objects"):
        told += f", {len(found)} of them, the best with score {float(query.get('score', 0.0)):.2f}"
    return told + (f" ({query['reason']})" if query.get("reason") else "")


def _config(toml: str) -> str:
    if not toml.strip():
        return ""
    details = f"<details><summary>config.toml</summary><pre>{escape(toml)}</pre></details>"
    return f'<h2>Configuration</h2><div class="card">{details}</div>'
