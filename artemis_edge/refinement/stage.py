"""The stage of the pipeline that colours the map: images wait until their surface is meshed, then are fused."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from artemis_edge.config import RefinementConfig
from artemis_edge.export.atlas import Atlas
from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import F32, F64, CameraImage, CameraModel, TrackedFrame
from artemis_edge.lens import log_falloff
from artemis_edge.refinement import texels as tx
from artemis_edge.refinement.atlas_builder import build_atlas
from artemis_edge.refinement.colours import exposure_of, little_known, update_vertices
from artemis_edge.refinement.exposure import SHADES, Exposures, undoing
from artemis_edge.refinement.painting import new_brush, paint
from artemis_edge.refinement.photographs import Alternate, Keyframes, Refused, Waiting, arrivals, decode
from artemis_edge.refinement.reliability import PARTS, Trust, new_observations
from artemis_edge.refinement.texel_pages import TexelPages
from artemis_edge.refinement.view import View, Viewer
from artemis_edge.voxel_map import VoxelMap

# Of the voxels in view, that may still wait for their first patch when an image is used
_UNMESHED = 0.1
_EVERYTHING = math.inf  # looks, after which a texel is left as it is
_EVERY_TRIANGLE = 1 << 30
_LEARNT = (4, 8, 16, 32)  # keyframes after which the lenses' fall-off is found
# Texels that the first image is taken to see, many: it must not cost more than the others
_FIRST_IN_VIEW = 1e6
_LITTLE = 4.0  # good observations, below which keyframes are asked again at the end
# Change of a lens's fall-off, in logarithm, from which on colours taken with the old one must give way, and what they
# are worth then, in good observations
_NOTABLE, _GIVE_WAY = 0.05, 0.1


def trust_of(config: RefinementConfig) -> Trust:
    """The configuration's part that kernels take."""
    return Trust(
        config.sigma_photo,
        config.sigma_geom,
        config.least_reliability,
        config.noise * config.noise,
        config.most_information,
        config.forget,
        config.least_cosine,
    )


# How many of how many keyframes have been asked again; whether to go on
GoOn = Callable[[int, int], bool]


def always(done: int, total: int) -> bool:
    """Go on, and tell nobody."""
    return True


class Refinement:
    """Colours vertices and texels with the images of the frames.

    While the map grows an image colours ``share`` x ``most_texels`` texels, of other voxels than the one before; the
    overload control lowers ``share`` (0..1].
    """

    def __init__(
        self, config: RefinementConfig, voxel_map: VoxelMap, budget_bytes: float, folder: Path
    ) -> None:
        self.share = 1.0
        self.refused = Refused()
        self.keyframes = Keyframes(folder, config.keyframes)
        self.texels = tx.allocate(config.texel_share * budget_bytes)
        self.pages = TexelPages(self.texels, folder, budget_bytes)
        self.trust = trust_of(config)
        self.viewer = Viewer(voxel_map.store, voxel_map.config.voxel_m, config.range_m, self.trust)
        self._config, self._map = config, voxel_map
        self._brush = new_brush(voxel_map.config.voxel_m, config.texel_px, config.finest_texel_m)
        self._waiting: deque[Waiting] = deque()
        self._used = Alternate(config.alternate)
        self._looks = 0
        self._in_view = _FIRST_IN_VIEW
        self._exposures = Exposures(config.vignetting)
        self._falloff: dict[str, F64] = {}
        self._models: dict[str, CameraModel] = {}
        self._shades: dict[str, F32] = {}

    def update(self, frame: TrackedFrame, stamp: int) -> None:
        """Take the images of a frame and use those whose turn has come."""
        if self._config.enabled:
            self._waiting.extend(filter(self._used.takes, arrivals(frame, stamp, self.refused)))
        most = max(len(frame.images), 1)  # of those that waited: one frame never pays for many
        while self._waiting and most > 0 and self._is_due(self._waiting[0], stamp):
            waiting = self._waiting.popleft()
            self._fuse(waiting, _EVERYTHING, learn=self.keyframes.offer(waiting))
            most -= 1

    def finish(self, go_on: GoOn = always) -> None:
        """Use all images that wait; then give what was meshed late its colour from the keyframes.

        The latter takes a third of a second a keyframe: ``go_on`` is asked before each.
        """
        unseen = _LITTLE * tx.INFORMATION_SCALE
        before = len(self.keyframes)
        if self._looks == 0:  # a map without colours: all images decide together what its exposure is
            for waiting, gain in zip(self._waiting, self._settle_exposures(), strict=True):
                self._fuse(waiting, _EVERYTHING, gain)
        else:
            for waiting in self._waiting:
                self._fuse(waiting, _EVERYTHING)
        self._waiting.clear()
        for k in range(before):
            if not go_on(k, before):
                self.refused.count["keyframes_not_asked_again"] = before - k
                return
            self._fuse(self.keyframes.get(k), unseen)

    @property
    def exposure(self) -> float:
        """Factor on all colours of the finished map that brings what is brighter than 255 into range."""
        return exposure_of(self._map.store)

    def atlas(self, mesh: Mesh) -> Atlas:
        """The texture of the finished mesh."""
        most = int(self._config.atlas_megatexels * 1e6)
        voxel_m = self._map.config.voxel_m
        return build_atlas(mesh, self.texels, self.pages, voxel_m, most, self.exposure)

    def close(self) -> None:
        """Remove the files of this run."""
        self.pages.close()
        self.keyframes.close()

    @property
    def lost(self) -> Mapping[str, int]:
        """Images and texels that could not be used, by reason."""
        refused = int(self.texels.counter[tx.REFUSED])
        return {**self.refused.count, **({"texels_without_memory": refused} if refused else {})}

    @property
    def falloff(self) -> Mapping[str, F64]:
        """Of each camera whose lens's fall-off was found, its coefficients (``lens.log_falloff``)."""
        return self._falloff

    @property
    def lenses(self) -> Mapping[str, tuple[CameraModel, F64]]:
        """Those cameras with their models."""
        return {name: (self._models[name], a) for name, a in self._falloff.items() if name in self._models}

    def _is_due(self, waiting: Waiting, stamp: int) -> bool:
        age = stamp - waiting.stamp
        if age >= self._config.patience_frames:
            return True
        if age < self._config.wait_frames:
            return False
        return self.viewer.unmeshed_share(waiting.image.model, waiting.T_world_cam) <= _UNMESHED

    def _settle_exposures(self) -> F32:
        """Gains of all images that wait, (n, 3), at one go; and the lenses' fall-off."""
        exposures = Exposures(self._config.vignetting)
        refused = Refused()  # each is counted when it is fused
        for waiting in self._waiting:
            pixels = decode(waiting.image, refused)
            model = waiting.image.model
            seen = new_observations(0)
            if pixels is not None:
                seen = self.viewer.look(pixels, model, waiting.T_world_cam).seen
            exposures.add(waiting.image.name, model, seen)
        if len(exposures) == 0:
            return np.empty((0, 3), np.float32)
        gains, falloff = exposures.solve()
        self._set_falloff(falloff)
        return gains

    def _set_falloff(self, falloff: dict[str, F64]) -> None:
        steps = np.linspace(0.0, 1.0, SHADES)
        change = [log_falloff(a - self._falloff.get(name, 0.0 * a), steps) for name, a in falloff.items()]
        if self._looks > 0 and max(float(np.abs(c).max()) for c in change) > _NOTABLE:
            tx.discount(self.texels, int(_GIVE_WAY * tx.INFORMATION_SCALE))
        self._falloff = falloff
        self._shades = {name: undoing(a) for name, a in falloff.items()}

    def _learn(self, waiting: Waiting, view: View) -> None:
        """Keep what a keyframe says of exposures; from time to time find the lenses' fall-off anew."""
        self._exposures.add(waiting.image.name, waiting.image.model, view.seen)
        if len(self._exposures) in _LEARNT:
            self._set_falloff(self._exposures.falloff())

    def _fuse(self, waiting: Waiting, enough: float, gain: F32 | None = None, learn: bool = False) -> None:
        pixels = decode(waiting.image, self.refused)
        if pixels is None:
            return
        self._looks += 1
        model = self._models[waiting.image.name] = waiting.image.model
        clear = sharpness(waiting.image, waiting.twist)
        learn = learn and self._config.vignetting and len(self._exposures) < _LEARNT[-1]
        # what is learnt must be of the same vertices from image to image
        some = None if gain is not None else 0 if learn else self._looks
        bounded = gain is None and enough == _EVERYTHING
        most = self._config.most_triangles if bounded else _EVERY_TRIANGLE
        view = self.viewer.look(pixels, model, waiting.T_world_cam, clear, some, most)
        if learn:
            self._learn(waiting, view)
        view = self.viewer.weigh(view, gain, self._shades.get(waiting.image.name))
        store, voxel_m = self._map.store, self._map.config.voxel_m
        seen = (
            view.seen
            if enough == _EVERYTHING
            else little_known(store, view.seen, _LITTLE / self.trust.noise2)
        )
        update_vertices(store, seen, model.fx * voxel_m / 4, view.photo.sharpness, self.trust)
        part = self._part() if bounded else PARTS
        painted = paint(
            self.texels,
            view.visible,
            store.vertex,
            view.photo,
            self.trust,
            self._brush,
            self._looks,
            part,
            enough,
        )
        self._in_view = painted * PARTS / part

    def _part(self) -> int:
        """How many of ``PARTS`` of the surface the next image colours, by how much the last one had in view."""
        wanted = self.share * self._used.images * self._config.most_texels / max(self._in_view, 1.0)
        return int(min(max(round(wanted * PARTS), 1), PARTS))


def sharpness(image: CameraImage, twist: F64) -> float:
    """Weight of an image by its motion blur, 0..1: one over the squared length of the smear in pixels.

    A pixel that mixes n pixels in a row tells as much as 1 / n of one, and what it tells is displaced as well; the
    turn rate of the body counts, since nearby things smear most by turning. Unknown exposure: no blur.
    """
    smear_px = float(np.linalg.norm(twist[3:])) * max(image.exposure_s, 0.0) * image.model.fx
    return 1.0 / max(smear_px, 1.0) ** 2
