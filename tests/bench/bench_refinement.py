"""What images cost in a map of a million vertices: python tests/bench/bench_refinement.py SESSION MAP [options].

MAP is an output directory made of SESSION with its true poses. Copies of it stand around it, all in memory, until there
are ``--vertices`` of them; then the photographs of the session refine it as they do while a map grows. CPU time of the
thread, ms.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge.block_store import ALIVE, CLASSES, LOG_CLASS
from artemis_edge.config import load
from artemis_edge.datasets import open_input
from artemis_edge.odometry.given_poses import GivenPoses
from artemis_edge.paging import Page, Pager, read_pages, with_attributes
from artemis_edge.refinement import stage, view
from artemis_edge.refinement.stage import Refinement
from artemis_edge.trajectory import read_tum
from artemis_edge.voxel_map import VoxelMap

_BUDGET = 6e9  # so that no pool is half full
_PARTS = (
    (stage, "decode"),
    (view, "list_visible"),
    (view, "observe"),
    (view, "estimate_gain"),
    (view, "weigh"),
    (stage, "update_vertices"),
    (stage, "paint"),
)


def copies(pages: list[Page], vertices: int) -> Iterator[Page]:
    """The map, then copies of it side by side, those around it first."""
    block = np.concatenate([page.block for page in pages])
    size = np.ptp(block, axis=0)[:2] + 1
    alive = max(sum(int(np.count_nonzero(page.state == ALIVE)) for page in pages), 1)
    rings = sorted(product(range(-9, 10), repeat=2), key=lambda place: (max(map(abs, place)), place))
    for x, y in rings[: -(-vertices // alive)]:
        step = np.array([x * size[0], y * size[1], 0], np.int32)
        for page in pages:
            yield replace(page, block=page.block + step)


def timed(module: Any, name: str, spent: dict[str, float]) -> None:
    """Add what a function of a module takes to ``spent``."""
    inner: Callable[..., Any] = getattr(module, name)

    def outer(*args: Any, **options: Any) -> Any:
        start = time.thread_time()
        result = inner(*args, **options)
        spent[name] = spent.get(name, 0.0) + 1e3 * (time.thread_time() - start)
        return result

    setattr(module, name, outer)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("session", type=Path)
    parser.add_argument("map", type=Path)
    parser.add_argument("--vertices", type=int, default=1_000_000)
    parser.add_argument("--frames", type=int, default=70)
    parser.add_argument("--warm", type=int, default=10, help="frames that are not counted")
    given = parser.parse_args()
    config = load()
    pages = list(read_pages(given.map / "map" / "blocks.bin"))
    odometry = GivenPoses(read_tum(given.session / "truth" / "trajectory_400hz.tum"))
    with tempfile.TemporaryDirectory() as folder:
        voxel_map = VoxelMap(config.voxel_map, _BUDGET, LOG_CLASS + CLASSES)
        refinement = Refinement(config.refinement, voxel_map, _BUDGET, Path(folder))
        pager = Pager(voxel_map.store, Path(folder), refinement.pages)
        for page in copies(pages, given.vertices):
            pager.adopt(with_attributes(page, voxel_map.store.attribute.shape[1]))
        assert len(pager.file) == 0, "not all of it is in memory"
        print(f"{np.count_nonzero(voxel_map.store.state == ALIVE)} vertices in memory")
        spent: dict[str, float] = {}
        for module, name in _PARTS:
            timed(module, name, spent)
        rows, parts, looks = [], [], []
        for n, frame in enumerate(open_input(given.session, config.input).frames()):
            if n == given.frames:
                break
            tracked = odometry.track(frame)
            spent.clear()
            before, start = refinement._looks, time.thread_time()
            refinement.update(tracked, n + 1)
            if n >= given.warm:
                rows.append(1e3 * (time.thread_time() - start))
                looks.append(refinement._looks - before)
                parts.append([spent.get(name, 0.0) for _, name in _PARTS])
        length = refinement.viewer._visible.length
        print(f"in view of the last image: {length[0]} vertices, {length[1]} triangles")
        took, used = np.array(rows), np.array(looks) > 0
        print(f"a frame: mean {took.mean():.1f}, p99 {np.quantile(took, 0.99):.1f} ms")
        print(
            f"an image that is used ({used.sum()} of {len(used)} frames): median {np.median(took[used]):.1f} ms"
        )
        for (_, name), ms in zip(_PARTS, np.median(np.array(parts)[used], axis=0), strict=True):
            print(f"  {name:16} {ms:6.1f}")
        refinement.close()


if __name__ == "__main__":
    main()
