"""What all readers share: points that are none, IMU samples of a frame, small file helpers."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import F32, I64, Bool, ImuSamples
from artemis_edge.trajectory import parse_seconds

SECOND_NS = 1_000_000_000


def valid_returns(points: F32) -> tuple[Bool | None, dict[str, int]]:
    """Which points (n, 3) are measurements (None: all), and how many are not, by reason.

    ``nan_points`` counts points with a coordinate that is not finite; ``no_return`` all-zero points, by which
    sensors say that a shot came back with nothing.
    """
    # Not the norm: a NaN or an infinity shows in the sum, and the sum is zero only where all are.
    with np.errstate(over="ignore", invalid="ignore"):
        reach = np.abs(points[:, 0]) + np.abs(points[:, 1]) + np.abs(points[:, 2])
        keep = (reach > 0.0) & (reach < np.inf)
    dropped = len(keep) - int(np.count_nonzero(keep))
    if dropped == 0:
        return None, {}
    zero = int(np.count_nonzero(reach == 0.0))
    counts = {"nan_points": dropped - zero, "no_return": zero}
    return keep, {reason: count for reason, count in counts.items() if count}


def full_intensity(values: F32) -> float:
    """The value that stands for full reflectance, guessed from one cloud: 1, 255, or the next 2^k - 1.

    Drivers write 0..1, 0..255 (Livox, Velodyne) or raw counts (Ouster) into the same field.
    """
    top = float(np.max(values, initial=0.0, where=np.isfinite(values)))
    if top <= 1.0:
        return 1.0
    return float(max(255.0, 2.0 ** np.ceil(np.log2(top + 1.0)) - 1.0))


def unit_intensity(values: F32, full: float) -> F32:
    """Intensities (n,) as 0..1; what lies outside is clipped, what is not finite is 0."""
    scaled: F32 = np.clip(values * np.float32(1.0 / full), 0.0, 1.0)
    scaled[~np.isfinite(scaled)] = 0.0
    return scaled


def add_counts(total: dict[str, int], more: dict[str, int]) -> None:
    """Add counts by reason to ``total``."""
    for reason, count in more.items():
        total[reason] = total.get(reason, 0) + count


def split_imu(stamp_ns: I64, window_start_ns: I64) -> I64:
    """Bounds (n + 1,) of the samples of each frame: frame k has samples ``bounds[k]:bounds[k + 1]``.

    A frame's window begins at ``window_start_ns[k]`` and ends where the next begins. The first frame also
    takes what came before it, the last what came after, so that every sample belongs to exactly one frame.
    """
    bounds = np.searchsorted(stamp_ns, window_start_ns).astype(np.int64)
    bounds[:1] = 0
    return np.append(bounds, len(stamp_ns))


def imu_between(imu: ImuSamples, first: int, last: int) -> ImuSamples:
    """Samples ``first:last``."""
    return ImuSamples(imu.stamp_ns[first:last], imu.gyro[first:last], imu.accel[first:last], imu.origin)


def median_interval_ns(stamp_ns: I64) -> float | None:
    """Median time between frames, None for fewer than two."""
    return float(np.median(np.diff(stamp_ns))) if len(stamp_ns) > 1 else None


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Sort key by which ``bag_2`` stands before ``bag_10``."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]


def seconds_to_ns(text: str, where: str) -> int:
    """Decimal seconds as nanoseconds, exactly; InputError naming ``where``."""
    try:
        return parse_seconds(text)
    except (ValueError, OverflowError):
        raise InputError(f"{where} holds '{text[:40]}' where a time in seconds is expected") from None


def one_line(error: Exception) -> str:
    """What another library says, fit for one line."""
    return " ".join(str(error).split())[:160]


def read_lines(path: Path) -> list[str]:
    """Lines of a text file that hold something; InputError if it cannot be read."""
    try:
        return [line for line in path.read_text().splitlines() if line.strip()]
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file") from None
