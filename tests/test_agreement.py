"""Vertices of one surface agree on their classes: against a slow twin, and what it is for."""

from __future__ import annotations

import math

import numpy as np

from artemis_edge.block_store import CLASSES
from artemis_edge.frames import F32, I32, U8
from artemis_edge.refinement.agreement import ONE_IMAGE, PRIOR, RAREST, ROUNDS, TEMPER, agreed

SPACING_M = 0.1
ACTIVE = np.array([1, 1, 1] + [0] * 13, np.uint8)


def sheet(columns: int, rows: int = 6) -> tuple[F32, F32, I32]:
    """A flat grid of vertices with its triangles."""
    x, y = np.meshgrid(np.arange(columns) * SPACING_M, np.arange(rows) * SPACING_M)
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1).astype(np.float32)
    faces = []
    for r in range(rows - 1):
        for c in range(columns - 1):
            k = r * columns + c
            faces += [[k, k + 1, k + columns], [k + 1, k + columns + 1, k + columns]]
    return vertices, np.tile(np.array([0, 0, 1], np.float32), (x.size, 1)), np.array(faces, np.int32)


def naive(lam: F32, active: U8, vertices: F32, normals: F32, faces: I32, beta: float) -> np.ndarray:
    slots = [c for c in range(CLASSES) if active[c]]
    known = [i for i in range(len(lam)) if lam[i].any()]
    edges = {(min(t[a], t[b]), max(t[a], t[b])) for t in faces.tolist() for a, b in ((0, 1), (1, 2), (2, 0))}

    def softmax(row: list[float]) -> list[float]:
        weight = [math.exp(v - max(row)) for v in row]
        return [w / sum(weight) for w in weight]

    own = {i: [float(lam[i, c]) for c in slots] for i in known}
    share = np.mean([softmax(own[i]) for i in known], axis=0)
    told_of = {i: min((max(own[i]) - min(own[i])) / ONE_IMAGE, 1.0) for i in own}
    own = {
        i: [
            TEMPER * (v + PRIOR * told_of[i] * math.log(max(p, RAREST)))
            for v, p in zip(own[i], share, strict=True)
        ]
        for i in own
    }
    told = dict(own)
    for _ in range(ROUNDS):
        said = {i: softmax(told[i]) for i in known}
        new = {i: list(own[i]) for i in known}
        for i, j in edges:
            if i in own and j in own:
                along = max(float(normals[i] @ normals[j]), 0.0)
                w = along**2 * min(SPACING_M / float(np.linalg.norm(vertices[i] - vertices[j])), 1.0)
                for k in range(len(slots)):
                    new[i][k] += beta * w * said[j][k]
                    new[j][k] += beta * w * said[i][k]
        told = new
    out = np.array(lam, np.float64)
    for i in known:
        out[i, slots] = np.array(told[i]) - max(told[i])
    return out


def test_agreement_is_its_formula() -> None:
    rng = np.random.default_rng(1)
    vertices, normals, faces = sheet(5, 4)
    vertices += rng.normal(0, 0.02, vertices.shape).astype(np.float32)
    turned = rng.normal([0, 0, 2], 0.7, normals.shape)
    normals = (turned / np.linalg.norm(turned, axis=1, keepdims=True)).astype(np.float32)
    lam = np.zeros((len(vertices), CLASSES), np.float32)
    lam[:, 1:] = -rng.random((len(vertices), CLASSES - 1)) * 8
    lam[[3, 11]] = 0.0
    found = agreed(lam, ACTIVE, vertices, normals, faces, SPACING_M, 2.0)
    np.testing.assert_allclose(found, naive(lam, ACTIVE, vertices, normals, faces, 2.0), atol=2e-3)
    assert not found[[3, 11]].any(), "what no image saw stays unknown"
    again = agreed(lam, ACTIVE, vertices, normals, faces, SPACING_M, 2.0)
    assert found.tobytes() == again.tobytes()


def test_a_stray_vertex_gives_way_and_a_crease_is_a_border() -> None:
    vertices, normals, faces = sheet(12)
    normals[vertices[:, 0] > 0.55] = (1.0, 0.0, 0.0)  # the right half is another surface
    lam = np.full((len(vertices), CLASSES), -6.0, np.float32)
    right = vertices[:, 0] > 0.55
    lam[np.arange(len(lam)), np.where(right, 2, 1)] = 0.0
    stray = int(np.flatnonzero(~right)[14])
    lam[stray] = -6.0
    lam[stray, 2] = 0.0
    label = agreed(lam, ACTIVE, vertices, normals, faces, SPACING_M, 3.0)[:, :3].argmax(axis=1)
    assert (label == np.where(right, 2, 1)).all()


def test_shares_settle_contradictions_and_not_what_nobody_has_told() -> None:
    vertices, normals, _ = sheet(10)
    lam = np.full((len(vertices), CLASSES), -20.0, np.float32)
    left = vertices[:, 0] < 0.15  # few are of class 1, most of class 2
    lam[np.arange(len(lam)), np.where(left, 1, 2)] = 0.0
    alone = np.zeros((0, 3), np.int32)
    doubtful, silent = 5, 7
    for vertex, depth in ((doubtful, -20.0), (silent, -0.4)):
        lam[vertex] = depth
        lam[vertex, 1:3] = 0.0, -0.3
    label = agreed(lam, ACTIVE, vertices, normals, alone, SPACING_M, 3.0)[:, :3].argmax(axis=1)
    assert label[doubtful] == 2 and label[silent] == 1


def test_nothing_to_agree_on_changes_nothing() -> None:
    vertices, normals, faces = sheet(3, 2)
    lam = np.zeros((6, CLASSES), np.float32)
    assert (agreed(lam, ACTIVE, vertices, normals, faces, SPACING_M, 3.0) == lam).all()
    lam[:, 1:] = -1.0
    assert (agreed(lam, ACTIVE, vertices, normals, faces, SPACING_M, 0.0) == lam).all()
    lonely = agreed(lam[:1], ACTIVE, vertices[:1], normals[:1], np.empty((0, 3), np.int32), SPACING_M, 3.0)
    assert lonely[0, :3].argmax() == 0 and lonely[0].any()
    none = np.empty((0, 3), np.float32)
    assert len(agreed(lam[:0], ACTIVE, none, none, np.empty((0, 3), np.int32), SPACING_M, 3.0)) == 0
