"""``objects.json`` of the output directory, and a mesh of one object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from artemis_edge.export.mesh import Mesh
from artemis_edge.highlight import FoundObject, Reply

_DIGITS = 4  # a tenth of a millimetre, of a thousandth of a score


def queries_json(replies: Sequence[Reply]) -> list[dict[str, Any]]:
    """What became of each question, for report.json."""
    return [
        {
            "text": reply.text,
            "status": str(reply.status),
            "score": round(max((found.score for found in reply.found), default=0.0), _DIGITS),
            "reason": reply.reason,
            "objects": [found.item.id for found in reply.found],
        }
        for reply in replies
    ]


def objects_json(replies: Sequence[Reply]) -> dict[str, Any]:
    """Content of objects.json: every hit of every question, and what became of each question."""
    return {
        "objects": [_entry(found) for reply in replies for found in reply.found],
        "queries": queries_json(replies),
    }


def _entry(found: FoundObject) -> dict[str, Any]:
    item = found.item
    return {
        "id": item.id,
        "text": found.text,
        "status": str(found.status),
        "score": round(found.score, _DIGITS),
        "class": item.name,
        "centroid": _numbers(item.centroid),
        "box": {
            "center": _numbers(item.box.centre),
            "size": _numbers(item.box.size),
            "yaw": round(item.box.yaw, _DIGITS),
        },
        "triangles": len(item.triangles),
        "area_m2": round(item.area_m2, _DIGITS),
    }


def _numbers(values: np.ndarray) -> list[float]:
    return [round(float(value), _DIGITS) for value in values]


def object_mesh(mesh: Mesh, found: FoundObject) -> Mesh:
    """The mesh of one object alone."""
    faces = mesh.faces[found.item.triangles]
    used, renumbered = np.unique(faces, return_inverse=True)
    return Mesh(
        vertices=mesh.vertices[used],
        normals=mesh.normals[used],
        colours=mesh.colours[used],
        labels=mesh.labels[used],
        confidence=mesh.confidence[used],
        faces=renumbered.reshape(faces.shape).astype(np.int32),
        label_names=mesh.label_names,
    )
