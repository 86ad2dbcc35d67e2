"""Coordinate reference systems with east, north and height in metres, through pyproj (extra ``geo``)."""

from __future__ import annotations

from typing import Any

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import F64

_MARGIN_DEG = 1.0  # by which points may lie outside of a CRS's area: borders are not exact


class Grid:
    """A projected CRS with heights, and its own ellipsoid's geocentric coordinates: no change of datum in between."""

    def __init__(self, epsg: int) -> None:
        """InputError without the extra ``geo``, and for a CRS without east and north in metres."""
        self.pyproj = pyproj = _pyproj()
        self.epsg, self.crs = epsg, _crs(pyproj, epsg)
        flat = self.crs.sub_crs_list[0] if self.crs.is_compound else self.crs
        self._flat = flat.to_3d() if len(flat.axis_info) == 2 else flat
        ellipsoid = flat.ellipsoid
        axes = f"+a={ellipsoid.semi_major_metre!r} +b={ellipsoid.semi_minor_metre!r}"
        self._geodetic = pyproj.Transformer.from_crs(self._flat, flat.geodetic_crs.to_3d(), always_xy=True)
        self._cartesian = pyproj.Transformer.from_pipeline(
            f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart {axes}"
        )

    def geodetic(self, grid: F64) -> F64:
        """Longitude, latitude (degrees, of the CRS's own datum) and height of east, north, up (n, 3)."""
        return _transformed(self._geodetic, grid)

    def geocentric(self, grid: F64) -> F64:
        """Geocentric coordinates (n, 3), m, of east, north, up (n, 3)."""
        return _transformed(self._cartesian, self.geodetic(grid))

    def of_geocentric(self, points: F64) -> F64:
        """Inverse of ``geocentric``."""
        back = _transformed(self._cartesian, points, "INVERSE")
        return _transformed(self._geodetic, back, "INVERSE")

    def of_globe(self, globe: F64) -> F64:
        """East, north, up (n, 3) of WGS 84 longitude, latitude (degrees) and height (n, 3)."""
        transformer = self.pyproj.Transformer.from_crs("EPSG:4979", self._flat, always_xy=True)
        return _transformed(transformer, globe)

    def require_area(self, given: F64) -> None:
        """InputError if east, north, up (n, 3) are not where the CRS is for."""
        lon, lat, _ = self.geodetic(given).T
        area, epsg = self.crs.area_of_use, self.epsg
        if not (np.isfinite(lon).all() and np.isfinite(lat).all()):
            raise InputError(
                f"the control points lie nowhere on Earth in EPSG:{epsg}; check the code and the columns"
            )
        if area is None:
            return
        within = (area.west - _MARGIN_DEG <= lon) & (lon <= area.east + _MARGIN_DEG)
        if area.west > area.east:  # across the date line
            within = (area.west - _MARGIN_DEG <= lon) | (lon <= area.east + _MARGIN_DEG)
        within &= (area.south - _MARGIN_DEG <= lat) & (lat <= area.north + _MARGIN_DEG)
        if not within.all():
            worst = int(np.argmin(within))
            raise InputError(
                f"the control points lie at {lon[worst]:.2f} degrees east, {lat[worst]:.2f} north, outside of the "
                f"area of EPSG:{epsg} ({area.name}); check the code, and whether east and north are exchanged"
            )

    @property
    def wkt(self) -> str:
        """As LAS 1.4 demands it (OGC 01-009), newer where that cannot say it."""
        try:
            return str(self.crs.to_wkt("WKT1_GDAL"))
        except self.pyproj.exceptions.CRSError:
            return str(self.crs.to_wkt())


def _pyproj() -> Any:
    try:
        import pyproj
    except ImportError:
        raise InputError(
            "coordinates of a country need the extra 'geo': pip install 'artemis-edge[geo]'"
        ) from None
    return pyproj


def _crs(pyproj: Any, epsg: int) -> Any:
    try:
        crs = pyproj.CRS.from_epsg(epsg)
    except pyproj.exceptions.CRSError:
        raise InputError(f"there is no CRS with the EPSG code {epsg}; UTM zone 32 north is 32632") from None
    units = {axis.unit_name for axis in crs.axis_info}
    if not (crs.is_projected or (crs.is_compound and crs.sub_crs_list[0].is_projected)) or units != {"metre"}:
        raise InputError(
            f"EPSG:{epsg} ({crs.name}) has no east and north in metres; give a projected CRS, such as a UTM zone"
        )
    if {axis.unit_name for axis in crs.geodetic_crs.axis_info} != {"degree"}:
        raise InputError(
            f"EPSG:{epsg} ({crs.name}) rests on other angles than degrees; give a newer CRS of that place"
        )
    return crs


def _transformed(transformer: Any, points: F64, direction: str = "FORWARD") -> F64:
    columns = transformer.transform(points[:, 0], points[:, 1], points[:, 2], direction=direction)
    return np.asarray(np.stack(columns, axis=1), np.float64)
