"""Recognising a place of a saved map: guesses all over it, each registered, and the best one believed if it is clear.

It is clear where most of what was seen lies on surfaces of the map, walls facing two ways among it, and no other place
explains nearly as much.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from artemis_edge.frames import F32, F64, Bool
from artemis_edge.loop.correlation import Correlator
from artemis_edge.loop.facets import FACET_M, Facets, facets_of
from artemis_edge.odometry import se3
from artemis_edge.odometry.motion import Prediction
from artemis_edge.odometry.plane_map import PlaneMap
from artemis_edge.odometry.registration import register
from artemis_edge.odometry.thin import TimedPoints, first_per_voxel

_GUESSES = 24
_VOXEL_M, _LEVELS = 0.5, 4
_POINTS = 3000  # of a piece that are registered
_SIGMA_M = 0.03
_NEIGHBOURS = 4
_SAME_M, _SAME_COSINE = (
    0.08,
    0.9,
)  # a facet this near to the plane of another, and turned as little, lies on it
_LEAST_FACETS = 30  # walls, of a piece that can be recognised
# Of the walls seen, those that must be the map's: walls of another place agree by chance in up to 0.55 of them
_LEAST_SHARE = 0.65
_LEAST_SPREAD = 0.05  # smaller eigenvalue of the mean of n n' over those walls, level
_CLEAR = 4.0  # deviations of a count, by which no other place may come as near to explaining the walls
_APART_M, _APART_RAD = 1.0, 0.2  # places farther apart are others


class Place(NamedTuple):
    """T_map_piece (4, 4); ``share`` of the ``walls`` seen that the map has there, and of the next best place."""

    T_map_piece: F64
    share: float
    walls: int
    other: float = 0.0

    @property
    def clear(self) -> bool:
        """Are walls that only this place explains too many for chance? What neither explains counts as its noise."""
        noise = float(self.walls * (2.0 - self.share - self.other)) ** 0.5
        return bool(self.walls * (self.share - self.other) > _CLEAR * noise)


class Recognition:
    """Ready to find pieces in one map, points float32 (n, 3), z up."""

    def __init__(self, points: F32) -> None:
        self._facets = facets_of(points)
        self._correlator = Correlator(self._facets) if len(self._facets.centre) else None
        self._tree = KDTree(self._facets.centre) if len(self._facets.centre) else None
        voxels = len(first_per_voxel(points, _VOXEL_M, 0.0, np.inf))
        self._planes = PlaneMap(_VOXEL_M, _LEVELS, max(2 * voxels, 1))
        self._planes.insert(points, np.eye(4))

    def find(self, points: F32) -> Place | None:
        """Where a piece lies whose points float32 (n, 3) have z up; None if that is not clear."""
        places = self.places(points)
        if not places:
            return None
        other = max((p.share for p in places[1:] if _other(places[0], p)), default=0.0)
        best = places[0]._replace(other=other)
        return best if best.share >= _LEAST_SHARE and best.clear else None

    def places(self, points: F32) -> list[Place]:
        """All places that were looked at, the best first, whatever they are worth."""
        piece = facets_of(points)
        walls = int(np.count_nonzero(piece.upright()))
        if self._correlator is None or walls < _LEAST_FACETS:
            return []
        scan = TimedPoints(points, np.zeros(len(points), np.float32))
        scan = scan.take(np.arange(0, len(points), max(len(points) // _POINTS, 1)))
        found = []
        for guess in self._correlator.guesses(piece, _GUESSES):
            T = self._registered(scan, guess.T_map_piece, self._correlator.cell_m)
            found.append(Place(T, self._share(piece.moved(T)), walls))
        return sorted(found, key=lambda place: -place.share)

    def _registered(self, scan: TimedPoints, guess: F64, cell_m: float) -> F64:
        """Point to plane, from a guess that is right to a cell."""
        free = Prediction(guess, guess, 1.0, 2.0 * cell_m, 0.1, assumed=np.zeros(6))
        coarse = register(self._planes, scan, free, guess, cell_m, _SIGMA_M).T_world_lidar
        free = replace(free, T_world_lidar=coarse)
        fine: F64 = register(self._planes, scan, free, coarse, 0.2, _SIGMA_M).T_world_lidar
        return np.asarray(se3.orthonormal(fine), np.float64)

    def _share(self, piece: Facets) -> float:
        """Share of the walls of a piece that lie on the map's, 0 if those face one way only."""
        upright = piece.upright()
        walls = Facets(piece.centre[upright], piece.normal[upright])
        same = self._explained(walls)
        normal = walls.normal[same][:, :2]
        if len(normal) < 0.5 * _LEAST_FACETS:
            return 0.0
        if np.linalg.eigvalsh(normal.T @ normal / len(normal))[0] < _LEAST_SPREAD:
            return 0.0
        return float(same.mean())

    def _explained(self, piece: Facets) -> Bool:
        """Which facets (n,) lie on one of the map."""
        assert self._tree is not None
        away, near = self._tree.query(piece.centre, _NEIGHBOURS, distance_upper_bound=1.5 * FACET_M)
        found = np.zeros(len(piece.centre), np.bool_)
        for k in range(_NEIGHBOURS):
            known = np.flatnonzero(np.isfinite(away[:, k]))
            normal, centre = self._facets.normal[near[known, k]], self._facets.centre[near[known, k]]
            off = np.abs(np.einsum("ij,ij->i", normal, piece.centre[known] - centre))
            turned = np.abs(np.einsum("ij,ij->i", normal, piece.normal[known]))
            found[known] |= (off < _SAME_M) & (turned > _SAME_COSINE)
        return found


def _other(a: Place, b: Place) -> bool:
    off = se3.log(se3.inverse(a.T_map_piece) @ b.T_map_piece)
    return bool(np.linalg.norm(off[:3]) > _APART_M or np.linalg.norm(off[3:]) > _APART_RAD)
