"""``mesh.glb``: glTF 2.0 in one binary file, Y up, metres, textured where there is an atlas.

Every atlas page is a primitive with its picture inside the file; triangles no camera saw make one more, with the
colours of their vertices. Written directly, because the layout is small and equal meshes must give equal bytes;
page by page, so that memory is that of the mesh and one page. Section numbers are those of the Khronos glTF 2.0
specification.
"""

from __future__ import annotations

import json
import shutil
import struct
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from artemis_edge.errors import InputError
from artemis_edge.export.atlas import UNTEXTURED, Atlas
from artemis_edge.export.atomic import replacing
from artemis_edge.export.corners import shared_corners
from artemis_edge.export.mesh import Mesh, require_finite
from artemis_edge.frames import F32, F64, I32, U8
from artemis_edge.progress import Report, silent

_MAGIC, _VERSION, _JSON, _BIN = b"glTF", 2, b"JSON", b"BIN\0"
_FLOAT, _UINT, _USHORT = 5126, 5125, 5123
_VERTEX_BUFFER, _INDEX_BUFFER = 34962, 34963
_LINEAR, _LINEAR_MIPMAPS, _CLAMP = 9729, 9987, 33071
_OPAQUE = np.iinfo(np.uint16).max
_LARGEST = (1 << 32) - 1  # a GLB states its length as uint32 (4.4.2)
_GENERATOR = "artemis-edge"
# A photograph carries its own light: a viewer's lamps must not shade it again.
_UNLIT = "KHR_materials_unlit"
_MATT = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
# Texture fine enough that no block pattern shows between texels of different colour: 4:4:4, quality 95.
_JPEG = [
    cv2.IMWRITE_JPEG_QUALITY, 95,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
]  # fmt: skip


def write_glb(
    path: Path,
    mesh: Mesh,
    atlas: Atlas | None = None,
    report: Report = silent,
    remarks: Mapping[str, Any] | None = None,
) -> None:
    """Write ``mesh``; world z becomes glTF y. The same mesh and atlas give the same bytes.

    ``remarks`` stand in the asset's ``extras``.

    Raises InputError for coordinates that are not finite, RunError when the file cannot be written.
    """
    require_finite(mesh)
    page = np.full(len(mesh.faces), UNTEXTURED, np.int32) if atlas is None else atlas.page
    with replacing(path) as file, tempfile.TemporaryFile(dir=path.parent) as spool:
        document = _Document(spool)
        numbers = np.unique(page).tolist()
        for done, number in enumerate(numbers):
            chosen = np.flatnonzero(page == number)
            if number == UNTEXTURED or atlas is None:
                document.add_coloured(mesh, mesh.faces[chosen])
            else:
                document.add_textured(mesh, mesh.faces[chosen], atlas.pages[number], atlas.uv[chosen])
            report(done + 1, len(numbers))
        content = document.finish(mesh.label_names)
        if remarks:
            content["asset"]["extras"] = dict(remarks)
        _write_container(file, content, spool, document.size)


class _Document:
    """The JSON of a file while its binary part grows in ``spool``."""

    def __init__(self, spool: BinaryIO) -> None:
        self.size = 0
        self._spool = spool
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._primitives: list[dict[str, Any]] = []
        self._materials: list[dict[str, Any]] = []
        self._images: list[dict[str, Any]] = []

    def add_coloured(self, mesh: Mesh, faces: I32) -> None:
        """Triangles with the colours of their vertices; lit where nothing has a colour, else it had no shape."""
        used = np.unique(faces)
        renumber = np.zeros(len(mesh.vertices), np.uint32)
        renumber[used] = np.arange(len(used), dtype=np.uint32)
        material: dict[str, Any] = {
            "name": "vertex colours",
            "pbrMetallicRoughness": _MATT,
            "doubleSided": True,
        }
        if np.ptp(mesh.colours[used], axis=0).any():
            material["extensions"] = {_UNLIT: {}}
        attributes = self._placed(mesh, used)
        colours = self._accessor(_linear_rgba(mesh.colours[used]), _USHORT, "VEC4") | {"normalized": True}
        attributes["COLOR_0"] = self._add_accessor(colours)
        self._add_primitive(attributes, renumber[faces], material)

    def add_textured(self, mesh: Mesh, faces: I32, picture: U8, uv: F32) -> None:
        """Triangles of one atlas page, ``uv`` float32 (m, 3, 2) in its pixels."""
        vertex, place, corners = shared_corners(faces, uv)
        size = np.array([picture.shape[1], picture.shape[0]], np.float32)
        # a picture spans 0..1 from border to border, and our pixel centres are whole numbers
        attributes = self._placed(mesh, vertex)
        texture = ((place + np.float32(0.5)) / size).astype("<f4")
        attributes["TEXCOORD_0"] = self._add_accessor(self._accessor(texture, _FLOAT, "VEC2"))
        number = len(self._images)
        jpeg = bytes(cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), _JPEG)[1])
        self._images.append({"mimeType": "image/jpeg", "bufferView": self._add_view(jpeg, None)})
        material = {
            "name": f"texture {number}",
            "pbrMetallicRoughness": {"baseColorTexture": {"index": number}, **_MATT},
            "doubleSided": True,
            "extensions": {_UNLIT: {}},
        }
        self._add_primitive(attributes, corners, material)

    def finish(self, label_names: dict[int, str]) -> dict[str, Any]:
        """The document of all that was added."""
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": _GENERATOR},
            "scene": 0,
            "scenes": [{"nodes": [0] if self._primitives else []}],
        }
        if not self._primitives:
            return document
        names = {str(label): name for label, name in sorted(label_names.items())}
        if any("extensions" in material for material in self._materials):
            document["extensionsUsed"] = [_UNLIT]
        if self._images:
            sampler = {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}
            document["samplers"] = [sampler]
            document["images"] = self._images
            document["textures"] = [{"source": k, "sampler": 0} for k in range(len(self._images))]
        return document | {
            "nodes": [{"name": "map", "mesh": 0}],
            "meshes": [
                {"name": "map", "primitives": self._primitives, "extras": {"label_names": names}},
            ],
            "materials": self._materials,
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self.size}],
        }

    def _placed(self, mesh: Mesh, vertex: NDArray[Any]) -> dict[str, int]:
        positions = _y_up(mesh.vertices[vertex])
        corners = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
        return {
            "POSITION": self._add_accessor(self._accessor(positions, _FLOAT, "VEC3") | corners),
            "NORMAL": self._add_accessor(self._accessor(_y_up(_unit(mesh.normals[vertex])), _FLOAT, "VEC3")),
        }

    def _add_primitive(
        self, attributes: dict[str, int], corners: NDArray[Any], material: dict[str, Any]
    ) -> None:
        indices = self._accessor(corners.astype("<u4").reshape(-1), _UINT, "SCALAR", _INDEX_BUFFER)
        number = len(self._materials)
        self._materials.append(material)
        self._primitives.append(
            {"attributes": attributes, "indices": self._add_accessor(indices), "material": number}
        )

    def _accessor(
        self, array: NDArray[Any], component: int, kind: str, target: int = _VERTEX_BUFFER
    ) -> dict[str, Any]:
        view = self._add_view(array.tobytes(), target)
        return {"bufferView": view, "componentType": component, "count": len(array), "type": kind}

    def _add_accessor(self, accessor: dict[str, Any]) -> int:
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def _add_view(self, content: bytes, target: int | None) -> int:
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": len(content)}
        self._views.append(view if target is None else view | {"target": target})
        padded = content + b"\0" * (
            -len(content) % 4
        )  # every array begins at a multiple of 4 bytes (3.6.2.4)
        self._spool.write(padded)
        self.size += len(padded)
        return len(self._views) - 1


def _y_up(vectors: F32) -> F32:
    """z up to y up, both right-handed: (x, y, z) becomes (x, z, -y)."""
    return np.ascontiguousarray(np.stack([vectors[:, 0], vectors[:, 2], -vectors[:, 1]], axis=1), "<f4")


def _unit(normals: F32) -> F32:
    """Of length one, as the specification demands (3.7.2.1); up where a vertex has no normal."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0], np.float32), normals.shape)
    return np.where(length > 0.0, normals / np.maximum(length, np.float32(1e-30)), up).astype(np.float32)


def _linear_rgba(colours: U8) -> NDArray[np.uint16]:
    """sRGB to linear, uint16 (n, 4): COLOR_0 is linear (3.7.2.1), and 8 bits cannot hold dark tones."""
    table = np.rint(srgb_to_linear(np.arange(256) / 255.0) * _OPAQUE).astype("<u2")
    rgba = np.full((len(colours), 4), _OPAQUE, "<u2")
    rgba[:, :3] = table[colours]
    return rgba


def srgb_to_linear(values: F64) -> F64:
    """Inverse of the sRGB transfer function, both 0..1 (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def _write_container(file: BinaryIO, document: dict[str, Any], spool: BinaryIO, size: int) -> None:
    """Header and chunks, each padded to 4 bytes (4.4)."""
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + (8 + size if size else 0)
    if total > _LARGEST:
        raise InputError(
            f"the map needs {total / 1e9:.1f} GB, more than the 4.3 GB a GLB file can hold; use --no-textured or "
            "--format obj"
        )
    file.write(struct.pack("<4sII", _MAGIC, _VERSION, total))
    file.write(struct.pack("<I4s", len(text), _JSON) + text)
    if size:
        file.write(struct.pack("<I4s", size, _BIN))
        spool.seek(0)
        shutil.copyfileobj(spool, file, 1 << 20)
