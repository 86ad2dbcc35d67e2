"""Backend ``fastsam-clip``: FastSAM cuts out everything, CLIP says how well each cut-out fits the words.

p(query | region) is a softmax over the query and decoys (other things that it could be), region by region. It is
not a softmax over regions: where none fits better than the decoys, nothing is found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from artemis_edge.frames import F32, U8
from artemis_edge.segmentation import yolo
from artemis_edge.segmentation.backend import Instance, Prompt, Segmentation, Status, Support
from artemis_edge.segmentation.clip import ImageEncoder, TextFeatures, region
from artemis_edge.segmentation.letterbox import Letterbox
from artemis_edge.segmentation.manifest import Manifest
from artemis_edge.segmentation.network import Network
from artemis_edge.segmentation.words import vocabulary
from artemis_edge.segmentation.yolo_seg import PAD, Thresholds, assemble, input_sizes, instances

# FastSAM's own choices for its everything mode; 32 regions bound the time that CLIP takes.
_REGIONS = Thresholds(score=0.4, overlap=0.9, most=32)
_SHARPNESS = 100.0  # exp of CLIP's learnt temperature
_ANYTHING = Prompt(0, "object")
DECOYS = (
    "wall", "ground", "road", "grass", "sky", "tree", "building", "person", "car", "bench", "bicycle", "sign",
    "pole", "fence", "window", "door", "chair", "table", "bag", "box", "shadow", "background texture",
)  # fmt: skip


def decoys(word: str) -> list[str]:
    """Things that a region could be instead of ``word``: nothing that the word covers or is covered by."""
    words = vocabulary()
    related = {word, *words.narrower(word), *words.broader(word)}
    return [name for name in DECOYS if name not in related]


def fit(regions: F32, texts: TextFeatures, word: str, rivals: Sequence[str]) -> F32:
    """p(word | region) for unit vectors (n, d) of regions: softmax of the word against decoys and rivals."""
    against = list(dict.fromkeys([word, *decoys(word), *rivals]))
    logits = _SHARPNESS * regions @ texts.features(against).T
    weight = np.exp(logits - logits.max(axis=1, keepdims=True))
    return np.asarray(weight[:, 0] / weight.sum(axis=1), np.float32)


class FastSamClip:
    """Looks for any words. One region may fit several prompts; each prompt keeps its own probability."""

    classes: tuple[str, ...] = ()

    def __init__(
        self,
        network: Network,
        manifest: Manifest,
        thresholds: Thresholds,
        images: ImageEncoder,
        texts: TextFeatures,
    ) -> None:
        self.name = manifest.name
        self._network = network
        self._manifest = manifest
        self._thresholds = thresholds
        self._images = images
        self._texts = texts

    def support(self, text: str) -> Support:
        """Any text is supported."""
        if self._texts.knows(text):
            return Support(Status.MATCHED)
        return Support(Status.UNSUPPORTED, f"the model {self.name} has no vector for '{text}'")

    def segment(self, image: U8, prompts: Sequence[Prompt]) -> Segmentation:
        """Regions of the image that fit the prompts; see :class:`Backend`."""
        sizes, fixed = input_sizes(self._network, self._manifest, image.shape)
        box = Letterbox.fit(image.shape[:2], sizes[-1], fixed, self._manifest.stride, centred=True)
        outputs = self._network.run(box.fill(image, PAD, self._manifest.mean, self._manifest.std))
        yolo.check_classes(outputs, 1, self.name)
        raw, protos = yolo.candidates(outputs, [0], _REGIONS.score)
        kept = yolo.suppress(raw, _REGIONS.overlap, _REGIONS.most)
        regions = instances(kept, protos, box, [_ANYTHING], [_ANYTHING.text])
        support = [self.support(prompt.text) for prompt in prompts]
        known = [p for p, s in zip(prompts, support, strict=True) if s.status is not Status.UNSUPPORTED]
        found = self._fitting(image, regions, known)
        return assemble(box, protos.shape[1:], prompts, support, found)

    def _fitting(self, image: U8, regions: Sequence[Instance], prompts: Sequence[Prompt]) -> list[Instance]:
        cuts = [(found, cut) for found in regions if (cut := cut_out(image, found)) is not None]
        if not cuts or not prompts:
            return []
        vectors = self._images.features([cut for _, cut in cuts])
        out = []
        for prompt in prompts:
            rivals = [p.text for p in prompts if p.text not in vocabulary().narrower(prompt.text)]
            likely = fit(vectors, self._texts, prompt.text, rivals)
            for k in np.flatnonzero(likely >= self._thresholds.score):
                found = cuts[k][0]
                p = float(likely[k])
                out.append(
                    replace(found, slot=prompt.slot, text=prompt.text, label=prompt.text, probability=p)
                )
        return sorted(out, key=lambda found: -found.probability)[: self._thresholds.most]


def cut_out(image: U8, found: Instance) -> U8 | None:
    """The square that CLIP is shown of an instance; None where its box covers no pixel."""
    height, width = image.shape[:2]
    x0, y0 = int(found.box[0]), int(found.box[1])
    x1, y1 = min(int(np.ceil(found.box[2])), width), min(int(np.ceil(found.box[3])), height)
    if x1 <= x0 or y1 <= y0:
        return None
    grid = found.grid
    here = replace(
        grid,
        offset_x=grid.offset_x + grid.scale_x * x0,
        offset_y=grid.offset_y + grid.scale_y * y0,
    )
    mask = np.asarray(here.at_pixels(found.mask, x1 - x0, y1 - y0), np.float32)
    return region(image, mask, (x0, y0, x1, y1))
