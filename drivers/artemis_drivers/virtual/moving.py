"""What moves through a scene as rigid bodies, prepared for ray casting and shading.

A mover's geometry stays in its own frame for ever: a ray at time t is carried into the frame the mover has at
t, so that every beam of a scan meets it where it is at that moment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from artemis_drivers._jit import njit
from artemis_drivers.virtual.mesh_builder import F64, I32, WorldMesh
from artemis_drivers.virtual.motion import Motion
from artemis_drivers.virtual.raycast import Bvh, Hits, build_bvh, cast
from artemis_drivers.virtual.world import Mover

_KNOT_S = 0.01  # spacing at which a mover's place is looked up when rays are sorted out
_KNOT_SLACK_M = 0.05  # it may leave the straight line between two by this: 4000 m/s2 of acceleration


@dataclass(frozen=True, slots=True)
class MovingPart:
    """One mover. ``first`` is the scene's number of its first triangle; ``radius`` m encloses it around the
    origin of its local frame, which is ``bvh.origin`` in the axes of ``mesh``.
    """

    mesh: WorldMesh
    motion: Motion
    bvh: Bvh
    first: int
    radius: float

    def pose(self, time_s: ArrayLike) -> F64:
        """T_world_local float64 (n, 4, 4) at times clipped to the motion's: local is what the mover's rows of
        ``Scene.surface`` and ``bvh`` are given in.
        """
        t = np.clip(np.atleast_1d(np.asarray(time_s, np.float64)), 0.0, self.motion.duration_s)
        T = self.motion.pose(t)
        T[:, :3, 3] += T[:, :3, :3] @ self.bvh.origin
        return T


def prepare_movers(movers: tuple[Mover, ...], first: int) -> tuple[MovingPart, ...]:
    """Hierarchies of the movers, whose triangles are numbered from ``first`` on."""
    parts = []
    for mover in movers:
        bvh = build_bvh(mover.mesh.corners())
        away = mover.mesh.vertices.astype(np.float64) - bvh.origin
        radius = float(np.linalg.norm(away, axis=1).max(initial=0.0))
        parts.append(MovingPart(mover.mesh, mover.motion, bvh, first, radius))
        first += len(mover.mesh.triangles)
    return tuple(parts)


def renumbered(parts: tuple[MovingPart, ...], first: int) -> tuple[MovingPart, ...]:
    """The same movers, numbered from another triangle on."""
    out = []
    for part in parts:
        out.append(MovingPart(part.mesh, part.motion, part.bvh, first, part.radius))
        first += len(part.mesh.triangles)
    return tuple(out)


def cast_mover(part: MovingPart, origin: F64, direction: F64, time_s: F64, limit: F64) -> tuple[I32, Hits]:
    """Rows of the rays that may meet a mover before ``limit`` metres, and their hits (its own numbers)."""
    rows = near_mover(part, origin, direction, time_s, limit)
    o, d = into_mover(part, origin[rows], direction[rows], time_s[rows])
    return rows, cast(part.bvh, o + part.bvh.origin, d, limit[rows])


def into_mover(part: MovingPart, origin: F64, direction: F64, time_s: F64) -> tuple[F64, F64]:
    """Rays (n, 3) of the world in the mover's local frame at their times (n,)."""
    if len(time_s) == 0:
        return np.empty((0, 3)), np.empty((0, 3))
    if time_s.min() == time_s.max():
        T = part.pose(time_s[:1])[0]
        return (origin - T[:3, 3]) @ T[:3, :3], direction @ T[:3, :3]
    T = part.pose(time_s)
    R = T[:, :3, :3]
    return np.einsum("nji,nj->ni", R, origin - T[:, :3, 3]), np.einsum("nji,nj->ni", R, direction)


def near_mover(
    part: MovingPart, origin: F64, direction: F64, time_s: F64, limit: F64, slack_m: float = 1e-3
) -> I32:
    """Rows of the rays that pass a mover's bounding sphere, grown by ``slack_m``, before ``limit`` metres."""
    out = np.empty(len(origin), np.int32)
    finite = time_s[np.isfinite(time_s)]
    if len(finite) == 0:
        return out[:0]
    start, stop = float(finite.min()), float(finite.max())
    knots = int(np.ceil((stop - start) / _KNOT_S)) + 1
    centre = part.pose(np.linspace(start, stop, knots))[:, :3, 3]
    step = (stop - start) / max(knots - 1, 1)
    radius = part.radius + slack_m + (_KNOT_SLACK_M if knots > 1 else 0.0)
    return out[: _near_sphere(origin, direction, time_s, limit, centre, start, step, radius, out)]


@njit
def _near_sphere(
    origin: F64,
    direction: F64,
    time: F64,
    limit: F64,
    centre: F64,
    start: float,
    step: float,
    radius: float,
    out: I32,
) -> int:
    """Rays whose line comes within ``radius`` of the moving ``centre`` (knots, 3), interpolated in time."""
    count, last = 0, len(centre) - 1
    for i in range(len(origin)):
        at = min(max((time[i] - start) / step, 0.0), float(last)) if last > 0 else 0.0
        k = min(int(at), max(last - 1, 0))
        share = at - k
        n = min(k + 1, last)
        x = centre[k, 0] + share * (centre[n, 0] - centre[k, 0]) - origin[i, 0]
        y = centre[k, 1] + share * (centre[n, 1] - centre[k, 1]) - origin[i, 1]
        z = centre[k, 2] + share * (centre[n, 2] - centre[k, 2]) - origin[i, 2]
        along = x * direction[i, 0] + y * direction[i, 1] + z * direction[i, 2]
        away = x * x + y * y + z * z
        if along < -radius or along > limit[i] + radius:
            continue
        if away - along * along <= radius * radius:
            out[count] = i
            count += 1
    return count
