"""A trajectory against a reference: absolute error after alignment, relative error per distance travelled.

    python -m artemis_edge.evaluate.trajectory ESTIMATE.tum --reference REF.tum --json

Absolute: root mean square and maximum of the distance between paired positions after the best rigid motion
(Umeyama 1991 without scale). Relative: as the KITTI odometry benchmark (Geiger 2012), over all stretches of
the reference of 10, 50 and 100 m, each error divided by the stretch's own length, then averaged.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge.errors import InputError, UserError
from artemis_edge.frames import F64, I64, Trajectory
from artemis_edge.trajectory import inverse, read_tum

STRETCHES_M = (10.0, 50.0, 100.0)
_PAIR_WITHIN_NS = 10_000_000
_LEAST_PAIRS = 3  # fewer points fix no rigid motion


@dataclass(frozen=True, slots=True)
class RelativeError:
    """Mean over ``stretches`` pairs of poses: translation in % of the distance, rotation in deg/m."""

    percent: float
    deg_per_m: float
    stretches: int


@dataclass(frozen=True, slots=True)
class TrajectoryEvaluation:
    """``aligned`` and ``reference`` float64 (n, 3): paired positions in the reference's frame (m)."""

    ate_rmse_m: float
    ate_max_m: float
    matched: int
    length_m: float
    relative: dict[float, RelativeError]
    aligned: F64
    reference: F64

    def to_json(self) -> dict[str, Any]:
        """The JSON object of ``evaluate trajectory``; stretches longer than the path are left out."""
        return {
            "ate_rmse_m": self.ate_rmse_m,
            "ate_max_m": self.ate_max_m,
            "matched": self.matched,
            "length_m": self.length_m,
            "rpe": {
                f"{length:g}": {"percent": e.percent, "deg_per_m": e.deg_per_m, "stretches": e.stretches}
                for length, e in self.relative.items()
            },
        }


def evaluate_trajectory(estimate: Trajectory, reference: Trajectory) -> TrajectoryEvaluation:
    """Compare poses paired by time within 10 ms.

    Raises InputError when fewer than three poses pair.
    """
    i, j = pair_by_time(estimate.stamp_ns, reference.stamp_ns)
    fewer, name = min((len(estimate), "estimate"), (len(reference), "reference"))
    if fewer < _LEAST_PAIRS:
        raise InputError(f"the {name} has {fewer} poses; at least {_LEAST_PAIRS} are needed to compare paths")
    if len(i) < _LEAST_PAIRS:
        raise InputError(
            f"only {len(i)} of {len(estimate)} poses have a reference pose within 10 ms; "
            "give both trajectories on the same clock"
        )
    poses, truth = estimate.T_world_lidar[i], reference.T_world_lidar[j]
    R, t = rigid_alignment(poses[:, :3, 3], truth[:, :3, 3])
    aligned = poses[:, :3, 3] @ R.T + t
    error = np.linalg.norm(aligned - truth[:, :3, 3], axis=1)
    travelled = path_length(truth[:, :3, 3])
    relative = {length: relative_error(poses, truth, travelled, length) for length in STRETCHES_M}
    return TrajectoryEvaluation(
        ate_rmse_m=float(np.sqrt(np.mean(error**2))),
        ate_max_m=float(error.max()),
        matched=len(i),
        length_m=float(travelled[-1]),
        relative={length: e for length, e in relative.items() if e is not None},
        aligned=aligned,
        reference=truth[:, :3, 3],
    )


def pair_by_time(a_ns: I64, b_ns: I64) -> tuple[I64, I64]:
    """Indices of mutually nearest stamps no more than 10 ms apart; both inputs ascend."""
    if len(a_ns) == 0 or len(b_ns) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    nearest_b, nearest_a = _nearest(a_ns, b_ns), _nearest(b_ns, a_ns)
    i = np.arange(len(a_ns))
    pairs = (nearest_a[nearest_b] == i) & (np.abs(b_ns[nearest_b] - a_ns) <= _PAIR_WITHIN_NS)
    return i[pairs], nearest_b[pairs]


def _nearest(stamps: I64, others: I64) -> I64:
    after = np.searchsorted(others, stamps).clip(1, max(len(others) - 1, 1))
    before, after = after - 1, np.minimum(after, len(others) - 1)
    nearest: I64 = np.where(stamps - others[before] <= others[after] - stamps, before, after)
    return nearest


def rigid_alignment(points: F64, target: F64) -> tuple[F64, F64]:
    """Rotation (3, 3) and translation (3,) that bring ``points`` (n, 3) closest to ``target`` (n, 3)."""
    from_mean, to_mean = points.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - to_mean).T @ (points - from_mean))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    return R, to_mean - R @ from_mean


def path_length(positions: F64) -> F64:
    """Distance travelled (n,) at each position (n, 3), metres."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])


def relative_error(poses: F64, truth: F64, travelled: F64, length_m: float) -> RelativeError | None:
    """Error over every stretch from a pose to the first at least ``length_m`` on; None if there is none."""
    start = np.arange(len(travelled))
    end = np.searchsorted(travelled, travelled + length_m)
    start, end = start[end < len(travelled)], end[end < len(travelled)]
    if len(start) == 0:
        return None
    estimated = inverse(poses[start]) @ poses[end]
    E = inverse(inverse(truth[start]) @ truth[end]) @ estimated
    length = travelled[end] - travelled[start]
    return RelativeError(
        percent=float(np.mean(np.linalg.norm(E[:, :3, 3], axis=1) / length) * 100.0),
        deg_per_m=float(np.mean(np.degrees(_angle(E)) / length)),
        stretches=len(start),
    )


def _angle(T: F64) -> F64:
    """Rotation angles (n,) in radians; the sine keeps small ones exact where the trace alone would not."""
    R = T[:, :3, :3]
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    angle: F64 = np.arctan2(np.linalg.norm(axis, axis=1), np.trace(R, axis1=1, axis2=2) - 1.0)
    return angle


def run(estimate: Path, reference: Path) -> TrajectoryEvaluation:
    """Read both TUM files and compare them."""
    return evaluate_trajectory(read_tum(estimate), read_tum(reference))


def to_text(evaluation: TrajectoryEvaluation) -> str:
    """The figures for people."""
    lines = [
        f"{evaluation.matched} poses paired over {evaluation.length_m:.1f} m",
        f"absolute error: {evaluation.ate_rmse_m:.4f} m rms, {evaluation.ate_max_m:.4f} m at most",
    ]
    lines += [
        f"per {length:g} m: {e.percent:.3f} %, {e.deg_per_m:.5f} deg/m ({e.stretches} stretches)"
        for length, e in evaluation.relative.items()
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """The module as a command of its own."""
    parser = argparse.ArgumentParser(prog="python -m artemis_edge.evaluate.trajectory")
    parser.add_argument("estimate", type=Path)
    parser.add_argument("--reference", type=Path, required=True)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    try:
        result = run(given.estimate, given.reference)
    except UserError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    print(json.dumps(result.to_json()) if given.json else to_text(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
