"""The demo: a short walk through the real simulation, odometry and pipeline."""

import json
from pathlib import Path

import numpy as np
import pytest

from artemis_edge.cli import main
from artemis_edge.evaluate.mesh import Comparison
from artemis_edge.session.demo import near_path


def test_demo_maps_what_it_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "demo"
    assert main(["demo", "--seconds", "1", "--out", str(out)]) == 0
    told = capsys.readouterr()
    for row in ("mesh within 10 cm", "wound as the world", "path", str(out / "report.html")):
        assert row in told.out
    report = json.loads((out / "report.json").read_text())
    assert report["frames"] == 10
    found = report["evaluation"]
    assert found["world"]["near_f1"] > 0.5
    assert found["trajectory"]["ate_rmse_m"] < 0.1
    assert found["mesh"]["edges"]["non_manifold_share"] == 0.0


def test_only_what_is_near_the_path_counts() -> None:
    mesh, cloud = np.array([[1.0, 0, 0], [50.0, 0, 0]]), np.array([[0.0, 2, 0], [0.0, 40, 0], [0.0, 3, 0]])
    whole = Comparison(0.1, mesh, np.array([0.0, 9.0]), cloud, np.array([0.0, 0.0, 9.0]))
    near = near_path(whole, np.zeros((1, 3)), 10.0)
    assert near.precision == 1.0
    assert near.recall == 0.5
