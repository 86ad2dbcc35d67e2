"""Reads PLY files, ours and foreign ones: ascii, binary of either byte order, any property order."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from artemis_edge.errors import InputError
from artemis_edge.export.mesh import Mesh, PointCloud, bare_mesh
from artemis_edge.frames import F32, F64, I32, I64, U8

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_STRUCT = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
_BYTE_ORDER = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 20
_COLOUR_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_INDEX_NAMES = ("vertex_indices", "vertex_index")


@dataclass(frozen=True, slots=True)
class _Property:
    name: str
    kind: str
    count_kind: str | None = None  # of lists: the type of their length


@dataclass(slots=True)
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)
    data: dict[str, Any] = field(default_factory=dict)  # array per scalar property, (flat, lengths) per list


@dataclass(slots=True)
class _Header:
    byte_order: str
    elements: list[_Element]
    label_names: dict[int, str]
    body: int  # offset of the first byte after the header


def read_ply(path: Path) -> Mesh | PointCloud:
    """A Mesh when the file has faces, else a PointCloud. Polygons become fans of triangles.

    Raises InputError when the file is missing, is no PLY, is truncated or has indices of absent vertices.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    try:
        header = _parse_header(content)
        _read_body(content, header)
        return _assemble(header)
    except _MalformedError as fault:
        raise InputError(f"{path} is not a usable PLY file: {fault}; export or copy it again") from None


def read_points(path: Path) -> PointCloud:
    """The vertices of any PLY file as a cloud; raises InputError as :func:`read_ply` does."""
    content = read_ply(path)
    if isinstance(content, PointCloud):
        return content
    return PointCloud(content.vertices, content.colours, content.labels, content.label_names)


def read_mesh(path: Path) -> Mesh:
    """A mesh; raises InputError when the file holds only points."""
    content = read_ply(path)
    if isinstance(content, PointCloud):
        raise InputError(f"{path} holds points but no triangles; give a mesh")
    return content


class _MalformedError(Exception):
    """What is wrong with the file, in words that follow "is not a usable PLY file:"."""


def _parse_header(content: bytes) -> _Header:
    if not content.startswith(b"ply"):
        raise _MalformedError("it does not begin with 'ply'")
    marker = content.find(b"end_header", 0, _LONGEST_HEADER)
    body = content.find(b"\n", marker) + 1
    if marker < 0 or body == 0:
        raise _MalformedError("its header does not end")
    header = _Header("?", [], {}, body)
    for line in content[:marker].decode("utf-8", errors="replace").splitlines()[1:]:
        try:
            _parse_line(line.split(), header)
        except (ValueError, IndexError, KeyError):
            raise _MalformedError(f"its header has the line '{line.strip()}'") from None
    if header.byte_order == "?":
        raise _MalformedError("its header states no format")
    return header


def _parse_line(words: list[str], header: _Header) -> None:
    match words:
        case ["format", name, _]:
            header.byte_order = _BYTE_ORDER[name]
        case ["comment", "label", number, *name] if number.isdecimal() and name:
            header.label_names[int(number)] = " ".join(name)
        case ["element", name, count] if count.isdecimal():
            header.elements.append(_Element(name, int(count)))
        case ["property", "list", count_kind, kind, name] if _TYPES[count_kind][0] != "f":
            header.elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[count_kind]))
        case ["property", kind, name]:
            header.elements[-1].properties.append(_Property(name, _TYPES[kind]))
        case ["comment" | "obj_info", *_] | []:
            pass
        case _:
            raise ValueError


def _read_body(content: bytes, header: _Header) -> None:
    if header.byte_order:
        offset = header.body
        for element in header.elements:
            offset = _read_binary(content, offset, element, header.byte_order)
        return
    try:
        numbers = np.array(content[header.body :].split(), np.float64)
    except ValueError:
        raise _MalformedError("it has text where numbers belong") from None
    offset = 0
    for element in header.elements:
        offset = _read_ascii(numbers, offset, element)


def _truncated(element: _Element) -> _MalformedError:
    return _MalformedError(f"it ends before its {element.count} rows of '{element.name}'")


def _read_binary(content: bytes, offset: int, element: _Element, order: str) -> int:
    """Read one element; all lists of a property equally long (the common case) takes one numpy view."""
    if element.count == 0:
        return offset
    lengths = _first_row_lengths(content, offset, element, order)
    fields: list[Any] = []
    for k, p in enumerate(element.properties):
        if p.count_kind is not None:
            fields.append((f"count{k}", order + p.count_kind))
            fields.append((f"value{k}", order + p.kind, (lengths[k],)))
        else:
            fields.append((f"value{k}", order + p.kind))
    row = np.dtype(fields)
    end = offset + row.itemsize * element.count
    uniform = end <= len(content)
    if uniform:
        rows = np.frombuffer(content, row, element.count, offset)
        uniform = all((rows[f"count{k}"] == lengths[k]).all() for k in lengths)
    if not uniform:
        if not lengths:
            raise _truncated(element)
        return _read_binary_rows(content, offset, element, order)
    for k, p in enumerate(element.properties):
        values = rows[f"value{k}"]
        if k in lengths:
            element.data[p.name] = (values.reshape(-1), np.full(element.count, lengths[k], np.int64))
        else:
            element.data[p.name] = values
    return end


def _first_row_lengths(content: bytes, offset: int, element: _Element, order: str) -> dict[int, int]:
    lengths: dict[int, int] = {}
    for k, p in enumerate(element.properties):
        if p.count_kind is None:
            offset += np.dtype(p.kind).itemsize
            continue
        lengths[k], offset = _list_length(content, offset, p.count_kind, element, order)
        offset += np.dtype(p.kind).itemsize * lengths[k]
    return lengths


def _list_length(content: bytes, offset: int, kind: str, element: _Element, order: str) -> tuple[int, int]:
    try:
        length = int(struct.unpack_from(order + _STRUCT[kind], content, offset)[0])
    except struct.error:
        raise _truncated(element) from None
    if length < 0 or length > len(content):
        raise _MalformedError(f"a list of '{element.name}' claims {length} entries")
    return length, offset + struct.calcsize(order + _STRUCT[kind])


def _read_binary_rows(content: bytes, offset: int, element: _Element, order: str) -> int:
    """Row by row: lists of different lengths, as of mixed triangles and quads."""
    values: list[list[Any]] = [[] for _ in element.properties]
    lengths: list[list[int]] = [[] for _ in element.properties]
    for _ in range(element.count):
        for k, p in enumerate(element.properties):
            length = 1
            if p.count_kind is not None:
                length, offset = _list_length(content, offset, p.count_kind, element, order)
            layout = f"{order}{length}{_STRUCT[p.kind]}"
            try:
                values[k].extend(struct.unpack_from(layout, content, offset))
            except struct.error:
                raise _truncated(element) from None
            lengths[k].append(length)
            offset += struct.calcsize(layout)
    for k, p in enumerate(element.properties):
        flat = np.array(values[k], p.kind)
        element.data[p.name] = flat if p.count_kind is None else (flat, np.array(lengths[k], np.int64))
    return offset


def _read_ascii(numbers: F64, offset: int, element: _Element) -> int:
    if all(p.count_kind is None for p in element.properties):
        end = offset + element.count * len(element.properties)
        if end > len(numbers):
            raise _truncated(element)
        table = numbers[offset:end].reshape(element.count, len(element.properties))
        for k, p in enumerate(element.properties):
            element.data[p.name] = _typed(table[:, k], p.kind)
        return end
    return _read_ascii_rows(numbers, offset, element)


def _read_ascii_rows(numbers: F64, offset: int, element: _Element) -> int:
    parts: list[list[F64]] = [[] for _ in element.properties]
    for _ in range(element.count):
        for k, p in enumerate(element.properties):
            length = 1
            if p.count_kind is not None:
                if offset >= len(numbers):
                    raise _truncated(element)
                if not numbers[offset] >= 0 or numbers[offset] > len(numbers) - offset - 1:
                    raise _truncated(element)
                length, offset = int(numbers[offset]), offset + 1
            elif offset >= len(numbers):
                raise _truncated(element)
            parts[k].append(numbers[offset : offset + length])
            offset += length
    for k, p in enumerate(element.properties):
        flat = _typed(np.concatenate(parts[k]) if parts[k] else np.empty(0), p.kind)
        lengths = np.array([len(part) for part in parts[k]], np.int64)
        element.data[p.name] = flat if p.count_kind is None else (flat, lengths)
    return offset


def _typed(values: F64, kind: str) -> NDArray[Any]:
    if kind[0] == "f":
        with np.errstate(over="ignore"):
            return values.astype(kind)
    limits = np.iinfo(kind)
    if not np.all((values >= limits.min) & (values <= limits.max)):
        raise _MalformedError(
            f"it has a number outside {limits.min}..{limits.max} where the header promises that range"
        )
    return values.astype(kind)


def _assemble(header: _Header) -> Mesh | PointCloud:
    elements = {element.name: element for element in header.elements}
    vertex = elements.get("vertex")
    if vertex is None or not {"x", "y", "z"} <= {p.name for p in vertex.properties}:
        raise _MalformedError("it has no vertices with x, y and z")
    names = header.label_names
    points = _columns(vertex, ("x", "y", "z"))
    if points is None:
        raise _MalformedError("its vertex coordinates are not plain numbers")
    colours, labels = _colours(vertex), _labels(vertex)
    face = elements.get("face")
    if face is None or (face.count == 0 and not _is_ours(vertex)):
        return PointCloud(points, colours, labels, names)
    confidence = _columns(vertex, ("confidence",))
    return bare_mesh(
        points,
        _triangles(face, vertex.count),
        normals=_columns(vertex, ("nx", "ny", "nz")),
        colours=colours,
        labels=labels,
        confidence=None if confidence is None else confidence[:, 0],
        label_names=names,
    )


def _is_ours(vertex: _Element) -> bool:
    """An empty map is still a mesh when its vertices carry what ours do."""
    return {"confidence", "label", "nx"} <= {p.name for p in vertex.properties}


def _columns(vertex: _Element, names: tuple[str, ...]) -> F32 | None:
    scalars = {p.name for p in vertex.properties if p.count_kind is None}
    if not scalars.issuperset(names):
        return None
    out = np.empty((vertex.count, len(names)), np.float32)
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite, as any other useless point
        for k, name in enumerate(names):
            out[:, k] = vertex.data.get(name, ())
    return out


def _colours(vertex: _Element) -> U8 | None:
    kinds = {p.name: p.kind for p in vertex.properties}
    for names in _COLOUR_NAMES:
        values = _columns(vertex, names)
        if values is None:
            continue
        kind = np.dtype(kinds[names[0]])
        full_scale = 1.0 if kind.kind == "f" else float(np.iinfo(kind).max)
        colours: U8 = np.clip(np.rint(values * (255.0 / full_scale)), 0, 255).astype(np.uint8)
        return colours
    return None


def _labels(vertex: _Element) -> U8 | None:
    values = _columns(vertex, ("label",))
    if values is None:
        return None
    if len(values) and not (values.min() >= 0 and values.max() <= np.iinfo(np.uint8).max):
        raise _MalformedError("it has labels outside 0..255")
    return values[:, 0].astype(np.uint8)


def _triangles(face: _Element, vertices: int) -> I32:
    """Fan of triangles per polygon, int32 (m, 3)."""
    name = next((n for n in _INDEX_NAMES if isinstance(face.data.get(n), tuple)), None)
    if name is None:
        if face.count == 0:
            return np.empty((0, 3), np.int32)
        raise _MalformedError("its faces have no list of vertex_indices")
    flat, lengths = face.data[name]
    if flat.dtype.kind == "f":
        raise _MalformedError("its faces name vertices by fractions")
    flat = flat.astype(np.int64)
    if len(flat) and not (flat.min() >= 0 and flat.max() < vertices):
        raise _MalformedError(f"a face names a vertex outside 0..{vertices - 1}")
    return _fans(flat, lengths).astype(np.int32)


def _fans(flat: I64, lengths: I64) -> I64:
    if (lengths == 3).all():
        return flat.reshape(-1, 3)
    first = np.cumsum(lengths) - lengths
    each = np.maximum(lengths - 2, 0)
    polygon = np.repeat(np.arange(len(lengths)), each)
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(each) - each, each)
    start = first[polygon]
    return np.stack([flat[start], flat[start + step + 1], flat[start + step + 2]], axis=1)
