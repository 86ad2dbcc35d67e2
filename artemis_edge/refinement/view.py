"""One photograph as the map sees it: what it shows, how deep, and how reliably. Shared by texture and semantics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from artemis_edge.block_store import Store
from artemis_edge.frames import F32, F64, U8, CameraModel
from artemis_edge.lens import corner_radius2
from artemis_edge.refinement.camera import Camera, make_camera, view_bounds
from artemis_edge.refinement.colours import estimate_gain
from artemis_edge.refinement.exposure import SHADES
from artemis_edge.refinement.reliability import (
    PARTS,
    Observations,
    Photo,
    Trust,
    clearly_behind,
    observe,
    weigh,
)
from artemis_edge.refinement.visible import Scope, Visible, list_visible, new_visible, unmeshed

_ONES = np.ones(SHADES, np.float32)
_ENOUGH = 8000  # vertices: many times what an image's exposure needs
_ALL = 1 << 30
_DEPTH_WIDTH = 320  # pixels of the reference depth map, about: finer ones lose nothing that matters


@dataclass(frozen=True, slots=True)
class View:
    """``visible`` lists vertices and triangles in the frustum (scratch: valid until the next view), ``photo`` holds
    image, camera and reference depth map, ``seen`` the observations of vertices with their W.
    """

    visible: Visible
    photo: Photo
    seen: Observations


class Viewer:
    """Makes views of a map. Keeps the scratch memory and what each camera model needs once."""

    def __init__(self, store: Store, voxel_m: float, far_m: float, trust: Trust) -> None:
        self._store, self._voxel_m, self._far_m, self.trust = store, voxel_m, far_m, trust
        self._visible = new_visible(store)
        self._bounds: dict[CameraModel, tuple[float, float, float, float, float]] = {}

    def unmeshed_share(self, model: CameraModel, T_world_cam: F64) -> float:
        """Share of the voxels in view that wait for their first patch; 1 where no voxel is in view."""
        camera = self._camera(model, T_world_cam)
        return float(unmeshed(self._store, camera, self._voxel_m, self._far_m))

    def look(
        self,
        image: U8,
        model: CameraModel,
        T_world_cam: F64,
        sharpness: float = 1.0,
        stamp: int | None = None,
        most: int = _ALL,
    ) -> View:
        """View of ``image`` uint8 (h, w, 3) RGB taken at ``T_world_cam`` (4, 4) with the map as it is now.

        With a ``stamp`` about ``_ENOUGH`` of the vertices that have a colour are observed, others with another one.
        Of more than ``most`` triangles the nearest are looked at.
        """
        camera = self._camera(model, T_world_cam)
        step = max(round(model.width / _DEPTH_WIDTH), 1)
        scope = Scope(self._voxel_m, self._far_m, step, clearly_behind(self.trust), most)
        self._visible, depth = list_visible(self._store, camera, scope, self._visible)
        photo = Photo(camera, image, depth, _ONES[:3], _ONES, 1.0 / corner_radius2(model), sharpness)
        share = PARTS
        if stamp is not None:
            share = max(min(PARTS * _ENOUGH // max(int(self._visible.length[0]), 1), PARTS), 1)
        seen = observe(self._store, self._visible, photo, self.trust, share, stamp or 0)
        return View(self._visible, photo, seen)

    def weigh(self, view: View, gain: F32 | None = None, shade: F32 | None = None) -> View:
        """Bring the image to the map's exposure and fill W (eq. 9).

        ``gain`` (3,) is estimated from the map where it is not given; ``shade`` is a table of ``exposure.SHADES``.
        """
        photo = view.photo
        if shade is not None:
            photo = photo._replace(shade=shade)
        photo = photo._replace(
            gain=estimate_gain(self._store, view.seen, photo, self.trust) if gain is None else gain
        )
        weigh(self._store, view.seen, photo, self.trust)
        return View(view.visible, photo, view.seen)

    def _camera(self, model: CameraModel, T_world_cam: F64) -> Camera:
        if model not in self._bounds:
            self._bounds[model] = view_bounds(model)
        return make_camera(model, T_world_cam, self._bounds[model])
