"""The local map of the odometry: planes in voxels of several sizes, bounded in memory.

Every voxel keeps running moments of its points; a plane is fitted when it is asked for and its voxel has
changed enough. Planes of voxels replace the k nearest neighbours of other methods at a third to a fifth of
the cost, and the moments give the plane's own uncertainty (the idea of Yuan et al., VoxelMap, RA-L 2022;
used here is the prediction variance of a linear regression).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from artemis_edge._jit import njit
from artemis_edge.eigen3 import smallest_eigen3
from artemis_edge.frames import F32, F64, I64, Bool

EMPTY = -1
_AXIS_BITS = 20  # +-2^19 voxels of 0.5 m are +-262 km
_HALF = 1 << (_AXIS_BITS - 1)
_AXIS_MASK = (1 << _AXIS_BITS) - 1
_MIX = 0x9E3779B97F4A7C15 - (1 << 64)  # 2^64 / golden ratio spreads neighbouring keys (Knuth 6.4)

MIN_POINTS = 6  # three define a plane, three more say how well
_MAX_POINTS = 400.0  # then the moments are halved: the map follows a scene that changes
_REFIT_GROWTH = 1.2  # a plane is fitted anew when its voxel has 20 % more points
_MAX_THICKNESS = 0.05  # smallest / middle eigenvalue: where a scan line turns a corner it is larger
_MIN_WIDTH = 0.02  # deviation across, as a share of the voxel: what is narrower is a line, of any normal
_SHRINK = 0.8  # radius kept when the map is full is shortened by this until half the slots are free


# Columns of a row; what registration reads comes first.
FITTED = 0  # points at the last fit
THICKNESS = 1  # variance of the plane along its normal, m2; negative: no plane
NORMAL = 2  # unit vector, 3
CENTRE = 5  # world, m, 3
SPREAD = 8  # inverse in-plane covariance xx xy xz yy yz zz, 1/m2, 6
COUNT = 14  # points
MOMENTS = 15  # sums of x y z xx xy xz yy yz zz about the voxel's lower corner, m and m2, 9
_COLUMNS = 24


class Table(NamedTuple):
    """Arrays of the map, as kernels take them.

    ``hash`` int64 (2^k, 2) is an open-addressing hash of key and slot, ``keys`` int64 (capacity,) the key
    of each slot, ``rows`` float64 (capacity, 24) its voxel: the columns above.
    """

    hash: I64
    keys: I64
    rows: F64


class PlaneMap:
    """Voxel planes at ``levels`` sizes ``voxel_m * 2^level``, at most ``capacity`` voxels in all."""

    def __init__(self, voxel_m: float, levels: int, capacity: int) -> None:
        self.voxel_m = voxel_m
        self.levels = levels
        self.capacity = capacity
        self.table = Table(empty_hash(capacity), np.empty(capacity, np.int64), np.empty((capacity, _COLUMNS)))
        self._used = 0

    def __len__(self) -> int:
        return self._used

    def clear(self) -> None:
        """Forget everything."""
        self.table.hash.fill(EMPTY)
        self._used = 0

    def insert(self, points: F32, T_world_lidar: F64) -> int:
        """Add points float32 (n, 3) of the lidar frame; returns how many found no room (see ``evict``).

        The scan is first summed into its own cells, whose sums go to the map and then into cells of twice the
        size: a fifth of the look-ups in the large table.
        """
        refused = 0
        cells, sums = sum_points(points, T_world_lidar, self.voxel_m)
        for level in range(self.levels):
            if level:
                cells, sums = coarsen(cells, sums, self.voxel_m * (1 << (level - 1)))
            self._used, left_out = add_cells(self.table, self._used, level, cells, sums)
            refused = max(refused, int(left_out))
        return refused

    def evict(self, centre: F64, radius_m: float) -> float:
        """Forget voxels farther than the radius from a place in world, nearer ones too until half is free.

        Returns the radius that is kept.
        """
        keep = nearby(self.table.keys[: self._used], centre, radius_m, self.voxel_m)
        while np.count_nonzero(keep) > self.capacity // 2:
            radius_m *= _SHRINK
            keep = nearby(self.table.keys[: self._used], centre, radius_m, self.voxel_m)
        if not keep.all():
            self.table.hash.fill(EMPTY)
            self._used = int(compact(self.table, keep))
        return radius_m

    def level_of(self, size_m: float) -> int:
        """The finest level whose voxels are not smaller than a size, or the coarsest."""
        level = 0
        while level < self.levels - 1 and self.voxel_m * (1 << level) < size_m:
            level += 1
        return level

    def planes(self, level: int) -> tuple[F64, F64, F64]:
        """Normals (n, 3), centres (n, 3) and thickness variances (n,) of the planes of a level."""
        fit_all(self.table, self._used, self.voxel_m)
        rows = self.table.rows[: self._used][self.table.keys[: self._used] >> (3 * _AXIS_BITS) == level]
        rows = rows[rows[:, THICKNESS] >= 0.0]
        return rows[:, NORMAL : NORMAL + 3], rows[:, CENTRE : CENTRE + 3], rows[:, THICKNESS]


@njit
def cell_key(level: int, x: int, y: int, z: int) -> int:
    """Key of the voxel (x, y, z) of a level, counted in voxels of that level."""
    upper = ((level << _AXIS_BITS) | (x + _HALF)) << _AXIS_BITS
    return ((upper | (y + _HALF)) << _AXIS_BITS) | (z + _HALF)


@njit
def voxel_key(level: int, x: int, y: int, z: int) -> int:
    """Key of the voxel of a level that holds the finest voxel (x, y, z)."""
    key: int = cell_key(level, x >> level, y >> level, z >> level)
    return key


@njit
def _size(key: int, voxel_m: float) -> float:
    """Edge of a voxel, m."""
    return voxel_m * (1 << (key >> (3 * _AXIS_BITS)))


@njit
def _corner(key: int, voxel_m: float) -> tuple[float, float, float]:
    """Lower corner of a voxel in world, m."""
    size = _size(key, voxel_m)
    x = ((key >> (2 * _AXIS_BITS)) & _AXIS_MASK) - _HALF
    y = ((key >> _AXIS_BITS) & _AXIS_MASK) - _HALF
    z = (key & _AXIS_MASK) - _HALF
    return x * size, y * size, z * size


@njit
def empty_hash(entries: int) -> I64:
    """An open-addressing hash int64 (2^k, 2) of key and value, at most half full with so many entries."""
    size = 1
    while size < 2 * entries:
        size *= 2
    return np.full((size, 2), EMPTY)


@njit
def probe(table: I64, key: int) -> int:
    """Place of the key in the hash, or the empty place where it belongs."""
    mask = len(table) - 1
    mixed = key * _MIX
    i = (mixed ^ (mixed >> 29)) & mask
    while table[i, 0] != key and table[i, 0] != EMPTY:
        i = (i + 1) & mask
    return i


@njit
def sum_points(points: F32, T_world_lidar: F64, voxel_m: float) -> tuple[I64, F64]:
    """Finest cells int64 (m, 3) touched in world, with count and moments (m, 10) about their corners."""
    T, n, inverse = T_world_lidar, 0, 1.0 / voxel_m
    table = empty_hash(len(points))
    cells, sums = np.empty((len(points), 3), np.int64), np.empty((len(points), 10))
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        ix, iy, iz = int(np.floor(x * inverse)), int(np.floor(y * inverse)), int(np.floor(z * inverse))
        key = cell_key(0, ix, iy, iz)
        place = probe(table, key)
        if table[place, 0] == EMPTY:
            table[place, 0], table[place, 1] = key, n
            cells[n, 0], cells[n, 1], cells[n, 2] = ix, iy, iz
            sums[n] = 0.0
            n += 1
        x, y, z = x - ix * voxel_m, y - iy * voxel_m, z - iz * voxel_m
        s = sums[table[place, 1]]
        s[0] += 1.0
        s[1] += x
        s[2] += y
        s[3] += z
        s[4] += x * x
        s[5] += x * y
        s[6] += x * z
        s[7] += y * y
        s[8] += y * z
        s[9] += z * z
    return cells[:n], sums[:n]


@njit
def coarsen(cells: I64, sums: F64, size_m: float) -> tuple[I64, F64]:
    """Cells of twice the size, and their sums; ``size_m`` is the edge of the given cells."""
    n = 0
    table = empty_hash(len(cells))
    out_cells, out = np.empty((len(cells), 3), np.int64), np.empty((len(cells), 10))
    for i in range(len(cells)):
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        key = voxel_key(1, x, y, z)
        place = probe(table, key)
        if table[place, 0] == EMPTY:
            table[place, 0], table[place, 1] = key, n
            out_cells[n, 0], out_cells[n, 1], out_cells[n, 2] = x >> 1, y >> 1, z >> 1
            out[n] = 0.0
            n += 1
        _add_shifted(out[table[place, 1]], sums[i], (x & 1) * size_m, (y & 1) * size_m, (z & 1) * size_m)
    return out_cells[:n], out[:n]


@njit
def _add_shifted(m: F64, s: F64, dx: float, dy: float, dz: float) -> None:
    """Add sums (10,) to others about a corner that lies (dx, dy, dz) lower."""
    n, x, y, z = s[0], s[1], s[2], s[3]
    m[0] += n
    m[1] += x + n * dx
    m[2] += y + n * dy
    m[3] += z + n * dz
    m[4] += s[4] + (2.0 * x + n * dx) * dx
    m[5] += s[5] + x * dy + y * dx + n * dx * dy
    m[6] += s[6] + x * dz + z * dx + n * dx * dz
    m[7] += s[7] + (2.0 * y + n * dy) * dy
    m[8] += s[8] + y * dz + z * dy + n * dy * dz
    m[9] += s[9] + (2.0 * z + n * dz) * dz


@njit
def add_cells(table: Table, used: int, level: int, cells: I64, sums: F64) -> tuple[int, int]:
    """Add the sums of cells to their voxels; returns slots used and points refused for want of room."""
    refused = 0
    for i in range(len(cells)):
        key = cell_key(level, cells[i, 0], cells[i, 1], cells[i, 2])
        place = probe(table.hash, key)
        if table.hash[place, 0] == EMPTY:
            if used == len(table.rows):
                refused += int(sums[i, 0])
                continue
            table.hash[place, 0], table.hash[place, 1], table.keys[used] = key, used, key
            table.rows[used] = 0.0
            table.rows[used, THICKNESS] = -1.0
            used += 1
        row = table.rows[table.hash[place, 1]]
        if row[COUNT] >= _MAX_POINTS:
            row[COUNT:] *= 0.5
            row[FITTED] *= 0.5
        for k in range(10):
            row[COUNT + k] += sums[i, k]
    return used, refused


@njit
def refresh(table: Table, slot: int, voxel_m: float) -> bool:
    """Fit the slot's plane if its voxel grew enough since the last fit; is there a plane?"""
    n = table.rows[slot, COUNT]
    if n >= MIN_POINTS and n >= _REFIT_GROWTH * table.rows[slot, FITTED]:
        _fit(table.rows[slot], table.keys[slot], voxel_m)
    return bool(table.rows[slot, THICKNESS] >= 0.0)


@njit
def _fit(row: F64, key: int, voxel_m: float) -> None:
    """Plane of the moments: normal, centre, thickness, in-plane spread; none where they are no thin sheet."""
    n, s = row[COUNT], row[MOMENTS:]
    mx, my, mz = s[0] / n, s[1] / n, s[2] / n
    xx, xy, xz = s[3] / n - mx * mx, s[4] / n - mx * my, s[5] / n - mx * mz
    yy, yz, zz = s[6] / n - my * my, s[7] / n - my * mz, s[8] / n - mz * mz
    e = np.empty(6)
    smallest_eigen3(xx, xy, xz, yy, yz, zz, e)
    a, b, c, thin, middle, wide = e
    row[FITTED], row[THICKNESS] = n, -1.0
    if not (thin <= _MAX_THICKNESS * middle and middle >= (_MIN_WIDTH * _size(key, voxel_m)) ** 2):
        return
    row[THICKNESS] = max(thin, 0.0) * n / (n - 3.0)  # a plane leaves n - 3 degrees of freedom
    row[NORMAL], row[NORMAL + 1], row[NORMAL + 2] = a, b, c
    cx, cy, cz = _corner(key, voxel_m)
    row[CENTRE], row[CENTRE + 1], row[CENTRE + 2] = mx + cx, my + cy, mz + cz
    # the inverse within the plane, by Cayley-Hamilton for the two in-plane eigenvalues
    trace, inverse = middle + wide, 1.0 / (middle * wide)
    m = row[SPREAD:]
    m[0] = (trace * (1.0 - a * a) - xx + thin * a * a) * inverse
    m[1] = (-trace * a * b - xy + thin * a * b) * inverse
    m[2] = (-trace * a * c - xz + thin * a * c) * inverse
    m[3] = (trace * (1.0 - b * b) - yy + thin * b * b) * inverse
    m[4] = (-trace * b * c - yz + thin * b * c) * inverse
    m[5] = (trace * (1.0 - c * c) - zz + thin * c * c) * inverse


@njit
def fit_all(table: Table, used: int, voxel_m: float) -> None:
    """Bring every plane up to date."""
    for slot in range(used):
        refresh(table, slot, voxel_m)


@njit
def nearby(keys: I64, centre: F64, radius_m: float, voxel_m: float) -> Bool:
    """Which voxels have their corner within the radius of a place in world."""
    keep = np.empty(len(keys), np.bool_)
    for slot in range(len(keys)):
        x, y, z = _corner(keys[slot], voxel_m)
        keep[slot] = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2 <= radius_m**2
    return keep


@njit
def compact(table: Table, keep: Bool) -> int:
    """Move the kept slots to the front, in order, and refill the emptied hash; returns slots used."""
    used = 0
    for slot in range(len(keep)):
        if keep[slot]:
            key = table.keys[slot]
            place = probe(table.hash, key)
            table.hash[place, 0], table.hash[place, 1], table.keys[used] = key, used, key
            table.rows[used] = table.rows[slot]
            used += 1
    return used
