"""PLY and GLB: what is written is read back, and foreign or broken files are handled."""

import contextlib
import errno
import json
import struct
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from artemis_edge.errors import InputError, RunError
from artemis_edge.export import ply
from artemis_edge.export.glb import write_glb
from artemis_edge.export.ply import Mesh, PointCloud, bare_mesh, read_ply, write_ply


def coloured_sphere() -> Mesh:
    sphere = trimesh.creation.icosphere(2)
    rng = np.random.default_rng(3)
    n = len(sphere.vertices)
    return bare_mesh(
        sphere.vertices,
        sphere.faces,
        colours=rng.integers(0, 256, (n, 3), dtype=np.uint8),
        labels=rng.integers(0, 4, n, dtype=np.uint8),
        confidence=rng.random(n, dtype=np.float32),
        label_names={0: "background", 3: "red car"},
    )


def assert_same(a: Mesh, b: Mesh) -> None:
    for name in ("vertices", "normals", "colours", "labels", "confidence", "faces"):
        left, right = getattr(a, name), getattr(b, name)
        assert left.dtype == right.dtype, name
        np.testing.assert_array_equal(left, right, err_msg=name)
    assert a.label_names == b.label_names


def test_ply_round_trip(tmp_path: Path) -> None:
    mesh = coloured_sphere()
    write_ply(tmp_path / "mesh.ply", mesh)
    back = read_ply(tmp_path / "mesh.ply")
    assert isinstance(back, Mesh)
    assert_same(mesh, back)


def test_ply_header_is_the_contract(tmp_path: Path) -> None:
    write_ply(tmp_path / "mesh.ply", coloured_sphere())
    header = (tmp_path / "mesh.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "comment label 3 red car" in header
    properties = [line.split()[1:] for line in header if line.startswith("property")]
    assert properties == [
        *(["float", n] for n in ("x", "y", "z", "nx", "ny", "nz")),
        *(["uchar", n] for n in ("red", "green", "blue", "label")),
        ["float", "confidence"],
        ["list", "uchar", "int", "vertex_indices"],
    ]


def test_ply_is_deterministic_and_opens_elsewhere(tmp_path: Path) -> None:
    mesh = coloured_sphere()
    write_ply(tmp_path / "a.ply", mesh)
    write_ply(tmp_path / "b.ply", mesh)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    other = trimesh.load(tmp_path / "a.ply", process=False)
    assert (len(other.vertices), len(other.faces)) == (len(mesh.vertices), len(mesh.faces))
    assert other.is_watertight
    np.testing.assert_array_equal(other.visual.vertex_colors[:, :3], mesh.colours)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_ply_of_another_writer(tmp_path: Path, encoding: str) -> None:
    sphere = trimesh.creation.icosphere(2)
    sphere.export(tmp_path / "m.ply", encoding=encoding)
    mesh = read_ply(tmp_path / "m.ply")
    assert isinstance(mesh, Mesh)
    np.testing.assert_allclose(mesh.vertices, sphere.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, sphere.faces)


def test_big_endian_doubles_in_another_order(tmp_path: Path) -> None:
    row = np.dtype(
        [("label", "u1"), ("z", ">f8"), ("y", ">f8"), ("x", ">f8"), ("r", ">f4"), ("g", ">f4"), ("b", ">f4")]
    )
    rows = np.zeros(5, row)
    rows["x"], rows["y"], rows["z"], rows["label"], rows["g"] = 1.5, np.arange(5), -3, 255, 1.0
    header = "ply\r\nformat binary_big_endian 1.0\r\nelement vertex 5\r\nproperty uchar label\r\n"
    header += "".join(f"property double {axis}\r\n" for axis in "zyx")
    header += "".join(f"property float {c}\r\n" for c in "rgb") + "comment label 2 big tree\r\nend_header\r\n"
    (tmp_path / "c.ply").write_bytes(header.encode() + rows.tobytes())
    cloud = read_ply(tmp_path / "c.ply")
    assert isinstance(cloud, PointCloud)
    np.testing.assert_array_equal(cloud.points, np.stack([np.full(5, 1.5), np.arange(5), np.full(5, -3)], 1))
    assert cloud.labels is not None and cloud.labels.tolist() == [255] * 5
    assert cloud.colours is not None and cloud.colours.tolist() == [[0, 255, 0]] * 5
    assert cloud.label_names == {2: "big tree"}


ONE_POINT = b"ply\nformat ascii 1.0\nelement vertex 1\n\
property float x\nproperty float y\nproperty float z\nend_header\n"
QUADS = "ply\nformat {format} 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n\
element face 2\nproperty list uchar int vertex_index\nend_header\n"


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_mixed_polygons_become_fans(tmp_path: Path, layout: str) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 2, 0]], np.float32)
    faces = ([0, 1, 2, 3], [3, 2, 4])
    if layout == "ascii":
        body = b"\n".join(b" ".join(b"%g" % v for v in p) for p in points.tolist())
        body += b"\n" + b"\n".join(b"%d " % len(f) + b" ".join(b"%d" % v for v in f) for f in faces)
    else:
        order = "<" if "little" in layout else ">"
        body = points.astype(order + "f4").tobytes()
        body += b"".join(bytes([len(f)]) + np.array(f, order + "i4").tobytes() for f in faces)
    (tmp_path / "q.ply").write_bytes(QUADS.format(format=layout).encode() + body)
    mesh = read_ply(tmp_path / "q.ply")
    assert isinstance(mesh, Mesh)
    np.testing.assert_array_equal(mesh.vertices, points)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [3, 2, 4]]
    np.testing.assert_array_equal(mesh.normals, np.tile(np.float32([0, 0, 1]), (5, 1)))


@pytest.mark.parametrize("keep", [2, 40, 300, -1])
def test_truncated_ply_says_so(tmp_path: Path, keep: int) -> None:
    write_ply(tmp_path / "m.ply", coloured_sphere())
    (tmp_path / "t.ply").write_bytes((tmp_path / "m.ply").read_bytes()[:keep])
    with pytest.raises(InputError, match=r"t\.ply is not a usable PLY file"):
        read_ply(tmp_path / "t.ply")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"solid not a ply",
        b"ply\nformat ascii 1.0\nelement vertex x\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
        ONE_POINT + b"1 a 2",
        QUADS.format(format="ascii").encode() + b"0 0 0 " * 5 + b"3 0 1 9 3 0 1 2",
    ],
)
def test_not_a_ply_says_so(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "t.ply").write_bytes(content)
    with pytest.raises(InputError, match=r"t\.ply is not a usable PLY file"):
        read_ply(tmp_path / "t.ply")


def test_missing_and_wrong_kind(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read"):
        read_ply(tmp_path / "absent.ply")
    mesh = coloured_sphere()
    write_ply(tmp_path / "empty.ply", bare_mesh(mesh.vertices[:0], mesh.faces[:0]))
    empty = read_ply(tmp_path / "empty.ply")
    assert isinstance(empty, Mesh) and len(empty.vertices) == 0
    (tmp_path / "cloud.ply").write_bytes(ONE_POINT + b"1 2 3")
    assert ply.read_points(tmp_path / "cloud.ply").points.tolist() == [[1, 2, 3]]
    with pytest.raises(InputError, match="no triangles"):
        ply.read_mesh(tmp_path / "cloud.ply")


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damaged_files_are_read_or_refused(data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "d.ply"
        write_ply(path, bare_mesh(np.eye(3), np.array([[0, 1, 2]], np.int32)))
        quads = QUADS.format(format="ascii").encode() + b"0 0 0 " * 5 + b"4 0 1 2 3 3 3 2 4"
        content = bytearray(data.draw(st.sampled_from([path.read_bytes(), quads])))
        for _ in range(data.draw(st.integers(1, 3))):
            start = data.draw(st.integers(0, len(content)))
            word = data.draw(
                st.sampled_from([b"-5", b"nan", b"inf", b"1e300", b"99999999999", b"list", b"float"])
            )
            content[start : start + data.draw(st.integers(0, 12))] = word
        path.write_bytes(content)
        with contextlib.suppress(InputError):
            assert isinstance(read_ply(path), Mesh | PointCloud)


def test_full_disk_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "m.ply"
    target.write_bytes(b"old")

    def full(*_: object) -> bytes:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(ply, "_face_rows", full)
    with pytest.raises(RunError, match="No space left on device"):
        write_ply(target, coloured_sphere())
    assert [p.name for p in tmp_path.iterdir()] == ["m.ply"]
    assert target.read_bytes() == b"old"


def read_chunks(path: Path) -> tuple[dict[str, Any], bytes]:
    content = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size, kind = struct.unpack_from("<I4s", content, 12)
    assert kind == b"JSON" and size % 4 == 0
    document = json.loads(content[20 : 20 + size])
    rest = content[20 + size :]
    if rest:
        assert struct.unpack_from("<I4s", rest) == (len(rest) - 8, b"BIN\0")
    return document, rest[8:]


def test_glb_opens_elsewhere_upright(tmp_path: Path) -> None:
    mesh = coloured_sphere()
    write_glb(tmp_path / "a.glb", mesh)
    write_glb(tmp_path / "b.glb", mesh)
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()
    (other,) = trimesh.load_scene(tmp_path / "a.glb", process=False).geometry.values()
    assert (len(other.vertices), len(other.faces)) == (len(mesh.vertices), len(mesh.faces))
    x, y, z = mesh.vertices.T
    np.testing.assert_array_equal(other.vertices.astype(np.float32), np.stack([x, z, -y], 1))
    assert other.is_watertight and other.volume > 0  # not turned inside out
    np.testing.assert_allclose(other.vertex_normals, other.vertices, atol=0.05)


def test_glb_colours_are_linear_and_accessors_true(tmp_path: Path) -> None:
    mesh = coloured_sphere()
    write_glb(tmp_path / "a.glb", mesh)
    document, binary = read_chunks(tmp_path / "a.glb")
    assert document["buffers"] == [{"byteLength": len(binary)}]
    arrays = []
    for accessor, view in zip(document["accessors"], document["bufferViews"], strict=True):
        dtype, width = (
            {5126: "<f4", 5125: "<u4", 5123: "<u2"}[accessor["componentType"]],
            accessor["type"][-1],
        )
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        arrays.append(
            np.frombuffer(part, dtype).reshape(accessor["count"], int(width) if width.isdigit() else 1)
        )
    positions, normals, colours, indices = arrays
    assert document["accessors"][0]["min"] == positions.min(axis=0).tolist()
    assert document["accessors"][0]["max"] == positions.max(axis=0).tolist()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    np.testing.assert_array_equal(indices.reshape(-1, 3), mesh.faces)
    assert document["accessors"][2]["normalized"] and (colours[:, 3] == 65535).all()
    linear = colours[:, :3] / 65535.0
    srgb = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_array_equal(np.rint(srgb * 255), mesh.colours)
    assert document["meshes"][0]["extras"]["label_names"] == {"0": "background", "3": "red car"}


def test_glb_of_nothing_and_of_nan(tmp_path: Path) -> None:
    mesh = coloured_sphere()
    write_glb(tmp_path / "e.glb", bare_mesh(mesh.vertices[:0], mesh.faces[:0]))
    document, binary = read_chunks(tmp_path / "e.glb")
    assert document["scenes"] == [{"nodes": []}] and binary == b"" and "meshes" not in document
    mesh.vertices[0, 0] = np.nan
    with pytest.raises(InputError, match="not finite"):
        write_glb(tmp_path / "n.glb", mesh)


def test_glb_normal_of_a_vertex_without_one_is_unit(tmp_path: Path) -> None:
    loose = bare_mesh(np.eye(4, 3), np.array([[0, 1, 2], [3, 3, 3]], np.int32))
    assert (loose.normals[3] == 0).all()
    write_glb(tmp_path / "l.glb", loose)
    document, binary = read_chunks(tmp_path / "l.glb")
    view = document["bufferViews"][1]
    normals = np.frombuffer(binary, "<f4", 12, view["byteOffset"]).reshape(4, 3)
    assert normals[3].tolist() == [0.0, 1.0, 0.0]
