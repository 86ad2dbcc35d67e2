"""Textured exports: what is written is what other programs read, and it is the same twice."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from artemis_edge.cli import main
from artemis_edge.export.atlas import Atlas, empty_atlas, write_atlas
from artemis_edge.export.corners import shared_corners
from artemis_edge.export.glb import write_glb
from artemis_edge.export.mesh import Mesh
from artemis_edge.export.obj import write_obj
from artemis_edge.export.ply import write_ply
from tests.textured import square_room


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """The output directory of a textured map."""
    mesh, atlas = square_room()
    write_ply(tmp_path / "mesh.ply", mesh)
    (tmp_path / "map").mkdir()
    write_atlas(tmp_path / "map", atlas)
    return tmp_path


def naive_corners(faces: np.ndarray, uv: np.ndarray) -> set[tuple[float, ...]]:
    pairs = zip(faces.reshape(-1).tolist(), uv.reshape(-1, 2).tolist(), strict=True)
    return {(vertex, x, y) for vertex, (x, y) in pairs}


@pytest.mark.parametrize("count", [0, 1, 60])
def test_corners_are_shared_as_far_as_they_are_the_same(count: int) -> None:
    rng = np.random.default_rng(count)
    faces = rng.integers(0, 9, (count, 3)).astype(np.int32)
    uv = rng.integers(0, 3, (count, 3, 2)).astype(np.float32)
    vertex, place, corners = shared_corners(faces, uv)
    np.testing.assert_array_equal(vertex[corners], faces)
    np.testing.assert_array_equal(place[corners], uv)
    assert len(vertex) == len(naive_corners(faces, uv))


def colour_at(geometry: trimesh.Trimesh, face: int, weights: np.ndarray) -> np.ndarray:
    """Colour of a point of a face as the other program sees it: nearest texel."""
    place = weights @ geometry.visual.uv[geometry.faces[face]]
    image = np.asarray(geometry.visual.material.baseColorTexture.convert("RGB"))
    column, row = place[0] * image.shape[1] - 0.5, (1.0 - place[1]) * image.shape[0] - 0.5
    return image[round(row), round(column)]


def assert_looks_like(geometries: list[trimesh.Trimesh], mesh: Mesh, atlas: Atlas) -> None:
    """Every textured face is there once, and the middle of it has the colour of the atlas page."""
    found = 0
    for geometry in geometries:
        if geometry.visual.uv is None:
            continue
        for number, corners in enumerate(geometry.triangles):
            x, y, z = corners.mean(axis=0)
            middle = mesh.vertices[mesh.faces].mean(axis=1)
            face = int(np.argmin(np.linalg.norm(middle - [x, -z, y], axis=1)))
            weights = np.full(3, 1 / 3)
            column, row = np.rint(weights @ atlas.uv[face]).astype(int)
            expected = atlas.pages[atlas.page[face]][row, column].astype(int)
            assert np.abs(colour_at(geometry, number, weights) - expected).max() < 12
            found += 1
    assert found == int((atlas.page >= 0).sum())


def test_textured_glb_opens_elsewhere_with_its_texture(room: Path) -> None:
    pytest.importorskip("PIL")
    mesh, atlas = square_room()
    assert main(["export", str(room), "--format", "glb", "--out", str(room / "a.glb")]) == 0
    scene = trimesh.load_scene(room / "a.glb", process=False)
    geometries = list(scene.geometry.values())
    assert len(geometries) == 3 and sum(len(g.faces) for g in geometries) == len(mesh.faces)
    assert_looks_like(geometries, mesh, atlas)
    (floor,) = (g for g in geometries if g.visual.uv is None)
    assert len(floor.faces) == 2 and len(np.unique(floor.visual.vertex_attributes["color"], axis=0)) == 4


def test_glb_is_the_same_twice_and_plain_on_request(room: Path) -> None:
    mesh, atlas = square_room()
    write_glb(room / "a.glb", mesh, atlas)
    write_glb(room / "b.glb", mesh, atlas)
    assert (room / "a.glb").read_bytes() == (room / "b.glb").read_bytes()
    assert main(["export", str(room), "--format", "glb", "--no-textured", "--out", str(room / "c.glb")]) == 0
    write_glb(room / "d.glb", mesh, empty_atlas(len(mesh.faces)))
    write_glb(room / "e.glb", mesh)
    assert (room / "c.glb").read_bytes() == (room / "d.glb").read_bytes() == (room / "e.glb").read_bytes()
    assert (
        b"image/jpeg" in (room / "a.glb").read_bytes() and b"image/jpeg" not in (room / "c.glb").read_bytes()
    )
    assert not [path for path in room.iterdir() if path.name.startswith(".")]


def test_export_into_a_folder_is_refused(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(room), "--format", "glb", "--out", str(room)]) == 2
    assert "needs the name of a file" in capsys.readouterr().err


def test_obj_opens_elsewhere_with_its_texture(room: Path) -> None:
    pytest.importorskip("PIL")
    mesh, atlas = square_room()
    assert main(["export", str(room), "--format", "obj", "--out", str(room / "a.obj")]) == 0
    assert {p.name for p in room.glob("a*")} == {"a.obj", "a.mtl", "a_000.png", "a_001.png"}
    scene = trimesh.load_scene(room / "a.obj", process=False)
    geometries = list(scene.geometry.values())
    assert sum(len(g.faces) for g in geometries) == len(mesh.faces)
    found = 0
    for geometry in geometries:
        image = getattr(geometry.visual.material, "image", None)
        if image is None:
            continue
        for corners, face in zip(geometry.triangles, geometry.faces, strict=True):
            middle = mesh.vertices[mesh.faces].mean(axis=1)
            own = int(np.argmin(np.linalg.norm(middle - corners.mean(axis=0), axis=1)))
            x, y = geometry.visual.uv[face].mean(axis=0)
            pixels = np.asarray(image.convert("RGB"))
            seen = pixels[round((1 - y) * pixels.shape[0] - 0.5), round(x * pixels.shape[1] - 0.5)]
            column, row = np.rint(atlas.uv[own].mean(axis=0)).astype(int)
            assert np.abs(seen.astype(int) - atlas.pages[atlas.page[own]][row, column]).max() < 12
            found += 1
    assert found == 8


def test_obj_is_the_same_twice_and_plain_on_request(room: Path) -> None:
    mesh, atlas = square_room()
    (room / "x").mkdir()
    write_obj(room / "a.obj", mesh, atlas)
    write_obj(room / "x" / "a.obj", mesh, atlas)
    for name in ("a.obj", "a.mtl", "a_000.png"):
        assert (room / name).read_bytes() == (room / "x" / name).read_bytes()
    assert main(["export", str(room), "--format", "obj", "--no-textured", "--out", str(room / "p.obj")]) == 0
    assert [path.name for path in room.glob("p*")] == ["p.obj"]
    plain = trimesh.load(room / "p.obj", process=False, maintain_order=True)
    np.testing.assert_allclose(plain.vertices, mesh.vertices, atol=1e-4)
    np.testing.assert_array_equal(plain.faces, mesh.faces)
    np.testing.assert_array_equal(plain.visual.vertex_colors[:, :3], mesh.colours)
    assert main(["export", str(room), "--format", "obj", "--out", str(room / "a b.obj")]) == 2
