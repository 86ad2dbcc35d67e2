"""The rigid motion that carries a map onto its control points, and whether it can be believed.

Least squares without scale (Kabsch 1976; Umeyama 1991, eqs 40 to 42 with c = 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import F64

_FEWEST = 3
_LEAST_SPREAD = 0.05  # of the second direction of the points, as a share of the first
_MOST_SCALE = 0.02  # by which distances may differ: more is another unit or another place
_MOST_TILT_DEG = 60.0  # a map is levelled; beyond this it would lie on its side or head
_FOOT_M = 0.3048


@dataclass(frozen=True, slots=True)
class Fit:
    """``T_local_world`` (4, 4); ``residual`` (n, 3) local minus moved map, m; ``left_out`` (n,) how far off each
    point is when it is not used, m (None with three points); ``scale`` of the distances, ``tilt_deg`` of the map's z.
    """

    T_local_world: F64
    residual: F64
    left_out: F64 | None
    scale: float
    tilt_deg: float

    @property
    def rms_m(self) -> float:
        """Root of the mean squared distance."""
        return float(np.sqrt((self.residual**2).sum(axis=1).mean()))


def rigid(world: F64, local: F64) -> F64:
    """T_local_world (4, 4), the best in the least squares sense for points (n, 3) in both frames."""
    a, b = world.mean(axis=0), local.mean(axis=0)
    U, _, Vt = np.linalg.svd((local - b).T @ (world - a))
    sign = np.diag([1.0, 1.0, np.linalg.det(U @ Vt)])
    T = np.eye(4)
    T[:3, :3] = U @ sign @ Vt
    T[:3, 3] = b - T[:3, :3] @ a
    return T


def fit(names: Sequence[str], world: F64, local: F64, most_rms_m: float) -> Fit:
    """The fit of points (n, 3) in the map (``world``) to those in a local east-north-up frame, metres.

    Raises InputError, one sentence, where too few points, their arrangement or their misfit make it worthless.
    """
    _require_spread(names, world)
    scale = _require_scale(world, local)
    T = rigid(world, local)
    residual = local - _moved(T, world)
    left_out = _left_out(world, local) if len(names) > _FEWEST else None
    found = Fit(T, residual, left_out, scale, float(np.degrees(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))))
    if found.tilt_deg > _MOST_TILT_DEG:
        raise InputError(
            f"the control points would turn the map over by {found.tilt_deg:.0f} degrees; see whether east and north "
            "are exchanged, or the points' names"
        )
    if found.rms_m > most_rms_m:
        raise InputError(_misfit(names, world, local, found, most_rms_m))
    return found


def _moved(T: F64, points: F64) -> F64:
    moved: F64 = points @ T[:3, :3].T + T[:3, 3]
    return moved


def _require_spread(names: Sequence[str], world: F64) -> None:
    if len(names) < _FEWEST:
        raise InputError(
            f"{len(names)} control points cannot place a map; give {_FEWEST} or more, not in a line"
        )
    spread = np.linalg.svd(world - world.mean(axis=0), compute_uv=False)
    if spread[0] == 0.0 or spread[1] < _LEAST_SPREAD * spread[0]:
        raise InputError("the control points lie in a line, about which the map can turn; add one beside it")


def _require_scale(world: F64, local: F64) -> float:
    """Distances in the CRS as a share of those in the map."""
    a, b = world - world.mean(axis=0), local - local.mean(axis=0)
    scale = float(np.sqrt((b**2).sum() / (a**2).sum()))
    if abs(scale - 1.0) <= _MOST_SCALE:
        return scale
    feet = any(abs(scale * unit - 1.0) <= _MOST_SCALE for unit in (_FOOT_M, 1.0 / _FOOT_M))
    why = (
        "are some of the coordinates in feet?"
        if feet
        else "see whether the points' names, their units and the EPSG code are right"
    )
    raise InputError(f"distances between the control points are {scale:.3f} times those in the map; {why}")


def _left_out(world: F64, local: F64) -> F64:
    """Each point's distance by the fit of the others; NaN where the others lie in a line."""
    found = np.full(len(world), np.nan)
    for k in range(len(world)):
        rest = np.arange(len(world)) != k
        spread = np.linalg.svd(world[rest] - world[rest].mean(axis=0), compute_uv=False)
        if spread[1] >= _LEAST_SPREAD * spread[0] > 0.0:
            T = rigid(world[rest], local[rest])
            found[k] = np.linalg.norm(local[k] - _moved(T, world[k : k + 1])[0])
    return found


def _misfit(names: Sequence[str], world: F64, local: F64, found: Fit, most_rms_m: float) -> str:
    off = np.linalg.norm(found.residual, axis=1) if found.left_out is None else np.nan_to_num(found.left_out)
    worst = int(off.argmax())
    text = f"the control points do not fit: {found.rms_m:.3f} m rms, {names[worst]} is {off[worst]:.3f} m off"
    if found.left_out is not None:
        rest = np.arange(len(names)) != worst
        T = rigid(world[rest], local[rest])
        without = np.sqrt(((local[rest] - _moved(T, world[rest])) ** 2).sum(axis=1).mean())
        text += f" ({without:.3f} m rms without it)"
    return f"{text}; mend it, or allow more with --limit (now {most_rms_m:g} m)"
