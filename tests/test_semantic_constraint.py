"""Eqs 2 to 8 against slow twins: a sweep of Gauss-Seidel, the slide towards where two objects meet, the whole stage."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial.distance import jensenshannon

from artemis_edge import block_store as bs
from artemis_edge.block_store import CLASSES, LOG_CLASS, NORMAL, ROUGHNESS, WEIGHT
from artemis_edge.class_rows import CLEAR_LOG
from artemis_edge.config import SemanticsConfig
from artemis_edge.frames import F64
from artemis_edge.semantic_constraint import CONFIDENT_XI, COPLANAR, ONE_SURFACE, SemanticConstraint

CELL_M, SIGMA_M = 0.1, 0.02
ACTIVE = np.array([1, 1, 1] + [0] * 13, np.uint8)
Cell = tuple[int, int, int]


class Patch:
    """A random surface of two voxels beside each other, and where its cells are."""

    def __init__(self, seed: int, objects: bool) -> None:
        rng = np.random.default_rng(seed)
        self.store = bs.allocate(1.0, LOG_CLASS + CLASSES)
        block = bs.find_or_add_block(self.store, 0, 0, 0)
        self.slot: dict[Cell, int] = {}
        self.voxels = []
        for k in range(2):
            v = int(bs.add_voxel(self.store, block, bs.inner_index(k, 0, 0), k, 0, 0))
            self.voxels.append(v)
            self.store.voxel_class[v, WEIGHT] = 3.0
            for x in range(4):
                for y in range(4):
                    self._vertex(rng, v, (4 * k + x, y, int(rng.integers(1, 3))), objects)

    def _vertex(self, rng: np.random.Generator, v: int, cell: Cell, objects: bool) -> None:
        x, y, z = cell[0] & 3, cell[1], cell[2]
        s = int(bs.add_cell(self.store, v, (x << 4) | (y << 2) | z))
        self.slot[cell] = s
        self.store.state[s] = bs.ALIVE if rng.random() < 0.9 else bs.EVIDENCE_ONLY
        place = (np.array(cell) + 0.5) * CELL_M
        place[2] = 0.2
        self.store.vertex[s, :3] = place + rng.normal(0, 0.015, 3)
        normal = rng.normal([0, 0, 1], 0.25)
        self.store.vertex[s, NORMAL : NORMAL + 3] = normal / np.linalg.norm(normal)
        self.store.vertex[s, ROUGHNESS] = rng.uniform(0, 0.04)
        lam = -rng.random(CLASSES) * 3.0
        if objects:
            lam[:] = -9.0
            lam[1 if cell[1] < 2 else 2] = 0.0
        self.store.attribute[s, LOG_CLASS:] = lam - lam.max()

    def living(self, cell: Cell) -> int:
        """Slot of the living vertex of a cell, -1 where there is none."""
        s = self.slot.get(cell, -1)
        return s if s >= 0 and self.store.state[s] == bs.ALIVE else -1

    def own(self) -> Iterator[tuple[Cell, int]]:
        """Living cells in the order in which voxels and cells are taken."""
        for k in range(2):
            for cell in sorted(c for c in self.slot if c[0] // 4 == k):
                if self.living(cell) >= 0:
                    yield cell, self.slot[cell]

    def around(self, cell: Cell) -> Iterator[int]:
        """Living neighbours."""
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                for dz in (-1, 0, 1):
                    s = self.living((cell[0] + dx, cell[1] + dy, cell[2] + dz))
                    if s >= 0 and (dx, dy, dz) != (0, 0, 0):
                        yield s

    def P(self, s: int) -> F64:
        """Class distribution of a vertex."""
        lam = np.where(ACTIVE > 0, self.store.attribute[s, LOG_CLASS:].astype(float), -np.inf)
        weight = np.exp(lam - lam.max())
        return np.asarray(weight / weight.sum())


def similarity(patch: Patch, config: SemanticsConfig, i: int, j: int) -> float:
    if not config.sim_semantic:
        return 1.0
    P, Q = patch.P(i), patch.P(j)
    if P.argmax() == Q.argmax() and min(P.max(), Q.max()) > 0.99:
        return 1.0
    xi = 1.0 - math.exp(-config.confidence_rate * 3.0)
    return math.exp(-config.temperature * math.sqrt(max(xi * xi * jensenshannon(P, Q) ** 2, 0.0)))


def naive_sweeps(patch: Patch, config: SemanticsConfig) -> F64:
    """Vertices (cells, 8) after the sweeps, from the same start."""
    vertex = patch.store.vertex.astype(np.float64)
    start = vertex.copy()
    for _ in range(config.sweeps):
        for cell, i in patch.own():
            n, a = start[i, 3:6], start[i, :3]
            trust = SIGMA_M**2 / (SIGMA_M**2 + start[i, ROUGHNESS] ** 2)
            mean = np.asarray(trust * n)
            top, bottom = 0.0, 0.0
            for j in patch.around(cell):
                g, e = vertex[j, 3:6], a - vertex[j, :3]
                if vertex[i, 3:6] @ g < ONE_SURFACE:
                    continue
                geo = CELL_M / max(float(np.linalg.norm(e)), 0.1 * CELL_M)
                w = config.lambda_smooth * similarity(patch, config, i, j) * geo
                mean = mean + w * g
                top += float(w * (e @ g) * (n @ g))
                bottom += float(w * (n @ g) ** 2)
            vertex[i, 3:6] = mean / np.linalg.norm(mean)
            if bottom > 0.0:
                vertex[i, :3] = a + np.clip(-top / (trust + bottom), -SIGMA_M, SIGMA_M) * n
    return vertex


def naive_slide(patch: Patch, config: SemanticsConfig, vertex: F64) -> F64:
    """The tangential motion of eq. 6's weights on top of the sweeps."""
    xi = 1.0 - math.exp(-config.confidence_rate * 3.0)
    klass = {}
    for cell, s in patch.own():
        lam = np.sort(patch.store.attribute[s, LOG_CLASS:])
        clear = lam[-1] - lam[-2] >= CLEAR_LOG and xi >= CONFIDENT_XI
        klass[cell] = int(patch.store.attribute[s, LOG_CLASS:].argmax()) if clear else -1
    of = {patch.slot[cell]: k for cell, k in klass.items()}
    for cell, i in patch.own():
        n, way, total = vertex[i, 3:6].copy(), np.zeros(3), 0.0
        for j in patch.around(cell):
            if of[i] < 0 or of[j] < 0 or of[j] == of[i]:
                continue
            e, g = vertex[j, :3] - vertex[i, :3], vertex[j, 3:6]
            t = e - (e @ n) * n
            beside = abs(n @ g) > COPLANAR or abs(t @ g) < 1e-9
            share = 0.5 if beside else float(np.clip((e @ g) / (t @ g), 0.0, 1.0))
            w = config.lambda_sem * xi * xi * CELL_M / float(np.linalg.norm(t))
            way, total = way + w * share * t, total + w
        if total > 0.0:
            way = way / total
            vertex[i, :3] += min(1.0, 0.5 * CELL_M / float(np.linalg.norm(way))) * way
    return vertex


def settled(patch: Patch, config: SemanticsConfig) -> None:
    constraint = SemanticConstraint(config, patch.store, CELL_M, SIGMA_M, ACTIVE)
    constraint.settle(np.array(patch.voxels, np.int32), 1)


@pytest.mark.parametrize("sim", [True, False])
def test_sweeps_are_those_of_eqs_2_4_5_and_8(sim: bool) -> None:
    config = SemanticsConfig(lambda_sem=0.0, lambda_smooth=0.7, sim_semantic=sim)
    patch = Patch(3, objects=False)
    expected = naive_sweeps(patch, config)
    before = patch.store.vertex.copy()
    settled(patch, config)
    rows = [s for _, s in patch.own()]
    np.testing.assert_allclose(patch.store.vertex[rows, :6], expected[rows, :6], atol=2e-5)
    assert np.abs(patch.store.vertex[rows, :3] - before[rows, :3]).max() > 1e-3, "something has moved"
    dead = [s for s in patch.slot.values() if s not in rows]
    assert (patch.store.vertex[dead] == before[dead]).all()


def test_vertices_slide_to_where_two_objects_meet() -> None:
    config = SemanticsConfig(lambda_smooth=0.0, sweeps=1)
    patch = Patch(4, objects=True)
    expected = naive_slide(patch, config, naive_sweeps(patch, config))
    before = patch.store.vertex.copy()
    settled(patch, config)
    rows = [s for _, s in patch.own()]
    np.testing.assert_allclose(patch.store.vertex[rows, :6], expected[rows, :6], atol=2e-5)
    moved = np.linalg.norm(patch.store.vertex[rows, :3] - before[rows, :3], axis=1)
    border = [cell[1] in (1, 2) for cell, _ in patch.own()]
    assert moved[~np.array(border)].max() < 1e-6 and moved[np.array(border)].max() > 0.01
    assert moved.max() <= 0.5 * CELL_M + 1e-6


def test_without_classes_or_vertices_nothing_slides_or_breaks() -> None:
    patch = Patch(5, objects=True)
    patch.store.voxel_class[patch.voxels, WEIGHT] = 0.0
    before = patch.store.vertex.copy()
    settled(patch, SemanticsConfig(lambda_smooth=0.0, sweeps=1))
    np.testing.assert_allclose(patch.store.vertex[:, :3], before[:, :3], atol=1e-7)
    patch.store.state[:] = bs.EVIDENCE_ONLY
    settled(patch, SemanticsConfig())
    constraint = SemanticConstraint(SemanticsConfig(), patch.store, CELL_M, SIGMA_M, ACTIVE)
    constraint.settle(np.empty(0, np.int32), 1)
