"""What an image sees of the map in memory, and the reference depth of its view."""

from __future__ import annotations

import numpy as np

from artemis_edge.block_store import Store
from artemis_edge.config import SemanticsConfig
from artemis_edge.frames import F32, F64, CameraModel
from artemis_edge.paging import resident_blocks
from artemis_edge.refinement.semantics import LEAST_RELIABILITY
from artemis_edge.sight import (
    Sight,
    Visibility,
    cell_px,
    empty_depth,
    look,
    new_seen,
    new_sight,
    splat_depth,
    without_depth,
)
from artemis_edge.voxel_fusion import MOST_SIGMAS


class MapView:
    """Looks at one map; ``seen`` holds the vertices of the last look."""

    def __init__(self, config: SemanticsConfig, store: Store, voxel_m: float) -> None:
        self.seen = new_seen(len(store.state))
        self._config, self._store = config, store
        self._block_m, self._spacing_m = 8 * voxel_m, voxel_m / 4
        self._blocks = np.empty(len(store.block), np.int32)

    def look(self, sight: Sight) -> int:
        """The vertices that ``sight`` shows into ``seen``, see :func:`sight.look`; how many."""
        blocks = self._blocks[: resident_blocks(self._store, self._blocks)]
        rules = visibility(self._config)
        return look(self._store, sight, blocks, self._block_m, self._config.reach_m, rules, self.seen)

    def depth(self, n: int, lens: F64) -> F32:
        """Reference depth of the ``n`` vertices that were looked at last, as of ``Sight.depth``."""
        depth = empty_depth(lens)
        splat_depth(self.seen, n, lens[0], self._spacing_m, cell_px(lens), depth)
        return depth

    def sight(self, camera: CameraModel, T_world_cam: F64) -> Sight:
        """The view of a camera with the reference depth that the map has now."""
        view = new_sight(camera, T_world_cam)
        return view._replace(depth=self.depth(self.look(without_depth(view)), view.lens))


def visibility(config: SemanticsConfig) -> Visibility:
    """When a vertex is what its pixel shows: for eq. 1 by sigma_d, for eqs 12 and 13 by W."""
    return Visibility(config.sigma_geom, LEAST_RELIABILITY, MOST_SIGMAS * config.sigma_d_m)
