"""LAZ (LAS 1.4, point format 7) of the coloured input points: position, intensity, time, colour, label.

``classification`` is the label of the mesh where it is near (0: background or no mesh); the names of the labels stand
in the file's classification lookup. GPS time is session time in seconds. Colours are 0 where no image saw the point.
Of a map with a georeference the coordinates are those of its CRS, which stands in the file as WKT.
"""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from artemis_edge.errors import InputError
from artemis_edge.export.atomic import replacing
from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import F32, F64, U8
from artemis_edge.geo.place import Placed
from artemis_edge.kept_points import TICKS_PER_S, KeptPoints, Rows
from artemis_edge.progress import Report, silent

_STEP_M = 0.001
_POINT_FORMAT, _VERSION = 7, "1.4"
_GENERATOR = "artemis-edge"
# Beyond this a point is not of the surface whose label it would take [m].
_LABEL_REACH_M = 0.2
_EIGHT_TO_SIXTEEN = 257  # 255 becomes 65535, as LAS demands
# Classification lookup of LAS 1.2 to 1.4: 256 entries of a class number and a name of 15 bytes
_LOOKUP_USER, _LOOKUP_RECORD, _LOOKUP_NAME = "LASF_Spec", 0, 15
_WKT_USER, _WKT_RECORD = "LASF_Projection", 2112


def write_laz(
    path: Path, kept: KeptPoints, mesh: Mesh, report: Report = silent, placed: Placed | None = None
) -> None:
    """Write the points of a map; the same map gives the same bytes, whatever the day.

    Raises InputError when laspy is not installed, RunError when the file cannot be written.
    """
    laspy = _laspy()
    header = _header(laspy, kept, mesh.label_names, placed)
    labels = _Labels(mesh)
    total, done = kept.rows, 0
    with replacing(path) as file:
        backend = laspy.LazBackend.Lazrs
        with laspy.open(
            file, mode="w", header=header, do_compress=True, laz_backend=backend, closefd=False
        ) as las:
            for rows in kept.chunks():
                las.write_points(_records(laspy, header, rows, kept, labels, placed))
                done += len(rows)
                report(done, total)


def _laspy() -> Any:
    try:
        import laspy

        laspy.LazBackend.Lazrs  # noqa: B018  (an old laspy without it)
    except (ImportError, AttributeError):
        laspy = None
    if laspy is None or not laspy.LazBackend.Lazrs.is_available():
        raise InputError("LAZ needs the extra 'export': pip install 'artemis-edge[export]'")
    return laspy


def _header(laspy: Any, kept: KeptPoints, names: dict[int, str], placed: Placed | None) -> Any:
    header = laspy.LasHeader(version=_VERSION, point_format=_POINT_FORMAT)
    low, high = _bounds(kept, placed)
    header.scales = np.full(3, _STEP_M)
    header.offsets = np.floor(0.5 * (low + high))
    header.generating_software = _GENERATOR
    day = datetime.datetime.fromtimestamp(max(kept.zero_ns, 0) * 1e-9, datetime.UTC)
    header.creation_date = day.date()  # the recording's, so that equal maps give equal files
    header.vlrs.append(
        laspy.VLR(
            user_id=_LOOKUP_USER,
            record_id=_LOOKUP_RECORD,
            description="names of classes",
            record_data=_lookup(names),
        )
    )
    if placed is not None:
        header.global_encoding.wkt = True
        header.vlrs.append(
            laspy.VLR(
                user_id=_WKT_USER,
                record_id=_WKT_RECORD,
                description="coordinate reference system",
                record_data=placed.georeference.wkt.encode() + b"\0",
            )
        )
    return header


def _bounds(kept: KeptPoints, placed: Placed | None) -> tuple[F64, F64]:
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for rows in kept.chunks():
        position = _position(rows, placed)
        low, high = np.minimum(low, position.min(axis=0)), np.maximum(high, position.max(axis=0))
    half_range_m = np.iinfo(np.int32).max * _STEP_M
    if not (high - low < half_range_m).all():
        raise InputError("the points spread over more than 2,000 km; their poses must be wrong")
    return low, high


def _lookup(names: dict[int, str]) -> bytes:
    entries = bytearray()
    for number in range(256):
        name = names.get(number, "").encode("ascii", errors="replace")[:_LOOKUP_NAME]
        entries += bytes([number]) + name.ljust(_LOOKUP_NAME, b"\0")
    return bytes(entries)


def _position(rows: Rows, placed: Placed | None) -> F64:
    """In the map, or in its CRS."""
    return rows["position"].astype(np.float64) if placed is None else placed.to_crs(rows["position"])


def _records(
    laspy: Any, header: Any, rows: Rows, kept: KeptPoints, labels: _Labels, placed: Placed | None
) -> Any:
    out = laspy.ScaleAwarePointRecord.zeros(len(rows), header=header)
    position = _position(rows, placed)
    out.x, out.y, out.z = position[:, 0], position[:, 1], position[:, 2]
    out.intensity = rows["intensity"]
    out.gps_time = kept.zero_ns * 1e-9 + rows["tick"] / TICKS_PER_S
    out.return_number = out.number_of_returns = np.ones(len(rows), np.uint8)
    colour = np.where((rows["seen"] > 0)[:, None], rows["colour"], 0).astype(np.uint16) * _EIGHT_TO_SIXTEEN
    out.red, out.green, out.blue = colour[:, 0], colour[:, 1], colour[:, 2]
    out.classification = labels.of(rows["position"])
    return out


class _Labels:
    """The label of the nearest vertex, 0 beyond reach; costs nothing where all are background."""

    def __init__(self, mesh: Mesh) -> None:
        self._labels = mesh.labels
        self._tree = cKDTree(mesh.vertices) if mesh.labels.any() else None

    def of(self, points: F32) -> U8:
        if self._tree is None:
            return np.zeros(len(points), np.uint8)
        distance, nearest = self._tree.query(points, distance_upper_bound=_LABEL_REACH_M)
        near = np.isfinite(distance)
        found: U8 = np.where(near, self._labels[np.where(near, nearest, 0)], 0).astype(np.uint8)
        return found
