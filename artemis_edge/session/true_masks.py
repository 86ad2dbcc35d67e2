"""Masks of a virtual session as a perfect network would give them, and the same spoilt on purpose.

For measuring what the map makes of masks apart from what a network sees. Spoilt: in each image a share of the
objects, drawn independently, gets a random other class, and every mask is dilated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from artemis_drivers.virtual.camera import VirtualCamera, undistort
from artemis_drivers.virtual.scene import cast_at

from artemis_edge.evaluate.semantics import PARTS
from artemis_edge.frames import F64, I32, U8
from artemis_edge.segmentation.backend import FULL_SCORE, DenseScores, Grid
from artemis_edge.session.rig import START_NS, Rig

_SHARE = 2  # a cell of the masks is so many pixels wide: a network's masks are no finer
_SURE = 0.95  # score of the true class; a perfect network is not one that is never wrong


@dataclass(frozen=True, slots=True)
class Spoilt:
    """``wrong`` share 0..1 of an image's objects that get another class; ``dilated_px`` by which masks grow."""

    wrong: float = 0.3
    dilated_px: int = 10
    seed: int = 0


class TrueMasks:
    """Dense scores of the photographs of a virtual session, by their stamp."""

    def __init__(self, rig: Rig, classes: Sequence[str], spoilt: Spoilt | None = None) -> None:
        """``classes`` are asked for in slots 1, 2 ...; others of the world show as background."""
        self.names = tuple(classes)
        self._rig, self._spoilt = rig, spoilt
        self._camera = rig.new_camera()
        names = list(rig.world.class_names)
        self._slot_of = np.zeros(256, np.uint8)
        for slot, name in enumerate(classes, start=1):
            for number, own in enumerate(names):
                if PARTS.get(own, own) == name:
                    self._slot_of[number] = slot

    def at(self, stamp_ns: int) -> DenseScores:
        """Scores of the photograph whose exposure's middle is at ``stamp_ns``."""
        time_s = (stamp_ns - START_NS) * 1e-9
        label, instance = labels_at(self._rig, self._camera, time_s)
        slots = len(self.names) + 1
        mask = self._slot_of[label]
        score = np.zeros((*mask.shape, slots), np.uint8)
        if self._spoilt is None:
            for slot in range(slots):
                score[mask == slot, slot] = round(_SURE * FULL_SCORE)
        else:
            self._spoil(mask, instance, stamp_ns, score)
        # cells are every _SHARE-th pixel
        grid = Grid(1.0 / _SHARE, 1.0 / _SHARE, 0.0, 0.0)
        return DenseScores(tuple(range(slots)), score, grid)

    def _spoil(self, mask: U8, instance: I32, stamp_ns: int, score: U8) -> None:
        """One mask an object, some of another class, all dilated; background is where no mask is."""
        assert self._spoilt is not None
        slots = score.shape[2]
        rng = np.random.default_rng([self._spoilt.seed, stamp_ns % (1 << 31)])
        size = 2 * round(self._spoilt.dilated_px / _SHARE) + 1
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
        sure = round(_SURE * FULL_SCORE)
        numbers, size_px = np.unique(instance[mask > 0], return_counts=True)
        # where grown masks overlap the smaller object is on top, as networks draw them
        for number in numbers[np.argsort(-size_px, kind="stable")]:
            here = (instance == number) & (mask > 0)
            slot = int(np.bincount(mask[here]).argmax())
            if rng.random() < self._spoilt.wrong:
                slot = int(rng.choice([k for k in range(1, slots) if k != slot]))
            grown = cv2.dilate(here.astype(np.uint8), kernel) > 0
            score[grown] = 0
            score[grown, slot] = sure
        score[(score == 0).all(axis=2), 0] = sure


def labels_at(rig: Rig, camera: VirtualCamera, time_s: float) -> tuple[U8, I32]:
    """Class and instance that the exact ray through every ``_SHARE``-th pixel meets, (h, w); 0 and -1: nothing."""
    T_world_cam: F64 = rig.camera_pose(time_s)
    scene = rig.window.at(float(T_world_cam[0, 3]))
    s = camera.spec
    v, u = np.mgrid[0 : s.height : _SHARE, 0 : s.width : _SHARE].astype(np.float64)
    x, y = undistort((u - s.cx) / s.fx, (v - s.cy) / s.fy, s.distortion)
    line = np.stack([x, y, np.ones_like(x)], axis=2).reshape(-1, 3)
    direction = line / np.linalg.norm(line, axis=1, keepdims=True) @ T_world_cam[:3, :3].T
    hits = cast_at(scene, np.tile(T_world_cam[:3, 3], (len(line), 1)), direction, time_s)
    triangle = hits.triangle.reshape(x.shape)
    label = np.where(triangle >= 0, scene.class_id[triangle], np.uint8(0))
    return label, np.where(triangle >= 0, scene.instance[triangle], np.int32(-1))
