"""Mesh against reference: sampling, thinning, scores and topology, each against a slow obvious way."""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import trimesh

from artemis_edge.errors import InputError
from artemis_edge.evaluate import mesh as evaluation
from artemis_edge.evaluate.mesh import evaluate_mesh
from artemis_edge.evaluate.sampling import samples, thin, triangle_areas
from artemis_edge.evaluate.topology import topology
from artemis_edge.export.ply import Mesh, bare_mesh, write_ply

GENERATOR = 5


def plane(nx: int = 8, ny: int = 8, size: float = 1.0) -> Mesh:
    """Square [0, size]^2 at z = 0, of nx * ny * 2 triangles facing up."""
    x, y = np.meshgrid(np.linspace(0, size, nx + 1), np.linspace(0, size, ny + 1), indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"))
    a, b, c, d = (
        i * (ny + 1) + j,
        (i + 1) * (ny + 1) + j,
        (i + 1) * (ny + 1) + j + 1,
        i * (ny + 1) + j + 1,
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return bare_mesh(vertices, faces.astype(np.int32))


def grid_cloud(x: float, y: float, z: float, step: float = 0.02) -> np.ndarray:
    """Cloud of the rectangle [0, x] x [0, y] at height z."""
    u, v = np.meshgrid(np.arange(0, x + 1e-9, step), np.arange(0, y + 1e-9, step))
    return np.stack([u.ravel(), v.ravel(), np.full(u.size, z)], axis=1).astype(np.float32)


def naive_thin(points: np.ndarray, voxel: float) -> np.ndarray:
    cells: dict[tuple[int, ...], list[np.ndarray]] = {}
    for p in points.astype(np.float64):
        cells.setdefault(tuple(int(np.floor(c / voxel)) for c in p), []).append(p)
    return np.array([np.mean(cells[key], axis=0) for key in sorted(cells)])


def naive_distances(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.array([np.sqrt(((others - p) ** 2).sum(axis=1)).min() for p in points])


def naive_edges(faces: np.ndarray) -> Counter[int]:
    edges = Counter(frozenset((f[k], f[(k + 1) % 3])) for f in faces.tolist() for k in range(3))
    return Counter(edges.values())


def test_samples_lie_in_their_triangles_evenly_by_area() -> None:
    mesh = bare_mesh(
        np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 5], [0.5, 0, 5], [0, 0.5, 5]]),
        np.array([[0, 1, 2], [3, 4, 5]], np.int32),
    )
    points = np.concatenate(list(samples(mesh.vertices, mesh.faces, 10_000)))
    area = triangle_areas(mesh.vertices, mesh.faces)
    np.testing.assert_allclose(area, [2.0, 0.125])
    assert len(points) == int(np.ceil(area.sum() * 10_000))
    low = points[points[:, 2] < 1]
    assert abs(len(low) - 20_000) <= 1
    assert (points[:, :2] >= 0).all() and (low[:, 0] + low[:, 1] <= 2 + 1e-6).all()
    # every tenth-by-tenth patch wholly inside holds its 100 samples to within the evenness of the sequence
    count, *_ = np.histogram2d(low[:, 0], low[:, 1], bins=10, range=[[0, 1], [0, 1]])
    assert count.min() > 90 and count.max() < 110


def test_sampling_chunks_and_repeats_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = plane()
    whole = np.concatenate(list(samples(mesh.vertices, mesh.faces, 5000)))
    monkeypatch.setattr("artemis_edge.evaluate.sampling._SAMPLES_AT_ONCE", 77)
    parts = list(samples(mesh.vertices, mesh.faces, 5000))
    assert len(parts) > 10
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    np.testing.assert_allclose(thin(iter(parts), 0.05), thin(iter([whole]), 0.05), rtol=0, atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 1000])
def test_thin_is_the_mean_per_voxel(count: int) -> None:
    points = np.random.default_rng(GENERATOR).normal(0, 1, (count, 3)).astype(np.float32)
    np.testing.assert_allclose(thin(iter([points]), 0.3), naive_thin(points, 0.3), atol=1e-12)


def test_thin_of_nothing_and_of_the_far_away() -> None:
    assert thin(iter([]), 0.05).shape == (0, 3)
    assert thin(iter([np.empty((0, 3), np.float32)]), 0.05).shape == (0, 3)
    with pytest.raises(InputError, match="from the origin"):
        thin(iter([np.array([[5e6, 0, 0]], np.float32)]), 0.05)


def test_scores_equal_brute_force() -> None:
    rng = np.random.default_rng(GENERATOR)
    mesh = plane()
    reference = rng.uniform([0, 0, -0.15], [1.2, 0.8, 0.15], (900, 3)).astype(np.float32)
    (result,) = evaluate_mesh(mesh, reference, [0.1]).comparisons
    on_mesh = naive_thin(np.concatenate(list(samples(mesh.vertices, mesh.faces, 1000))), 0.05)
    cloud = naive_thin(reference, 0.05)
    forth, back = naive_distances(on_mesh, cloud), naive_distances(cloud, on_mesh)
    assert result.precision == np.mean(forth <= 0.1)
    assert result.recall == np.mean(back <= 0.1)
    assert 0.2 < result.recall < 0.9
    assert result.f1 == pytest.approx(2 / (1 / np.mean(forth <= 0.1) + 1 / np.mean(back <= 0.1)))
    assert result.accuracy_m == pytest.approx(forth.mean()) and result.completeness_m == pytest.approx(
        back.mean()
    )


def test_known_shift_and_half_coverage() -> None:
    # mesh is the unit square; the reference its left half, 6 cm above: precision 0.5 + the strip tau reaches
    result = evaluate_mesh(plane(), grid_cloud(0.5, 1.0, 0.06), [0.1, 0.05])
    wide, narrow = result.comparisons
    reach = np.sqrt(0.1**2 - 0.06**2)
    assert wide.recall == 1.0 and wide.precision == pytest.approx(0.5 + reach, abs=0.03)
    assert (narrow.precision, narrow.recall, narrow.f1) == (0.0, 0.0, 0.0)
    assert wide.completeness_m == pytest.approx(0.06, abs=0.005)
    shown = result.to_json()
    assert set(shown["thresholds"]) == {"0.1", "0.05"}
    assert shown["completeness_cm"] == pytest.approx(6.0, abs=0.5)
    assert shown["chamfer_cm"] == pytest.approx((shown["accuracy_cm"] + shown["completeness_cm"]) / 2)


def test_crop_cuts_the_mesh_to_the_reference() -> None:
    reference = grid_cloud(0.5, 1.0, 0.0)
    assert evaluate_mesh(plane(), reference, [0.1]).comparisons[0].precision < 0.65
    assert evaluate_mesh(plane(), reference, [0.1], crop=True).comparisons[0].precision > 0.99
    one_big = bare_mesh(plane(1, 1, 40.0).vertices - 20, plane(1, 1).faces)
    one_big.vertices[:, 2] = 0
    cropped = evaluate_mesh(one_big, reference, [0.1], crop=True).comparisons[0]
    # the margin of tau around the box lies within tau of the cloud but for its corners
    assert 0.9 < cropped.precision < 1.0 and cropped.recall == 1.0
    assert cropped.mesh_points[:, 0].min() >= -0.1 and cropped.mesh_points[:, 0].max() <= 0.6 + 1e-6


def test_not_finite_is_counted() -> None:
    mesh = plane(2, 2)
    mesh.vertices[0] = np.nan
    reference = np.concatenate([grid_cloud(1, 1, 0), np.full((7, 3), np.inf, np.float32)])
    result = evaluate_mesh(mesh, reference)
    assert result.skipped == {"reference_points": 7, "triangles": 2}
    assert result.area_m2 == pytest.approx(0.75)


@pytest.mark.parametrize("thresholds", [[], [0.0], [-1.0], [float("nan")], [1e300], [1e-9], [0.1, 101.0]])
def test_bad_threshold(thresholds: list[float]) -> None:
    with pytest.raises(InputError, match="threshold"):
        evaluate_mesh(plane(), grid_cloud(1, 1, 0), thresholds)


@pytest.mark.parametrize("tau", [0.001, 100.0])
def test_thresholds_at_their_limits(tau: float) -> None:
    mesh = plane(1, 1, 0.05)
    found = evaluate_mesh(mesh, grid_cloud(0.05, 0.05, 0.0, 0.01), [tau])
    assert found.comparisons[0].recall == 1.0


def huge_triangle(at: float) -> Mesh:
    """A good square beside a triangle of 100 km."""
    good, far = plane(), np.array([[at, 0, 0], [at + 1e5, 0, 0], [at, 1e5, 0]], np.float32)
    faces = np.concatenate([good.faces, np.arange(3, dtype=np.int32)[None] + len(good.vertices)])
    return bare_mesh(np.concatenate([good.vertices, far]), faces)


def test_a_huge_triangle_is_cropped_before_it_is_sampled() -> None:
    cloud = grid_cloud(1.0, 1.0, 0.0)
    assert evaluate_mesh(huge_triangle(50.0), cloud, [0.1], crop=True).comparisons[0].f1 == 1.0
    for at, crop in ((50.0, False), (0.5, True)):
        with pytest.raises(InputError, match=r"5e\+09 m2 of mesh need 5e\+12 samples, more than 1e\+09"):
            evaluate_mesh(huge_triangle(at), cloud, [0.1], crop=crop)


def test_vertices_beyond_any_scene() -> None:
    astray = bare_mesh(np.float32([[0, 0, 0], [1e30, 0, 0], [0, 1e30, 0]]), np.int32([[0, 1, 2]]))
    with pytest.raises(InputError, match="samples"):
        evaluate_mesh(astray, grid_cloud(1, 1, 0), [0.1])
    with pytest.raises(InputError, match="shift both clouds"):
        evaluate_mesh(plane(), np.float32([[0, 0, 0], [1e30, 0, 0]]), [0.1])


def test_nothing_to_compare() -> None:
    with pytest.raises(InputError, match="reference cloud has no points"):
        evaluate_mesh(plane(), np.empty((0, 3), np.float32))
    with pytest.raises(InputError, match="same frame"):
        evaluate_mesh(plane(), grid_cloud(1, 1, 90), crop=True)


def test_topology_of_closed_open_and_broken() -> None:
    sphere = trimesh.creation.icosphere(2)
    closed = topology(sphere.vertices.astype(np.float32), sphere.faces.astype(np.int32))
    assert (closed.non_manifold_share, closed.boundary_share, closed.orientation_share) == (0.0, 0.0, 1.0)
    mesh = plane(3, 5)
    counts = naive_edges(mesh.faces)
    opened = topology(mesh.vertices, mesh.faces)
    assert opened.edges == sum(counts.values())
    assert opened.boundary_share == counts[1] / sum(counts.values()) == 16 / opened.edges
    fin = np.concatenate([mesh.faces, mesh.faces[:4]])  # 4 triangles twice: their edges have 3 or 4
    counts = naive_edges(fin)
    broken = topology(mesh.vertices, fin)
    assert broken.non_manifold_share == (counts[3] + counts[4]) / sum(counts.values()) > 0


def test_topology_sees_flipped_copied_and_degenerate() -> None:
    mesh = plane(1, 1)
    flipped = mesh.faces.copy()
    flipped[1] = flipped[1, ::-1]
    assert topology(mesh.vertices, flipped).orientation_share == 0.0
    soup = mesh.vertices[mesh.faces.ravel()]  # every triangle its own copies of the vertices
    copied = topology(soup * np.float32([1, 1, -1]), np.arange(6, dtype=np.int32).reshape(2, 3))
    assert copied.edges == 5 and copied.orientation_share == 1.0
    more = np.concatenate([mesh.faces, [[0, 0, 1]]]).astype(np.int32)
    assert topology(mesh.vertices, more).degenerate_triangles == 1
    nothing = topology(mesh.vertices[:0], mesh.faces[:0])
    assert (nothing.edges, nothing.boundary_share, nothing.orientation_share) == (0, 0.0, 1.0)


def test_command_prints_the_contract(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "m.ply", plane())
    trimesh.PointCloud(grid_cloud(1, 1, 0)).export(tmp_path / "ref.ply")
    arguments = [str(tmp_path / "m.ply"), "--reference", str(tmp_path / "ref.ply")]
    assert evaluation.main([*arguments, "--json", "--crop"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["thresholds"]["0.1"] == {"precision": 1.0, "recall": 1.0, "f1": 1.0}
    assert {"chamfer_cm", "accuracy_cm", "completeness_cm", "vertices", "triangles", "area_m2"} <= set(shown)
    assert shown["edges"]["non_manifold_share"] == 0.0
    assert shown["area_m2"] == pytest.approx(1.0)
    assert evaluation.main(arguments) == 0
    assert "F1 1.0000" in capsys.readouterr().out
    assert evaluation.main([str(tmp_path / "absent.ply"), *arguments[1:]]) == 2
    assert capsys.readouterr().err.count("\n") == 1
