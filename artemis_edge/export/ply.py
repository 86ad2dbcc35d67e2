"""The PLY file of a mesh (the contract of ``mesh.ply``); reading is in ``ply_reader.py``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.export.atomic import replacing
from artemis_edge.export.mesh import Mesh, PointCloud, bare_mesh, vertex_normals
from artemis_edge.export.ply_reader import read_mesh, read_ply, read_points
from artemis_edge.frames import I32

__all__ = [
    "Mesh",
    "PointCloud",
    "bare_mesh",
    "find_mesh",
    "read_mesh",
    "read_ply",
    "read_points",
    "vertex_normals",
    "write_ply",
]

_VERTEX = np.dtype(
    [
        ("position", "<f4", 3),
        ("normal", "<f4", 3),
        ("colour", "u1", 3),
        ("label", "u1"),
        ("confidence", "<f4"),
    ]
)
_FACE = np.dtype([("count", "u1"), ("vertex", "<i4", 3)])
_HEADER = """\
ply
format binary_little_endian 1.0
{comments}element vertex {vertices}
property float x
property float y
property float z
property float nx
property float ny
property float nz
property uchar red
property uchar green
property uchar blue
property uchar label
property float confidence
element face {faces}
property list uchar int vertex_indices
end_header
"""
_ROWS_AT_ONCE = 1 << 20


def find_mesh(map_path: Path) -> Path:
    """The mesh file of MAP: an output directory or the file itself. Raises InputError if there is none."""
    path = map_path / "mesh.ply" if map_path.is_dir() else map_path
    if not path.is_file():
        raise InputError(f"no mesh at {path}; give an output directory or its mesh.ply")
    return path


def write_ply(path: Path, mesh: Mesh, remarks: Sequence[str] = ()) -> None:
    """Write ``mesh`` as binary little-endian PLY with one ``comment label N NAME`` line a class.

    ``remarks`` are further comments. Equal meshes give equal bytes. Raises RunError when the file cannot be written;
    no half file is left.
    """
    comments = "".join(f"comment {remark}\n" for remark in remarks) + "".join(
        f"comment label {label} {' '.join(name.split())}\n"
        for label, name in sorted(mesh.label_names.items())
    )
    header = _HEADER.format(comments=comments, vertices=len(mesh.vertices), faces=len(mesh.faces))
    with replacing(path) as file:
        file.write(header.encode())
        for start in range(0, len(mesh.vertices), _ROWS_AT_ONCE):
            file.write(_vertex_rows(mesh, slice(start, start + _ROWS_AT_ONCE)))
        for start in range(0, len(mesh.faces), _ROWS_AT_ONCE):
            file.write(_face_rows(mesh.faces[start : start + _ROWS_AT_ONCE]))


def _vertex_rows(mesh: Mesh, part: slice) -> bytes:
    rows = np.empty(len(mesh.vertices[part]), _VERTEX)
    rows["position"] = mesh.vertices[part]
    rows["normal"] = mesh.normals[part]
    rows["colour"] = mesh.colours[part]
    rows["label"] = mesh.labels[part]
    rows["confidence"] = mesh.confidence[part]
    return rows.tobytes()


def _face_rows(faces: I32) -> bytes:
    rows = np.empty(len(faces), _FACE)
    rows["count"] = 3
    rows["vertex"] = faces
    return rows.tobytes()
