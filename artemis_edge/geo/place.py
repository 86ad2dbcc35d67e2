"""Where a map lies in a coordinate reference system; kept beside it as ``map/georeference.json``.

Heights are taken as they are given: with a CRS that has none of its own they count as heights above the ellipsoid, and
an error of 50 m there (a geoid) changes distances by 8 ppm.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from artemis_edge.errors import InputError
from artemis_edge.export.atomic import write_bytes
from artemis_edge.frames import F32, F64
from artemis_edge.geo.control_points import places, read_control_points
from artemis_edge.geo.fit import Fit, fit
from artemis_edge.geo.grid import Grid
from artemis_edge.opened_map import map_folder
from artemis_edge.trajectory import read_tum

FILE = "georeference.json"
_OFFSET_STEP_M = 100.0  # float32 holds what is left to a tenth of a millimetre over a kilometre
_STEP_M = 1.0  # to tell the directions of the grid


class Residual(Struct, frozen=True):
    """A control point: ``off`` east, north, up and ``distance_m`` of the map from it, m; ``left_out_m`` without it."""

    name: str
    given: tuple[float, float, float]
    off: tuple[float, float, float]
    distance_m: float
    left_out_m: float | None = None


class Georeference(Struct, frozen=True):
    """``T_ecef_world`` rows (4 x 4) maps to geocentric coordinates, m; ``offset`` of mesh exports, in the CRS."""

    epsg: int
    name: str
    wkt: str
    T_ecef_world: tuple[tuple[float, float, float, float], ...]
    offset: tuple[float, float, float]
    rms_m: float
    left_out_rms_m: float | None
    scale: float
    tilt_deg: float
    points: tuple[Residual, ...]


@dataclass(frozen=True, slots=True)
class Placed:
    """A georeference at work: ``to_crs`` needs the extra ``geo``."""

    georeference: Georeference
    grid: Grid

    @classmethod
    def of(cls, georeference: Georeference) -> Placed:
        """InputError without the extra."""
        return cls(georeference, Grid(georeference.epsg))

    def to_crs(self, points: F32 | F64) -> F64:
        """Points (n, 3) of the map as east, north, up, float64."""
        T = np.array(self.georeference.T_ecef_world)
        return self.grid.of_geocentric(np.asarray(points, np.float64) @ T[:3, :3].T + T[:3, 3])

    def to_local(self, points: F32) -> F32:
        """The same less the offset, which float32 can hold."""
        local: F32 = (self.to_crs(points) - np.array(self.georeference.offset)).astype(np.float32)
        return local

    def turned(self, directions: F32, at: F32) -> F32:
        """Directions (n, 3) of the map in the axes of the grid, as they are around the point ``at`` (3,)."""
        ends = self.to_crs(at.astype(np.float64) + _STEP_M * np.concatenate([np.zeros((1, 3)), np.eye(3)]))
        U, _, Vt = np.linalg.svd((ends[1:] - ends[0]).T)
        found: F32 = (directions @ (U @ Vt).T).astype(np.float32)
        return found

    @property
    def words(self) -> list[str]:
        """For the comments of a file."""
        g = self.georeference
        east, north, up = (f"{value:.0f}" for value in g.offset)
        return [f"crs EPSG:{g.epsg}", f"offset {east} {north} {up}"]


def georeference(
    map_path: Path, control: Path, epsg: int, most_rms_m: float, session: Path | None = None
) -> Georeference:
    """Fit a map to control points and keep the result beside it.

    Raises InputError, one sentence, where the points, the CRS or their fit are no good; nothing is kept then.
    """
    folder = map_folder(map_path)
    if folder is None:
        raise InputError(f"{map_path} is no output directory of `artemis-edge reprocess`, run or demo")
    grid = Grid(epsg)
    points, on_globe = read_control_points(control)
    world = places(points, read_tum(folder.parent / "trajectory.tum"), session)
    given = np.array([point.given for point in points])
    given = grid.of_globe(given) if on_globe else given
    grid.require_area(given)
    ecef = grid.geocentric(given)
    R, origin = _east_north_up(grid, given)
    names = [point.name for point in points]
    found = fit(names, world, (ecef - origin) @ R, most_rms_m)
    T = np.eye(4)
    T[:3, :3] = R @ found.T_local_world[:3, :3]
    T[:3, 3] = R @ found.T_local_world[:3, 3] + origin
    made = _made(grid, T, found, names, given)
    write_bytes(folder / FILE, msgspec.json.format(msgspec.json.encode(made), indent=2) + b"\n")
    return made


def read_georeference(folder: Path) -> Georeference | None:
    """That of a map's folder ``map/``; None where it has none, InputError if the file is damaged."""
    path = folder / FILE
    if not path.is_file():
        return None
    try:
        return msgspec.json.decode(path.read_bytes(), type=Georeference)
    except msgspec.MsgspecError:
        raise InputError(
            f"{path} is damaged or of another version; run `artemis-edge georeference` again"
        ) from None


def to_json(made: Georeference) -> dict[str, Any]:
    """For ``report.json``: without the text of the CRS."""
    found: dict[str, Any] = json.loads(msgspec.json.encode(made))
    del found["wkt"]
    return found


def _made(grid: Grid, T: F64, found: Fit, names: list[str], given: F64) -> Georeference:
    middle = given.mean(axis=0)
    offset = np.floor(middle / _OFFSET_STEP_M) * _OFFSET_STEP_M
    left_out = found.left_out
    off = np.linalg.norm(found.residual, axis=1)
    known = None if left_out is None or np.isnan(left_out).all() else left_out[~np.isnan(left_out)]
    residuals = tuple(
        Residual(
            name,
            _triple(given[k]),
            _triple(-found.residual[k]),
            round(float(off[k]), 4),
            None if left_out is None or np.isnan(left_out[k]) else round(float(left_out[k]), 4),
        )
        for k, name in enumerate(names)
    )
    return Georeference(
        grid.epsg,
        grid.crs.name,
        grid.wkt,
        tuple(tuple(row) for row in T.tolist()),
        (float(offset[0]), float(offset[1]), 0.0),
        round(found.rms_m, 4),
        None if known is None else round(float(np.sqrt((known**2).mean())), 4),
        round(found.scale, 6),
        round(found.tilt_deg, 3),
        residuals,
    )


def _triple(values: F64) -> tuple[float, float, float]:
    a, b, c = (round(float(value), 4) for value in values)
    return a, b, c


def _east_north_up(grid: Grid, given: F64) -> tuple[F64, F64]:
    """R_ecef_enu (3, 3) and the origin (3,) of a local frame in the middle of points (n, 3) of the grid."""
    middle = given.mean(axis=0, keepdims=True)
    lon, lat, _ = grid.geodetic(middle)[0]
    lam, phi = np.radians(lon), np.radians(lat)
    east = [-np.sin(lam), np.cos(lam), 0.0]
    north = [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)]
    up = [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)]
    return np.array([east, north, up]).T, grid.geocentric(middle)[0]
