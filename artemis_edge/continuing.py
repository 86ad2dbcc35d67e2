"""Going on in a map made before (``--continue``): finding it, recognising the place, taking over what it holds."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge.config import Config, load
from artemis_edge.errors import InputError
from artemis_edge.export.ply import read_mesh
from artemis_edge.frames import F32, Odometry, SyncedFrame
from artemis_edge.keeper import Keeper
from artemis_edge.loop.recognition import Recognition
from artemis_edge.loop.relocate import Found, search_all
from artemis_edge.mapping_run import Mapper
from artemis_edge.odometry.known_map import KnownMap, Start
from artemis_edge.paging import Page, read_pages
from artemis_edge.refinement.photographs import Waiting
from artemis_edge.segmentation.keyframes import photographs

MESH, MAP, BLOCKS, CONFIG = "mesh.ply", "map", "blocks.bin", "config.toml"
_RESULT = re.compile(r"result(?:_(\d+))?")
_DIGITS = 4


@dataclass(frozen=True, slots=True)
class EarlierMap:
    """An output directory ``root``; ``vertices`` float32 (n, 3) of its mesh."""

    root: Path
    vertices: F32

    def into(self, mapper: Mapper, keeper: Keeper) -> None:
        """Let a mapper and a keeper begin with what the map holds."""
        mapper.take_over(self._pages(), self._photographs())
        keeper.take_over(self.root / MAP)

    def start(self, found: Found) -> Start:
        """For an odometry whose own world was recognised."""
        return Start(found.T_map_world, KnownMap(self.vertices))

    def account(self, found: Found, first_ns: int) -> dict[str, Any]:
        """For the report."""
        return {
            "map": str(self.root),
            "T_map_world": np.round(found.T_map_world, 6).tolist(),
            "recognised_after_s": round((found.stamp_ns - first_ns) * 1e-9, _DIGITS),
            "looks": found.looks,
            "share_of_walls": round(found.place.share, _DIGITS),
            "share_elsewhere": round(found.place.other, _DIGITS),
        }

    def unknown(self, name: str) -> str:
        """The sentence for a recording that was not recognised."""
        return (
            f"{name} was not recognised in {self.root}; begin the recording, or walk during it, where the map shows "
            f"walls or other upright surfaces facing two ways, and look at them for some seconds"
        )

    def _pages(self) -> Iterator[Page]:
        blocks, found = self.root / MAP / BLOCKS, False
        try:
            for page in read_pages(blocks):
                found = True
                yield page
            if not found:
                raise ValueError("no blocks of the mesh beside it")
        except ValueError as error:
            raise InputError(f"{blocks} is damaged ({error}); make that map again") from None

    def _photographs(self) -> Iterator[Waiting]:
        still = np.zeros(6)
        for image, T_world_cam in photographs(self.root / MAP):
            yield Waiting(image, T_world_cam, still, 0)


def open_earlier(path: Path, config: Config) -> EarlierMap:
    """The map at ``path``: an output directory, its mesh, or a session that was mapped; InputError if there is none.

    Its voxels must be as large as those of ``config``.
    """
    root = _root(path)
    if root is None:
        raise InputError(
            f"{path} holds no map to continue; give the output directory of a run, or a session with a result"
        )
    settings = root / MAP / CONFIG
    voxel_m = config.voxel_map.voxel_m
    if settings.is_file():
        theirs = load(settings).voxel_map.voxel_m
        if theirs != voxel_m:
            raise InputError(
                f"{root} has voxels of {theirs:g} m, this run of {voxel_m:g} m; continue it with "
                f"--set voxel_map.voxel_m={theirs:g}"
            )
    vertices = read_mesh(root / MESH).vertices
    if len(vertices) == 0:
        raise InputError(f"the map in {root} is empty; there is nothing to continue")
    return EarlierMap(root, np.ascontiguousarray(vertices, np.float32))


def find_earlier(path: Path, config: Config) -> EarlierMap | None:
    """As ``open_earlier``; None where there is no map (a session that was only recorded)."""
    return None if _root(path) is None else open_earlier(path, config)


def _root(path: Path) -> Path | None:
    """The output directory meant by a path; of a session the newest result."""
    folder = path if path.is_dir() else path.parent
    results = [
        (int(found[1] or 1), item)
        for item in folder.glob("result*")
        if (found := _RESULT.fullmatch(item.name))
    ]
    for candidate in (folder, *(item for _, item in sorted(results, reverse=True))):
        if (candidate / MESH).is_file() and (candidate / MAP / BLOCKS).is_file():
            return candidate
    return None


def find_start(
    earlier: EarlierMap, make: Callable[[], Odometry], frames: Iterable[SyncedFrame], name: str
) -> Found:
    """Where a recording begins in the map; InputError where it is not recognised."""
    found = search_all(Recognition(earlier.vertices), make, frames)
    if found is None:
        raise InputError(earlier.unknown(name))
    return found
