"""``report.json`` and ``report.html``: what a run made, what it cost, what it lost, how good it is."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from artemis_edge.evaluate.mesh import MeshEvaluation
from artemis_edge.evaluate.sampling import triangle_areas
from artemis_edge.evaluate.trajectory import TrajectoryEvaluation
from artemis_edge.export.atomic import write_bytes
from artemis_edge.export.ply import Mesh
from artemis_edge.frames import Trajectory
from artemis_edge.session import report_html
from artemis_edge.session.statistics import RunStatistics

__all__ = ["Evaluation", "RunStatistics", "write_report"]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What was measured against a reference or against a virtual world's truth, where there is one.

    ``world`` are the shares of ``session.truth.TruthReport``.
    """

    mesh: MeshEvaluation | None = None
    trajectory: TrajectoryEvaluation | None = None
    world: Mapping[str, float] | None = None

    def to_json(self) -> dict[str, Any]:
        """The JSON objects of the ``evaluate`` commands, by name."""
        parts = (("mesh", self.mesh), ("trajectory", self.trajectory))
        found: dict[str, Any] = {name: part.to_json() for name, part in parts if part is not None}
        return found if self.world is None else found | {"world": dict(self.world)}


def write_report(
    out_dir: Path,
    mesh: Mesh,
    trajectory: Trajectory,
    statistics: RunStatistics,
    queries: Sequence[Mapping[str, Any]] = (),
    evaluation: Evaluation | None = None,
) -> dict[str, Any]:
    """Write ``report.json`` and ``report.html`` into ``out_dir`` and return what the former says.

    ``queries`` are the objects of ``objects.json`` or whatever is known of each question. Raises RunError
    when a file cannot be written.
    """
    report = report_object(mesh, statistics, queries, evaluation)
    text = json.dumps(report, indent=2, allow_nan=False, ensure_ascii=False)
    write_bytes(out_dir / "report.json", (text + "\n").encode())
    page = report_html.page(report, mesh, trajectory, statistics, evaluation)
    write_bytes(out_dir / "report.html", page.encode())
    return report


def report_object(
    mesh: Mesh,
    statistics: RunStatistics,
    queries: Sequence[Mapping[str, Any]] = (),
    evaluation: Evaluation | None = None,
) -> dict[str, Any]:
    """The content of ``report.json``: plain JSON values, None for numbers that are not finite."""
    report = statistics.summary() | {
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.faces),
        "area_m2": round(float(triangle_areas(mesh.vertices, mesh.faces).sum()), 3),
        "queries": [dict(query) for query in queries],
    }
    if evaluation is not None:
        report["evaluation"] = evaluation.to_json()
    plain: dict[str, Any] = _plain(report)
    return plain


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
