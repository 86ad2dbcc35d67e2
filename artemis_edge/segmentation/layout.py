"""How objects lie to each other: relations between their boxes, softly from 0 to 1."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from artemis_edge.frames import F64

# Where "next to" and "far from" begin is a choice: an arm's reach, and a few steps [m].
_NEAR_M, _NEAR_SOFT_M = 1.5, 1.0
_FAR_M, _FAR_SOFT_M = 5.0, 2.0
_TOUCH_M, _TOUCH_SOFT_M = 0.35, 0.3
_SIDEWAYS = 3.0


@dataclass(frozen=True, slots=True)
class Box:
    """An upright box: ``centre`` (3,) and ``size`` (3,) in metres, turned by ``yaw`` radians about z."""

    centre: F64
    size: F64
    yaw: float = 0.0

    def corners(self) -> F64:
        """The four corners seen from above, in order: (4, 2)."""
        half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * np.asarray(self.size[:2]) / 2
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.asarray(self.centre[:2] + half @ np.array([[c, s], [-s, c]]))

    @property
    def bottom(self) -> float:
        """Height of its lower side."""
        return float(self.centre[2] - self.size[2] / 2)

    @property
    def top(self) -> float:
        """Height of its upper side."""
        return float(self.centre[2] + self.size[2] / 2)

    def measure(self, name: str) -> float:
        """``height``, ``length``, ``width`` in metres, ``volume`` in cubic metres."""
        across, along = sorted(float(side) for side in self.size[:2])
        high = float(self.size[2])
        return {"height": high, "length": along, "width": across, "volume": across * along * high}[name]


def gap_above(one: Box, other: Box) -> float:
    """Distance of two boxes seen from above, 0 where they overlap [m]."""
    a, b = one.corners(), other.corners()
    if not _separated(a, b) and not _separated(b, a):
        return 0.0
    return min(_to_edges(a, b), _to_edges(b, a))


def gap(one: Box, other: Box) -> float:
    """Distance of two boxes, 0 where they overlap [m]."""
    upward = max(one.bottom - other.top, other.bottom - one.top, 0.0)
    return float(np.hypot(gap_above(one, other), upward))


def _separated(a: F64, b: F64) -> bool:
    """Whether an edge of rectangle ``a`` has all of ``b`` beyond it (separating axes)."""
    for k in range(2):
        axis = a[k + 1] - a[k]
        ours, theirs = a @ axis, b @ axis
        if theirs.min() > ours.max() or theirs.max() < ours.min():
            return True
    return False


def _to_edges(points: F64, polygon: F64) -> float:
    """Least distance of points to the edges of a polygon."""
    start, step = polygon, np.roll(polygon, -1, axis=0) - polygon
    offset = points[:, None] - start[None]
    share = np.sum(offset * step, axis=2) / np.maximum(np.sum(step * step, axis=1), 1e-12)
    nearest = start + np.clip(share, 0, 1)[:, :, None] * step
    return float(np.linalg.norm(points[:, None] - nearest, axis=2).min())


def _below(value: float, limit: float, soft: float) -> float:
    """1 well below the limit, 0.5 at it, 0 well above it."""
    return float(np.clip((limit - value) / soft + 0.5, 0.0, 1.0))


def _next_to(one: Box, other: Box) -> float:
    return _below(gap(one, other), _NEAR_M, _NEAR_SOFT_M)


def _far_from(one: Box, other: Box) -> float:
    return 1.0 - _below(gap(one, other), _FAR_M, _FAR_SOFT_M)


def _on(one: Box, other: Box) -> float:
    """Over the other as seen from above, reaching higher, and not hovering."""
    over = _below(gap_above(one, other), _TOUCH_M, _TOUCH_SOFT_M)
    rests = _below(one.bottom - other.top, _TOUCH_M, _TOUCH_SOFT_M)
    return min(over, rests, 1.0 if one.top > other.top and one.centre[2] > other.centre[2] else 0.0)


def _above(one: Box, other: Box) -> float:
    over = _below(gap_above(one, other), _TOUCH_M, _TOUCH_SOFT_M)
    return min(over, _below(other.top - one.bottom, _TOUCH_M, _TOUCH_SOFT_M))


def _under(one: Box, other: Box) -> float:
    """Below its upper side and under its outline: a bench under a tree is not below the tree's trunk."""
    over = _below(gap_above(one, other), _TOUCH_M, _TOUCH_SOFT_M)
    return min(over, 1.0 if one.top < other.top and one.centre[2] < other.centre[2] else 0.0)


def _inside(one: Box, other: Box) -> float:
    centre = Box(one.centre, np.zeros(3))
    return _below(gap(centre, other), 0.5 * _TOUCH_SOFT_M, _TOUCH_SOFT_M)


#: Relations to one landmark that hold whoever looks.
RELATIONS: Mapping[str, Callable[[Box, Box], float]] = MappingProxyType(
    {
        "next_to": _next_to,
        "far_from": _far_from,
        "on": _on,
        "above": _above,
        "under": _under,
        "inside": _inside,
    }
)


def between(one: Box, first: Box, second: Box) -> float:
    """Whether a box lies between two others, as seen from above: on the way from one to the other, and near it."""
    start, way = first.centre[:2], second.centre[:2] - first.centre[:2]
    length = float(np.linalg.norm(way))
    if length < _TOUCH_M:
        return 0.0
    along = float((one.centre[:2] - start) @ way) / length
    off = one.centre[:2] - start
    aside = abs(float(way[0] * off[1] - way[1] * off[0])) / length
    if not 0.0 < along < length:
        return 0.0
    return _below(aside, max(0.25 * length, _NEAR_M), _NEAR_SOFT_M)


def seen_from(viewpoint: F64, kind: str, one: Box, other: Box) -> float:
    """How well one of VIEWED fits for somebody at ``viewpoint`` (3,) who looks at ``other``."""
    towards = other.centre[:2] - viewpoint[:2]
    distance = float(np.linalg.norm(towards))
    if distance < _TOUCH_M:
        return 0.0
    forward = towards / distance
    off = one.centre[:2] - other.centre[:2]
    ahead, leftward = float(off @ forward), float(off @ np.array([-forward[1], forward[0]]))
    wanted, across = {
        "left_of": (leftward, ahead),
        "right_of": (-leftward, ahead),
        "behind": (ahead, leftward),
        "in_front_of": (-ahead, leftward),
    }[kind]
    if wanted <= 0.0:
        return 0.0
    # left and right are told across a wider span of depth than behind is told across the view
    span = _SIDEWAYS if kind in ("left_of", "right_of") else 1.0
    return _below(abs(across) - span * wanted, 0.0, max(wanted, _TOUCH_SOFT_M))


def exceeds(kind: str, value: float, limit: float) -> bool:
    """Whether one of COMPARED is true of two measures."""
    return value > limit if kind.startswith("more_") else value < limit


#: Comparisons with a landmark or a length, and what of the boxes they compare.
COMPARED: Mapping[str, str] = MappingProxyType(
    {
        **{
            "more_height": "height",
            "less_height": "height",
            "more_volume": "volume",
            "less_volume": "volume",
        },
        **{"more_length": "length", "more_width": "width", "less_width": "width"},
    }
)
VIEWED: Sequence[str] = ("left_of", "right_of", "behind", "in_front_of")
