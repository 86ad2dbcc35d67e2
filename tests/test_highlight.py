"""Objects of a labelled mesh, answers to questions, objects.json."""

from __future__ import annotations

import numpy as np
import pytest

from artemis_edge.export.mesh import Mesh, bare_mesh
from artemis_edge.export.objects import object_mesh, objects_json, queries_json
from artemis_edge.frames import CameraImage, CameraModel
from artemis_edge.highlight import answer, objects_of, pieces, upright_box
from artemis_edge.questions import every_image
from artemis_edge.segmentation.attribute import NAME
from artemis_edge.segmentation.registry import open_by_name
from artemis_edge.segmentation.resolve import understand


def sheet(x: float, label: int, size: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    corners = np.array([[x, 0, 0], [x + size, 0, 0], [x + size, 0, size], [x, 0, size]], np.float32)
    return corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.full(4, label, np.uint8)


def world(*sheets: tuple[np.ndarray, np.ndarray, np.ndarray]) -> Mesh:
    first = np.cumsum([0] + [len(s[0]) for s in sheets])
    return bare_mesh(
        np.concatenate([s[0] for s in sheets]),
        np.concatenate([s[1] + k for s, k in zip(sheets, first, strict=False)]).astype(np.int32),
        labels=np.concatenate([s[2] for s in sheets]),
        colours=np.full((first[-1], 3), 180, np.uint8),
        label_names={0: "background", 1: "car", 2: "person"},
    )


def test_objects_are_split_by_distance_and_class() -> None:
    mesh = world(
        sheet(0, 1), sheet(1.2, 1), sheet(3.0, 1, 2.0), sheet(5.1, 2), sheet(9.0, 0), sheet(12, 1, 0.1)
    )
    found = objects_of(mesh, np.ones(len(mesh.vertices), np.float32))
    assert [(o.name, len(o.triangles)) for o in found] == [("car", 2), ("car", 4), ("person", 2)]
    assert [o.id for o in found] == [1, 2, 3]
    assert found[0].area_m2 == pytest.approx(4.0)
    np.testing.assert_allclose(found[1].centroid, [1.1, 0.0, 0.5], atol=1e-5)
    assert found[0].colour is None, "grey is what nobody coloured"


def test_nothing_has_no_pieces() -> None:
    assert len(pieces(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))) == 0


def test_box_is_turned_with_its_object() -> None:
    points = np.array([[x, y, z] for x in (-2, 2) for y in (-1, 1) for z in (0, 1)], np.float64)
    turn = np.radians(30)
    R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    box = upright_box((points @ R.T).astype(np.float32))
    np.testing.assert_allclose(box.size, [4, 2, 1], atol=1e-4)
    assert box.yaw == pytest.approx(turn, abs=1e-3)


def test_answers_are_ranked_and_what_is_unsure_is_not_claimed() -> None:
    mesh = world(sheet(0, 1), sheet(3, 1), sheet(6, 1), sheet(9, 2))
    probability = np.repeat(np.array([0.7, 0.9, 0.3, 0.2], np.float32), 4)
    backend = open_by_name(NAME)
    asked = [understand(text, backend) for text in ("car", "person", "quarkle")]
    car, person, nonsense = answer(asked, objects_of(mesh, probability))
    assert [round(f.score, 2) for f in car.found] == [0.9, 0.7]
    assert person.found == () and str(person.status) == "not_found"
    assert str(nonsense.status) == "unsupported" and nonsense.reason
    content = objects_json([car, person, nonsense])
    assert [o["text"] for o in content["objects"]] == ["car", "car"]
    assert set(content["objects"][0]) >= {"id", "status", "score", "centroid", "box", "triangles", "area_m2"}
    assert set(content["objects"][0]["box"]) == {"center", "size", "yaw"}
    assert [q["status"] for q in queries_json([car, person, nonsense])][1:] == ["not_found", "unsupported"]
    alone = object_mesh(mesh, car.found[0])
    assert len(alone.vertices) == 4 and alone.vertices[:, 0].min() == 3.0


def test_the_far_side_of_a_thing_counts_neither_for_it_nor_against_it() -> None:
    """Two triangles over corners 0 1 2 and 0 2 3: corners 0 and 2 weigh a third each, the others a sixth."""
    mesh = world(sheet(0, 1))
    for probability, score in (
        ((0.8, 0.8, 0.8, 0.8), 0.8),
        ((0.8, 0.0, 0.8, 0.0), 0.8),
        ((0.9, 0.0, 0.0, 0.0), 0.6),  # a third is two thirds of enough
        ((0.0, 0.6, 0.0, 0.0), 0.2),
        ((0.0, 0.0, 0.0, 0.0), 0.0),
    ):
        (found,) = objects_of(mesh, np.array(probability, np.float32))
        assert found.classes["car"] == pytest.approx(score), probability


def test_every_second_image_of_a_camera_is_due_whatever_frame_it_comes_in() -> None:
    due = every_image(2, 3)
    image = CameraImage("cam_0", 0, b"", CameraModel(8, 8, 8.0, 8.0, 4.0, 4.0), np.eye(4))
    assert [due(turn, image) for turn in (1, 3, 5, 7)] == [4, None, 8, None]
