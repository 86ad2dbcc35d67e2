"""Which triangles of a finished map a text means: by the objects of ``objects.json``, else by class names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.export.ply import Mesh
from artemis_edge.frames import F64, U8, Bool
from artemis_edge.json_file import read_json
from artemis_edge.segmentation.query import shown

_OBJECTS = "objects.json"
_FOUND = ("matched", "approximate")
_BACKGROUND = 0
# An object's box ends at its outermost points; the vertices that belong to it may stand out by their noise [m].
_BOX_MARGIN_M = 0.05


def highlighted_triangles(map_path: Path, mesh: Mesh, text: str) -> Bool:
    """Bool (m,): the triangles of objects found for ``text``, or else of the classes named so.

    Case does not matter. Raises InputError when the map has neither.
    """
    objects = [o for o in read_objects(map_path) if _same(str(o.get("text", "")), text)]
    chosen = [o for o in objects if o.get("status") in _FOUND and "box" in o]
    if chosen:
        found: Bool = np.logical_or.reduce([_in_object(mesh, o) for o in chosen])
        return found
    labels = [label for label, name in mesh.label_names.items() if label != _BACKGROUND and _same(name, text)]
    if labels:
        return np.isin(face_labels(mesh), labels)
    raise InputError(f"nothing in this map is known as '{shown(text)}'; {_known(map_path, mesh)}")


def read_objects(map_path: Path) -> list[dict[str, Any]]:
    """The objects of MAP, none where there is no ``objects.json``; InputError if it is not one."""
    path = (map_path if map_path.is_dir() else map_path.parent) / _OBJECTS
    if not path.is_file():
        return []
    try:
        objects = read_json(path)["objects"]
    except (OSError, ValueError, KeyError, TypeError):
        objects = None
    if not isinstance(objects, list) or not all(isinstance(o, dict) for o in objects):
        raise InputError(f"{path} is not a list of objects; make the map again")
    return objects


def face_labels(mesh: Mesh) -> U8:
    """The label most corners of a face have, uint8 (m,); where all differ, that of the first."""
    a, b, c = (mesh.labels[mesh.faces[:, k]] for k in range(3))
    return np.where(b == c, b, a)


def _same(name: str, text: str) -> bool:
    return name.strip().casefold() == text.strip().casefold()


def _in_object(mesh: Mesh, found: dict[str, Any]) -> Bool:
    """Triangles whose middle lies in the object's box and which, where its class has a label, bear it."""
    inside = _in_box(mesh, found["box"])
    kind = str(found.get("class", found.get("text", "")))
    labels = [n for n, name in mesh.label_names.items() if n and _same(name, kind)]
    return inside & np.isin(face_labels(mesh), labels) if labels else inside


def _in_box(mesh: Mesh, box: dict[str, Any]) -> Bool:
    """Box: ``center`` (3,), ``size`` (3,) in metres and ``yaw`` about z in radians."""
    try:
        centre, size = np.array(box["center"], np.float64), np.array(box["size"], np.float64)
        yaw = float(box.get("yaw", 0.0))
    except (KeyError, TypeError, ValueError):
        raise InputError("objects.json has a box without center, size and yaw; make the map again") from None
    away: F64 = mesh.vertices[mesh.faces].astype(np.float64).mean(axis=1) - centre
    cosine, sine = np.cos(yaw), np.sin(yaw)
    x, y = away[:, 0] * cosine + away[:, 1] * sine, away[:, 1] * cosine - away[:, 0] * sine
    half = 0.5 * size + _BOX_MARGIN_M
    inside: Bool = (np.abs(x) <= half[0]) & (np.abs(y) <= half[1]) & (np.abs(away[:, 2]) <= half[2])
    return inside


def _known(map_path: Path, mesh: Mesh) -> str:
    names = {str(o["text"]) for o in read_objects(map_path) if o.get("text") and o.get("status") in _FOUND}
    names |= {name for label, name in mesh.label_names.items() if label != _BACKGROUND}
    if not names:
        return "no objects are known in it; map it again with --query TEXT"
    return f"it knows: {', '.join(sorted(names))}"
