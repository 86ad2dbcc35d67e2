"""Slow, obvious twins of the map's kernels, and the small worlds that its tests share."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from artemis_edge import paging
from artemis_edge.config import Config, MesherConfig, VoxelMapConfig
from artemis_edge.export.mesh import Mesh, bare_mesh
from artemis_edge.frames import F32, F64, I64, DeskewedScan, LidarScan, SyncedFrame, TrackedFrame
from artemis_edge.mesher import Mesher
from artemis_edge.paging import PageFile, Pager
from artemis_edge.pipeline import BASE_MB, Pipeline
from artemis_edge.voxel_map import VoxelMap

Cell = tuple[int, int, int]


def accumulate(
    points: F32, T: F64, origin: F64, cell_m: float, least_m: float, most_m: float, noise_m: float
) -> dict[Cell, F64]:
    """Sums of ``insert_points`` by cell: count, sum (3), squares (6), view (3), about the cell's centre."""
    cells: dict[Cell, F64] = defaultdict(lambda: np.zeros(13))
    for p in points.astype(np.float64):
        distance = float(np.linalg.norm(p - origin))
        if not (np.isfinite(p).all() and least_m <= distance <= most_m):
            continue
        world = T[:3, :3] @ p + T[:3, 3]
        cell = np.floor(world / cell_m)
        d = world - (cell + 0.5) * cell_m
        w = 1.0 / (1.0 + (distance / noise_m) ** 2)
        view = T[:3, :3] @ (origin - p) / max(distance, 1e-6)
        square = np.outer(d, d)[np.triu_indices(3)]
        x, y, z = cell.astype(int).tolist()
        cells[x, y, z] += w * np.concatenate(([1.0], d, square, view))
    return dict(cells)


def sum_around(cells: dict[Cell, F64], at: Cell) -> F64:
    """Sum of the rows of the 27 cells around ``at``."""
    total = np.zeros(13)
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            for dz in (-1, 0, 1):
                total += cells.get((at[0] + dx, at[1] + dy, at[2] + dz), np.zeros(13))
    return total


def pixel(direction: F64, pixels: int) -> tuple[int, int, int]:
    """Cube face (+x, -x, +y, -y, +z, -z), row and column of a direction: equal parts of the face's edge."""
    axis = int(np.argmax(np.abs(direction)))
    others = [k for k in range(3) if k != axis]
    face = 2 * axis + (0 if direction[axis] > 0 else 1)
    column, row = ((direction[k] / abs(direction[axis]) + 1.0) / 2.0 * pixels for k in others)
    return face, min(math.floor(row), pixels - 1), min(math.floor(column), pixels - 1)


def nearest_ranges(points: F32, origin: F64, pixels: int) -> dict[tuple[int, int, int], float]:
    """Smallest range by pixel."""
    out: dict[tuple[int, int, int], float] = {}
    for p in points.astype(np.float64) - origin:
        if np.isfinite(p).all() and p.any():
            at = pixel(p, pixels)
            out[at] = min(out.get(at, math.inf), float(np.linalg.norm(p)))
    return out


def directed_edges(triangles: I64) -> Counter[tuple[int, int]]:
    """How often each directed edge is used."""
    return Counter((int(t[k]), int(t[(k + 1) % 3])) for t in triangles for k in range(3))


def assert_manifold(triangles: I64) -> None:
    """No directed edge twice: at most two triangles an edge, turning alike; no vertex twice in a triangle."""
    again = {edge: n for edge, n in directed_edges(triangles).items() if n > 1}
    assert not again, f"{len(again)} directed edges used more than once"
    assert all(len(set(t)) == 3 for t in triangles.tolist())


def assert_no_doubles(triangles: I64) -> None:
    """No two triangles of the same three vertices: neither copies nor back to back."""
    assert len(np.unique(np.sort(triangles, axis=1), axis=0)) == len(triangles)


def free_edges(triangles: I64) -> list[tuple[int, int]]:
    """Directed edges that no triangle uses the other way round."""
    edges = directed_edges(triangles)
    return [edge for edge in edges if (edge[1], edge[0]) not in edges]


def all_triangles(pager: Pager) -> I64:
    """Vertex names of all triangles of a map, (t, 3)."""
    parts = [page.triangle_ids() for page in pager.pages()]
    return np.concatenate(parts) if parts else np.empty((0, 3), np.int64)


def living_vertices(pager: Pager) -> dict[int, F32]:
    """Position by name of every living vertex of a map."""
    out: dict[int, F32] = {}
    for page in pager.pages():
        alive = page.alive()
        out.update(zip(page.vertex_ids()[alive].tolist(), page.vertex[alive, :3], strict=True))
    return out


def raw_mesh(pager: Pager) -> Mesh:
    """All triangles as they are in the patches, nothing closed, trimmed or left out."""
    living = living_vertices(pager)
    row = {name: k for k, name in enumerate(living)}
    faces = [[row[name] for name in t] for t in all_triangles(pager).tolist()]
    vertices = np.array(list(living.values()), np.float32).reshape(-1, 3)
    return bare_mesh(vertices, np.array(faces, np.int32).reshape(-1, 3))


def area(mesh: Mesh) -> float:
    """Sum of the triangles' areas [m2]."""
    p, q, r = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return float(np.linalg.norm(np.cross(q - p, r - p), axis=1).sum() / 2)


def face_normals(mesh: Mesh) -> F64:
    """Unit normals of the triangles (t, 3)."""
    p, q, r = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    n = np.cross(q - p, r - p)
    return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-15)


def frame_of(points: F64, sensor: Iterable[float] = (0.0, 0.0, 0.0), index: int = 0) -> TrackedFrame:
    """A frame of world points (n, 3) seen from ``sensor``; the lidar's axes are those of the world."""
    T = np.eye(4)
    T[:3, 3] = list(sensor)
    local = (np.asarray(points, np.float64).reshape(-1, 3) - T[:3, 3]).astype(np.float32)
    return TrackedFrame(index, index * 100_000_000, T, (DeskewedScan(local, np.zeros(3)),))


class SmallMapper:
    """A map of the smallest memory with its mesher and pager, fed with world points."""

    def __init__(
        self,
        folder: Path,
        voxel_map: VoxelMapConfig | None = None,
        mesher: MesherConfig | None = None,
        budget_bytes: float = 20e6,
    ) -> None:
        self.voxel_map = VoxelMap(voxel_map or VoxelMapConfig(), budget_bytes)
        self.store = self.voxel_map.store
        self.pager = Pager(self.store, folder)
        self.mesher = Mesher(mesher or MesherConfig(), self.voxel_map, self.pager.prepare)
        self.stamp = 0

    def add(self, points: F64, sensor: Iterable[float] = (0.0, 0.0, 0.0)) -> None:
        """One frame."""
        self.stamp += 1
        active = self.voxel_map.insert(frame_of(points, sensor, self.stamp), self.stamp)
        self.mesher.update(active, self.stamp)

    def finish(self) -> Mesh:
        """Mesh what waits; the mesh of the patches as they are."""
        self.mesher.flush(self.stamp)
        return raw_mesh(self.pager)


def rectangle(
    rng: np.random.Generator,
    corner: Iterable[float],
    u: Iterable[float],
    v: Iterable[float],
    per_m2: float,
    sigma: float,
) -> F64:
    """Random points (n, 3) on the parallelogram ``corner + a u + b v`` with Gaussian noise across it."""
    c, u, v = (np.array(list(x), np.float64) for x in (corner, u, v))
    normal = np.cross(u, v)
    size = float(np.linalg.norm(normal))
    n = int(size * per_m2)
    ab = rng.uniform(size=(n, 2))
    return c + ab[:, :1] * u + ab[:, 1:] * v + rng.normal(0.0, sigma, (n, 1)) * normal / size


class KnownPoses:
    """Odometry that is told the sensor's place in each frame; nothing to correct."""

    def __init__(self, places: list[tuple[float, float, float]]) -> None:
        self.places = places

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        T = np.eye(4)
        T[:3, 3] = self.places[frame.index]
        scans = tuple(DeskewedScan(scan.points, np.zeros(3)) for scan in frame.scans)
        return TrackedFrame(frame.index, frame.stamp_ns, T, scans)


def corridor(
    places: list[tuple[float, float, float]], points: int = 1500, reach_m: float = 4.0
) -> list[SyncedFrame]:
    """One scan at each place of a corridor along x: two walls, floor and ceiling, 2.1 m wide and high."""
    frames = []
    for index, place in enumerate(places):
        rng = np.random.default_rng(index)
        x = place[0]
        p = rng.uniform((x - reach_m, -1.05, -0.95), (x + reach_m, 1.05, 1.15), (points, 3))
        side = np.arange(points) % 4
        p[side == 0, 1], p[side == 1, 1], p[side == 2, 2], p[side == 3, 2] = -1.05, 1.05, -0.95, 1.15
        p += rng.normal(0.0, 0.005, p.shape)
        scan = LidarScan((p - place).astype(np.float32), index * 100_000_000)
        frames.append(SyncedFrame(index, index * 100_000_000, (scan,)))
    return frames


@contextmanager
def closing_page_files() -> Iterator[None]:
    """Closes the files of all pagers made meanwhile: a pipeline does so only when it saves its map."""
    made: list[PageFile] = []

    class Listed(PageFile):
        def __init__(self, folder: Path) -> None:
            super().__init__(folder)
            made.append(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paging, "PageFile", Listed)
        yield
    for file in made:
        file.close()


def walk(length_m: float, step_m: float) -> list[tuple[float, float, float]]:
    """Places along x, there and back."""
    there = [(float(x), 0.0, 0.0) for x in np.arange(0.0, length_m, step_m)]
    return [*there, *reversed(there)]


def small_pipeline(
    folder: Path, places: list[tuple[float, float, float]], budget_mb: int = 0, **mesher: int
) -> Pipeline:
    """A pipeline with ``budget_mb`` of map memory (0: the smallest there is)."""
    config = Config(
        voxel_map=VoxelMapConfig(memory_budget_mb=BASE_MB + budget_mb), mesher=MesherConfig(**mesher)
    )
    return Pipeline(config, KnownPoses(places), folder)
