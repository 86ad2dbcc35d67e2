"""Worlds from files: labels in node names, textures, transforms, walks, and mistakes told in one sentence."""

from __future__ import annotations

import base64
import json
import re
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from artemis_drivers.virtual.catalogue import build_world
from artemis_drivers.virtual.loaded import label_of, load
from artemis_drivers.virtual.mesh_builder import CLASS_NAMES
from artemis_drivers.virtual.model import read_model
from artemis_drivers.virtual.textures import SIZE


def room() -> trimesh.Scene:
    """Floor of 12 x 10 m, a bench, two parts of one car, and something of a class that we do not know.

    y is up in glTF: a box's z becomes -y of our world.
    """
    scene = trimesh.Scene()
    floor = trimesh.creation.box((12.0, 0.2, 10.0))
    floor.apply_translation((0, -0.1, 0))
    scene.add_geometry(floor, node_name="ground_1")
    lift = np.eye(4)
    lift[:3, 3] = 1.0, 0.25, 2.0
    scene.add_geometry(trimesh.creation.box((2.0, 0.5, 0.5)), node_name="bench_2", transform=lift)
    for k in range(2):
        T = np.eye(4)
        T[:3, 3] = -3.0, 0.5 + k, 0.0
        scene.add_geometry(
            trimesh.creation.box((1, 1, 1)), node_name="Car.007" if k else "car_7", transform=T
        )
    scene.add_geometry(trimesh.creation.box((0.3, 4, 0.3)), node_name="obelisk", transform=lift)
    return scene


@pytest.fixture
def glb(tmp_path: Path) -> Path:
    path = tmp_path / "room.glb"
    path.write_bytes(room().export(file_type="glb"))
    return path


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("bench_2", ("bench", 2)),
        ("bench.002", ("bench", 2)),
        ("Bench-2", ("bench", 2)),
        ("bench2", ("bench", 2)),
        ("bench", ("bench", None)),
        ("Garden Gnome 12", ("garden_gnome", 12)),
        ("", ("", None)),
        ("42", ("", 42)),
    ],
)
def test_labels_in_names(name: str, label: tuple[str, int | None]) -> None:
    assert label_of(name) == label


def test_a_glb_becomes_a_world(glb: Path) -> None:
    world = load(glb, seed=3, length=60.0)
    mesh = world.mesh()
    assert world.class_names[: len(CLASS_NAMES)] == CLASS_NAMES
    assert world.class_names[len(CLASS_NAMES) :] == ("obelisk",)
    assert len(mesh.triangles) == 5 * 12

    def part(name: str) -> np.ndarray:  # type: ignore[type-arg]
        return mesh.class_id == world.class_names.index(name)

    bench = mesh.corners()[part("bench")].reshape(-1, 3)
    # y up becomes z up: (1, 0.25, 2) -> (1, -2, 0.25)
    np.testing.assert_allclose(bench.min(axis=0), [0.0, -2.25, 0.0], atol=1e-6)
    np.testing.assert_allclose(bench.max(axis=0), [2.0, -1.75, 0.5], atol=1e-6)
    assert len(np.unique(mesh.instance[part("car")])) == 1  # car_7 and Car.007 are one
    assert len(np.unique(mesh.instance)) == 4
    corners = mesh.corners()[part("ground")].astype(np.float64)
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(24.0)


def test_a_walk_is_found_on_free_ground(glb: Path) -> None:
    world = load(glb, length=60.0)
    steps = np.linalg.norm(np.diff(world.path, axis=0), axis=1)
    assert steps.sum() >= 60 and steps.max() < 0.5
    np.testing.assert_allclose(world.path[:, 2], 1.45, atol=0.01)
    assert np.abs(world.path[:, 0]).max() < 5.7 and np.abs(world.path[:, 1]).max() < 4.7
    inside_car = (np.abs(world.path[:, 0] + 3.0) < 0.8) & (np.abs(world.path[:, 1]) < 0.8)
    assert not inside_car.any()


def textured(tmp_path: Path, change: dict[str, object] | None = None) -> Path:
    """GLB written by hand: one square of 2 m named ground_1 with a picture whose left half is red."""
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:, :32], picture[:, 32:] = (0, 0, 255), (255, 0, 0)  # BGR
    _, png = cv2.imencode(".png", picture)
    points = np.array([[-5, 0, 5], [5, 0, 5], [5, 0, -5], [-5, 0, -5]], "<f4")
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4")  # v down
    index = np.array([0, 1, 2, 0, 2, 3], "<u2")
    blobs = [points.tobytes(), uv.tobytes(), index.tobytes(), png.tobytes()]
    blobs = [b + bytes(-len(b) % 4) for b in blobs]
    first = np.cumsum([0, *(len(b) for b in blobs)])
    tree: dict[str, object] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"name": "set", "children": [1, 2, 3]},
            {"name": "ground_1", "mesh": 0},
            {"name": "path_1", "translation": [-3, 1.5, 0]},
            {"name": "path_2", "translation": [3, 1.5, 1]},
        ],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(first[k]), "byteLength": len(blobs[k])} for k in range(4)
        ],
        "buffers": [{"byteLength": int(first[-1])}],
        "materials": [{"name": "tiles", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        **(change or {}),
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(blobs)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    path = tmp_path / "textured.glb"
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


def test_textures_lie_where_the_file_puts_them(tmp_path: Path) -> None:
    world = load(textured(tmp_path), length=5.0)
    mesh, arrays = world.mesh(), world.atlas.arrays
    material = int(mesh.material[0])
    start = arrays.start[material, 0]
    picture = arrays.texels[start : start + SIZE * SIZE].reshape(SIZE, SIZE)
    corners = mesh.corners().reshape(-1, 3)
    for point, uv in zip(corners, mesh.uv.reshape(-1, 2), strict=True):
        column = int(np.clip(uv[0] * SIZE, 1, SIZE - 2))
        row = int(np.clip((1 - uv[1]) * SIZE, 1, SIZE - 2))
        red, blue = picture[row, column] & 255, picture[row, column] >> 16
        assert (red > 200) == (point[0] < 0) and (blue > 200) == (point[0] > 0)
        assert uv[1] == pytest.approx(0.0 if point[1] < 0 else 1.0)  # v up, y of ours = -z of glTF
    np.testing.assert_allclose(world.path[0], [-3, 0, 1.5], atol=0.2)
    area, normal = mesh.areas_and_normals()
    assert (normal[:, 2] > 0.99).all() and area.sum() == pytest.approx(100.0)


def test_an_open_path_must_be_long_enough_a_closed_one_is_walked_in_laps(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is 6 m long and the walk needs 40 m"):
        load(textured(tmp_path), length=40.0)
    places = [(-3, 1.5, -3), (3, 1.5, -3), (3, 1.5, 3), (-3, 1.5, 3), (-3, 1.5, -2.8)]
    nodes = [{"name": f"path_{k}", "translation": place} for k, place in enumerate(places, 1)]
    change = {"nodes": [{"name": "ground", "mesh": 0}, *nodes], "scenes": [{"nodes": [0, 1, 2, 3, 4, 5]}]}
    path = load(textured(tmp_path, change), length=60.0).path
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() >= 60.0
    assert np.abs(path[:, :2]).max() < 3.1


def test_a_path_through_a_wall_is_refused(tmp_path: Path) -> None:
    scene = room()
    for k, x in enumerate((-4.5, 4.5), 1):
        place = np.eye(4)
        place[:3, 3] = x, 0.5, 0.0
        scene.graph.update(frame_to=f"path_{k}", matrix=place)
    path = tmp_path / "room.glb"
    path.write_bytes(scene.export(file_type="glb"))
    with pytest.raises(ValueError, match=r"runs into something of class car at x -3\.\d, y 0\.0, z 0\.5 m"):
        load(path, length=5.0)


def test_an_obj_with_material_becomes_a_world(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "wood.png"), np.full((1024, 300, 3), 120, np.uint8))
    (tmp_path / "m.mtl").write_text(
        "newmtl wood\nKd 1 1 1\nmap_Kd wood.png\nnewmtl clear\nKd .2 .5 1\nd 0.3\n"
    )
    (tmp_path / "yard.obj").write_text(
        "# a yard\nmtllib m.mtl\nv -6 -6 0\nv 6 -6 0\nv 6 6 0\nv -6 6 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "o ground\nusemtl wood\nf 1/1 2/2 3/3 4/4\n"
        "v 0 0 0\nv 1 0 0\nv 1 0 1\no window_4\nusemtl clear\nf -3 -2 -1\n"
        "o window_5\nf 5 5 6\n"
    )
    world = build_world(str(tmp_path / "yard.obj"), 0, 30.0)
    mesh = world.mesh()
    assert len(mesh.triangles) == 3
    assert world.notes == (
        "texture 'wood' of 300 x 1024 pixels is scaled down to 512 x 512",
        "1 triangles without area were left out",
    )
    clear = mesh.class_id == world.class_names.index("window")
    assert world.atlas.arrays.glass[mesh.material].tolist() == clear.tolist()
    assert mesh.tint[clear][0].tolist() == [51, 128, 255]
    assert mesh.uv[:2].max() == 1.0


def test_equal_files_give_equal_worlds(glb: Path) -> None:
    one, two = load(glb, 1, 50.0), load(glb, 1, 50.0)
    assert one.mesh().vertices.tobytes() == two.mesh().vertices.tobytes()
    assert one.path.tobytes() == two.path.tobytes()


def test_double_sided_materials_are_seen_from_both_sides(tmp_path: Path) -> None:
    material = {"pbrMetallicRoughness": {"baseColorFactor": [0.25, 1, 1, 0.5]}, "doubleSided": True}
    material["alphaMode"] = "BLEND"
    world = load(textured(tmp_path, {"materials": [material]}), length=5.0)
    mesh = world.mesh()
    assert sorted(np.rint(mesh.areas_and_normals()[1][:, 2]).tolist()) == [-1, -1, 1, 1]
    assert world.atlas.arrays.glass[mesh.material].all()
    assert mesh.tint[0].tolist() == [128, 255, 255]


def test_external_buffers_of_gltf(tmp_path: Path) -> None:
    points = np.array([[-9, 0, 9], [9, 0, 9], [0, 0, -9]], "<f4").tobytes()
    tree = {
        "asset": {"version": "2.0"},
        "nodes": [{"name": "ground", "mesh": 0, "scale": [-1, 1, 1]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"uri": "data:;base64," + base64.b64encode(points).decode(), "byteLength": 36}],
    }
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(tree))
    # a mirrored node keeps its front
    assert load(path).mesh().areas_and_normals()[1][0, 2] == pytest.approx(1.0)
    tree["buffers"] = [{"uri": "gone.bin", "byteLength": 36}]
    path.write_text(json.dumps(tree))
    with pytest.raises(ValueError, match=r"gone\.bin, which is not beside it"):
        read_model(path)


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.stl", b"solid", "give a .glb, .gltf or .obj"),
        ("a.glb", b"PK\x03\x04 not a model at all", "no GLB file"),
        ("a.glb", b"glTF\x01\0\0\0\x14\0\0\0" + bytes(8), "not glTF 2.0"),
        (
            "a.glb",
            struct.pack("<4sII", b"glTF", 2, 24) + struct.pack("<I4s", 4, b"JSON") + b"{{{{",
            "is damaged",
        ),
        ("a.gltf", b'{"scenes": [{"nodes": [5]}], "nodes": []}', "is damaged"),
        ("a.gltf", b'{"scenes": [{"nodes": [0]}], "nodes": [{"children": [0]}]}', "nodes within themselves"),
        ("a.gltf", b'{"extensionsRequired": ["KHR_draco_mesh_compression"]}', "KHR_draco_mesh_compression"),
        ("a.gltf", b'{"nodes": []}', "has no triangles"),
        ("a.obj", b"v 0 0 0\nf 1 2 3\n", "a vertex that is not there"),
        ("a.obj", b"v 0 0 zero\n", "is damaged"),
        ("a.obj", b"mtllib gone.mtl\n", "gone.mtl, which is not beside it"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\no thing\nf 1 2 3\n", "add nodes path_1"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\no ground\nf 1 2 3\n", "no free ground"),
        ("a.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\no ground\nf 1 2 3\n", "not numbers"),
    ],
)
def test_mistakes_are_told_in_one_sentence(tmp_path: Path, name: str, content: bytes, told: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(told)) as error:
        load(path)
    assert "\n" not in str(error.value)


def test_missing_files_and_unknown_worlds(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="there is no file"):
        build_world(str(tmp_path / "gone.glb"), 0, 10.0)
    with pytest.raises(ValueError, match="no virtual world named 'moon'; there are: street, courtyard, hall"):
        build_world("moon", 0, 10.0)
