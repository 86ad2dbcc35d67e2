"""Wavefront OBJ with MTL and one picture for each atlas page, as old tools and CAD programs read it.

``out.obj``, ``out.mtl`` and ``out_000.png`` ... beside it. Coordinates are those of the map (z up, metres); vertices
carry their colour as three more numbers, as MeshLab and Blender read it. A picture's v axis points up in OBJ.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from artemis_edge.errors import InputError
from artemis_edge.export.atlas import UNTEXTURED, Atlas
from artemis_edge.export.atomic import replacing, write_bytes
from artemis_edge.export.corners import shared_corners
from artemis_edge.export.mesh import Mesh, require_finite
from artemis_edge.export.png import png_bytes
from artemis_edge.progress import Report, silent

_ROWS_AT_ONCE = 100_000
_PLAIN = "vertex_colours"


def write_obj(
    path: Path,
    mesh: Mesh,
    atlas: Atlas | None = None,
    report: Report = silent,
    remarks: Sequence[str] = (),
) -> None:
    """Write ``mesh`` and, with an atlas, the material file and pictures beside it; ``remarks`` as comments.

    Raises InputError for a name that a material cannot bear and for coordinates that are not finite, RunError when
    a file cannot be written.
    """
    if any(character.isspace() for character in path.name):
        raise InputError(f"'{path.name}': an OBJ cannot name its materials with blanks; choose another --out")
    require_finite(mesh)
    numbers = [] if atlas is None else np.unique(atlas.page[atlas.page != UNTEXTURED]).tolist()
    pictures = {number: f"{path.stem}_{number:03d}.png" for number in numbers}
    if atlas is not None:
        for number, name in pictures.items():
            write_bytes(path.with_name(name), png_bytes(atlas.pages[number]))
        write_bytes(path.with_suffix(".mtl"), _materials(pictures).encode())
    with replacing(path) as file:
        file.write("".join(f"# {remark}\n" for remark in remarks).encode())
        file.write(f"# artemis-edge: metres, z up\n{_library(path, atlas)}o map\n".encode())
        _write_vertices(file, mesh)
        _write_faces(file, mesh, atlas, pictures, report)


def _library(path: Path, atlas: Atlas | None) -> str:
    return "" if atlas is None else f"mtllib {path.with_suffix('.mtl').name}\n"


def _materials(pictures: dict[int, str]) -> str:
    """Nothing shines; the picture is the colour (Kd white), or the vertices' colours are."""
    text = f"newmtl {_PLAIN}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\n"
    for number, name in pictures.items():
        text += f"\nnewmtl page_{number:03d}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {name}\n"
    return text


def _write_vertices(file: BinaryIO, mesh: Mesh) -> None:
    for part in _parts(len(mesh.vertices)):
        rows = np.concatenate([mesh.vertices[part], mesh.colours[part] / np.float32(255.0)], axis=1)
        _write_rows(file, "v %.4f %.4f %.4f %.4f %.4f %.4f\n", rows)
    for part in _parts(len(mesh.normals)):
        _write_rows(file, "vn %.4f %.4f %.4f\n", mesh.normals[part])


def _write_faces(
    file: BinaryIO, mesh: Mesh, atlas: Atlas | None, pictures: dict[int, str], report: Report
) -> None:
    """Untextured faces first, then page by page; numbers count from one over the whole file."""
    plain = mesh.faces if atlas is None else mesh.faces[atlas.page == UNTEXTURED]
    if len(plain):
        file.write(b"" if atlas is None else f"usemtl {_PLAIN}\n".encode())
    for part in _parts(len(plain)):
        _write_rows(file, "f %d//%d %d//%d %d//%d\n", np.repeat(plain[part] + 1, 2, axis=1))
    first = 1
    for done, number in enumerate(pictures):
        assert atlas is not None
        chosen = np.flatnonzero(atlas.page == number)
        faces = mesh.faces[chosen]
        _, place, corners = shared_corners(faces, atlas.uv[chosen])
        height, width = atlas.pages[number].shape[:2]
        u, v = (place[:, 0] + 0.5) / width, 1.0 - (place[:, 1] + 0.5) / height
        _write_rows(file, "vt %.6f %.6f\n", np.stack([u, v], axis=1))
        file.write(f"usemtl page_{number:03d}\n".encode())
        rows = np.stack([faces + 1, corners + first, faces + 1], axis=2).reshape(-1, 9)
        _write_rows(file, "f %d/%d/%d %d/%d/%d %d/%d/%d\n", rows)
        first += len(place)
        report(done + 1, len(pictures))


def _parts(count: int) -> list[slice]:
    return [slice(start, start + _ROWS_AT_ONCE) for start in range(0, count, _ROWS_AT_ONCE)]


def _write_rows(file: BinaryIO, form: str, rows: NDArray[np.generic]) -> None:
    for part in _parts(len(rows)):
        numbers = rows[part]
        file.write((form * len(numbers) % tuple(numbers.reshape(-1).tolist())).encode())
