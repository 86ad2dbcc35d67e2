"""E_semantic on the finished mesh: joined vertices of one surface agree on their classes.

Eq. 3 penalises edges between vertices of unlike distributions. While the map grows, vertices give way to it by their
places (``semantic_constraint.py``); when it is finished, by their distributions: each vertex weighs what its own
images said against what its neighbours on the same surface are. What images get wrong of one vertex (its pixel
shows what lies behind a silhouette, a mask was of another class) they seldom get wrong of all its neighbours alike.

    lambda_i <- tau (lambda_i + k s_i log pi) + beta sum_j w_ij P_j,    w_ij = max(n_i . n_j, 0)^2 min(r / L_ij, 1)

pi are the shares of the classes in the map: where a few images contradict each other, it is more likely the wall
that most of the map is. s_i, 0..1, is how much images have told of the vertex: where they contradict each other, that
is much, and where none has said anything yet, its neighbours know better than the shares. Edges to another surface
(a crease, a border seen as one) weigh little or nothing.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.sparse import coo_array, csr_array

from artemis_edge.export.mesh import edges_of
from artemis_edge.frames import F32, I32, U8
from artemis_edge.refinement.semantics import FLOOR

# tau: of what images say so much counts. Views of a vertex resemble each other and err alike; eq. 12 takes them as
# independent
TEMPER = 0.25
# Exponent of pi: with 1, thin things whose images waver between them and what is behind them give way to that
PRIOR = 0.5
# What one image that is sure tells a class from another by, natural logarithm (eq. 12): from there on s_i is 1
ONE_IMAGE = -math.log(FLOOR)
# pi of a class that is nearly absent: no class is so rare that a handful of images could not find it
RAREST = 1e-3
# Rounds in which classes travel: one edge each
ROUNDS = 10


def agreed(
    lam: F32, active: U8, vertices: F32, normals: F32, faces: I32, spacing_m: float, weight: float
) -> F32:
    """Log-probabilities float32 (n, CLASSES), best 0, from those of the vertices' own images, ``lam``.

    Rows of zeros (no image saw the vertex) and columns of slots that are not ``active`` stay as they are.
    ``spacing_m`` is r, ``weight`` beta; 0 leaves everything as it is.
    """
    slots, known = np.flatnonzero(active), np.flatnonzero(lam.any(axis=1))
    out = lam.copy()
    if weight == 0.0 or len(known) == 0:
        return out
    own = _normal(lam[np.ix_(known, slots)])
    share = np.maximum(_softmax(own).mean(axis=0), np.float32(RAREST))
    told = np.minimum(own.min(axis=1, keepdims=True) / np.float32(-ONE_IMAGE), np.float32(1.0))
    own = np.float32(TEMPER) * (own + np.float32(PRIOR) * told * np.log(share))
    graph = np.float32(weight) * neighbours(vertices, normals, faces, known, spacing_m)
    now = own
    for _ in range(ROUNDS):
        now = own + graph @ _softmax(now)
    now = _normal(now)
    # all zeros would say that nobody has looked
    now[(now == 0.0).all(axis=1), 1:] = np.float32(-1e-6)
    out[np.ix_(known, slots)] = now
    return out


def neighbours(vertices: F32, normals: F32, faces: I32, known: np.ndarray, spacing_m: float) -> csr_array:
    """w_ij between the vertices ``known`` (k,), float32 (k, k)."""
    edges = edges_of(faces)
    row = np.full(len(vertices), -1, np.int32)
    row[known] = np.arange(len(known), dtype=np.int32)
    edges = edges[(row[edges] >= 0).all(axis=1)]
    i, j = edges[:, 0], edges[:, 1]
    along = np.maximum(np.einsum("ij,ij->i", normals[i], normals[j]), 0.0)
    length = np.linalg.norm(vertices[i] - vertices[j], axis=1)
    w = (along**2 * np.minimum(spacing_m / np.maximum(length, 1e-6), 1.0)).astype(np.float32)
    both = (np.concatenate((w, w)), (np.concatenate((row[i], row[j])), np.concatenate((row[j], row[i]))))
    return csr_array(coo_array(both, shape=(len(known), len(known))))


def _normal(lam: F32) -> F32:
    best: F32 = lam - lam.max(axis=1, keepdims=True)
    return best


def _softmax(lam: F32) -> F32:
    weight: F32 = np.exp(_normal(lam))
    weight /= weight.sum(axis=1, keepdims=True)
    return weight
