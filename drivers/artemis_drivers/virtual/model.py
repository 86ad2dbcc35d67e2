"""Reads textured models: GLB and glTF 2.0 (Khronos specification) and OBJ, as parts with a node name each."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from artemis_drivers.virtual.mesh_builder import F64, U8, Colour

_WHITE: Colour = (1.0, 1.0, 1.0)
#: glTF's component types.
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
#: glTF is y up: T_world_gltf.
_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


class ModelError(ValueError):
    """One sentence: what is wrong with the file and what to do."""


@dataclass(frozen=True, slots=True)
class Look:
    """A part's material: ``picture`` uint8 (h, w, 3) RGB or None, ``tint`` 0..1 multiplies it."""

    name: str
    picture: U8 | None = None
    tint: Colour = _WHITE
    glass: bool = False
    double_sided: bool = False


@dataclass(frozen=True, slots=True)
class Part:
    """Triangles of one node and one material.

    ``names`` of the node and those above it, nearest first; ``corners`` float64 (m, 3, 3) metres, z up;
    ``uv`` float64 (m, 3, 2), v upwards, 1 is one repetition of the picture.
    """

    names: tuple[str, ...]
    corners: F64
    uv: F64
    look: Look


@dataclass(slots=True)
class Model:
    """A file's parts and the places of its nodes without triangles."""

    parts: list[Part] = field(default_factory=list)
    places: dict[str, F64] = field(default_factory=dict)


def read_model(path: Path) -> Model:
    """Read ``path``. Raises ModelError when it is missing, of another kind, or broken."""
    kinds = {".glb": _read_glb, ".gltf": _read_gltf, ".obj": _read_obj}
    read = kinds.get(path.suffix.lower())
    if read is None:
        raise ModelError(f"{path} is no model that can be loaded; give a .glb, .gltf or .obj file")
    if not path.is_file():
        raise ModelError(f"there is no file {path}; give the path of a .glb, .gltf or .obj file")
    try:
        return read(path)
    except ModelError:
        raise
    except (ValueError, KeyError, IndexError, TypeError, struct.error, OSError) as error:
        kind = type(error).__name__
        raise ModelError(f"{path} is damaged ({kind}: {error}); export it again") from error


def decoded(data: bytes, what: str) -> U8:
    """RGB picture of PNG or JPEG bytes."""
    bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if bgr is None:
        raise ModelError(f"the picture {what} cannot be read; use PNG or JPEG")
    return np.asarray(bgr[..., ::-1], np.uint8)


# --- glTF


def _read_glb(path: Path) -> Model:
    data = path.read_bytes()
    if len(data) < 20 or data[:4] != b"glTF":
        raise ModelError(f"{path} is no GLB file; export it again as binary glTF 2.0")
    version, total = struct.unpack_from("<II", data, 4)
    if version != 2 or total > len(data):
        raise ModelError(f"{path} is not glTF 2.0 or is cut off; export it again as binary glTF 2.0")
    chunks: dict[bytes, bytes] = {}
    at = 12
    while at + 8 <= total:
        size, kind = struct.unpack_from("<I4s", data, at)
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    return _Gltf(json.loads(chunks[b"JSON"]), path, chunks.get(b"BIN\0", b"")).model()


def _read_gltf(path: Path) -> Model:
    return _Gltf(json.loads(path.read_text("utf-8")), path, b"").model()


class _Gltf:
    def __init__(self, tree: dict[str, Any], path: Path, binary: bytes) -> None:
        self.tree, self.path, self.binary = tree, path, binary
        needed = [e for e in tree.get("extensionsRequired", []) if e != "KHR_materials_unlit"]
        if needed:
            raise ModelError(f"{path} needs the glTF extension {needed[0]}; export it without compression")
        self.looks = [self._look(k) for k in range(len(tree.get("materials", [])))]

    def model(self) -> Model:
        scenes = self.tree.get("scenes") or [{"nodes": list(range(len(self.tree.get("nodes", []))))}]
        model = Model()
        for root in scenes[self.tree.get("scene", 0)].get("nodes", []):
            self._visit(model, root, _Z_UP, ())
        return model

    def _visit(self, model: Model, number: int, T_world_parent: F64, above: tuple[str, ...]) -> None:
        if len(above) > 200:
            raise ModelError(f"{self.path} has nodes within themselves; export it again")
        node = self.tree["nodes"][number]
        names = (str(node.get("name", "")), *above)
        T = T_world_parent @ _node_transform(node)
        if "mesh" in node:
            for primitive in self.tree["meshes"][node["mesh"]]["primitives"]:
                if primitive.get("mode", 4) == 4:
                    model.parts.append(self._part(primitive, T, names))
        elif names[0]:
            model.places[names[0]] = T[:3, 3]
        for child in node.get("children", []):
            self._visit(model, child, T, names)

    def _part(self, primitive: dict[str, Any], T: F64, names: tuple[str, ...]) -> Part:
        attributes = primitive["attributes"]
        points = self._accessor(attributes["POSITION"]).astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        order = (
            self._accessor(primitive["indices"]).reshape(-1).astype(np.int64)
            if "indices" in primitive
            else np.arange(len(points))
        )
        triangles = order.reshape(-1, 3)
        if np.linalg.det(T[:3, :3]) < 0:
            triangles = triangles[:, ::-1]
        uv = np.zeros((len(points), 2))
        if "TEXCOORD_0" in attributes:
            uv = self._accessor(attributes["TEXCOORD_0"]).astype(np.float64)
            uv = np.column_stack([uv[:, 0], 1.0 - uv[:, 1]])
        look = self.looks[primitive["material"]] if "material" in primitive else Look("")
        return Part(names, points[triangles], uv[triangles], look)

    def _accessor(self, number: int) -> NDArray[Any]:
        accessor = self.tree["accessors"][number]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ModelError(f"{self.path} has sparse accessors; export it again without them")
        view = self.tree["bufferViews"][accessor["bufferView"]]
        kind, wide = np.dtype(_COMPONENTS[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        data = self._view(view)[accessor.get("byteOffset", 0) :]
        count, stride = accessor["count"], view.get("byteStride", kind.itemsize * wide)
        rows = np.ndarray((count, wide), kind, data, 0, (stride, kind.itemsize))
        if accessor.get("normalized") and kind.kind == "u":
            return rows.astype(np.float64) / float(np.iinfo(kind).max)
        return rows

    def _view(self, view: dict[str, Any]) -> bytes:
        buffer = self.tree["buffers"][view["buffer"]]
        data = self._uri(buffer["uri"]) if "uri" in buffer else self.binary
        first = view.get("byteOffset", 0)
        return data[first : first + view["byteLength"]]

    def _uri(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        beside = self.path.parent / uri
        if not beside.is_file():
            raise ModelError(
                f"{self.path} refers to {uri}, which is not beside it; export it as one .glb file"
            )
        return beside.read_bytes()

    def _look(self, number: int) -> Look:
        material = self.tree["materials"][number]
        surface = material.get("pbrMetallicRoughness", {})
        r, g, b, alpha = surface.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))
        picture = None
        if "baseColorTexture" in surface:
            source = self.tree["textures"][surface["baseColorTexture"]["index"]]["source"]
            image = self.tree["images"][source]
            data = (
                self._view(self.tree["bufferViews"][image["bufferView"]])
                if "bufferView" in image
                else self._uri(image["uri"])
            )
            picture = decoded(data, f"number {source} of {self.path}")
        # linear factors; tints multiply the square root of reflectance, as pictures do
        tint = (float(r) ** 0.5, float(g) ** 0.5, float(b) ** 0.5)
        clear = material.get("alphaMode") == "BLEND" and alpha < 0.9
        name = f"{number} {material.get('name', '')}"
        return Look(name, picture, tint, clear, bool(material.get("doubleSided", False)))


def _node_transform(node: dict[str, Any]) -> F64:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    T = np.eye(4)
    rotation = Rotation.from_quat(node.get("rotation", (0.0, 0.0, 0.0, 1.0))).as_matrix()
    T[:3, :3] = rotation * np.array(node.get("scale", (1.0, 1.0, 1.0)), np.float64)
    T[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return T


# --- OBJ


def _read_obj(path: Path) -> Model:
    """Objects (``o``) and groups (``g``) are nodes; coordinates are taken as z up, metres."""
    model, points, texture = Model(), [], [(0.0, 0.0)]
    looks: dict[str, Look] = {}
    faces: dict[tuple[str, str], list[tuple[list[int], list[int]]]] = {}
    node, material = "", ""
    for words in _lines(path):
        if words[0] == "v":
            points.append(tuple(float(w) for w in words[1:4]))
        elif words[0] == "vt":
            texture.append((float(words[1]), float(words[2])))
        elif words[0] in ("o", "g") and len(words) > 1:
            node = words[1]
        elif words[0] == "usemtl":
            material = " ".join(words[1:])
        elif words[0] == "mtllib":
            looks.update(_read_mtl(path.parent / " ".join(words[1:])))
        elif words[0] == "f":
            faces.setdefault((node, material), []).extend(_fan(words[1:], len(points), len(texture)))
    where, at = np.array(points, np.float64).reshape(-1, 3), np.array(texture, np.float64)
    for (name, of), triangles in faces.items():
        corners = where[np.array([t[0] for t in triangles])]
        uv = at[np.array([t[1] for t in triangles])]
        model.parts.append(Part((name,), corners, uv, looks.get(of, Look(of))))
    return model


def _lines(path: Path) -> Iterator[list[str]]:
    for line in path.read_text("utf-8", errors="replace").splitlines():
        words = line.split("#")[0].split()
        if words:
            yield words


def _fan(words: list[str], points: int, textures: int) -> list[tuple[list[int], list[int]]]:
    """Triangles of a polygon: numbers of points and of texture coordinates (0: none)."""
    corners = []
    for word in words:
        parts = word.split("/")
        v = int(parts[0])
        t = int(parts[1]) if len(parts) > 1 and parts[1] else 0
        corners.append((v - 1 if v > 0 else points + v, t if t >= 0 else textures + t))
    if any(not 0 <= v < points or t >= textures for v, t in corners):
        raise ModelError("a face of the OBJ file names a vertex that is not there; export it again")
    return [
        ([corners[0][0], corners[k][0], corners[k + 1][0]], [corners[0][1], corners[k][1], corners[k + 1][1]])
        for k in range(1, len(corners) - 1)
    ]


def _read_mtl(path: Path) -> dict[str, Look]:
    if not path.is_file():
        raise ModelError(f"the OBJ file refers to {path.name}, which is not beside it; put it there")
    looks: dict[str, Look] = {}
    name = ""
    for words in _lines(path):
        old = looks.get(name, Look(name))
        if words[0] == "newmtl":
            name = " ".join(words[1:])
            looks[name] = Look(name)
        elif words[0] == "Kd":
            r, g, b = (float(w) for w in words[1:4])
            looks[name] = Look(name, old.picture, (r, g, b), old.glass)
        elif words[0] == "d":
            looks[name] = Look(name, old.picture, old.tint, float(words[1]) < 0.9)
        elif words[0] == "map_Kd":
            image = path.parent / " ".join(words[1:])
            if not image.is_file():
                raise ModelError(f"{path.name} refers to {image.name}, which is not beside it; put it there")
            looks[name] = Look(name, decoded(image.read_bytes(), str(image)), _WHITE, old.glass)
    return looks
