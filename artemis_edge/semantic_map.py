"""The Semantic Brush on the map: masks in, classes of voxels and vertices out.

Holds which class is in which slot and the scratch memory; the mathematics is in ``voxel_fusion.py`` (eq. 1),
``semantic_constraint.py`` (eqs 2-8) and ``refinement/semantics.py`` (eqs 12-13).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from artemis_edge.block_store import CLASSES, LOG_CLASS, NORMAL, WEIGHT, Store
from artemis_edge.class_rows import CLEAR_LOG
from artemis_edge.config import SemanticsConfig
from artemis_edge.errors import InputError
from artemis_edge.export.mesh import edges_of
from artemis_edge.forgetting import Forgotten, forget_blocks
from artemis_edge.frames import F32, F64, I32, U8, Bool, CameraImage
from artemis_edge.map_view import MapView, visibility
from artemis_edge.measured import LatestScans, Scratch, Shown, scope_of, see_measured
from artemis_edge.paging import resident_blocks
from artemis_edge.refinement.agreement import agreed
from artemis_edge.refinement.semantics import labels_of, refine
from artemis_edge.segmentation.backend import DenseScores
from artemis_edge.sight import Sight, cell_px, filled, keep_visible, new_sight, without_depth
from artemis_edge.trajectory import inverse
from artemis_edge.voxel_fusion import fuse, grid_of, sample_scores, start_from

BACKGROUND = "background"
_SAME_SURFACE = 0.7  # cosine between normals


@dataclass(frozen=True, slots=True)
class LateMask:
    """What a network saw in an image, and the view (pose, reference depth) of that image."""

    sight: Sight
    scores: DenseScores


class Segmenter(Protocol):
    """Where masks come from. Neither call waits for a network that runs beside the pipeline."""

    @property
    def names(self) -> Sequence[str]:
        """Classes asked for, from slot 1 on."""
        ...

    def offer(self, image: CameraImage, look: Callable[[], Sight]) -> None:
        """An image that may be segmented; ``look`` sees the map as it is now, which costs as much as a fusion."""
        ...

    def ready(self) -> list[LateMask]:
        """Masks that are done."""
        ...

    def drain(self) -> list[LateMask]:
        """Masks that are left at the end of a run; waits for them."""
        ...


class SemanticMap:
    """Classes of one map's voxels and vertices."""

    def __init__(self, config: SemanticsConfig, store: Store, voxel_m: float) -> None:
        self.config = config
        self.store = store
        self.names: dict[int, str] = {0: BACKGROUND}
        self.active = np.zeros(CLASSES, np.uint8)
        self.active[0] = 1
        self.view = MapView(config, store, voxel_m)
        self._spacing_m = voxel_m / 4
        self._seen = self.view.seen
        self.scans = LatestScans()
        self._sampled = np.empty((len(store.state), CLASSES), np.float32)
        self._scratch = np.empty(CLASSES, np.float32)
        self._points = Scratch(np.zeros(len(store.state), np.int32), np.empty(NORMAL + 3, np.float32))
        self._depth = np.empty((0, 0, 4), np.float32)
        self.probability = np.empty(0, np.float32)

    def ask(self, names: Sequence[str]) -> None:
        """The classes looked for, from slot 1 on; raises InputError for more than there are slots."""
        if len(names) >= CLASSES:
            raise InputError(f"{len(names)} classes were asked for; at most {CLASSES - 1} at a time")
        self.names = {0: BACKGROUND} | dict(enumerate(names, start=1))
        self.active[:] = 0
        self.active[: len(names) + 1] = 1

    def assign(self, slots: Mapping[int, str], stamp: int) -> Forgotten | None:
        """Which class each slot holds from now on (background apart).

        What the map knew of classes that are gone is taken back; returns what pages on disk still need, None where
        nothing is gone.
        """
        gone = np.zeros(CLASSES, np.uint8)
        gone[[s for s, name in self.names.items() if s and slots.get(s) != name]] = 1
        self.names = {0: BACKGROUND} | dict(sorted(slots.items()))
        self.active[:] = active_slots(self.names)  # in place: others hold it
        if not gone.any():
            return None
        forgotten = Forgotten(gone, self.active.copy())
        blocks = np.empty(len(self.store.block), np.int32)
        blocks = blocks[: resident_blocks(self.store, blocks)]
        forget_blocks(self.store, blocks, gone, forgotten.active, stamp)
        return forgotten

    @property
    def asked(self) -> bool:
        """Whether any class is looked for."""
        return len(self.names) > 1

    def slots_of(self, names: Sequence[str]) -> U8:
        """Which slots hold one of the classes, uint8 (CLASSES,)."""
        out = np.zeros(CLASSES, np.uint8)
        out[[slot for slot, name in self.names.items() if name in names]] = 1
        return out

    def sight(self, image: CameraImage, T_world_lidar: F64) -> Sight:
        """The view of an image with the reference depth that the map has now; without one where nothing is asked."""
        T_world_cam = T_world_lidar @ inverse(image.T_cam_lidar)
        if not self.asked:
            return without_depth(new_sight(image.model, T_world_cam))
        view = self.view.sight(image.model, T_world_cam)
        return view._replace(measured=self.scans.in_view(view, self.config.reach_m))

    def fuse(self, mask: LateMask, stamp: int) -> int:
        """Voxel fusion (eq. 1) of a mask; returns how many vertices it sees."""
        n, lens = self.view.look(mask.sight), mask.sight.lens
        depth = self._depth = filled(mask.sight.depth, self.view.depth(n, lens))
        n = int(keep_visible(self._seen, n, cell_px(lens), depth, visibility(self.config)))
        sampled = self._rows(n, mask.scores)
        sample_scores(self._seen, n, mask.scores.score, grid_of(mask.scores), sampled)
        fuse(
            self.store,
            self._seen,
            n,
            sampled,
            slot_layers(mask.scores),
            self.config.sigma_d_m,
            self._scratch,
        )
        return n

    def refine(self, mask: LateMask, n: int, stamp: int) -> int:
        """Semantic refinement (eqs 12, 13) by the mask that was fused last and saw ``n`` vertices.

        They are refined by what their own pixels show, and those that beams have just met by what the pixels of the
        points show; returns how many observations that is.
        """
        slots, seen = slot_layers(mask.scores), self._seen
        rows = self._rows(n, mask.scores)
        told = refine(self.store, seen, n, rows, slots, seen.reliability, stamp, self._scratch)
        return int(told) + self._refine_measured(mask, slots, stamp)

    def _refine_measured(self, mask: LateMask, slots: I32, stamp: int) -> int:
        sight, seen = mask.sight._replace(depth=self._depth), self._seen
        scope = scope_of(sight.lens, self.config.reach_m, self._spacing_m)
        scores = mask.scores
        shown = Shown(scores.score, grid_of(scores), np.array(scores.slots, np.int32))
        mean = self._rows(len(seen.slot), scores)
        n = see_measured(self.store, sight.measured, sight, scope, shown, self._points, seen, mean)
        weight = seen.reliability
        return int(refine(self.store, seen, n, mean[:n], slots, weight, stamp, self._scratch))

    def finished_labels(self, lam: F32, vertices: F32, normals: F32, faces: I32) -> U8:
        """Labels (n,) of a finished mesh from log-probabilities (n, CLASSES), refined by what neighbours agree on.

        A vertex that no image saw takes its class from the seen surface around it, up to ``spread_rings`` edges
        away and not around corners. ``probability`` (n,) is then that of each seen vertex' class, 0 of others.
        """
        label, probability = np.zeros(len(lam), np.uint8), np.zeros(len(lam), np.float32)
        if self.config.refinement:
            weight = self.config.agreement
            lam = agreed(lam, self.active, vertices, normals, faces, self._spacing_m, weight)
        labels_of(lam, self.active, label, probability, self._scratch)
        self.probability = probability
        return spread_labels(label, probability > 0.0, normals, faces, self.config.spread_rings)

    def _rows(self, n: int, scores: DenseScores) -> F32:
        layers = scores.score.shape[2]
        return self._sampled.reshape(-1)[: n * layers].reshape(n, layers)


def slot_layers(scores: DenseScores) -> I32:
    """The layer of each slot, int32 (CLASSES,); -1 where it was not asked for."""
    out = np.full(CLASSES, -1, np.int32)
    for layer, slot in enumerate(scores.slots):
        out[slot] = layer
    return out


def start_blank(lam: F32, voxel_class: F32) -> None:
    """Rows of ``lam`` (n, CLASSES) that are all 0 start from their voxels' sums (n, CLASSES + 1)."""
    rows = np.flatnonzero(~lam.any(axis=1) & (voxel_class[:, WEIGHT] > 0.0))
    attribute = np.zeros(LOG_CLASS + CLASSES, np.float32)
    for row in rows:
        start_from(attribute, voxel_class[row])
        lam[row] = attribute[LOG_CLASS:]


def clear_classes(lam: F32) -> I32:
    """The class each row of ``lam`` (n, CLASSES) clearly has (class_rows.py), int32 (n,); -1 where none."""
    most = lam.max(axis=1)
    second = np.where(lam < most[:, None], lam, -np.inf).max(axis=1)
    clear = np.isfinite(second) & (most - second >= CLEAR_LOG)
    return np.where(clear, lam.argmax(axis=1), -1).astype(np.int32)


def spread_labels(label: U8, known: Bool, normals: F32, faces: I32, rings: int) -> U8:
    """Labels of the vertices that are not ``known``, ring by ring over edges between like normals; of several
    neighbours' classes the most frequent, of equally frequent ones the lowest."""
    label, known = label.copy(), known.copy()
    edges = edges_of(faces)
    edges = np.concatenate((edges, edges[:, ::-1]))
    edges = edges[~known[edges[:, 1]]]
    edges = edges[np.einsum("ij,ij->i", normals[edges[:, 0]], normals[edges[:, 1]]) > _SAME_SURFACE]
    for _ in range(rings):
        ready = known[edges[:, 0]]
        if not ready.any():
            break
        votes = np.bincount(
            edges[ready, 1].astype(np.int64) * CLASSES + label[edges[ready, 0]],
            minlength=len(label) * CLASSES,
        ).reshape(-1, CLASSES)
        reached = votes.any(axis=1)
        label[reached] = votes[reached].argmax(axis=1)
        known |= reached
        edges = edges[~known[edges[:, 1]]]
    return label


def active_slots(names: dict[int, str]) -> U8:
    """Which slots hold a class, uint8 (CLASSES,)."""
    out = np.zeros(CLASSES, np.uint8)
    out[list(names)] = 1
    return out
