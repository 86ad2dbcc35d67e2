"""Memory of the surface's texture: squares of texels that hang on space, not on triangles.

A chart is one face of one voxel: texels in a square grid parallel to two axes, seen along the third. A point of
the surface belongs to the chart of its voxel in the direction its triangle faces, so that meshing a voxel anew
leaves its texture where it is, and the texels of neighbouring charts continue each other.

Each texel carries the Gaussian colour state of section III-C: mean in units of 1/64 grey level, and information
(how many good observations it is worth).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from artemis_edge._jit import kernel
from artemis_edge.block_store import EMPTY_KEY, find_slot, remove_key
from artemis_edge.frames import I32, I64

LEVELS = 4
COARSEST = 8  # texels along the edge of a chart of level 0; each level has twice as many
DIRECTIONS = 6  # +x, +y, +z, -x, -y, -z: where the surface faces
# Steps of a mean per grey level. A place may be brighter than 255 in the map's exposure, which is that of an image
# that another one, darker, did not clip: uint16 holds 1023 levels
MEAN_SCALE = 64.0
INFORMATION_SCALE = 1024.0
# Columns of TexelStore.chart
AT, LEVEL, LOOKS, STAMP = range(4)
# Slots of TexelStore.counter
N_CHARTS, FREE_CHARTS, N_TEXELS, REFUSED = range(4)
_AXIS_BITS = 20
WAVER = 0.25  # of a voxel: surfaces of later scans lie within 0.1 m of the first


class TexelStore(NamedTuple):
    """Charts in an open-addressing hash, their texels in rooms of 64, 256, 1024 or 4096."""

    hash_key: I64  # (h,)
    hash_slot: I32  # (h,)
    key: I64  # (c,) of each chart
    chart: I32  # (c, 4): first texel, level, images that saw it, stamp of the last one
    texel: NDArray[np.uint16]  # (t, 4) red, green, blue, information
    counter: I64  # (4,)
    free_chart: I32  # (c,)
    free_room: I32  # (LEVELS, c)
    free_rooms: I64  # (LEVELS,)


def allocate(budget_bytes: float) -> TexelStore:
    """Empty memory that can grow to ``budget_bytes``; the system gives pages when they are first touched."""
    texels = max(int(budget_bytes / (8 + 1 / 8)), 1 << 16)
    charts = max(texels // 128, 512)
    slots = 1 << int(np.ceil(np.log2(2 * charts)))
    return TexelStore(
        hash_key=np.full(slots, EMPTY_KEY, np.int64),
        hash_slot=np.zeros(slots, np.int32),
        key=np.empty(charts, np.int64),
        chart=np.empty((charts, 4), np.int32),
        texel=np.empty((texels, 4), np.uint16),
        counter=np.zeros(4, np.int64),
        free_chart=np.empty(charts, np.int32),
        free_room=np.empty((LEVELS, charts), np.int32),
        free_rooms=np.zeros(LEVELS, np.int64),
    )


@kernel
def chart_key(x: int, y: int, z: int, direction: int) -> int:
    """Key of the chart of voxel x, y, z that faces ``direction``."""
    bias, mask = 1 << (_AXIS_BITS - 1), (1 << _AXIS_BITS) - 1
    key = ((int(x) + bias) & mask) << (2 * _AXIS_BITS)
    return ((key | (((int(y) + bias) & mask) << _AXIS_BITS) | ((int(z) + bias) & mask)) << 3) | direction


@kernel
def find_chart(texels: TexelStore, key: int) -> int:
    """Chart of a key or -1."""
    at = find_slot(texels.hash_key, key)
    return texels.hash_slot[at] if texels.hash_key[at] == key else -1


@kernel
def add_chart(texels: TexelStore, key: int, level: int) -> int:
    """A chart that nothing is known of; -1 and counted as refused when there is no memory."""
    counter = texels.counter
    room = _take_room(texels, level)
    if room < 0:
        counter[REFUSED] += 1
        return -1
    if counter[FREE_CHARTS] > 0:
        counter[FREE_CHARTS] -= 1
        chart = texels.free_chart[counter[FREE_CHARTS]]
    elif counter[N_CHARTS] < texels.chart.shape[0]:
        chart = np.int32(counter[N_CHARTS])
        counter[N_CHARTS] += 1
    else:
        _give_room(texels, room, level)
        counter[REFUSED] += 1
        return -1
    at = find_slot(texels.hash_key, key)
    texels.hash_key[at] = key
    texels.hash_slot[at] = chart
    texels.key[chart] = key
    row = texels.chart[chart]
    row[AT], row[LEVEL], row[LOOKS], row[STAMP] = room, level, 0, 0
    return int(chart)


@kernel
def remove_chart(texels: TexelStore, chart: int) -> None:
    """Forget a chart and give its memory back."""
    remove_key(texels.hash_key, texels.hash_slot, find_slot(texels.hash_key, texels.key[chart]))
    _give_room(texels, texels.chart[chart, AT], texels.chart[chart, LEVEL])
    texels.free_chart[texels.counter[FREE_CHARTS]] = chart
    texels.counter[FREE_CHARTS] += 1


@kernel
def _take_room(texels: TexelStore, level: int) -> int:
    """First texel of a cleared room, -1 when there is none."""
    size = (COARSEST << level) * (COARSEST << level)
    if texels.free_rooms[level] > 0:
        texels.free_rooms[level] -= 1
        at = int(texels.free_room[level, texels.free_rooms[level]])
    else:
        at = int(texels.counter[N_TEXELS])
        if at + size > texels.texel.shape[0]:
            return -1
        texels.counter[N_TEXELS] += size
    for i in range(at, at + size):
        for k in range(4):
            texels.texel[i, k] = 0
    return at


@kernel
def _give_room(texels: TexelStore, at: int, level: int) -> None:
    texels.free_room[level, texels.free_rooms[level]] = at
    texels.free_rooms[level] += 1


@kernel
def refine_chart(texels: TexelStore, chart: int, level: int) -> bool:
    """Give a chart texels of a finer level; False, and nothing changed, when there is no memory.

    A texel's information is shared out among those it becomes: what was blurred gives way to what is sharp.
    """
    row = texels.chart[chart]
    old_at, old_level = int(row[AT]), int(row[LEVEL])
    at = _take_room(texels, level)
    if at < 0:
        texels.counter[REFUSED] += 1
        return False
    edge, ratio = COARSEST << level, level - old_level
    old_edge = edge >> ratio
    for j in range(edge):
        for i in range(edge):
            old = texels.texel[old_at + (j >> ratio) * old_edge + (i >> ratio)]
            new = texels.texel[at + j * edge + i]
            new[0], new[1], new[2] = old[0], old[1], old[2]
            if old[3] > 0:
                new[3] = max(int(old[3]) >> (2 * ratio), 1)
    _give_room(texels, old_at, old_level)
    row[AT], row[LEVEL] = at, level
    return True


def discount(texels: TexelStore, most: int) -> None:
    """Leave no texel in memory more information than ``most`` (as stored): what comes next outweighs them."""
    used = texels.texel[: int(texels.counter[N_TEXELS]), 3]
    np.minimum(used, np.uint16(most), out=used)


@kernel
def used_texels(texels: TexelStore) -> int:
    """Texels in rooms that are not free."""
    n = int(texels.counter[N_TEXELS])
    for level in range(LEVELS):
        n -= texels.free_rooms[level] * (COARSEST << level) * (COARSEST << level)
    return n


def chart_blocks(texels: TexelStore) -> set[tuple[int, int, int]]:
    """Blocks that have charts in memory."""
    key = texels.hash_key[texels.hash_key != EMPTY_KEY] >> 3
    bias, mask = 1 << (_AXIS_BITS - 1), (1 << _AXIS_BITS) - 1
    voxel = np.stack([((key >> (_AXIS_BITS * k)) & mask) - bias for k in (2, 1, 0)], axis=1)
    return {(x, y, z) for x, y, z in np.unique(voxel >> 3, axis=0).tolist()}


@kernel
def place_key(direction: int, b: int, c: int, a: int) -> int:
    """Key of the chart with the index ``a`` along its axis and ``b``, ``c`` along the next two axes."""
    axis = direction % 3
    if axis == 0:
        return int(chart_key(a, b, c, direction))
    if axis == 1:
        return int(chart_key(c, a, b, direction))
    return int(chart_key(b, c, a, direction))


@kernel
def chart_near(texels: TexelStore, direction: int, b: int, c: int, a: float) -> int:
    """The chart that a piece of surface at ``a`` (in voxels along the axis) belongs to; -1 where there is none yet.

    A surface that wavers about the border of two voxels stays with the chart it has: within ``WAVER`` of the border
    the neighbour's chart counts too, and of two the one that more images saw.
    """
    k = math.floor(a)
    chart = find_chart(texels, place_key(direction, b, c, k))
    other = k
    if a - k < WAVER:
        other = k - 1
    elif a - k > 1.0 - WAVER:
        other = k + 1
    if other != k:
        second = find_chart(texels, place_key(direction, b, c, other))
        if second >= 0 and (chart < 0 or texels.chart[second, LOOKS] > texels.chart[chart, LOOKS]):
            return int(second)
    return int(chart)
