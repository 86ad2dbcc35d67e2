"""``mesh.glb``: glTF 2.0 in one binary file, Y up, metres, colours per vertex.

Written directly, because the layout is small and equal meshes must give equal bytes. Section numbers are
those of the Khronos glTF 2.0 specification.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from artemis_edge.errors import InputError
from artemis_edge.export.atomic import write_bytes
from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import F32, F64, U8

_MAGIC, _VERSION, _JSON, _BIN = b"glTF", 2, b"JSON", b"BIN\0"
_FLOAT, _UINT, _USHORT = 5126, 5125, 5123
_VERTEX_BUFFER, _INDEX_BUFFER = 34962, 34963
_OPAQUE = np.iinfo(np.uint16).max
_GENERATOR = "artemis-edge"


def write_glb(path: Path, mesh: Mesh) -> None:
    """Write ``mesh``; world z becomes glTF y.

    Raises InputError for coordinates that are not finite, RunError when the file cannot be written.
    """
    if not (np.isfinite(mesh.vertices).all() and np.isfinite(mesh.normals).all()):
        raise InputError(
            "the mesh has coordinates that are not finite; write it again with `artemis-edge reprocess`"
        )
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": _GENERATOR},
        "scene": 0,
        "scenes": [{"nodes": []}],
    }
    blobs: list[bytes] = []
    if len(mesh.faces):
        _add_mesh(document, blobs, mesh)
    write_bytes(path, _container(document, b"".join(blobs)))


def _add_mesh(document: dict[str, Any], blobs: list[bytes], mesh: Mesh) -> None:
    arrays: tuple[tuple[NDArray[Any], int, str, int], ...] = (
        (_y_up(mesh.vertices), _FLOAT, "VEC3", _VERTEX_BUFFER),
        (_y_up(_unit(mesh.normals)), _FLOAT, "VEC3", _VERTEX_BUFFER),
        (_linear_rgba(mesh.colours), _USHORT, "VEC4", _VERTEX_BUFFER),
        (mesh.faces.astype("<u4").reshape(-1), _UINT, "SCALAR", _INDEX_BUFFER),
    )
    views, accessors, offset = [], [], 0
    for k, (array, component, kind, target) in enumerate(arrays):
        blob = array.tobytes()  # every element is a multiple of 4 bytes: aligned without padding (3.6.2.4)
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(blob), "target": target})
        accessors.append({"bufferView": k, "componentType": component, "count": len(array), "type": kind})
        blobs.append(blob)
        offset += len(blob)
    accessors[0] |= {"min": arrays[0][0].min(axis=0).tolist(), "max": arrays[0][0].max(axis=0).tolist()}
    accessors[2] |= {"normalized": True}
    names = {str(label): name for label, name in sorted(mesh.label_names.items())}
    attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}
    document |= {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "map", "mesh": 0}],
        "meshes": [
            {
                "name": "map",
                "primitives": [{"attributes": attributes, "indices": 3, "material": 0}],
                "extras": {"label_names": names},
            }
        ],
        "materials": [
            {
                "name": "vertex colours",
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
                "doubleSided": True,
            }
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }


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


def _container(document: dict[str, Any], binary: bytes) -> bytes:
    """Header and chunks, each padded to 4 bytes (4.4)."""
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()
    chunks = _chunk(_JSON, text + b" " * (-len(text) % 4))
    if binary:
        chunks += _chunk(_BIN, binary + b"\0" * (-len(binary) % 4))
    return struct.pack("<4sII", _MAGIC, _VERSION, 12 + len(chunks)) + chunks


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack("<I4s", len(content), kind) + content
