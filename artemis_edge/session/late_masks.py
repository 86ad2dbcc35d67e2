"""Masks that come as messages of a session: the segmentation of a live run, and of its replay.

The network works beside the mapping, on whatever photograph is newest. Its mask is sent and recorded like what a
device measures, and is fused in the first frame after it came. So a replay fuses the same masks in the same frames.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from artemis_edge.frames import CameraImage
from artemis_edge.segmentation.backend import BACKGROUND, MOST_SLOTS, DenseScores, Grid, Prompt
from artemis_edge.segmentation.live import current_layers
from artemis_edge.semantic_map import LateMask
from artemis_edge.session.asked import Asked
from artemis_edge.session.messages import Header, Mask
from artemis_edge.sight import Sight, without_depth

_RECENT = 40  # views of a camera whose depth map is kept: some seconds
_PATIENCE = 30  # frames that a mask waits for the frame of its image
_MOST_A_FRAME = 2  # are fused: no frame waits for a network that looks back fast
_DEFLATE = 1  # masks are mostly one value: the fastest level makes them a tenth
_MOST_CELLS = 1 << 24
Key = tuple[str, int]  # camera, stamp


@dataclass(slots=True)
class _Waiting:
    """``turns`` frames since it came."""

    key: Key
    prompts: tuple[Prompt, ...]
    scores: DenseScores
    turns: int = 0


class LateMasks:
    """Where the pipeline gets masks from. ``lost`` counts those that were of no use, by reason."""

    def __init__(self) -> None:
        self.asked: Asked | None = None
        self.lost: Counter[str] = Counter()
        self.fused = 0
        self._recent: dict[str, list[int]] = {}
        self._views: dict[Key, Sight] = {}
        self._waiting: list[_Waiting] = []

    @property
    def names(self) -> Sequence[str]:
        """None to begin with: questions come as messages, too."""
        return ()

    def take(self, message: Mask) -> None:
        """A mask; one that is none is counted."""
        try:
            prompts, scores = unpack(message)
        except ValueError:
            self.lost["masks_undecodable"] += 1
            return
        self._waiting.append(_Waiting((message.header.frame_id, message.header.stamp_ns), prompts, scores))

    def offer(self, image: CameraImage, look: Callable[[], Sight]) -> None:
        """The view of an image of the frame; of older images the view without its depth map is kept."""
        self._views[image.name, image.stamp_ns] = look()  # any image may get a mask
        recent = self._recent.setdefault(image.name, [])
        recent.append(image.stamp_ns)
        if len(recent) > _RECENT:
            old = image.name, recent.pop(0)
            self._views[old] = without_depth(self._views[old])

    def ready(self) -> list[LateMask]:
        """Masks whose image has been seen, in the order in which they came."""
        return self._take(last=False)

    def drain(self) -> list[LateMask]:
        """All that can be used still."""
        return self._take(last=True)

    def _take(self, last: bool) -> list[LateMask]:
        out: list[LateMask] = []
        left: list[_Waiting] = []
        for mask in self._waiting:
            sight = self._views.get(mask.key)
            mask.turns += 1
            if sight is not None and not last and len(out) >= _MOST_A_FRAME:
                left.append(mask)
            elif sight is not None:
                out += self._current(mask, sight)
            elif last or mask.turns > _PATIENCE:
                self.lost["masks_without_frame"] += 1
            else:
                left.append(mask)
        self._waiting = left
        self.fused += len(out)
        return out

    def _current(self, mask: _Waiting, sight: Sight) -> list[LateMask]:
        """The mask without what nobody asks for any more; nothing where nothing is left."""
        if self.asked is None:
            return []
        scores = current_layers(mask.scores, mask.prompts, self.asked.is_current)
        return [LateMask(sight, scores)] if len(scores.slots) > 1 else []


def pack(camera: str, stamp_ns: int, prompts: Sequence[Prompt], scores: DenseScores) -> Mask:
    """The message of a mask."""
    height, width, _ = scores.score.shape
    text = {prompt.slot: prompt.text for prompt in prompts}
    grid = scores.grid
    return Mask(
        Header(stamp_ns, camera),
        np.array(scores.slots, np.uint8),
        tuple(text.get(slot, "") for slot in scores.slots),
        height,
        width,
        np.array([grid.scale_x, grid.scale_y, grid.offset_x, grid.offset_y]),
        zlib.compress(np.ascontiguousarray(scores.score).tobytes(), _DEFLATE),
    )


def unpack(message: Mask) -> tuple[tuple[Prompt, ...], DenseScores]:
    """What was asked and what was seen; ValueError where the message is no mask."""
    slots = tuple(int(slot) for slot in message.slot)
    cells = message.height * message.width * len(slots)
    if slots[:1] != (BACKGROUND,) or max(slots) > MOST_SLOTS or len(set(slots)) < len(slots):
        raise ValueError("the slots of a mask are background and others up to 15")
    if len(message.text) != len(slots) or not 0 < cells <= _MOST_CELLS or not np.isfinite(message.grid).all():
        raise ValueError("the sizes of a mask do not fit")
    try:
        data = zlib.decompressobj().decompress(message.score, cells + 1)
    except zlib.error as error:
        raise ValueError(str(error)) from None
    if len(data) != cells:
        raise ValueError(f"a mask has {len(data)} of {cells} scores")
    score = np.frombuffer(data, np.uint8).reshape(message.height, message.width, len(slots)).copy()
    prompts = tuple(Prompt(slot, text) for slot, text in zip(slots, message.text, strict=True) if slot)
    return prompts, DenseScores(slots, score, Grid(*(float(v) for v in message.grid)))
