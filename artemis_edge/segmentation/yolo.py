"""Decoding the tensors of the YOLO segmentation family (YOLOv8-seg, YOLO11-seg, FastSAM, YOLOE).

Two layouts. The ordinary export: rows of box centre, size, class probabilities, mask coefficients; [1, 4+C+M, N].
Raw heads: per stride box distributions, class logits, coefficients, [1, 64|C|M, h, w], where a box edge is the
mean of a distribution over 16 bins (distribution focal loss, Li et al. 2020). Both with prototypes [1, M, h, w],
whose linear combination by the coefficients is the logit of a mask (Bolya et al., YOLACT, 2019).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import F32, I64
from artemis_edge.segmentation.network import Array

STRIDES = (8, 16, 32)
MASKS = 32
_BINS = 16
_EDGES = 4
_SIDE = {"box": _EDGES * _BINS, "coef": MASKS}

Shapes = Mapping[str, tuple[int | None, ...]]


@dataclass(frozen=True, slots=True)
class Candidates:
    """Boxes worth a look: ``box`` float32 (n, 4) x0, y0, x1, y1 and ``coefficients`` (n, M), in the input's pixels.

    ``column`` int64 (n,) says which of the classes asked for, ``score`` float32 (n,) its probability.
    """

    box: F32
    score: F32
    column: I64
    coefficients: F32

    def take(self, rows: I64) -> Candidates:
        """Some of them."""
        return Candidates(self.box[rows], self.score[rows], self.column[rows], self.coefficients[rows])


def class_count(outputs: Shapes) -> int | None:
    """Number of classes of a network with such outputs: 0 where it is left open; None if it is none of the family."""
    if is_raw(outputs):
        sides = [outputs[f"cls{stride}"] for stride in STRIDES]
        fits = all(
            len(outputs[f"{what}{stride}"]) == 4 and outputs[f"{what}{stride}"][1] == channels
            for what, channels in _SIDE.items()
            for stride in STRIDES
        )
        return (sides[0][1] or 0) if fits and len({side[1] for side in sides}) == 1 else None
    ordinary = [shape for shape in outputs.values() if len(shape) == 3]
    protos = [shape for shape in outputs.values() if len(shape) == 4 and shape[1] == MASKS]
    if len(ordinary) != 1 or len(protos) != 1 or len(outputs) != 2:
        return None
    rows = ordinary[0][1]
    if rows is None:
        return 0
    return rows - _EDGES - MASKS if rows > _EDGES + MASKS else None


def check_classes(outputs: Mapping[str, Array], classes: int, name: str) -> None:
    """Raises InputError where tensors are not those of so many classes; a file may leave their shape open."""
    found = class_count({key: value.shape for key, value in outputs.items()})
    if found != classes:
        raise InputError(
            f"the model {name} gives tensors of {found if found is not None else 'no'} classes, {classes} are named; "
            "register it again with the names that it was trained with"
        )


def is_raw(outputs: Mapping[str, object]) -> bool:
    """Whether the outputs are raw heads, by name."""
    heads = {f"{what}{stride}" for what in ("box", "cls", "coef") for stride in STRIDES}
    return heads | {"proto"} <= set(outputs)


def candidates(outputs: Mapping[str, Array], columns: Sequence[int], least: float) -> tuple[Candidates, F32]:
    """Boxes whose probability of one of the classes ``columns`` is at least ``least``; and the prototypes (M, h, w)."""
    wanted = np.asarray(columns, np.int64)
    if is_raw(outputs):
        return _from_heads(outputs, wanted, least), np.asarray(outputs["proto"][0], np.float32)
    rows = next(value for value in outputs.values() if value.ndim == 3)[0]
    protos = next(value for value in outputs.values() if value.ndim == 4)[0]
    return _from_rows(np.asarray(rows, np.float32), wanted, least), np.asarray(protos, np.float32)


def _from_rows(rows: F32, wanted: I64, least: float) -> Candidates:
    scores = rows[_EDGES + wanted]
    column, anchor = np.nonzero(scores >= least)
    centre, half = rows[:2, anchor].T, rows[2:4, anchor].T / 2
    box = np.concatenate([centre - half, centre + half], axis=1)
    return Candidates(box, scores[column, anchor], column, rows[-MASKS:, anchor].T)


def _from_heads(outputs: Mapping[str, Array], wanted: I64, least: float) -> Candidates:
    parts = []
    for stride in STRIDES:
        _, high, wide = outputs[f"cls{stride}"][0].shape
        logits = outputs[f"cls{stride}"][0][wanted].reshape(len(wanted), high * wide)
        column, anchor = np.nonzero(logits >= _logit(least))
        edges = outputs[f"box{stride}"][0].reshape(_EDGES, _BINS, high * wide)[:, :, anchor]
        centre = np.stack([anchor % wide, anchor // wide], axis=1) + 0.5
        reach = _mean_bin(np.asarray(edges, np.float32))
        box = np.concatenate([centre - reach[:, :2], centre + reach[:, 2:]], axis=1) * stride
        score = sigmoid(logits[column, anchor])
        coefficients = outputs[f"coef{stride}"][0].reshape(MASKS, high * wide)[:, anchor].T
        parts.append((box, score, column, coefficients))
    box, score, column, coefficients = (np.concatenate(items) for items in zip(*parts, strict=True))
    f32 = np.float32
    return Candidates(box.astype(f32), score.astype(f32), column, coefficients.astype(f32))


def _mean_bin(edges: F32) -> F32:
    """Expected bin of distributions (4, 16, n) given as logits: left, top, right, bottom, float32 (n, 4)."""
    weight = np.exp(edges - edges.max(axis=1, keepdims=True, initial=-np.inf))
    bins = np.arange(_BINS, dtype=np.float32)[None, :, None]
    return np.asarray((weight * bins).sum(axis=1) / weight.sum(axis=1), np.float32).T


def sigmoid(x: Array) -> F32:
    """1 / (1 + exp(-x)) without overflow."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * x.astype(np.float32))), np.float32)


def _logit(probability: float) -> float:
    return float(np.log(probability / (1.0 - probability)))


def suppress(found: Candidates, overlap: float, most: int) -> Candidates:
    """Non-maximum suppression within each class, best first: at most ``most`` that overlap by less than ``overlap``.

    ``overlap`` is intersection over union.
    """
    if not len(found.score):
        return found
    # OpenCV wants corner and size; a threshold on scores was applied before
    corner_size = np.concatenate([found.box[:, :2], found.box[:, 2:] - found.box[:, :2]], axis=1)
    kept = cv2.dnn.NMSBoxesBatched(
        corner_size.tolist(), found.score.tolist(), found.column.tolist(), 0.0, overlap
    )
    rows = np.asarray(kept, np.int64).reshape(-1)
    best = rows[np.argsort(-found.score[rows], kind="stable")][:most]
    return found.take(best)


def crop_mask(protos: F32, coefficients: F32, box: F32) -> tuple[F32, int, int]:
    """Soft mask of one box, float32 (h, w), and the cell (x, y) of ``protos`` that it begins at.

    ``box`` is x0, y0, x1, y1 in cells of the prototypes (M, h, w), edges; cells that it covers in part count in part.
    """
    _, high, wide = protos.shape
    x0, x1 = (int(v) for v in np.clip([np.floor(box[0]), np.ceil(box[2])], 0, wide))
    y0, y1 = (int(v) for v in np.clip([np.floor(box[1]), np.ceil(box[3])], 0, high))
    part = protos[:, y0:y1, x0:x1]
    mask = sigmoid(np.tensordot(coefficients, part, axes=1))
    mask *= _covered(y0, y1, box[1], box[3])[:, None]
    mask *= _covered(x0, x1, box[0], box[2])[None, :]
    return mask, x0, y0


def _covered(start: int, stop: int, low: float, high: float) -> F32:
    """Share of each cell start <= k < stop that lies between ``low`` and ``high``."""
    cell = np.arange(start, stop, dtype=np.float32)
    return np.asarray(np.clip(np.minimum(cell + 1, high) - np.maximum(cell, low), 0.0, 1.0), np.float32)
