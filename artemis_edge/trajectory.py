"""Poses in time: TUM files, interpolation, and pairing with the frames of an input.

A TUM line is ``stamp tx ty tz qx qy qz qw`` (seconds, metres, unit quaternion) and stands for
``T_world_lidar``; lines that start with ``#`` are comments. (Format: Sturm et al., "A Benchmark for the
Evaluation of RGB-D SLAM Systems", IROS 2012.)
"""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from artemis_edge.errors import InputError
from artemis_edge.export.atomic import write_bytes
from artemis_edge.frames import F64, I64, Bool, Trajectory

_COLUMNS = 8
# Stamps are int64 nanoseconds: 9.2e9 s, the year 2262.
_LAST_S = 9_000_000_000
# A printed quaternion is a unit quaternion up to rounding; further off, the columns are something else.
_UNIT_TOLERANCE = 0.05
# Fifteen times the Earth's radius: beyond any frame on it, and squares stay far from overflow.
FARTHEST_M = 1e8
# A rotation printed with a few digits is orthonormal up to this.
_ROTATION_TOLERANCE = 1e-3
# Printed stamps are rounded: this far beyond the first or last pose that pose still holds.
COVER_NS = 1_000_000
# Between poses this many frame periods apart nobody knows how the sensor moved.
_HOLE_FRAMES = 2.0


def matrix_from_quaternion(translation: F64, quaternion: F64) -> F64:
    """Transforms (..., 4, 4) of translations (..., 3) and quaternions x, y, z, w (..., 4) of any length."""
    translation, quaternion = np.asarray(translation, np.float64), np.asarray(quaternion, np.float64)
    T = np.zeros((*quaternion.shape[:-1], 4, 4))
    if quaternion.size:
        T[..., :3, :3] = (
            Rotation.from_quat(quaternion.reshape(-1, 4)).as_matrix().reshape(T[..., :3, :3].shape)
        )
    T[..., :3, 3] = translation
    T[..., 3, 3] = 1.0
    return T


def quaternion_from_matrix(T: F64) -> F64:
    """Unit quaternions (..., 4) as x, y, z, w with w >= 0, of transforms (..., 4, 4)."""
    T = np.asarray(T, np.float64)
    if T.size == 0:
        return np.empty((*T.shape[:-2], 4))
    R = np.ascontiguousarray(T[..., :3, :3]).reshape(-1, 3, 3)
    return np.asarray(Rotation.from_matrix(R).as_quat(canonical=True)).reshape(*T.shape[:-2], 4)


def inverse(T: F64) -> F64:
    """Inverses (..., 4, 4) of rigid transforms."""
    out = np.zeros_like(T)
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = R
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", R, T[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def is_pose(T: F64) -> bool:
    """Whether an array is a rotation and a translation of at most ``FARTHEST_M`` as a 4 x 4 matrix."""
    if T.shape != (4, 4) or not (np.abs(T) <= FARTHEST_M).all() or not np.allclose(T[3], [0, 0, 0, 1]):
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() < _ROTATION_TOLERANCE and np.linalg.det(R) > 0.0)


def read_tum(path: Path) -> Trajectory:
    """The poses of a TUM file, stamps exact to the nanosecond.

    Raises InputError if the file cannot be read, is empty, has a line that is not eight finite numbers with a
    position on Earth and a unit quaternion, or stamps that do not ascend.
    """
    try:
        text = path.read_text()
    except OSError as error:
        raise InputError(f"cannot read the poses {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file of poses 'stamp tx ty tz qx qy qz qw'") from None
    stamps, rows = [], []
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            stamp, row = _parse_line(line, f"line {number} of {path}")
            stamps.append(stamp)
            rows.append(row)
    if not rows:
        raise InputError(f"{path} holds no poses; each line must be 'stamp tx ty tz qx qy qz qw'")
    stamp_ns, values = np.array(stamps, np.int64), np.array(rows)
    backward = np.flatnonzero(np.diff(stamp_ns) <= 0)
    if len(backward):
        fault = int(backward[0]) + 1
        raise InputError(
            f"the stamps of {path} do not ascend at pose {fault + 1} ({seconds_text(stamp_ns[fault])} s); "
            "sort the poses by time and keep one per stamp"
        )
    return Trajectory(stamp_ns, matrix_from_quaternion(values[:, :3], values[:, 3:]))


def _parse_line(line: str, where: str) -> tuple[int, list[float]]:
    words = line.split()
    if len(words) != _COLUMNS:
        raise InputError(f"{where} has {len(words)} columns; a pose is 'stamp tx ty tz qx qy qz qw'")
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise InputError(f"{where} is not eight numbers; a pose is 'stamp tx ty tz qx qy qz qw'") from None
    if not np.isfinite(values).all():
        raise InputError(f"{where} holds a value that is not finite; remove that pose")
    if max(abs(value) for value in values[1:4]) > FARTHEST_M:
        raise InputError(f"the position in {where} lies beyond {FARTHEST_M / 1000:,.0f} km; it is in metres")
    try:
        stamp_ns = parse_seconds(words[0])
    except (ValueError, OverflowError):
        raise InputError(f"the stamp in {where} is not in seconds; TUM stamps are seconds") from None
    if abs(float(np.linalg.norm(values[4:])) - 1.0) > _UNIT_TOLERANCE:
        raise InputError(f"the quaternion in {where} is not of unit length; the order is qx qy qz qw")
    return stamp_ns, values[1:]


def parse_seconds(text: str) -> int:
    """Decimal seconds as nanoseconds, exactly; ValueError for no number, OverflowError beyond int64."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise ValueError(text) from None
    # Compared, not subtracted: arithmetic on a hostile exponent fails.
    if seconds.is_nan() or not -_LAST_S < seconds < _LAST_S:
        raise OverflowError(text)
    return int((seconds * 1_000_000_000).to_integral_value())


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write poses as TUM lines: stamps to the nanosecond, positions to the micrometre. Raises RunError."""
    quaternions = quaternion_from_matrix(trajectory.T_world_lidar)
    lines = []
    for stamp, T, q in zip(trajectory.stamp_ns.tolist(), trajectory.T_world_lidar, quaternions, strict=True):
        values = " ".join(f"{v:.6f}" for v in T[:3, 3]) + " " + " ".join(f"{v:.9f}" for v in q)
        lines.append(f"{seconds_text(stamp)} {values}\n")
    write_bytes(path, "".join(lines).encode())


def seconds_text(stamp_ns: int) -> str:
    """Nanoseconds as decimal seconds, exactly."""
    whole, rest = divmod(abs(stamp_ns), 1_000_000_000)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{rest:09d}"


def covered(trajectory: Trajectory, stamp_ns: I64) -> Bool:
    """Which stamps (n,) lie within the time of the poses."""
    if len(trajectory) == 0:
        return np.zeros(len(stamp_ns), np.bool_)
    first, last = trajectory.stamp_ns[0] - COVER_NS, trajectory.stamp_ns[-1] + COVER_NS
    return np.asarray((stamp_ns >= first) & (stamp_ns <= last))


def interpolate(trajectory: Trajectory, stamp_ns: I64) -> F64:
    """Poses (n, 4, 4) at stamps (n,): positions linear, rotations along the great arc between two poses.

    A stamp beyond the first or last pose takes that pose; whoever asks decides with ``covered``. The
    trajectory must not be empty.
    """
    times, poses = trajectory.stamp_ns, trajectory.T_world_lidar
    after = np.clip(np.searchsorted(times, stamp_ns, "right"), 1, max(len(times) - 1, 1))
    left, right = after - 1, np.minimum(after, len(times) - 1)
    span = np.maximum(times[right] - times[left], 1)
    share = np.clip((np.asarray(stamp_ns, np.int64) - times[left]) / span, 0.0, 1.0)
    T = poses[np.where(share < 1.0, left, right)]
    inner = np.flatnonzero((share > 0.0) & (share < 1.0))
    if len(inner):
        start, stop = (
            Rotation.from_matrix(poses[left[inner], :3, :3]),
            Rotation.from_matrix(poses[right[inner], :3, :3]),
        )
        turn = (start.inv() * stop).as_rotvec() * share[inner, None]
        T[inner, :3, :3] = (start * Rotation.from_rotvec(turn)).as_matrix()
        T[inner, :3, 3] += share[inner, None] * (poses[right[inner], :3, 3] - poses[left[inner], :3, 3])
    return T


def pose_per_frame(
    poses: Trajectory, frame_stamp_ns: I64, start: int = 0, stop: int | None = None, name: str = "the poses"
) -> Trajectory:
    """Poses at the stamps of frames ``start <= index < stop``, as ``--poses`` means them.

    ``frame_stamp_ns`` (n,) are the stamps of all frames of the input. With exactly one pose per frame, row
    pairs with row, whatever the times say; otherwise the poses are interpolated by time. Raises InputError if
    they do not cover every frame asked for.
    """
    wanted = frame_stamp_ns[start:stop]
    if len(poses) == len(frame_stamp_ns):
        return Trajectory(wanted, poses.T_world_lidar[start:stop])
    inside = covered(poses, wanted)
    if not inside.all():
        raise InputError(_not_covered(poses, wanted, inside, start, name))
    return Trajectory(wanted, interpolate(poses, wanted))


def hole_sentence(poses: Trajectory, frame_stamp_ns: I64) -> str | None:
    """What to say of frames (n,) between poses more than two frame periods apart; None without such frames."""
    if len(poses) < 2 or len(frame_stamp_ns) < 2:
        return None
    times = poses.stamp_ns
    after = np.clip(np.searchsorted(times, frame_stamp_ns), 1, len(times) - 1)
    gap = times[after] - times[after - 1]
    apart = np.minimum(np.abs(frame_stamp_ns - times[after - 1]), np.abs(frame_stamp_ns - times[after]))
    within = (gap > _HOLE_FRAMES * np.median(np.diff(frame_stamp_ns))) & (apart > COVER_NS)
    if not within.any():
        return None
    return (
        f"{int(within.sum())} frames lie in holes of the poses, the longest {gap[within].max() / 1e9:.2f} s; "
        "their poses are interpolated across them"
    )


def _not_covered(poses: Trajectory, wanted: I64, inside: Bool, start: int, name: str) -> str:
    span = f"{poses.stamp_ns[0] / 1e9:.3f} to {poses.stamp_ns[-1] / 1e9:.3f} s"
    frames = f"{wanted[0] / 1e9:.3f} to {wanted[-1] / 1e9:.3f} s"
    if not inside.any():
        return (
            f"{name} ({len(poses)} poses, {span}) cover none of the {len(wanted)} frames ({frames}); "
            "give one pose per frame or poses on the clock of the input"
        )
    index, missing = start + np.flatnonzero(inside), int((~inside).sum())
    return (
        f"{name} ({len(poses)} poses, {span}) do not cover {missing} of the {len(wanted)} frames ({frames}); "
        f"map the covered ones with --frames {index[0]}:{index[-1] + 1}"
    )
