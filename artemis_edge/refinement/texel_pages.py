"""Texels of blocks that go to disk with their block, and come back with it."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from artemis_edge._jit import kernel
from artemis_edge.frames import I32, I64
from artemis_edge.refinement.texels import (
    AT,
    COARSEST,
    DIRECTIONS,
    LEVEL,
    LOOKS,
    TexelStore,
    add_chart,
    chart_blocks,
    chart_key,
    find_chart,
    remove_chart,
    used_texels,
)

_HEADER = struct.Struct("<4sI")
_MAGIC = b"AET1"
_MOST = 512 * DIRECTIONS  # charts of a block
BYTES_PER_TEXEL = 8


@kernel
def charts_of_block(texels: TexelStore, bx: int, by: int, bz: int, out: I32) -> int:
    """Charts of the 8 x 8 x 8 voxels of a block; returns how many."""
    n = 0
    for inner in range(512):
        x, y, z = bx * 8 + (inner >> 6), by * 8 + ((inner >> 3) & 7), bz * 8 + (inner & 7)
        for direction in range(DIRECTIONS):
            chart = find_chart(texels, chart_key(x, y, z, direction))
            if chart >= 0:
                out[n] = chart
                n += 1
    return n


class TexelPages:
    """Keeps the texels of blocks that are not in memory in an append-only file."""

    def __init__(self, texels: TexelStore, folder: Path, budget_bytes: float) -> None:
        self._texels, self._path = texels, folder / "texels.bin"
        self._budget = max(budget_bytes, float(texels.texel.nbytes))
        self._place: dict[tuple[int, int, int], tuple[int, int]] = {}
        self._charts = np.empty(_MOST, np.int32)

    def __len__(self) -> int:
        return len(self._place)

    def load(self, geometry: float) -> float:
        """Share of the memory in use, when the map itself uses the share ``geometry`` of it."""
        used = float(used_texels(self._texels))
        return max(geometry + used * BYTES_PER_TEXEL / self._budget, used / len(self._texels.texel))

    def leave(self, bx: int, by: int, bz: int) -> None:
        """Send the texels of a block to disk."""
        n = charts_of_block(self._texels, bx, by, bz, self._charts)
        if n == 0:
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        data = pack_charts(self._texels, self._charts[:n])
        with self._path.open("ab") as file:
            self._place[bx, by, bz] = (file.tell(), len(data))
            file.write(data)
        for chart in self._charts[:n].tolist():
            remove_chart(self._texels, chart)

    def come_back(self, bx: int, by: int, bz: int) -> None:
        """Bring the texels of a block back into memory, where it has any on disk."""
        place = self._place.pop((bx, by, bz), None)
        if place is not None:
            with self._path.open("rb") as file:
                file.seek(place[0])
                unpack_charts(self._texels, file.read(place[1]))

    def need(self, blocks: Iterable[tuple[int, int, int]]) -> None:
        """Have the texels of ``blocks`` in memory; those of others leave when there is too little."""
        wanted = set(blocks)
        missing = sorted(wanted & self._place.keys())
        coming = sum(self._place[block][1] for block in missing)
        used = used_texels(self._texels) * BYTES_PER_TEXEL
        if used + coming > 0.9 * self._texels.texel.nbytes:
            for block in sorted(chart_blocks(self._texels) - wanted):
                self.leave(*block)
        for block in missing:
            self.come_back(*block)

    def close(self) -> None:
        """Remove the file."""
        self._path.unlink(missing_ok=True)


def pack_charts(texels: TexelStore, charts: I32) -> bytes:
    """Charts as bytes: keys, levels and looks, then their texels."""
    rows = texels.chart[charts]
    parts = [
        _HEADER.pack(_MAGIC, len(charts)),
        texels.key[charts].astype("<i8").tobytes(),
        rows[:, [LEVEL, LOOKS]].astype("<i4").tobytes(),
    ]
    for at, level in rows[:, [AT, LEVEL]].tolist():
        parts.append(texels.texel[at : at + (COARSEST << level) ** 2].astype("<u2", copy=False).tobytes())
    return b"".join(parts)


def unpack_charts(texels: TexelStore, data: bytes) -> None:
    """Put charts back; where one has been begun anew meanwhile, the one that more images saw stays.

    ValueError when the bytes are not whole charts.
    """
    if len(data) < _HEADER.size or data[:4] != _MAGIC:
        raise ValueError("not a page of texels")
    n = _HEADER.unpack_from(data)[1]
    if len(data) < _HEADER.size + 16 * n:
        raise ValueError("page of texels cut off")
    keys: I64 = np.frombuffer(data, "<i8", n, _HEADER.size)
    rows = np.frombuffer(data, "<i4", 2 * n, _HEADER.size + 8 * n).reshape(-1, 2)
    at = _HEADER.size + 16 * n
    for key, (level, looks) in zip(keys.tolist(), rows.tolist(), strict=True):
        size = (COARSEST << level) ** 2
        content = np.frombuffer(data, "<u2", 4 * size, at).reshape(-1, 4)
        at += size * BYTES_PER_TEXEL
        chart = find_chart(texels, key)
        if chart >= 0 and texels.chart[chart, LOOKS] >= looks:
            continue
        if chart >= 0:
            remove_chart(texels, chart)
        chart = add_chart(texels, key, level)
        if chart >= 0:
            texels.chart[chart, LOOKS] = looks
            first = texels.chart[chart, AT]
            texels.texel[first : first + size] = content


def blocks_around(keys: Iterable[tuple[int, int, int]]) -> set[tuple[int, int, int]]:
    """Blocks and their 26 neighbours."""
    span = (-1, 0, 1)
    return {(x + i, y + j, z + k) for x, y, z in keys for i in span for j in span for k in span}
