"""Control points: places that are known in the map and in a coordinate reference system (CSV)."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from artemis_edge import topics
from artemis_edge.errors import InputError
from artemis_edge.frames import F64, Trajectory
from artemis_edge.session.feed import messages
from artemis_edge.session.messages import Imu, PointCloud2, Text
from artemis_edge.trajectory import covered, interpolate

# What surveyors' programs call the columns
_OTHER_NAMES = {
    "id": "name", "point": "name", "label": "name",
    "e": "east", "easting": "east", "n": "north", "northing": "north",
    "h": "up", "height": "up", "elevation": "up", "altitude": "up", "z_crs": "up",
    "lon": "longitude", "lat": "latitude",
}  # fmt: skip
_MAP, _GRID, _GLOBE = ("x", "y", "z"), ("east", "north", "up"), ("longitude", "latitude", "up")
_KNOWN = "name, x, y, z (or mark, above) and east, north, up (or longitude, latitude, up)"


@dataclass(frozen=True, slots=True)
class ControlPoint:
    """A place: ``world`` (3,) in the map's frame, m; ``given`` (3,) east, north, up or longitude, latitude, height.

    Without ``world`` it is where the scanner was at mark number ``mark``, ``above_m`` over the point.
    """

    name: str
    given: tuple[float, float, float]
    world: tuple[float, float, float] | None = None
    mark: int = 0
    above_m: float = 0.0


def read_control_points(path: Path) -> tuple[list[ControlPoint], bool]:
    """The rows of a CSV file, and whether they give longitude and latitude (degrees) instead of east and north.

    The first row names the columns; fields are parted by commas, semicolons or tabs. Raises InputError, one sentence.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"cannot read the control points {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is no text file; control points are a CSV file with {_KNOWN}") from None
    rows = _rows(path, text)
    columns = set(rows[0][1]) if rows else set()
    on_globe = set(_GLOBE) <= columns
    if not rows or not (on_globe or set(_GRID) <= columns) or not (set(_MAP) <= columns or "mark" in columns):
        raise InputError(f"{path}: the first row must name the columns {_KNOWN}, and rows must follow")
    points = [_point(f"{path}, line {line}", number, row) for number, (line, row) in enumerate(rows, 1)]
    names = [point.name for point in points]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{path}: two control points are named {twice}; give each its own name")
    return points, on_globe


def _rows(path: Path, text: str) -> list[tuple[int, dict[str, str]]]:
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip() and line[0] != "#"]
    if not lines:
        return []
    parted = max(",;\t", key=lines[0][1].count)
    try:
        fields = [next(csv.reader(io.StringIO(line), delimiter=parted)) for _, line in lines]
    except csv.Error as error:
        raise InputError(f"{path} is no CSV file: {error}") from None
    head = [_OTHER_NAMES.get(name, name) for name in (cell.strip().lower() for cell in fields[0])]
    found = []
    for (number, _), cells in zip(lines[1:], fields[1:], strict=True):
        if len(cells) != len(head):
            raise InputError(f"{path}, line {number} has {len(cells)} columns, the first row {len(head)}")
        found.append((number, {name: cell.strip() for name, cell in zip(head, cells, strict=True)}))
    return found


def _point(where: str, number: int, row: Mapping[str, str]) -> ControlPoint:
    given = _three(where, row, _GLOBE if "longitude" in row else _GRID)
    name = row.get("name") or str(number)
    if any(row.get(axis) for axis in _MAP):
        return ControlPoint(name, given, _three(where, row, _MAP))
    mark = row.get("mark", "")
    if not mark.isdecimal():
        raise InputError(f"{where}: {name} has neither x, y, z nor the number of a mark")
    return ControlPoint(
        name, given, None, int(mark), _number(where, row, "above") if row.get("above") else 0.0
    )


def _three(where: str, row: Mapping[str, str], names: tuple[str, str, str]) -> tuple[float, float, float]:
    a, b, c = (_number(where, row, name) for name in names)
    return a, b, c


def _number(where: str, row: Mapping[str, str], name: str) -> float:
    text = row.get(name, "")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{where}: '{text}' for {name} is no number; decimals are written with a point")
    return value


def places(points: list[ControlPoint], trajectory: Trajectory, session: Path | None) -> F64:
    """Where the points are in the map, float64 (n, 3); marks are looked up in the recording ``session``."""
    wanted = [point for point in points if point.world is None]
    if wanted and session is None:
        raise InputError(f"{wanted[0].name} is a mark; say with --session in which recording it was set")
    stamps = mark_stamps(session) if wanted and session is not None else {}
    return np.array([point.world or _at_mark(point, stamps, trajectory) for point in points])


def _at_mark(point: ControlPoint, stamps: Mapping[int, int], trajectory: Trajectory) -> tuple[float, ...]:
    if point.mark not in stamps:
        there = ", ".join(map(str, stamps)) or "none"
        raise InputError(f"{point.name}: the recording has no mark {point.mark}; it has {there}")
    stamp = np.array([stamps[point.mark]])
    if not covered(trajectory, stamp)[0]:
        raise InputError(f"{point.name}: mark {point.mark} was set at a time that the map does not cover")
    position = interpolate(trajectory, stamp)[0, :3, 3] - np.array([0.0, 0.0, point.above_m])
    return tuple(position.tolist())


def mark_stamps(session: Path) -> dict[int, int]:
    """Session time of each mark of a recording, ns: that of the sample or cloud received last before it."""
    found: dict[int, int] = {}
    latest = 0
    for sent in messages(session):
        if sent.topic == topics.EVENTS.name and b'"mark"' in sent.data:
            event = json.loads(Text.decode(sent.data).text)
            if event.get("kind") == "mark":
                found[int(event["number"])] = latest
        elif sent.ros_type == Imu.ROS_TYPE:
            latest = max(latest, Imu.decode(sent.data).header.stamp_ns)
        elif sent.ros_type == PointCloud2.ROS_TYPE:
            latest = max(latest, PointCloud2.decode(sent.data).header.stamp_ns)
    return found
