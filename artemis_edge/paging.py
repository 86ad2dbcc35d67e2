"""Pages: a block of the map as plain arrays, to be drawn, written, sent to disk and brought back.

A page names cells by their place in the block, so it means the same wherever the block's slots were.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np

from artemis_edge import block_store as bs
from artemis_edge._jit import kernel, njit
from artemis_edge.block_store import (
    ALIVE,
    AT_MESH,
    BX,
    CHANGED,
    FRESH,
    PATCH_AT,
    PATCH_LEN,
    PATCH_ROOM,
    PENDING,
    QUEUED,
    SEEN,
    Store,
)
from artemis_edge.errors import RunError
from artemis_edge.frames import F32, I32, I64, U8, Bool
from artemis_edge.key_set import KeySet
from artemis_edge.voxel_map import AT_ONCE

TIGHT = 0.85  # share of a pool from which on blocks go to disk
_ROOMY = 0.70  # share until which they go
# Blocks that go at a time, so that no frame pays for many; above _NEARLY_FULL as many as must
MOST_OUT, _NEARLY_FULL = 24, 0.92
_ADOPTED = 0.5  # share of memory that a map made before may take
BUSY_FRAMES = 50  # a block seen this lately is not sent to disk

_HEADER = struct.Struct("<4sIiiiIII")
_MAGIC = b"AEP2"
_META = (PENDING, FRESH, AT_MESH)


@dataclass(frozen=True, slots=True)
class Page:
    """One block or several: rows of ``block`` (b, 3) own ``n_voxels`` voxels each, those own cells and triangles.

    ``inner`` int16 (v,) place of a voxel in its block, ``meta`` int32 (v, 3), ``n_cells`` and ``n_triangles``
    int16 (v,), ``voxel_class`` float32 (v, 0 or 17); ``cell`` uint8 (c,), ``evidence`` float32 (c, 16), ``vertex``
    float32 (c, 8), ``attribute`` float32 (c, 0, 4 or 20), ``state`` uint8 (c,); ``triangle`` uint16 (t, 3) codes.
    """

    block: I32
    n_voxels: I32
    inner: np.ndarray
    meta: I32
    n_cells: np.ndarray
    n_triangles: np.ndarray
    voxel_class: F32
    cell: U8
    evidence: F32
    vertex: F32
    attribute: F32
    state: U8
    triangle: np.ndarray

    def arrays(self) -> tuple[np.ndarray, ...]:
        """What a block holds, in the order in which kernels take it and bytes keep it."""
        return (
            self.inner,
            self.meta,
            self.n_cells,
            self.n_triangles,
            self.voxel_class,
            self.cell,
            self.evidence,
            self.vertex,
            self.attribute,
            self.state,
            self.triangle,
        )

    def voxel_index(self) -> I64:
        """Voxel coordinates int64 (v, 3)."""
        base = np.repeat(self.block.astype(np.int64) * 8, self.n_voxels, axis=0)
        inner = self.inner.astype(np.int64)
        return base + np.stack((inner >> 6, (inner >> 3) & 7, inner & 7), axis=1)

    def vertex_ids(self) -> I64:
        """Name of every cell's vertex, int64 (c,): its cell coordinates, 21 bits each."""
        voxel = np.repeat(self.voxel_index(), self.n_cells, axis=0)
        cell = self.cell.astype(np.int64)
        return _pack_ids(
            voxel[:, 0] * 4 + (cell >> 4), voxel[:, 1] * 4 + ((cell >> 2) & 3), voxel[:, 2] * 4 + (cell & 3)
        )

    def triangle_ids(self) -> I64:
        """Vertex names of every triangle, int64 (t, 3)."""
        voxel = np.repeat(self.voxel_index(), self.n_triangles, axis=0) * 4 - 12
        code = self.triangle.astype(np.int64) & (EAR_MASK)
        x, y, z = code >> 10, (code >> 5) & 31, code & 31
        return _pack_ids(x + voxel[:, 0:1], y + voxel[:, 1:2], z + voxel[:, 2:3])

    def alive(self) -> Bool:
        """Which cells hold a living vertex, bool (c,)."""
        return self.state == ALIVE


EAR_MASK = 0x7FFF  # the 16th bit of a code is the mesher's


def _pack_ids(x: I64, y: I64, z: I64) -> I64:
    bias = 1 << 20
    return ((x + bias) << 42) | ((y + bias) << 21) | (z + bias)


@kernel
def count_blocks(store: Store, slots: I32, n_voxels: I32) -> tuple[int, int, int]:
    """Voxels, cells and triangles of blocks; ``n_voxels`` (b,) is filled."""
    voxels = cells = triangles = 0
    for i in range(slots.shape[0]):
        n_voxels[i] = 0
        for inner in range(512):
            v = store.block_voxel[slots[i], inner]
            if v < 0:
                continue
            n_voxels[i] += 1
            triangles += store.voxel[v, PATCH_LEN]
            for c in range(64):
                cells += store.voxel_cell[v, c] >= 0
        voxels += n_voxels[i]
    return voxels, cells, triangles


@kernel
def fill_page(
    store: Store,
    slots: I32,
    inner: np.ndarray,
    meta: I32,
    n_cells: np.ndarray,
    n_triangles: np.ndarray,
    voxel_class: F32,
    cell: U8,
    evidence: F32,
    vertex: F32,
    attribute: F32,
    state: U8,
    triangle: np.ndarray,
) -> None:
    """Copy blocks into the arrays of a page."""
    i = j = k = 0
    for slot in slots:
        for place in range(512):
            v = store.block_voxel[slot, place]
            if v < 0:
                continue
            inner[i] = place
            meta[i, 0], meta[i, 1], meta[i, 2] = (
                store.voxel[v, PENDING],
                store.voxel[v, FRESH],
                store.voxel[v, AT_MESH],
            )
            n_triangles[i] = store.voxel[v, PATCH_LEN]
            for q in range(voxel_class.shape[1]):
                voxel_class[i, q] = store.voxel_class[v, q]
            for t in range(store.voxel[v, PATCH_LEN]):
                for q in range(3):
                    triangle[k, q] = store.triangle[store.voxel[v, PATCH_AT] + t, q]
                k += 1
            first = j
            for c in range(64):
                s = store.voxel_cell[v, c]
                if s < 0:
                    continue
                cell[j] = c
                state[j] = store.state[s]
                for q in range(16):
                    evidence[j, q] = store.evidence[s, q]
                for q in range(8):
                    vertex[j, q] = store.vertex[s, q]
                for q in range(attribute.shape[1]):
                    attribute[j, q] = store.attribute[s, q]
                j += 1
            n_cells[i] = j - first
            i += 1


def pack(store: Store, slots: I32) -> Page:
    """Page of resident blocks, in the order of ``slots``."""
    n_voxels = np.empty(len(slots), np.int32)
    v, c, t = count_blocks(store, slots, n_voxels)
    page = Page(
        block=store.block[slots, BX : BX + 3].copy(),
        n_voxels=n_voxels,
        inner=np.empty(v, np.int16),
        meta=np.empty((v, 3), np.int32),
        n_cells=np.empty(v, np.int16),
        n_triangles=np.empty(v, np.int16),
        voxel_class=np.empty((v, store.voxel_class.shape[1]), np.float32),
        cell=np.empty(c, np.uint8),
        evidence=np.empty((c, 16), np.float32),
        vertex=np.empty((c, 8), np.float32),
        attribute=np.empty((c, store.attribute.shape[1]), np.float32),
        state=np.empty(c, np.uint8),
        triangle=np.empty((t, 3), np.uint16),
    )
    fill_page(
        store,
        slots,
        *page.arrays(),
    )
    return page


@kernel
def restore_block(
    store: Store,
    block: int,
    stamp: int,
    inner: np.ndarray,
    meta: I32,
    n_cells: np.ndarray,
    n_triangles: np.ndarray,
    voxel_class: F32,
    cell: U8,
    evidence: F32,
    vertex: F32,
    attribute: F32,
    state: U8,
    triangle: np.ndarray,
) -> bool:
    """Bring one block's page back into slot ``block``, which may have received points since; False: no room.

    Evidence and what is known of classes add up; colours seen anew stay. A patch made since then is kept, else the
    page's comes back.
    """
    j = k = 0
    x0, y0, z0 = store.block[block, 0] * 8, store.block[block, 1] * 8, store.block[block, 2] * 8
    for i in range(inner.shape[0]):
        place = np.int64(inner[i])
        v = store.block_voxel[block, place]
        if v < 0:
            v = bs.add_voxel(
                store, block, place, x0 + (place >> 6), y0 + ((place >> 3) & 7), z0 + (place & 7)
            )
            if v < 0:
                return False
        store.voxel[v, PENDING] += meta[i, 0]
        store.voxel[v, FRESH] += meta[i, 1]
        store.voxel[v, AT_MESH] += meta[i, 2]
        for q in range(voxel_class.shape[1]):
            store.voxel_class[v, q] += voxel_class[i, q]
        for _ in range(n_cells[i]):
            s = store.voxel_cell[v, cell[j]]
            if s < 0:
                s = bs.add_cell(store, v, cell[j])
                if s < 0:
                    return False
            for q in range(16):
                store.evidence[s, q] += evidence[j, q]
            _merge_attributes(store.attribute, s, attribute, j)
            if store.state[s] == 0:
                store.state[s] = state[j]
                for q in range(8):
                    store.vertex[s, q] = vertex[j, q]
            j += 1
        fits = store.voxel[v, PATCH_LEN] > 0 or bs.set_patch(
            store, v, triangle[k : k + n_triangles[i]], n_triangles[i]
        )
        if not fits:  # it is meshed again when there is room
            store.voxel[v, FRESH] += AT_ONCE
            bs.enqueue(store, v, stamp)
        k += n_triangles[i]
    # most come back because a neighbour needs them, and may go again soon
    store.block[block, SEEN] = max(store.block[block, SEEN], stamp - BUSY_FRAMES + 5)
    return True


@kernel
def _merge_attributes(now: F32, s: int, before: F32, j: int) -> None:
    """Logarithms of likelihoods add up (eq. 12); of two colours the newer stays."""
    if now.shape[1] > bs.INFORMATION and now[s, bs.INFORMATION] == 0.0:
        for q in range(bs.LOG_CLASS):
            now[s, q] = before[j, q]
    for q in range(bs.LOG_CLASS, now.shape[1]):
        now[s, q] += before[j, q]


@kernel
def has_waiting(store: Store, block: int) -> bool:
    """Whether a voxel of the block waits for meshing."""
    for inner in range(512):
        v = store.block_voxel[block, inner]
        if v >= 0 and store.voxel[v, QUEUED] != 0:
            return True
    return False


@njit
def voxels_with_room(store: Store) -> I32:
    """Slots of resident voxels that own room for triangles."""
    out = np.empty(store.voxel.shape[0], np.int32)
    n = 0
    for at in range(store.hash_key.shape[0]):
        if store.hash_key[at] == bs.EMPTY_KEY:
            continue
        for inner in range(512):
            v = store.block_voxel[store.hash_slot[at], inner]
            if v >= 0 and store.voxel[v, PATCH_ROOM] > 0:
                out[n] = v
                n += 1
    return out[:n].copy()


@kernel
def compact_patches(store: Store, voxels: I32) -> None:
    """Close the gaps between the patches of ``voxels``, which come in the order of their places."""
    end = 0
    for v in voxels:
        at = store.voxel[v, PATCH_AT]
        for t in range(store.voxel[v, PATCH_LEN]):
            for k in range(3):
                store.triangle[end + t, k] = store.triangle[at + t, k]
        store.voxel[v, PATCH_AT] = end
        end += store.voxel[v, PATCH_ROOM]
    store.counter[bs.N_TRIANGLES] = end
    store.free_patches[:] = 0


@kernel
def resident_blocks(store: Store, out: I32) -> int:
    """Slots of all resident blocks."""
    n = 0
    for at in range(store.hash_key.shape[0]):
        if store.hash_key[at] != bs.EMPTY_KEY:
            out[n] = store.hash_slot[at]
            n += 1
    return n


def page_bytes(page: Page) -> bytes:
    """A page of one block as bytes."""
    head = _HEADER.pack(
        _MAGIC,
        len(page.inner),
        *page.block[0].tolist(),
        len(page.cell),
        len(page.triangle),
        page.attribute.shape[1],
    )
    return head + b"".join(np.ascontiguousarray(a).tobytes() for a in page.arrays())


def page_from_bytes(data: bytes) -> Page:
    """Inverse of ``page_bytes``; ValueError when the bytes are not a whole page."""
    if len(data) < _HEADER.size:
        raise ValueError("page too short")
    magic, v, bx, by, bz, c, t, attributes = _HEADER.unpack_from(data)
    if magic != _MAGIC:
        raise ValueError("not a page")
    shapes = _shapes(v, c, t, attributes)
    at, arrays = _HEADER.size, []
    for kind, shape in shapes:
        count = int(np.prod(shape))
        if at + count * np.dtype(kind).itemsize > len(data):
            raise ValueError("page cut off")
        arrays.append(np.frombuffer(data, kind, count, at).reshape(shape))
        at += count * np.dtype(kind).itemsize
    if arrays[2].sum() != c or arrays[3].sum() != t:
        raise ValueError("page does not add up")
    return Page(np.array([[bx, by, bz]], np.int32), np.array([v], np.int32), *arrays)


def _shapes(v: int, c: int, t: int, attributes: int) -> list[tuple[str, tuple[int, ...]]]:
    """Kinds and shapes of a page's arrays, in their order."""
    return [
        ("<i2", (v,)),
        ("<i4", (v, 3)),
        ("<i2", (v,)),
        ("<i2", (v,)),
        ("<f4", (v, bs.class_columns(attributes))),
        ("<u1", (c,)),
        ("<f4", (c, 16)),
        ("<f4", (c, 8)),
        ("<f4", (c, attributes)),
        ("<u1", (c,)),
        ("<u2", (t, 3)),
    ]


def read_pages(path: Path) -> Iterator[Page]:
    """The pages of a saved map, one after the other; ValueError where the file is no such."""
    with path.open("rb") as file:
        while head := file.read(_HEADER.size):
            if len(head) < _HEADER.size or not head.startswith(_MAGIC):
                raise ValueError("not a page")
            _, v, _, _, _, c, t, attributes = _HEADER.unpack(head)
            size = sum(
                int(np.prod(shape)) * np.dtype(kind).itemsize for kind, shape in _shapes(v, c, t, attributes)
            )
            yield page_from_bytes(head + file.read(size))


def with_attributes(page: Page, columns: int) -> Page:
    """The page for a store with so many columns of attributes: colours stay, classes are asked for anew."""
    attribute = np.zeros((len(page.cell), columns), np.float32)
    both = min(columns, page.attribute.shape[1], bs.LOG_CLASS)
    attribute[:, :both] = page.attribute[:, :both]
    voxel_class = np.zeros((len(page.inner), bs.class_columns(columns)), np.float32)
    return replace(page, attribute=attribute, voxel_class=voxel_class)


class PageFile:
    """Blocks on disk: an append-only file and the place of each block's newest page in it.

    ``mend`` are changes to the whole map that pages of before them still need, in their order: each is made when the
    page is read.
    """

    def __init__(self, folder: Path) -> None:
        self.mend: list[Callable[[Page], Page]] = []
        self._path = folder / "pages.bin"
        self._file: BinaryIO | None = None
        self._place: dict[int, tuple[int, int, int]] = {}
        self._known = KeySet()  # the same keys, for kernels
        self._end = 0

    def __len__(self) -> int:
        return len(self._place)

    def __contains__(self, key: int) -> bool:
        return key in self._place

    def keys(self) -> I64:
        """Sorted keys of the blocks on disk."""
        return np.array(sorted(self._place), np.int64)

    def around(self, block: I32) -> I64:
        """Sorted keys of those of the blocks (n, 3) and of their neighbours that are on disk."""
        return self._known.around(block)

    def put(self, key: int, page: Page) -> None:
        """Append a page; the file is made when first needed."""
        if self._file is None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._path.open("w+b")
        data = page_bytes(page)
        self._file.seek(self._end)
        self._file.write(data)
        self._place[key] = (self._end, len(data), len(self.mend))
        self._known.add(key)
        self._end += len(data)

    def get(self, key: int) -> Page:
        """The newest page of a block."""
        assert self._file is not None
        at, size, mended = self._place[key]
        self._file.seek(at)
        page = page_from_bytes(self._file.read(size))
        for mend in self.mend[mended:]:
            page = mend(page)
        return page

    def take(self, key: int) -> Page:
        """The page of a block that becomes resident again."""
        page = self.get(key)
        del self._place[key]
        self._known.remove(key)
        return page

    def flush(self) -> None:
        """Have everything in the file: another process is about to use it, too."""
        if self._file is not None:
            self._file.flush()

    def reopen(self) -> None:
        """In a copy of the process: its own place in the file. Pages that the other appended mean nothing here."""
        if self._file is not None:
            self._file = self._path.open("r+b")

    def close(self) -> None:
        """Close and remove the file: the map is saved elsewhere."""
        if self._file is not None:
            self._file.close()
            self._path.unlink(missing_ok=True)
            self._file = None


def slot_keys(store: Store, slots: I32) -> I64:
    """Keys of resident blocks, int64 (b,)."""
    return block_keys(store.block[slots, BX : BX + 3])


def block_keys(block: I32) -> I64:
    """Keys of block indices (b, 3), as ``block_store.block_key``."""
    b = block.astype(np.int64)
    return _pack_ids(b[:, 0], b[:, 1], b[:, 2])


class Companion(Protocol):
    """What goes to disk and comes back with a block but is kept elsewhere (texels)."""

    def load(self, geometry: float) -> float:
        """Share of the memory in use, when the map itself uses the share ``geometry`` of it."""
        ...

    def leave(self, bx: int, by: int, bz: int) -> None:
        """A block goes to disk."""
        ...

    def come_back(self, bx: int, by: int, bz: int) -> None:
        """A block is in memory again."""
        ...


def _rehearse() -> None:
    """Load the kernels of paging: the first block that goes to disk must not stop a frame for a second."""
    store = bs.allocate(0.0)
    slot = bs.find_or_add_block(store, 0, 0, 0)
    has_waiting(store, slot)
    page = page_from_bytes(page_bytes(pack(store, np.array([slot], np.int32))))
    restore_block(store, slot, 0, *page.arrays())
    bs.remove_block(store, slot)
    KeySet().around(np.zeros((1, 3), np.int32))


class Pager:
    """Keeps a store within its pools: the least recently seen blocks go to disk and come back when touched."""

    def __init__(self, store: Store, folder: Path, companion: Companion | None = None) -> None:
        self._store, self._companion = store, companion
        self.file = PageFile(folder)
        self._slots = np.empty(store.block.shape[0], np.int32)
        self.paged_out = 0
        self.paged_in = 0
        # Times a neighbour could not come back: the budget is too small for one frame's surroundings, and patches
        # at that border may not meet
        self.left_on_disk = 0
        self._drains = False
        _rehearse()

    def resident(self) -> I32:
        """Slots of resident blocks, sorted by key."""
        slots = self._slots[: resident_blocks(self._store, self._slots)].copy()
        return slots[np.argsort(slot_keys(self._store, slots), kind="stable")]

    def adopt(self, page: Page) -> None:
        """Take a page of a map made before: into memory while half of it is free, else onto the disk."""
        key = int(block_keys(page.block)[0])
        self.file.put(key, page)
        if self.fill() < _ADOPTED:
            self._restore(key, 0)

    def bring_back(self, touched: I32, stamp: int) -> None:
        """Load the pages of touched blocks and of their neighbours, whose patches must meet."""
        if len(self.file) == 0 or len(touched) == 0:
            return
        block = self._store.block[touched, BX : BX + 3]
        wanted = self.file.around(block)
        if len(wanted) == 0:
            return
        self._store.block[touched, SEEN] = stamp
        own = set(block_keys(block).tolist())
        for key in wanted.tolist():
            if self.fill() > 0.9:  # of what is in memory only what this frame needs must stay
                self.make_room(stamp, busy_frames=BUSY_FRAMES - 10)
            if self.fill() > 0.95 and key not in own:
                self.left_on_disk += 1
            else:
                self._restore(key, stamp)

    def make_room(self, stamp: int, busy_frames: int = BUSY_FRAMES) -> None:
        """Send blocks to disk from when a pool is 85 % full until it is 70 % full; never one seen lately.

        At most ``MOST_OUT`` a call, unless memory is nearly full.
        """
        if self._store.counter[bs.N_TRIANGLES] > TIGHT * len(self._store.triangle):
            self._compact()
        fill = self.fill()
        self._drains = fill >= (_ROOMY if self._drains else TIGHT)
        if not self._drains:
            return
        slots = self.resident()
        seen = self._store.block[slots, SEEN]
        old = np.flatnonzero(seen <= stamp - busy_frames)
        out = 0
        for slot in slots[old[np.argsort(seen[old], kind="stable")]].tolist():
            if has_waiting(self._store, slot) or self._store.block[slot, CHANGED] != 0:
                continue
            self._send(slot)
            out += 1
            fill = self.fill()
            if fill < _ROOMY or (out >= MOST_OUT and fill < _NEARLY_FULL):
                return

    def _send(self, slot: int) -> None:
        """One block to disk."""
        one = np.array([slot], np.int32)
        self.file.put(int(slot_keys(self._store, one)[0]), pack(self._store, one))
        if self._companion is not None:
            self._companion.leave(*self._store.block[slot, BX : BX + 3].tolist())
        bs.remove_block(self._store, slot)
        self.paged_out += 1

    def prepare(self, blocks: I32, stamp: int) -> None:
        """Have the neighbours of blocks in memory whose patches are about to change."""
        if len(self.file) > 0:
            self.make_room(stamp)
            self.bring_back(blocks[self._store.block[blocks, SEEN] >= 0], stamp)  # not those that just went

    def _compact(self) -> None:
        """Move all patches together: rooms of the wrong size would else be free and of no use."""
        voxels = voxels_with_room(self._store)
        order = np.argsort(self._store.voxel[voxels, PATCH_AT], kind="stable")
        compact_patches(self._store, voxels[order])

    def fill(self) -> float:
        """Share of the fullest pool that is in use, and of the memory that the companion shares with it."""
        c, s = self._store.counter, self._store
        free = (s.free_patches * (bs.SMALLEST_ROOM << np.arange(bs.PATCH_CLASSES))).sum()
        fullest = float(
            max(
                (c[bs.N_BLOCKS] - c[bs.FREE_BLOCKS]) / len(s.block),
                (c[bs.N_VOXELS] - c[bs.FREE_VOXELS]) / len(s.voxel),
                (c[bs.N_CELLS] - c[bs.FREE_CELLS]) / len(s.evidence),
                (c[bs.N_TRIANGLES] - free) / len(s.triangle),
            )
        )
        return fullest if self._companion is None else self._companion.load(fullest)

    def pages(self) -> Iterator[Page]:
        """Every block of the map, resident or not, in order of keys; a page a block."""
        resident = self.resident()
        place = dict(zip(slot_keys(self._store, resident).tolist(), resident.tolist(), strict=True))
        for key in sorted([*place, *self.file.keys().tolist()]):
            if key in place:
                yield pack(self._store, np.array([place[key]], np.int32))
            else:
                yield self.file.get(key)

    def _restore(self, key: int, stamp: int) -> None:
        page = self.file.take(key)
        bx, by, bz = page.block[0].tolist()
        slot = bs.find_or_add_block(self._store, bx, by, bz)
        fits = slot >= 0 and restore_block(
            self._store,
            slot,
            stamp,
            *page.arrays(),
        )
        if not fits:
            raise RunError(
                "the memory budget is too small for what is in view; raise voxel_map.memory_budget_mb"
            )
        if self._companion is not None:
            self._companion.come_back(bx, by, bz)
        self.paged_in += 1
