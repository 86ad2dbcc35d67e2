"""A picture of the growing mesh, small enough for a terminal: vertices as splats, seen from behind or from above.

In a terminal a pixel is a decimetre or more, and vertices lie that close; triangles would show nothing further.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from msgspec.structs import replace

from artemis_edge.frames import F32, F64, I64, U8, MeshDelta
from artemis_edge.lights import lit
from artemis_edge.status import QueryStatus

Kind = Literal["behind", "above"]

MOST_VERTICES = 400_000  # drawn at a time: 25 ms of numpy
SKY = (12, 14, 20)
_GREY = 180
_DIM = 0.45  # what is not asked for steps back while something is highlighted
_TILT = np.deg2rad(35.0)  # how steeply one looks down from behind
_BEHIND_M = 9.0
_PIECE_M = 0.5  # vertices of a class this near to each other are one thing
_LEAST_PIECE = 20  # fewer are a stray mask
_AGAIN_S = 1.0
_HALF_RANGE = 1 << 19  # cells: 262 km
_LARGEST = 6  # pixels of a vertex that is near
_OVERLAP = 1.5  # of a vertex over its spacing, which is uneven
_FOV = 1.1  # focal length over half the width: 85 degrees across


@dataclass(frozen=True, slots=True)
class _Block:
    position: F32
    colour: U8
    label: U8


class MapCopy:
    """The newest vertices of every block that was told; ``version`` counts how often there was news."""

    def __init__(self) -> None:
        self.version = 0
        self._blocks: dict[tuple[int, int, int], _Block] = {}
        self._merged: _Block | None = None
        self._vertices = 0

    def apply(self, delta: MeshDelta) -> None:
        """Take over the blocks of a delta."""
        position, label = delta.position.copy(), delta.label.copy()
        shaded, ends = _shaded(delta.colour, delta.normal), delta.vertex_start.tolist()
        for k, block in enumerate(delta.block.tolist()):
            rows, place = slice(ends[k], ends[k + 1]), tuple(block)
            if (before := self._blocks.get(place)) is not None:
                self._vertices -= len(before.label)
            self._blocks[place] = _Block(position[rows], shaded[rows], label[rows])
            self._vertices += ends[k + 1] - ends[k]
        self._merged = None
        self.version += 1

    def __len__(self) -> int:
        return self._vertices

    def points(self) -> tuple[F32, U8, U8]:
        """Positions (n, 3), colours (n, 3) and labels (n,), thinned evenly to ``MOST_VERTICES``."""
        if self._merged is None:
            blocks = list(self._blocks.values()) or [_Block(*_nothing())]
            step = max(1, -(-len(self) // MOST_VERTICES))
            self._merged = _Block(
                np.concatenate([b.position[::step] for b in blocks]),
                np.concatenate([b.colour[::step] for b in blocks]),
                np.concatenate([b.label[::step] for b in blocks]),
            )
        return self._merged.position, self._merged.colour, self._merged.label


def _nothing() -> tuple[F32, U8, U8]:
    return np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8), np.empty(0, np.uint8)


def _shaded(colour: U8, normal: F32) -> U8:
    """Colours no camera has seen are shaded by direction and told apart: floors greenish, walls bluish."""
    grey = (colour == _GREY).all(axis=1)
    if not grey.any():
        return colour.copy()
    out = colour.copy()
    up = np.abs(normal[grey, 2])[:, None]
    light = 0.55 + 0.45 * np.abs(normal[grey] @ np.array([0.5, 0.3, 0.81], np.float32))[:, None]
    wall, floor = np.array([150, 165, 190], np.float32), np.array([140, 170, 130], np.float32)
    out[grey] = (light * (wall * (1.0 - up) + floor * up)).astype(np.uint8)
    return out


def found_in(copy: MapCopy, query: QueryStatus) -> QueryStatus:
    """A question that tells labels only, with the pieces that the map shows of them: count and places."""
    if not query.labels or query.places:
        return query
    points, _, label = copy.points()
    rows = points[np.isin(label, query.labels)]
    places = _places(rows)
    status = query.status if places else "searching"
    return replace(query, count=len(places), places=places, status=status)


class Finder:
    """``found_in`` for the questions of a page; where only the map has changed not more than once a second."""

    def __init__(self, copy: MapCopy, clock: Callable[[], float] = time.monotonic) -> None:
        self._copy, self._clock = copy, clock
        self._known: dict[str, tuple[list[int], int, float, QueryStatus]] = {}

    def __call__(self, query: QueryStatus) -> QueryStatus:
        """The question with its pieces, as they were a second ago at the oldest."""
        if not query.labels or query.places:
            return query
        version, now = self._copy.version, self._clock()
        labels, seen, at_s, found = self._known.get(query.text, ([], -1, 0.0, query))
        if labels != query.labels or (seen != version and now - at_s >= _AGAIN_S):
            found = found_in(self._copy, query)
            self._known[query.text] = (query.labels, version, now, found)
        status = query.status if found.places else "searching"
        return replace(query, count=found.count, places=found.places, status=status)


def _places(rows: F32) -> list[tuple[float, float, float]]:
    """The middle of each piece that points (n, 3) make, the largest piece first."""
    cells = np.floor(rows / _PIECE_M).astype(np.int64)
    _, first, own, count = np.unique(_code(cells), return_index=True, return_inverse=True, return_counts=True)
    corners = [tuple(cell) for cell in cells[first].tolist()]
    image = dict(zip(corners, count.tolist(), strict=True))
    number = {cell: k for k, cell in enumerate(corners)}
    places = []
    for piece in _pieces(image):
        if sum(image[cell] for cell in piece) >= _LEAST_PIECE:
            chosen = np.zeros(len(corners), np.bool_)
            chosen[[number[cell] for cell in piece]] = True
            x, y, z = rows[chosen[own]].mean(axis=0).tolist()
            places.append((x, y, z))
    return places


def _pieces(cells: dict[tuple[int, ...], int]) -> list[list[tuple[int, ...]]]:
    """Groups of cells that touch, the largest first."""
    left, found = dict(cells), []
    around = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    while left:
        piece, edge = [], [left.popitem()[0]]
        while edge:
            cell = edge.pop()
            piece.append(cell)
            for step in around:
                near = tuple(a + b for a, b in zip(cell, step, strict=True))
                if left.pop(near, None) is not None:
                    edge.append(near)
        found.append(sorted(piece))
    return sorted(found, key=lambda piece: (-len(piece), piece[0]))


def _code(cells: I64) -> I64:
    """One number of each cell (n, 3), in the order of x, y, z; cells are within half a million of the origin."""
    code: I64 = (cells + _HALF_RANGE) @ np.array([1 << 40, 1 << 20, 1])
    return code


def draw(
    copy: MapCopy,
    width: int,
    height: int,
    position: tuple[float, float, float],
    yaw: float,
    kind: Kind = "behind",
    span_m: float = 40.0,
    queries: Sequence[QueryStatus] = (),
    spacing_m: float = 0.0,
) -> U8:
    """Picture uint8 (height, width, 3). What ``queries`` mean lights up; ``span_m`` is shown across.

    Pixels are square. From above north (y) is up; the operator is drawn as a bright cross. A vertex fills a pixel, or
    where that is finer a square of ``spacing_m``.
    """
    points, shade, label = copy.points()
    image = np.full((height, width, 3), SKY, np.uint8)
    view = _above if kind == "above" else _behind
    u, v, depth = view(points, width, height, np.array(position), yaw, span_m)
    rim = _LARGEST if spacing_m > 0.0 else 0
    seen = (u >= -rim) & (u < width + rim) & (v >= -rim) & (v < height + rim) & (depth > 0.3)
    shade = highlight(shade, points, label, queries)
    rows = np.flatnonzero(seen)
    order = rows[np.argsort(-depth[rows], kind="stable")]  # the nearest is drawn last
    colour, u, v = _fogged(shade[order], depth[order], span_m, kind), u[order], v[order]
    pixels_a_metre = width / span_m if kind == "above" else 0.5 * width * _FOV / depth[order]
    size = np.broadcast_to(np.clip(np.ceil(_OVERLAP * spacing_m * pixels_a_metre), 1, _LARGEST), u.shape)
    for side in np.unique(size).astype(int).tolist():  # what is larger is nearer
        some = size == side
        _stamp(image, u[some], v[some], side, colour[some])
    if kind == "above":
        _mark(image, width // 2, height // 2)
    return image


def _stamp(image: U8, u: F64, v: F64, side: int, colour: U8) -> None:
    """Squares of ``side`` pixels around (u, v), the last on top."""
    height, width = image.shape[:2]
    around = np.arange(side) - (side - 1) // 2
    at_u, at_v = np.broadcast_arrays(u[:, None, None] + around, v[:, None, None] + around[:, None])
    inside = (at_u >= 0) & (at_u < width) & (at_v >= 0) & (at_v < height)
    flat = (at_v[inside] * width + at_u[inside]).astype(np.int64)
    image.reshape(-1, 3)[flat] = np.broadcast_to(colour[:, None, None], (*inside.shape, 3))[inside]


def highlight(shade: U8, points: F32, label: U8, queries: Sequence[QueryStatus]) -> U8:
    """What is asked for glows in its colour, all else steps back; unchanged where nothing is looked for."""
    if not any(query.labels for query in queries):
        return shade
    out = (shade * _DIM).astype(np.uint8)
    for rows, colour in lit(points, label, queries):
        mixed = 0.25 * shade[rows] + 0.75 * np.array(colour, np.float32)
        out[rows] = mixed.astype(np.uint8)
    return out


def _above(
    points: F32, width: int, height: int, position: F64, yaw: float, span_m: float
) -> tuple[F64, F64, F64]:
    scale = width / span_m
    relative = points - position
    u = np.floor(width / 2 + relative[:, 0] * scale)
    v = np.floor(height / 2 - relative[:, 1] * scale)
    return u, v, 100.0 - relative[:, 2]


def _behind(
    points: F32, width: int, height: int, position: F64, yaw: float, span_m: float
) -> tuple[F64, F64, F64]:
    """A camera behind and above the operator, looking ahead and down."""
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    distance = _BEHIND_M * span_m / 40.0
    eye = position - ahead * distance * np.cos(_TILT) + (0, 0, distance * np.sin(_TILT))
    forward = ahead * np.cos(_TILT) - np.array([0, 0, np.sin(_TILT)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    relative = points - eye
    depth = relative @ forward
    focal = 0.5 * width * _FOV
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.floor(width / 2 + focal * (relative @ right) / depth)
        v = np.floor(height / 2 + focal * (relative @ down) / depth)
    return u, v, depth


def _fogged(shade: U8, depth: F64, span_m: float, kind: Kind) -> U8:
    """What is far fades towards the sky, so that near and far are told apart without colour too."""
    if kind == "above" or len(depth) == 0:
        return shade
    share = np.clip(depth / (1.5 * span_m), 0.0, 0.7)[:, None]
    return (shade * (1.0 - share) + np.array(SKY) * share).astype(np.uint8)


def _mark(image: U8, u: int, v: int) -> None:
    height, width = image.shape[:2]
    for du, dv in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)):
        if 0 <= u + du < width and 0 <= v + dv < height:
            image[v + dv, u + du] = (255, 255, 255)


def luminance_text(image: U8) -> list[str]:
    """The picture as plain characters, two rows of pixels a line: for terminals without colour."""
    ramp = " .:-=+*#%@"
    pairs = image[: len(image) // 2 * 2].reshape(-1, 2, image.shape[1], 3).mean(axis=(1, 3))
    level: I64 = (pairs / 256.0 * len(ramp)).astype(np.int64)
    return ["".join(ramp[k] for k in row) for row in level]
