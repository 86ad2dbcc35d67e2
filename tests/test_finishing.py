"""What the finished mesh is made of: holes closed, whiskers trimmed, pieces told apart by edges."""

import math
from collections import Counter

import numpy as np
import pytest

from artemis_edge import finishing
from artemis_edge.frames import F32, F64, I32
from tests import naive

LONGEST_M = 0.45


def sheet(n: int) -> tuple[F32, F32, I32]:
    """A flat square of (n - 1)^2 pairs of triangles at 0.1 m, facing up."""
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    vertices = np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)]).astype(np.float32) * np.float32(0.1)
    normals = np.tile(np.array([0, 0, 1], np.float32), (n * n, 1))
    a = (x[:-1, :-1] * n + y[:-1, :-1]).ravel()
    faces = np.concatenate([np.stack([a, a + n, a + n + 1], 1), np.stack([a, a + n + 1, a + 1], 1)])
    return vertices, normals, faces.astype(np.int32)


def inner(faces: I32, n: int) -> I32:
    """Rows of faces whose corners are all away from the rim."""
    x, y = faces // n, faces % n
    return np.flatnonzero(((x > 0) & (x < n - 1) & (y > 0) & (y < n - 1)).all(axis=1)).astype(np.int32)


def covered_m2(vertices: F32, faces: I32) -> float:
    p, q, r = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    return float(np.cross(q - p, r - p)[:, 2].sum() / 2)


@pytest.mark.parametrize("seed", range(6))
def test_small_holes_are_closed_wherever_they_touch(seed: int) -> None:
    """Holes that meet in a vertex are walked around one by one."""
    n = 14
    vertices, normals, faces = sheet(n)
    rng = np.random.default_rng(seed)
    gone = rng.choice(inner(faces, n), 30, replace=False)
    holed = np.delete(faces, gone, axis=0)
    closed = finishing.close_loops(vertices, normals, holed, LONGEST_M)
    naive.assert_manifold(closed.astype(np.int64))
    missing = covered_m2(vertices, faces) - covered_m2(vertices, closed)
    assert -1e-6 < missing < 0.25 * 30 * 0.005, "three of four at least"
    again = finishing.close_loops(vertices, normals, closed, LONGEST_M)
    naive.assert_manifold(again.astype(np.int64))


def test_the_rim_of_the_sheet_and_wide_holes_stay_open() -> None:
    n = 12
    vertices, normals, faces = sheet(n)
    x, y = faces // n, faces % n
    wide = ((x >= 3) & (x <= 8) & (y >= 3) & (y <= 8)).all(axis=1)
    holed = faces[~wide]
    np.testing.assert_array_equal(finishing.close_loops(vertices, normals, holed, LONGEST_M), holed)


def test_free_edges_are_those_without_a_twin() -> None:
    _, _, faces = sheet(5)
    free = finishing.free_edges(faces)
    found = {
        (int(f[k]), int(f[(k + 1) % 3]))
        for f, row in zip(faces, free, strict=True)
        for k in range(3)
        if row[k]
    }
    assert found == set(naive.free_edges(faces.astype(np.int64)))
    assert finishing.free_edges(faces[:0]).shape == (0, 3)


def test_whiskers_are_trimmed() -> None:
    vertices, normals, faces = sheet(6)
    tip = np.array([[0.9, 0.2, 0]], np.float32)
    vertices, normals = np.concatenate([vertices, tip]), np.concatenate([normals, normals[:1]])
    whisker = np.array([[5 * 6 + 1, 36, 5 * 6 + 2]], np.int32)
    finished = finishing.finish(vertices, normals, np.concatenate([faces, whisker]), LONGEST_M, 1)
    assert not (finished == 36).any() and len(finished) >= len(faces) - 2


def test_pieces_that_share_only_a_corner_are_two() -> None:
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 5, 6], [5, 7, 6]], np.int32)
    assert finishing.large_islands(faces, 3).tolist() == [True, True, True, False, False]
    assert finishing.large_islands(faces, 2).all()
    assert finishing.large_islands(faces[:0], 4).shape == (0,)


def test_nothing_stays_nothing() -> None:
    vertices, normals, faces = sheet(2)
    assert len(finishing.finish(vertices, normals, faces[:0], LONGEST_M, 4)) == 0


Triangle = tuple[int, int, int]


class Twin:
    """``close_loops`` by dictionaries and lists: the free edges walked around, each loop cut up or mended."""

    def __init__(self, vertices: F32, normals: F32, faces: I32) -> None:
        self.p, self.g = vertices.astype(np.float64), normals.astype(np.float64)
        self.faces = [tuple(f) for f in faces.tolist()]
        self.owner = {edge: t for t, f in enumerate(self.faces) for edge in edges_of(f)}
        self.free = sorted((b, a) for a, b in self.owner if (b, a) not in self.owner)
        self.used: set[tuple[int, int]] = set()

    def angle_right(self, a: int, b: int, c: int) -> float:
        """Clockwise from b-a to b-c as seen from where the normal of b points to."""
        u, w, g = self.p[a] - self.p[b], self.p[c] - self.p[b], self.g[b]
        u, w = u - (u @ g) * g, w - (w @ g) * g
        turn = math.atan2(-triple(u, w, g), u @ w)
        return turn if turn > 0.0 else turn + 2.0 * math.pi

    def walk(self, seed: tuple[int, int]) -> list[tuple[int, int]]:
        path = [seed]
        while path[-1][1] != seed[0]:
            before, at = path[-1]
            if at in [start for start, _ in path] or len(path) == finishing.LONGEST_LOOP:
                return []
            ahead = [edge for edge in self.free if edge[0] == at and edge not in self.used]
            if not ahead:
                return []
            path.append(min(ahead, key=lambda edge: self.angle_right(before, at, edge[1])))
        return path if len(path) >= 3 else []

    def length(self, a: int, b: int) -> float:
        return float(np.linalg.norm(self.p[a] - self.p[b]))

    def faces_out(self, f: Triangle) -> bool:
        p, q, r = self.p[list(f)]
        return triple(q - p, r - p, self.g[list(f)].sum(axis=0)) > 0.0

    def cut(self, loop: list[int]) -> list[Triangle]:
        """Ears by the shortest diagonal that is no edge yet; empty when there is none or one faces back."""
        loop, parts = list(loop), []
        while len(loop) > 3:
            n = len(loop)
            ears = [(loop[k - 1], loop[k], loop[(k + 1) % n]) for k in range(n)]
            new = [f for f in ears if (f[0], f[2]) not in self.owner and (f[2], f[0]) not in self.owner]
            new = [f for f in new if self.length(f[0], f[2]) <= LONGEST_M]
            if not new:
                return []
            parts.append(min(new, key=lambda f: self.length(f[0], f[2])))
            loop.remove(parts[-1][1])
        parts.append((loop[0], loop[1], loop[2]))
        return parts if all(self.faces_out(f) for f in parts) else []

    def mend(self, path: list[tuple[int, int]]) -> tuple[list[Triangle], set[int]]:
        loop, n = [a for a, _ in path], len(path)
        beside = [self.owner[b, a] for a, b in path]
        apex = [(set(self.faces[t]) - set(edge)).pop() for t, edge in zip(beside, path, strict=True)]
        ways: list[tuple[float, list[Triangle], set[int]]] = []
        for k in (k for k in range(n) if apex[k] not in loop):
            after = (k + 1) % n
            trials = [([*loop[: k + 1], apex[k], *loop[k + 1 :]], {beside[k]})]
            if apex[after] == apex[k] and beside[after] != beside[k]:
                trials.append(
                    ([apex[k] if i == after else a for i, a in enumerate(loop)], {beside[k], beside[after]})
                )
            for trial, taken in trials:
                if parts := self.cut(trial):
                    ways.append((max(self.length(*e) for f in parts for e in edges_of(f)), parts, taken))
        return min(ways, key=lambda way: way[0])[1:] if ways else ([], set())

    def closed(self, klass: I32 | None) -> set[Triangle]:
        found: list[tuple[list[Triangle], set[int]]] = []
        for seed in self.free:
            if seed not in self.used:
                path = self.walk(seed)
                self.used.update(path)
                parts = self.cut([a for a, _ in path]) if path else []
                found.append((parts, set()) if parts or not path else self.mend(path))
        if klass is not None:
            found = [way for way in found if all(len({*klass[list(f)]} - {-1}) < 2 for f in way[0])]
        good, gone = [], set[int]()
        for parts, taken in found:
            if not taken & gone:
                good.append((parts, taken))
            gone |= taken
        while True:
            gone = {t for _, taken in good for t in taken}
            rest = [f for t, f in enumerate(self.faces) if t not in gone]
            all_faces = rest + [f for parts, _ in good for f in parts]
            often = Counter(edge for f in all_faces for edge in edges_of(f))
            stay = [way for way in good if all(often[e] == 1 for f in way[0] for e in edges_of(f))]
            if len(stay) == len(good):
                return {turned(f) for f in all_faces}
            good = stay


def triple(u: F64, v: F64, w: F64) -> float:
    """u x v . w; for single vectors numpy's cross product takes twenty times as long."""
    a, b, c = u.tolist()
    d, e, f = v.tolist()
    return float(np.dot((b * f - c * e, c * d - a * f, a * e - b * d), w))


def edges_of(f: Triangle) -> list[tuple[int, int]]:
    return [(f[0], f[1]), (f[1], f[2]), (f[2], f[0])]


def turned(f: Triangle) -> Triangle:
    """The same triangle from its lowest corner on."""
    k = f.index(min(f))
    return (f[k], f[(k + 1) % 3], f[(k + 2) % 3])


def tangled(seed: int, n: int = 10) -> tuple[F32, F32, I32]:
    """A wavy sheet with parts torn out and filled with whatever triangles fit edge by edge: holes and overlaps."""
    rng = np.random.default_rng(seed)
    vertices, normals, faces = sheet(n)
    vertices += rng.normal(0.0, 0.02, vertices.shape).astype(np.float32)
    normals += rng.normal(0.0, 0.1, normals.shape).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    gone = rng.choice(inner(faces, n), 40, replace=False)
    torn, kept = faces[gone], np.delete(faces, gone, axis=0)
    used = naive.directed_edges(kept.astype(np.int64))
    tries = rng.choice(np.unique(torn), (20_000, 3))
    p = vertices[tries]
    (ux, uy), (vx, vy) = (p[:, 1] - p[:, 0])[:, :2].T, (p[:, 2] - p[:, 0])[:, :2].T
    fits = (np.ptp(p, axis=1).max(axis=1) < 0.25) & (ux * vy - uy * vx > 0.001)
    extra: list[Triangle] = []
    for a, b, c in tries[fits].tolist():
        if not any(used[edge] for edge in edges_of((a, b, c))):
            used.update(edges_of((a, b, c)))
            extra.append((a, b, c))
    return vertices, normals, np.concatenate([kept, np.array(extra, np.int32)])


@pytest.mark.parametrize("seed", range(8))
def test_loops_are_closed_as_the_naive_twin_closes_them(seed: int) -> None:
    vertices, normals, faces = tangled(seed)
    klass = None if seed % 2 else np.random.default_rng(seed).integers(-1, 2, len(vertices)).astype(np.int32)
    closed = finishing.close_loops(vertices, normals, faces, LONGEST_M, klass)
    naive.assert_manifold(closed.astype(np.int64))
    assert {turned(tuple(f)) for f in closed.tolist()} == Twin(vertices, normals, faces).closed(klass)
    again = finishing.close_loops(vertices, normals, faces, LONGEST_M, klass)
    assert closed.tobytes() == again.tobytes()


@pytest.mark.parametrize("spare", [False, True])
def test_an_overlap_is_mended(spare: bool) -> None:
    """The surface below row y = 0.3 does not know the middle vertex of the row and reaches over it, with ``spare``
    by way of another vertex."""
    n = 7
    vertices, normals, faces = sheet(n)
    below, row = [n * x + 2 for x in (2, 3, 4)], [n * x + 3 for x in (2, 3, 4)]
    whole = covered_m2(vertices, faces)
    vertices = np.concatenate([vertices, np.array([[0.3, 0.33, 0.0]], np.float32)])
    normals = np.concatenate([normals, normals[:1]])
    vertices[row[1], 1] -= 0.02
    strip = np.isin(faces, below + row).all(axis=1)
    new = [(below[0], below[1], row[0]), (below[1], below[2], row[2])]
    if spare:
        new += [(below[1], row[2], n * n), (below[1], n * n, row[0])]
    else:
        new += [(below[1], row[2], row[0])]
    faces = np.concatenate([faces[~strip], np.array(new, np.int32)])
    closed = finishing.close_loops(vertices, normals, faces, LONGEST_M)
    naive.assert_manifold(closed.astype(np.int64))
    assert finishing.free_edges(closed).sum() == 4 * (n - 1), "nothing but the rim is open"
    assert covered_m2(vertices, closed) == pytest.approx(whole, abs=1e-6)
    assert not (closed == n * n).any()


def test_nothing_is_closed_between_two_classes() -> None:
    n = 7
    vertices, normals, faces = sheet(n)
    holed = np.delete(faces, inner(faces, n)[:1], axis=0)
    klass = np.full(n * n, -1, np.int32)
    assert len(finishing.close_loops(vertices, normals, holed, LONGEST_M, klass)) == len(faces)
    gone = faces[inner(faces, n)[0]]
    klass[gone[0]], klass[gone[1]] = 2, 5
    assert len(finishing.close_loops(vertices, normals, holed, LONGEST_M, klass)) == len(holed)


@pytest.mark.parametrize("value", [np.nan, 0.0])
def test_vertices_without_a_place_or_all_in_one_place_do_no_harm(value: float) -> None:
    n = 7
    vertices, normals, faces = sheet(n)
    holed = np.delete(faces, inner(faces, n)[:6], axis=0)
    closed = finishing.close_loops(np.full_like(vertices, value), normals, holed, LONGEST_M)
    np.testing.assert_array_equal(closed, holed)
