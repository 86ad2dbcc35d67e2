"""Flat pieces of a cloud: what places are recognised by."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from artemis_edge.frames import F32, F64, Bool
from artemis_edge.odometry.plane_map import PlaneMap
from artemis_edge.odometry.thin import first_per_voxel

FACET_M = 1.0  # edge of the voxels that a plane is fitted in
_LEVEL_COSINE = 0.9  # a floor, a ceiling
_UPRIGHT_COSINE = 0.4


class Facets(NamedTuple):
    """Centres float64 (n, 3), m, and unit normals (n, 3) of either sign, z up."""

    centre: F64
    normal: F64

    def moved(self, T: F64) -> Facets:
        """Transformed by T (4, 4)."""
        return Facets(self.centre @ T[:3, :3].T + T[:3, 3], self.normal @ T[:3, :3].T)

    def level(self) -> Bool:
        """Which (n,) are floors or ceilings."""
        return np.asarray(np.abs(self.normal[:, 2]) > _LEVEL_COSINE)

    def upright(self) -> Bool:
        """Which (n,) are walls and the like."""
        return np.asarray(np.abs(self.normal[:, 2]) < _UPRIGHT_COSINE)


def facets_of(points: F32) -> Facets:
    """Of points float32 (n, 3) with z up."""
    voxels = len(first_per_voxel(points, FACET_M, 0.0, np.inf))
    planes = PlaneMap(FACET_M, 1, max(voxels, 1))
    planes.insert(points, np.eye(4))
    normal, centre, _ = planes.planes(0)
    return Facets(centre, normal)
