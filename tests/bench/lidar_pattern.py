"""Scan patterns of the virtual LiDARs in figures, and beside the real frames of a Livox with one laser.

    python tests/bench/lidar_pattern.py            (ARTEMIS_DATA set: with the real frames)

Coverage is the share of square cells of 0.28 degrees (the long side of a beam) within the field of view that
at least one shot fell into. Real frames: still recordings of a one-laser Livox with a circular view of 70.4
degrees, points in firing order; shots without a return have no direction and some were taken out before, so
both sides are compared on cells that ever returned anything, and steps between neighbours only where both
returned.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from artemis_drivers.virtual import avia
from artemis_drivers.virtual.lidar import Sensor
from artemis_drivers.virtual.lidars import LIDARS
from artemis_drivers.virtual.mesh_builder import F64
from artemis_drivers.virtual.prisms import deflect
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial import cKDTree

CELL_DEG = 0.28
REAL_CELL_DEG = 0.5
REAL_FRAME = 29_952
REAL_HZ = 100_000
MID40_HZ = np.array([-121.5657, 77.7430])  # HELIOS++ gives the Mid-40's rates to the Mid-70, too


def degrees(direction: F64) -> F64:
    """Azimuth and elevation (n, 2)."""
    angle = np.column_stack([np.arctan2(direction[:, 1], direction[:, 0]), np.arcsin(direction[:, 2])])
    return np.asarray(np.degrees(angle))


def cells(direction: F64, size: float) -> NDArray[np.int64]:
    """Distinct cells (m, 2) that directions fall into."""
    return np.unique(np.floor(degrees(direction) / size).astype(np.int64), axis=0)


def gap(a: F64, b: F64) -> F64:
    """Angle between directions, degrees."""
    return np.asarray(np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2, 0, 1))))


def row(values: Iterable[float], form: str = "{:6.3f}") -> str:
    """Figures on a line."""
    return " ".join(form.format(v) for v in values)


def describe(name: str, sensor: Sensor) -> None:
    """Rate, lines, timing, neighbours and coverage of a virtual LiDAR."""
    frames = [sensor.beams(k, 1.0) for k in range(30)]
    second = sum(len(f.time_s) for f in frames[:10])
    angle = degrees(np.concatenate([f.direction for f in frames]))
    print(f"\n{name}: {sensor.name}")
    print(f"  shots in the first second {second}, lines {len(np.unique(frames[0].line))}, one every ", end="")
    print(f"{np.median(np.diff(frames[0].time_s)) * 1e6:.4f} us")
    print(f"  azimuth {row(angle[:, 0][[angle[:, 0].argmin(), angle[:, 0].argmax()]], '{:.2f}')}", end="")
    print(f", elevation {angle[:, 1].min():.2f} {angle[:, 1].max():.2f}")
    one = frames[0].direction[frames[0].line == 0]
    print(
        f"  to the next shot of a laser, deg (5/50/95 %):   {row(np.percentile(gap(one[1:], one[:-1]), [5, 50, 95]))}"
    )
    near = np.degrees(cKDTree(frames[0].direction).query(frames[0].direction, k=2)[0][:, 1])
    print(f"  to the nearest shot of a frame, deg (5/50/95 %): {row(np.percentile(near, [5, 50, 95]))}")
    field = len(cells(np.concatenate([sensor.beams(k, 1.0).direction for k in range(100)]), CELL_DEG))
    print("  coverage of what 10 s reach, after s: ", end="")
    shots = np.concatenate([f.direction for f in frames])
    for seconds in (0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 3.0):
        done = cells(shots[: round(seconds * sensor.points_per_second)], CELL_DEG)
        print(f"{seconds:g}: {100 * len(done) / field:.0f} %", end="  ")
    print()


def one_laser(seconds: float, wedges: F64, rates: F64) -> F64:
    """Directions of a laser on the axis behind prisms, 100 000 shots a second."""
    time = np.arange(round(seconds * REAL_HZ)) / REAL_HZ
    out = np.empty((len(time), 3))
    which = np.zeros(len(time), np.int64)
    deflect(wedges, rates, avia.INDEX, np.array([[1.0, 0, 0]]), which, time, out)
    return out


def equal_wedges(half_angle_deg: float) -> F64:
    """Two equal wedges that fill a circle of this half angle."""

    def reach(wedge: float) -> float:
        d = one_laser(1 / REAL_HZ, np.full(2, wedge), np.zeros(2))[0]
        return float(np.degrees(np.arccos(d[0]))) - half_angle_deg

    return np.full(2, brentq(reach, 0.1, 0.62))


def real_frames(folder: Path) -> list[F64]:
    """Directions (29952, 3) of every frame of a recording, NaN where nothing returned."""
    frames = []
    for path in sorted(folder.glob("velodyne/*.bin")):
        points = np.fromfile(path, np.float32).reshape(-1, 4)[:, :3].astype(np.float64)
        distance = np.linalg.norm(points, axis=1, keepdims=True)
        frames.append(points / np.where(distance > 0, distance, np.nan))
    return frames


def speed_by_radius(direction: F64) -> F64:
    """Median step between successive shots, degrees, in six rings of 6 degrees about the axis."""
    both = np.isfinite(direction[1:]).all(axis=1) & np.isfinite(direction[:-1]).all(axis=1)
    a, b = direction[1:][both], direction[:-1][both]
    ring = (np.degrees(np.arccos(np.clip(a[:, 0], -1, 1))) / 6).astype(int)
    steps = gap(a, b)
    return np.array([np.median(steps[ring == k]) for k in range(6)])


def inside(field: NDArray[np.int64], direction: F64) -> int:
    """Number of cells of ``field`` that directions fall into."""
    mine = cells(direction, REAL_CELL_DEG)
    known = {tuple(c) for c in field.tolist()}
    return sum(tuple(c) in known for c in mine.tolist())


def compare(folder: Path) -> None:
    """The same figures of a real recording and of the two-prism model."""
    frames = real_frames(folder)
    shots = np.concatenate(frames)
    good = shots[np.isfinite(shots[:, 0])]
    half = float(np.degrees(np.arccos(good[:, 0].min())))
    field = cells(good, REAL_CELL_DEG)
    print(
        f"\nreal one-laser Livox, {folder.name}: {len(frames)} frames, {100 * len(good) / len(shots):.0f} % return"
    )
    print(f"  half angle {half:.2f} deg")
    seconds = len(shots) / REAL_HZ
    patterns = {
        "real": shots,
        "the Avia's three prisms": one_laser(seconds, avia.WEDGE, avia.RATE_HZ),
        "two, the Mid-40's rates": one_laser(seconds, equal_wedges(half), MID40_HZ),
    }
    edges = np.arange(0, 37, 6)
    for label, pattern in patterns.items():
        seen = pattern[np.isfinite(pattern[:, 0])]
        print(f"  {label:24s} step by ring of 6 deg: {row(speed_by_radius(pattern))}")
        ring = np.histogram(np.degrees(np.arccos(np.clip(seen[:, 0], -1, 1))), edges)[0] / len(seen)
        print(f"  {'':24s} share of shots by ring: {row(ring)}")
        print(f"  {'':24s} coverage of the field after frames of 0.3 s: ", end="")
        for count in (1, 2, 3, 5, 10, 20):
            share = inside(field, seen_until(pattern, count)) / len(field)
            print(f"{count}: {100 * share:.0f} %", end="  ")
        print()


def seen_until(pattern: F64, frames: int) -> F64:
    """Directions of the first frames that are known."""
    part = pattern[: frames * REAL_FRAME]
    return part[np.isfinite(part[:, 0])]


def main() -> None:
    """Print everything."""
    for name, sensor in LIDARS.items():
        describe(name, sensor)
    data = os.environ.get("ARTEMIS_DATA")
    if data is None:
        print("\nARTEMIS_DATA is not set: no comparison with real frames")
        return
    for sequence in ("00", "11"):
        compare(Path(data) / "livox_mid70_static" / "sequences" / sequence)


if __name__ == "__main__":
    main()
