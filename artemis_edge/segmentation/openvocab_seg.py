"""Backend ``openvocab-seg``: the YOLO segmentation family with the vectors of the words as a second input.

Inputs: an image [1, 3, H, W] and text features [1, K, d] or [K, d]; outputs as of yolo.py with K classes. K may be
fixed: unused rows are zero.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import F32, U8
from artemis_edge.segmentation import yolo
from artemis_edge.segmentation.backend import Prompt, Segmentation, Status, Support
from artemis_edge.segmentation.clip import TextFeatures
from artemis_edge.segmentation.letterbox import Letterbox
from artemis_edge.segmentation.manifest import Manifest
from artemis_edge.segmentation.network import Network
from artemis_edge.segmentation.yolo_seg import PAD, Thresholds, assemble, input_sizes, instances


class OpenVocabulary:
    """Looks for any words that have a vector."""

    def __init__(
        self, network: Network, manifest: Manifest, thresholds: Thresholds, texts: TextFeatures
    ) -> None:
        self.name = manifest.name
        self.classes = manifest.classes
        self._network = network
        self._manifest = manifest
        self._thresholds = thresholds
        self._texts = texts
        self._shape = list(network.inputs.values())[1]

    def support(self, text: str) -> Support:
        """Whether the word has a vector."""
        if self._texts.knows(text):
            return Support(Status.MATCHED)
        return Support(Status.UNSUPPORTED, f"the model {self.name} has no vector for '{text}'")

    def segment(self, image: U8, prompts: Sequence[Prompt]) -> Segmentation:
        """Instances of the prompts by the network; see :class:`Backend`."""
        sizes, fixed = input_sizes(self._network, self._manifest, image.shape)
        box = Letterbox.fit(image.shape[:2], sizes[-1], fixed, self._manifest.stride, centred=True)
        support = [self.support(prompt.text) for prompt in prompts]
        known = [p for p, s in zip(prompts, support, strict=True) if s.status is not Status.UNSUPPORTED]
        filled = box.fill(image, PAD, self._manifest.mean, self._manifest.std)
        rows = self._rows([prompt.text for prompt in known])
        outputs = self._network.run(filled, rows)
        yolo.check_classes(outputs, rows.shape[-2], self.name)
        limits = self._thresholds
        raw, protos = yolo.candidates(outputs, range(len(known)), limits.score)
        kept = yolo.suppress(raw, limits.overlap, limits.most)
        labels = [prompt.text for prompt in known]
        return assemble(box, protos.shape[1:], prompts, support, instances(kept, protos, box, known, labels))

    def _rows(self, words: Sequence[str]) -> F32:
        """The second input for these words."""
        count, width = self._shape[-2:]
        vectors = self._texts.features(words) if words else np.zeros((0, width or 1), np.float32)
        if width is not None and vectors.shape[1] != width:
            raise InputError(
                f"{self._network.file} takes vectors of {width} numbers, those of the text have {vectors.shape[1]}"
            )
        if count is not None and len(words) > count:
            raise InputError(f"{self._network.file} takes {count} words at once, {len(words)} were asked for")
        rows = np.zeros((count or max(len(words), 1), vectors.shape[1]), np.float32)
        rows[: len(words)] = vectors
        return rows[None] if len(self._shape) == 3 else rows
