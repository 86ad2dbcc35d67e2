"""IoU of a labelled mesh against a labelled cloud, and what is counted as wrong."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from artemis_edge import cli
from artemis_edge.errors import InputError
from artemis_edge.evaluate.boundaries import score_boundaries
from artemis_edge.evaluate.semantics import evaluate_semantics, labelled_samples, predicted_labels
from artemis_edge.export.mesh import Mesh, PointCloud, bare_mesh
from artemis_edge.export.ply import write_ply


def strip(labels: tuple[int, ...] = (1, 1, 1, 2, 2, 2)) -> Mesh:
    """A strip along x of 2.5 m: vertices every half metre, labelled from left to right."""
    x = np.arange(len(labels)) * 0.5
    vertices = np.concatenate([np.stack([x, np.full(len(x), y), np.zeros(len(x))], 1) for y in (0.0, 0.5)])
    n = len(x)
    faces = [[k, k + 1, n + k] for k in range(n - 1)] + [[k + 1, n + k + 1, n + k] for k in range(n - 1)]
    both = np.array(labels * 2, np.uint8)
    names = {0: "background", 1: "car", 2: "ground"}
    return bare_mesh(vertices.astype(np.float32), np.array(faces, np.int32), labels=both, label_names=names)


def cloud(x: list[float], labels: list[int], names: dict[int, str]) -> PointCloud:
    points = np.stack([x, np.full(len(x), 0.25), np.zeros(len(x))], 1).astype(np.float32)
    return PointCloud(points, labels=np.array(labels, np.uint8), label_names=names)


NAMES = {7: "Car", 9: "ground", 4: "tree"}


def test_a_point_takes_the_label_of_the_corner_it_belongs_to() -> None:
    found = predicted_labels(
        strip(), np.array([[0.9, 0.1, 0.0], [1.6, 0.1, 0.0], [9.0, 0.0, 0.0]], np.float32)
    )
    assert found.tolist() == [1, 2, -1]
    points, labels = labelled_samples(strip())
    assert len(points) == len(labels) and {1, 2} == set(labels.tolist())


def test_iou_by_name() -> None:
    reference = cloud([0.1, 0.9, 1.6, 2.4, 0.3, 2.2], [7, 7, 9, 9, 9, 4], NAMES)
    found = evaluate_semantics(strip(), reference)
    assert found.classes["car"].iou == pytest.approx(2 / 3)
    assert found.classes["ground"].iou == pytest.approx(2 / 4)
    assert found.miou == pytest.approx((2 / 3 + 2 / 4) / 2)
    assert set(found.classes) == {"car", "ground"}


def test_points_without_mesh_are_wrong_and_255_is_ignored() -> None:
    reference = cloud([0.1, 30.0, 0.2], [7, 7, 255], NAMES)
    found = evaluate_semantics(strip(), reference)
    assert (found.classes["car"].iou, found.unmatched_share, found.points) == (0.5, 0.5, 2)


def test_what_cannot_be_compared_is_said() -> None:
    with pytest.raises(InputError, match="no labels"):
        evaluate_semantics(strip(), PointCloud(np.zeros((1, 3), np.float32)))
    with pytest.raises(InputError, match="no class in common"):
        evaluate_semantics(strip(), cloud([0.1], [4], NAMES))


def test_boundary_band_judges_only_what_lies_near_another_class() -> None:
    mesh = strip()
    x = np.arange(0.0, 2.5, 0.02)
    points = np.stack([x, np.full(len(x), 0.25), np.where(x < 0.3, 0.5, 0.0)], 1).astype(np.float32)
    reference = PointCloud(points, labels=np.where(x < 1.25, 1, 2).astype(np.uint8))
    near = score_boundaries(mesh, reference, (0.05,))[0.05]
    assert near.recall == 1.0, "the points far off the mesh are far from the border"
    assert 0.0 < near.precision <= 1.0


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "mesh.ply", strip())
    write_ply(tmp_path / "cloud.ply", strip())
    arguments = ["evaluate", "semantics", str(tmp_path), "--labels", str(tmp_path / "cloud.ply")]
    assert cli.main([*arguments, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["miou"] == 1.0 and found["unmatched_share"] == 0.0
    assert set(found["classes"]) == {"car", "ground"} and found["classes"]["car"]["points"] == 6
    assert cli.main(arguments) == 0
    assert "mean IoU 1.000" in capsys.readouterr().out
