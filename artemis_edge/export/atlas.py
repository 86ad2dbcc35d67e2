"""The texture of a finished mesh: atlas pages, and where each corner of each face lies on them.

In a map's directory: ``map/atlas_000.png`` ... and ``map/atlas.npz``.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.export.atomic import replacing, write_bytes
from artemis_edge.frames import F32, I32, U8

UNTEXTURED = -1
INDEX = "atlas.npz"
# Photographs hardly compress beyond the first level, which is four times as fast as the default
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


@dataclass(frozen=True, slots=True)
class Atlas:
    """Texture of a mesh of m faces.

    ``pages`` uint8 (h, w, 3) sRGB each; ``page`` int32 (m,) the page of each face, ``UNTEXTURED`` (-1) where no
    camera saw it: its vertices' colours count then; ``uv`` float32 (m, 3, 2) pixels (column, row) of the face's
    corners on its page, a pixel's centre having integer coordinates, (0, 0) the upper left one.

    Around what a face needs its colours go on for ``padding`` pixels, so that log2(padding) mip levels mix in
    nothing foreign.
    """

    pages: tuple[U8, ...]
    page: I32
    uv: F32
    padding: int = 0

    def __len__(self) -> int:
        return len(self.page)


def empty_atlas(faces: int) -> Atlas:
    """No texture for a mesh of ``faces`` faces."""
    return Atlas((), np.full(faces, UNTEXTURED, np.int32), np.zeros((faces, 3, 2), np.float32))


def write_atlas(map_dir: Path, atlas: Atlas) -> int:
    """Write an atlas into the directory of a map; returns its size in bytes. The same atlas gives the same bytes.

    The index is written last: an atlas without it is none.
    """
    (map_dir / INDEX).unlink(missing_ok=True)
    size = 0
    for k, page in enumerate(atlas.pages):
        data = bytes(cv2.imencode(".png", np.ascontiguousarray(page[..., ::-1]), _PNG)[1])
        write_bytes(_page_path(map_dir, k), data)
        size += len(data)
    with replacing(map_dir / INDEX) as file:
        np.savez(
            file,
            page=atlas.page,
            uv=atlas.uv,
            pages=np.int64(len(atlas.pages)),
            padding=np.int64(atlas.padding),
        )
    return size + (map_dir / INDEX).stat().st_size


def read_atlas(map_dir: Path) -> Atlas | None:
    """The atlas of a map, None where it has none; InputError names a part that is missing or broken."""
    path = map_dir / INDEX
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as index:
            page, uv = index["page"], index["uv"]
            count, padding = int(index["pages"]), int(index["padding"])
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        raise InputError(f"{path} is not an atlas of this program; make the map again") from None
    pages = tuple(_read_page(_page_path(map_dir, k)) for k in range(count))
    if page.ndim != 1 or uv.shape != (len(page), 3, 2) or (len(page) and int(page.max()) >= count):
        raise InputError(f"{path} does not fit its pages; make the map again")
    return Atlas(pages, page.astype(np.int32), uv.astype(np.float32), padding)


def _page_path(map_dir: Path, k: int) -> Path:
    return map_dir / f"atlas_{k:03d}.png"


def _read_page(path: Path) -> U8:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if image is None:
        raise InputError(f"{path} is missing or is no picture; make the map again")
    return np.ascontiguousarray(image[..., ::-1]).astype(np.uint8, copy=False)
