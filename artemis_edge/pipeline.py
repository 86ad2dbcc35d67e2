"""The paper's Fig. 2: one call a stage, in order."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from artemis_edge.block_store import CHANGED, CLASSES, LOG_CLASS, REFUSED_POINTS
from artemis_edge.config import Config
from artemis_edge.delta import Outbox
from artemis_edge.export.atlas import write_atlas
from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import F32, F64, CameraModel, MeshDelta, Odometry, SyncedFrame, TrackedFrame
from artemis_edge.known_lenses import write_lenses
from artemis_edge.load import Load
from artemis_edge.map_view import MapView
from artemis_edge.map_writer import save_map, write_mesh, write_removed
from artemis_edge.mesher import Mesher
from artemis_edge.paging import TIGHT, Page, Pager, with_attributes
from artemis_edge.refinement.photographs import Waiting
from artemis_edge.refinement.stage import GoOn, Refinement, always
from artemis_edge.semantic_constraint import SemanticConstraint
from artemis_edge.semantic_map import Segmenter, SemanticMap
from artemis_edge.sight import Sight
from artemis_edge.visibility import FreeSpace
from artemis_edge.voxel_map import VoxelMap

# Python, numba and the libraries before the first frame, and what writing the results takes (docs/tuning.md) [MB]
BASE_MB = 450
#: Classes that move by themselves, as far as the dynamic filter is concerned
MOVABLE = ("person", "cyclist", "bicycle", "motorcycle", "car", "truck", "bus", "van", "dog", "cat")


class Pipeline:
    """Frames in, mesh deltas out. Knows nothing of files it was fed from, terminals or sockets."""

    def __init__(
        self, config: Config, odometry: Odometry, page_folder: Path, segmenter: Segmenter | None = None
    ) -> None:
        """Without a ``segmenter`` the map has no classes, and no memory for them."""
        self.config = config
        self.odometry = odometry
        self.segmenter = segmenter
        budget = (config.voxel_map.memory_budget_mb - BASE_MB) * 1e6
        self.voxel_map = VoxelMap(config.voxel_map, budget, LOG_CLASS + (CLASSES if segmenter else 0))
        self.semantics = self._semantics() if segmenter else None
        self._view = self.semantics.view if self.semantics else self._looking()
        self.free_space = FreeSpace(config.voxel_map, self.voxel_map)
        self.refinement = Refinement(config.refinement, self.voxel_map, budget, page_folder)
        self.pager = Pager(self.voxel_map.store, page_folder, self.refinement.pages)
        self.constraint = self._constraint()
        self.mesher = Mesher(config.mesher, self.voxel_map, self.pager.prepare, self.constraint)
        active = None if self.semantics is None else self.semantics.active
        self.outbox = Outbox(self.voxel_map.store, active)
        self.tracked: TrackedFrame | None = None
        self._uncoloured: TrackedFrame | None = None
        self.trajectory: list[tuple[int, F64]] = []
        self.stage_ms: dict[str, float] = {}
        self._stamp = 0
        self._mesh: Mesh | None = None

    def take_over(self, pages: Iterable[Page], photographs: Iterable[Waiting]) -> None:
        """Begin with the blocks of a map made before, and what colours them, before the first frame."""
        for page in pages:
            self.pager.adopt(with_attributes(page, self.voxel_map.store.attribute.shape[1]))
        for waiting in photographs:
            self.refinement.keyframes.offer(waiting)
        self.tell_everything()

    def process(self, frame: SyncedFrame) -> MeshDelta:
        """All stages for one frame; its images are refined with the next one (``_track``)."""
        self.stage_ms = {"odometry": 0.0, "refinement": 0.0}
        tracked = self.tracked = self._track(frame)
        self._stamp += 1
        with self._stage("voxel_map"):
            active = self.voxel_map.insert(tracked, self._stamp)
            self.pager.bring_back(self.voxel_map.touched_blocks(), self._stamp)
        with self._stage("free_space"):
            self.free_space.carve(tracked, self._stamp)
        self._fuse_masks()
        with self._stage("mesher"):
            self.mesher.update(active, self._stamp)
        self._offer_images(tracked)
        with self._stage("delta"):
            # what goes to disk must have been told
            tight = self.pager.fill() >= TIGHT
            delta = self.outbox.everything(frame.index) if tight else self.outbox.changed(frame.index)
            self.pager.make_room(self._stamp)
        self.trajectory.append((tracked.stamp_ns, tracked.T_world_lidar))
        self._uncoloured = tracked
        return delta

    def ask(self, slots: Mapping[int, str]) -> None:
        """Which class each slot of the map holds from the next frame on; what it knew of others is taken back.

        Of a pipeline with a segmenter only.
        """
        assert self.semantics is not None
        forgotten = self.semantics.assign(slots, self._stamp)
        if forgotten is not None:
            self.pager.file.mend.append(forgotten)

    def reduce(self, load: Load) -> None:
        """How much may be done from the next frame on; less where the machine is overloaded."""
        self.refinement.share = load.texture_share
        if self.constraint is not None:
            self.constraint.most_sweeps = load.most_sweeps

    def sight(self, camera: CameraModel, T_world_cam: F64) -> Sight:
        """The view of a camera with the reference depth that the map has now."""
        return self._view.sight(camera, T_world_cam)

    def tell_everything(self) -> None:
        """A viewer is new: all blocks in memory are told again, as the coming frames have room."""
        self.voxel_map.store.block[self.pager.resident(), CHANGED] = 1

    def finish(self, go_on: GoOn = always) -> MeshDelta:
        """Everything postponed; the delta holds all that was not told yet. ``go_on``: see ``Refinement.finish``."""
        self.stage_ms = {}
        self._colour()
        self._fuse_masks(last=True)
        if self.semantics is not None and self.config.voxel_map.dynamic_filter:
            with self._stage("free_space"):
                self.free_space.remove_movable(self.semantics.slots_of(MOVABLE), self._stamp)
        with self._stage("mesher"):
            if self.constraint is not None:
                self.constraint.unsettle(self._stamp)
            self.mesher.flush(self._stamp)
        with self._stage("refinement"):
            self.refinement.finish(go_on)
        with self._stage("delta"):
            return self.outbox.everything(self._stamp)

    def _track(self, frame: SyncedFrame) -> TrackedFrame:
        """The frame's pose; on the other core meanwhile the colours of the last frame: neither needs the other."""
        with ThreadPoolExecutor(1) as beside:
            colouring = beside.submit(self._colour)
            with self._stage("odometry"):
                tracked = self.odometry.track(frame)
            colouring.result()
        return tracked

    def _colour(self) -> None:
        """Refine the map with the images of the last frame, unless that is done."""
        last, self._uncoloured = self._uncoloured, None
        if last is not None:
            with self._stage("refinement"):
                self.refinement.update(last, self._stamp)

    def _looking(self) -> MapView:
        return MapView(self.config.semantics, self.voxel_map.store, self.config.voxel_map.voxel_m)

    def _semantics(self) -> SemanticMap:
        assert self.segmenter is not None
        semantics = SemanticMap(self.config.semantics, self.voxel_map.store, self.config.voxel_map.voxel_m)
        semantics.ask(self.segmenter.names)
        return semantics

    def _constraint(self) -> SemanticConstraint | None:
        if self.semantics is None or not self.config.semantics.constraint:
            return None
        sigma_m = self.config.voxel_map.plane_sigma_m
        return SemanticConstraint(
            self.config.semantics,
            self.voxel_map.store,
            self.voxel_map.cell_m,
            sigma_m,
            self.semantics.active,
        )

    def _fuse_masks(self, last: bool = False) -> None:
        """Masks that are done: into the voxels (eq. 1) and, weighed by W, into the vertices (eqs 12, 13)."""
        if self.segmenter is None or self.semantics is None:
            return
        for mask in self.segmenter.drain() if last else self.segmenter.ready():
            with self._stage("voxel_fusion"):
                seen = self.semantics.fuse(mask, self._stamp)
            if self.config.semantics.refinement:
                with self._stage("semantic_refinement"):
                    self.semantics.refine(mask, seen, self._stamp)

    def _offer_images(self, tracked: TrackedFrame) -> None:
        """Images of the frame to the segmentation, with the depth that the map has at their time."""
        if self.segmenter is None or self.semantics is None:
            return
        with self._stage("segmentation"):
            self.semantics.scans.take(tracked)
            for image, T_world_lidar in zip(tracked.images, tracked.image_poses, strict=True):
                self.segmenter.offer(image, partial(self.semantics.sight, image, T_world_lidar))

    @property
    def warnings(self) -> list[str]:
        """The first of each kind of photograph that could not be used."""
        return list(self.refinement.refused.sentences.values())

    @property
    def lost(self) -> dict[str, int]:
        """What the stages could not take, by reason; empty when nothing was lost."""
        counts = {
            "points_without_memory": int(self.voxel_map.store.counter[REFUSED_POINTS]),
            "patches_without_memory": self.mesher.refused,
            "blocks_without_memory": self.pager.left_on_disk,
        }
        return {**{reason: n for reason, n in counts.items() if n}, **self.refinement.lost}

    @property
    def falloff(self) -> Mapping[str, F64]:
        """Of each camera whose lens's fall-off was found, its coefficients (``lens.log_falloff``)."""
        return self.refinement.falloff

    @property
    def probability(self) -> F32:
        """Of each vertex of the written mesh, that of its class; empty without classes."""
        return np.empty(0, np.float32) if self.semantics is None else self.semantics.probability

    def write_mesh(self, path: Path) -> Mesh:
        """Write ``mesh.ply``, finished, and return the mesh."""
        rules = self.config.mesher
        longest_m = rules.long_edge * self.voxel_map.cell_m
        self._mesh = write_mesh(
            path, self.pager, longest_m, rules.smallest_island, self.semantics, self.refinement.exposure
        )
        return self._mesh

    def save(self, folder: Path) -> int:
        """Write what reopens the map; returns its size in bytes."""
        size = save_map(folder, self.pager, self.config) + write_lenses(folder, self.refinement.lenses)
        if self.config.voxel_map.dynamic_filter:
            size += write_removed(folder, self.free_space.removed)
        if self._mesh is not None:
            atlas = self.refinement.atlas(self._mesh)
            size += write_atlas(folder, atlas) if atlas.pages else 0
        self.pager.file.close()
        self.refinement.close()
        return size

    def before_copy(self) -> None:
        """The process is about to be copied by a fork."""
        self.pager.file.flush()

    def after_copy(self) -> None:
        """This is a copy that goes on in the place of its original."""
        self.pager.file.reopen()

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.stage_ms[name] = self.stage_ms.get(name, 0.0) + (time.perf_counter() - start) * 1e3
